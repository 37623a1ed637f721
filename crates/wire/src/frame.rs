//! Frames as they come: encodings named, images still encoded, without a copy.

use crate::Calibration;
use crate::field::{At, FieldError};
use crate::v1;
use bytes::Bytes;
use coma_geometry::{Intrinsics, StampNs};

/// An encoded colour image.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ColorData {
    /// JPEG.
    Jpeg(Bytes),
    /// PNG.
    Png(Bytes),
    /// `[height, width, 3]`, sRGB.
    Rgb8(Bytes),
}

/// An encoded depth image.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DepthData {
    /// PNG, one 16-bit channel.
    Png16(Bytes),
    /// `[height, width]`, little-endian.
    Raw16(Bytes),
    /// CoMA's depth codec.
    Coma(Bytes),
}

/// A frame whose encodings are known and whose raw images have the calibration's size. Compressed
/// images are still to be decoded.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EncodedFrame {
    /// Strictly increasing within a session.
    pub sequence: u64,
    /// Sensor clock.
    pub stamp: StampNs,
    /// Colour.
    pub color: ColorData,
    /// Depth.
    pub depth: DepthData,
}

/// Reads a colour image of the camera's size.
pub fn read_color(
    encoding: i32,
    data: Bytes,
    camera: &Intrinsics,
    at: &At<'_>,
) -> Result<ColorData, FieldError> {
    let bytes = at.field("color");
    if data.is_empty() {
        return Err(bytes.refuse("is empty"));
    }
    match v1::ColorEncoding::try_from(encoding) {
        Ok(v1::ColorEncoding::Jpeg) => Ok(ColorData::Jpeg(data)),
        Ok(v1::ColorEncoding::Png) => Ok(ColorData::Png(data)),
        Ok(v1::ColorEncoding::Rgb8) => {
            raw_size(&data, camera, 3, &bytes)?;
            Ok(ColorData::Rgb8(data))
        }
        Ok(v1::ColorEncoding::Unspecified) => Err(at.field("color_encoding").refuse("is missing")),
        Err(_) => Err(at.field("color_encoding").refuse(format!("{encoding} is unknown"))),
    }
}

fn raw_size(data: &Bytes, camera: &Intrinsics, bytes: usize, at: &At<'_>) -> Result<(), FieldError> {
    let needed = camera.pixels() * bytes;
    if data.len() == needed {
        return Ok(());
    }
    let Intrinsics { width, height, .. } = camera;
    Err(at.refuse(format!("{} bytes, {width}x{height} pixels are {needed} bytes", data.len())))
}

impl EncodedFrame {
    /// Checks a frame against its session's calibration.
    pub fn from_wire(m: v1::Frame, calibration: &Calibration, at: &At<'_>) -> Result<Self, FieldError> {
        if m.camera_id != calibration.camera_id {
            let message = format!("{} is not the calibrated camera {}", m.camera_id, calibration.camera_id);
            return Err(at.field("camera_id").refuse(message));
        }
        let color = read_color(m.color_encoding, m.color, &calibration.color, at)?;
        let bytes = at.field("depth");
        if m.depth.is_empty() {
            return Err(bytes.refuse("is empty"));
        }
        let depth = match v1::DepthEncoding::try_from(m.depth_encoding) {
            Ok(v1::DepthEncoding::Png16) => DepthData::Png16(m.depth),
            Ok(v1::DepthEncoding::Raw16) => {
                raw_size(&m.depth, calibration.depth_camera(), 2, &bytes)?;
                DepthData::Raw16(m.depth)
            }
            Ok(v1::DepthEncoding::Coma) => DepthData::Coma(m.depth),
            Ok(v1::DepthEncoding::Unspecified) => {
                return Err(at.field("depth_encoding").refuse("is missing"));
            }
            Err(_) => {
                return Err(at.field("depth_encoding").refuse(format!("{} is unknown", m.depth_encoding)));
            }
        };
        Ok(EncodedFrame { sequence: m.sequence, stamp: StampNs(m.stamp_ns), color, depth })
    }
}

/// The message of a frame.
pub fn encode_frame(frame: EncodedFrame) -> v1::Frame {
    let (color_encoding, color) = match frame.color {
        ColorData::Jpeg(data) => (v1::ColorEncoding::Jpeg, data),
        ColorData::Png(data) => (v1::ColorEncoding::Png, data),
        ColorData::Rgb8(data) => (v1::ColorEncoding::Rgb8, data),
    };
    let (depth_encoding, depth) = match frame.depth {
        DepthData::Png16(data) => (v1::DepthEncoding::Png16, data),
        DepthData::Raw16(data) => (v1::DepthEncoding::Raw16, data),
        DepthData::Coma(data) => (v1::DepthEncoding::Coma, data),
    };
    v1::Frame {
        sequence: frame.sequence,
        stamp_ns: frame.stamp.0,
        camera_id: 0,
        color_encoding: color_encoding.into(),
        color,
        depth_encoding: depth_encoding.into(),
        depth,
    }
}

/// A session's id: 1 to 64 characters of a-z, 0-9 and '-'.
pub fn session_id(text: &str, at: &At<'_>) -> Result<String, FieldError> {
    let allowed = |c: u8| c.is_ascii_lowercase() || c.is_ascii_digit() || c == b'-';
    if (1..=64).contains(&text.len()) && text.bytes().all(allowed) {
        Ok(text.to_owned())
    } else {
        let shown: String = text.chars().take(80).collect();
        Err(at.refuse(format!("{shown:?} is not 1 to 64 characters of a-z, 0-9 and '-'")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Intrinsics = Intrinsics { width: 8, height: 8, fx: 8.0, fy: 8.0, cx: 3.5, cy: 3.5 };

    fn frame() -> EncodedFrame {
        EncodedFrame {
            sequence: 3,
            stamp: StampNs(-5),
            color: ColorData::Rgb8(vec![0; 192].into()),
            depth: DepthData::Raw16(vec![0; 128].into()),
        }
    }

    #[test]
    fn a_frame_survives_the_wire() {
        let calibration = Calibration::registered(CAMERA, 1000.0);
        let read = EncodedFrame::from_wire(encode_frame(frame()), &calibration, &At::Root("frame"));
        assert_eq!(read.unwrap(), frame());
    }

    #[test]
    fn wrong_images_are_refused_by_field() {
        let calibration = Calibration::registered(CAMERA, 1000.0);
        let refused = |change: &dyn Fn(&mut v1::Frame)| {
            let mut message = encode_frame(frame());
            change(&mut message);
            EncodedFrame::from_wire(message, &calibration, &At::Root("frame")).unwrap_err()
        };
        let short = refused(&|m| m.depth = vec![0; 127].into());
        assert_eq!(short.field, "frame.depth");
        assert_eq!(short.message, "127 bytes, 8x8 pixels are 128 bytes");
        assert_eq!(refused(&|m| m.color = Bytes::new()).field, "frame.color");
        assert_eq!(refused(&|m| m.color_encoding = 99).field, "frame.color_encoding");
        assert_eq!(refused(&|m| m.depth_encoding = 0).field, "frame.depth_encoding");
        assert_eq!(refused(&|m| m.camera_id = 1).field, "frame.camera_id");
    }

    #[test]
    fn session_ids_are_plain() {
        let at = At::Root("session_id");
        assert!(session_id("robot-7", &at).is_ok());
        for bad in ["", "Robot", "a b", "../x", &"x".repeat(65)] {
            assert!(session_id(bad, &at).is_err(), "{bad:?}");
        }
    }
}
