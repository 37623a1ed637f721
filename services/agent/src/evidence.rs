//! What registration needs of an anchor: made from a frame, named by its content, read back by a peer.

use bytes::Bytes;
use coma_depth_codec::Settings as DepthSettings;
use coma_frame::{Image, RgbdFrame, pyramid};
use coma_geometry::Intrinsics;
use coma_registration::View;
use coma_slam::log::Evidence;
use coma_wire::{EvidenceBlob, FieldError, decode_evidence, encode_evidence};
use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, ImageEncoder, ImageFormat};

/// Widest image that is sent in full, pixels; registration works at this size.
const FULL_WIDTH: u32 = 320;

/// The two sizes of an anchor's evidence.
pub struct AnchorEvidence {
    /// Quarter resolution of `full`'s sides.
    pub coarse: (Evidence, Bytes),
    /// Full working resolution.
    pub full: (Evidence, Bytes),
}

/// Compresses an anchor: depth in steps that follow the sensor's noise, intensity as a small JPEG.
pub fn from_frame(frame: &RgbdFrame) -> anyhow::Result<AnchorEvidence> {
    let mut level =
        Level { camera: frame.camera, depth_m: frame.depth_m.clone(), intensity: frame.color.luminance() };
    while level.camera.width > FULL_WIDTH {
        level = level.halved();
    }
    let full = level.encode(frame)?;
    let coarse = level.halved().halved().encode(frame)?;
    Ok(AnchorEvidence { coarse, full })
}

struct Level {
    camera: Intrinsics,
    depth_m: Image<f32>,
    intensity: Image<f32>,
}

impl Level {
    fn halved(&self) -> Level {
        Level {
            camera: self.camera.halved(),
            depth_m: pyramid::halve_depth(&self.depth_m, 0.05),
            intensity: pyramid::halve(&self.intensity),
        }
    }

    fn encode(&self, frame: &RgbdFrame) -> anyhow::Result<(Evidence, Bytes)> {
        let settings = DepthSettings::default();
        let depth = coma_depth_codec::encode(&self.depth_m, &settings)?;
        let grey: Vec<u8> = self.intensity.pixels().iter().map(|v| (v * 255.0 + 0.5) as u8).collect();
        let mut intensity = Vec::new();
        JpegEncoder::new_with_quality(&mut intensity, 80).write_image(
            &grey,
            self.camera.width,
            self.camera.height,
            ExtendedColorType::L8,
        )?;
        Ok(encode_evidence(&EvidenceBlob {
            camera: self.camera,
            depth_noise: frame.noise,
            depth: depth.into(),
            intensity: intensity.into(),
        }))
    }
}

/// Checks a blob against its name and decodes it for registration.
pub fn to_view(name: &Evidence, blob: Bytes) -> Result<View, FieldError> {
    let blob = decode_evidence(name, blob)?;
    let camera = blob.camera;
    let limits = coma_depth_codec::Limits { max_pixels: camera.pixels() };
    let decoded = coma_depth_codec::decode(&blob.depth, limits)
        .map_err(|e| FieldError::new("blob.depth", e.to_string()))?;
    if decoded.depth_m.width() != camera.width as usize || decoded.depth_m.height() != camera.height as usize
    {
        return Err(FieldError::new("blob.depth", "has another size than its camera"));
    }
    let picture = crate::decode::picture(
        &blob.intensity,
        ImageFormat::Jpeg,
        camera.width,
        camera.height,
        "blob.intensity",
    )?;
    let grey = picture.into_luma8().into_raw().into_iter().map(|v| v as f32 / 255.0).collect();
    let intensity = Image::from_pixels(camera.width as usize, camera.height as usize, grey)
        .ok_or_else(|| FieldError::new("blob.intensity", "has another size than its camera"))?;
    Ok(View { depth_m: decoded.depth_m, intensity, camera, noise: blob.depth_noise })
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_frame::DepthNoise;
    use coma_geometry::StampNs;

    #[test]
    fn evidence_comes_back_within_the_sensor_s_noise() {
        let camera = Intrinsics { width: 640, height: 480, fx: 525.0, fy: 525.0, cx: 319.5, cy: 239.5 };
        let color = Image::from_fn(640, 480, |x, y| [(x / 3) as u8, (y / 2) as u8, 128]);
        let depth = Image::from_fn(640, 480, |x, y| 1.0 + 0.001 * x as f32 + 0.002 * y as f32);
        let noise = DepthNoise::default();
        let frame = RgbdFrame::new(0, StampNs(0), camera, noise, color, depth).unwrap();
        let made = from_frame(&frame).unwrap();
        let view = to_view(&made.full.0, made.full.1.clone()).unwrap();
        assert_eq!((view.camera.width, view.depth_m.width()), (320, 320));
        // The mean of the 2x2 block at (100, 100).
        let truth = 1.0 + 0.001 * 200.5 + 0.002 * 200.5;
        assert!((view.depth_m[(100, 100)] - truth).abs() < noise.sigma_m(truth));
        assert!(made.coarse.0.size_bytes * 4 < made.full.0.size_bytes);
        assert!(to_view(&made.coarse.0, made.full.1).is_err(), "another blob's bytes");
    }
}
