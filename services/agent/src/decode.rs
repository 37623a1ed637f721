//! Encoded frames become frames: images decoded within limits, depth scaled and registered, lenses undone.

use coma_frame::{FrameError, Image, RgbdFrame, ingest};
use coma_geometry::Pose;
use coma_wire::{Calibration, ColorData, DepthData, EncodedFrame, FieldError};
use image::{DynamicImage, ImageFormat, ImageReader, Limits};
use std::io::Cursor;

/// Decodes a frame; what is wrong is said with the field's path.
pub fn decode(encoded: &EncodedFrame, calibration: &Calibration) -> Result<RgbdFrame, FieldError> {
    let color = decode_color(&encoded.color, calibration)?;
    let depth = decode_depth(&encoded.depth, calibration)?;
    let color = ingest::undistort_color(&color, &calibration.color, &calibration.color_distortion);
    let own_camera = calibration.depth.is_some() || calibration.color_from_depth != Pose::identity();
    let depth = if own_camera {
        ingest::register_depth_to_color(
            &depth,
            calibration.depth_camera(),
            &calibration.depth_distortion,
            &calibration.color,
            &calibration.color_from_depth,
        )
    } else {
        ingest::undistort_depth(&depth, &calibration.color, &calibration.color_distortion)
    };
    RgbdFrame::new(encoded.sequence, encoded.stamp, calibration.color, calibration.depth_noise, color, depth)
        .map_err(|error| match &error {
            FrameError::Size { field, .. } => FieldError::new(format!("frame.{field}"), error.to_string()),
        })
}

/// Decodes JPEG, PNG or raw colour of the camera's size.
pub fn decode_color(data: &ColorData, calibration: &Calibration) -> Result<Image<[u8; 3]>, FieldError> {
    let (width, height) = (calibration.color.width, calibration.color.height);
    let bytes = match data {
        ColorData::Rgb8(bytes) => bytes.to_vec(),
        ColorData::Jpeg(bytes) => {
            picture(bytes, ImageFormat::Jpeg, width, height, "frame.color")?.into_rgb8().into_raw()
        }
        ColorData::Png(bytes) => {
            picture(bytes, ImageFormat::Png, width, height, "frame.color")?.into_rgb8().into_raw()
        }
    };
    let pixels = bytes.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect();
    Image::from_pixels(width as usize, height as usize, pixels)
        .ok_or_else(|| FieldError::new("frame.color", format!("is not {width}x{height} RGB pixels")))
}

fn decode_depth(data: &DepthData, calibration: &Calibration) -> Result<Image<f32>, FieldError> {
    let camera = calibration.depth_camera();
    let (width, height) = (camera.width, camera.height);
    let refuse = |message: String| FieldError::new("frame.depth", message);
    let metres = |raw: u16| raw as f32 / calibration.depth_units_per_metre as f32;
    let depth = match data {
        DepthData::Raw16(bytes) => {
            bytes.chunks_exact(2).map(|b| metres(u16::from_le_bytes([b[0], b[1]]))).collect()
        }
        DepthData::Png16(bytes) => match picture(bytes, ImageFormat::Png, width, height, "frame.depth")? {
            DynamicImage::ImageLuma16(image) => image.into_raw().into_iter().map(metres).collect(),
            other => return Err(refuse(format!("is a {:?} PNG, 16-bit grey is needed", other.color()))),
        },
        DepthData::Coma(bytes) => {
            let limits = coma_depth_codec::Limits { max_pixels: camera.pixels() };
            let decoded = coma_depth_codec::decode(bytes, limits).map_err(|e| refuse(e.to_string()))?;
            if decoded.depth_m.width() != width as usize || decoded.depth_m.height() != height as usize {
                let (w, h) = (decoded.depth_m.width(), decoded.depth_m.height());
                return Err(refuse(format!("is {w}x{h}, the calibration says {width}x{height}")));
            }
            decoded.depth_m.into_pixels()
        }
    };
    let (min, max) =
        (calibration.depth_min_m as f32, calibration.depth_max_m.map_or(f32::INFINITY, |m| m as f32));
    let depth = depth.into_iter().map(|z: f32| if z >= min && z <= max { z } else { 0.0 }).collect();
    Image::from_pixels(width as usize, height as usize, depth)
        .ok_or_else(|| refuse(format!("is not {width}x{height} pixels")))
}

/// Decodes a compressed image that must have the given size; a header that claims more allocates nothing.
pub fn picture(
    bytes: &[u8],
    format: ImageFormat,
    width: u32,
    height: u32,
    field: &str,
) -> Result<DynamicImage, FieldError> {
    let refuse = |message: String| FieldError::new(field, message);
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    let mut limits = Limits::default();
    limits.max_image_width = Some(width);
    limits.max_image_height = Some(height);
    limits.max_alloc = Some(width as u64 * height as u64 * 16 + (1 << 20));
    reader.limits(limits);
    let image = reader.decode().map_err(|e| refuse(format!("cannot be decoded as {format:?}: {e}")))?;
    if image.width() != width || image.height() != height {
        let (w, h) = (image.width(), image.height());
        return Err(refuse(format!("is {w}x{h}, the calibration says {width}x{height}")));
    }
    Ok(image)
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytes::Bytes;
    use coma_geometry::{Intrinsics, StampNs};

    fn calibration() -> Calibration {
        let color = Intrinsics { width: 16, height: 12, fx: 14.0, fy: 14.0, cx: 7.5, cy: 5.5 };
        Calibration::registered(color, 1000.0)
    }

    fn png(width: u32, height: u32) -> Bytes {
        let mut out = Cursor::new(Vec::new());
        DynamicImage::new_rgb8(width, height).write_to(&mut out, ImageFormat::Png).unwrap();
        out.into_inner().into()
    }

    fn frame(color: ColorData) -> EncodedFrame {
        let depth: Vec<u8> = (0..192u16).flat_map(|i| (i * 10).to_le_bytes()).collect();
        EncodedFrame { sequence: 1, stamp: StampNs(5), color, depth: DepthData::Raw16(depth.into()) }
    }

    #[test]
    fn raw_depth_is_scaled_to_metres_and_zero_stays_zero() {
        let frame = decode(&frame(ColorData::Png(png(16, 12))), &calibration()).unwrap();
        assert_eq!(frame.depth_m[(0, 0)], 0.0);
        assert_eq!(frame.depth_m[(15, 11)], 1.91);
    }

    #[test]
    fn truncated_and_wrong_pictures_are_refused_by_field() {
        let refused = |color| decode(&frame(color), &calibration()).unwrap_err();
        let whole = png(16, 12);
        let cut = refused(ColorData::Png(whole.slice(..whole.len() / 2)));
        assert_eq!(cut.field, "frame.color");
        let jpeg = refused(ColorData::Jpeg(Bytes::from_static(&[0xff, 0xd8, 0xff, 0xe0, 0, 1])));
        assert_eq!(jpeg.field, "frame.color");
        let other = refused(ColorData::Png(png(8, 12)));
        assert!(other.message.contains("8x12"), "{}", other.message);
        assert!(refused(ColorData::Png(png(2000, 12))).field == "frame.color");
    }
}
