//! Encoded pictures become images, within limits; what is wrong is said with the field's path.

use bytes::Bytes;
use coma_frame::Image;
use coma_geometry::Intrinsics;
use coma_wire::{At, ColorData, FieldError, v1};
use image::{ImageFormat, ImageReader, Limits};
use std::io::Cursor;

/// A picture whose encoding and size are known, still encoded.
pub struct Picture {
    camera: Intrinsics,
    color: ColorData,
    depth: Option<Bytes>,
}

/// A decoded picture.
pub struct Decoded {
    /// sRGB.
    pub color: Image<[u8; 3]>,
    /// Metres, 0 = no measurement; of the same size.
    pub depth_m: Option<Image<f32>>,
}

impl Picture {
    /// Checks what can be checked without decoding.
    pub fn from_wire(request: v1::DescribeRequest, max_pixels: usize) -> Result<Self, FieldError> {
        let at = At::Root("camera");
        let camera: Intrinsics = at.required(request.camera)?;
        if camera.pixels() > max_pixels {
            let Intrinsics { width, height, .. } = camera;
            let message =
                format!("{width}x{height} pixels are over this service's max_pixels = {max_pixels}");
            return Err(at.refuse(message));
        }
        let color = coma_wire::read_color(request.color_encoding, request.color, &camera, &At::ROOT)?;
        let depth = (!request.depth.is_empty()).then_some(request.depth);
        Ok(Picture { camera, color, depth })
    }

    /// Decodes colour, and depth where there is some.
    pub fn decode(&self) -> Result<Decoded, FieldError> {
        let color = decode_color(&self.color, &self.camera)?;
        let depth_m = self.depth.as_ref().map(|bytes| decode_depth(bytes, &self.camera)).transpose()?;
        Ok(Decoded { color, depth_m })
    }
}

fn decode_color(data: &ColorData, camera: &Intrinsics) -> Result<Image<[u8; 3]>, FieldError> {
    let refuse = |message: String| FieldError::new("color", message);
    let bytes = match data {
        ColorData::Rgb8(bytes) => bytes.to_vec(),
        ColorData::Jpeg(bytes) => decompress(bytes, ImageFormat::Jpeg, camera)?,
        ColorData::Png(bytes) => decompress(bytes, ImageFormat::Png, camera)?,
    };
    let pixels = bytes.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect();
    let (width, height) = (camera.width as usize, camera.height as usize);
    Image::from_pixels(width, height, pixels)
        .ok_or_else(|| refuse(format!("is not {width}x{height} RGB pixels")))
}

/// RGB bytes of a compressed image of the camera's size; a header that claims more allocates nothing.
fn decompress(bytes: &[u8], format: ImageFormat, camera: &Intrinsics) -> Result<Vec<u8>, FieldError> {
    let refuse = |message: String| FieldError::new("color", message);
    let (width, height) = (camera.width, camera.height);
    let mut limits = Limits::default();
    limits.max_image_width = Some(width);
    limits.max_image_height = Some(height);
    limits.max_alloc = Some(width as u64 * height as u64 * 16 + (1 << 20));
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    reader.limits(limits);
    let image = reader.decode().map_err(|e| refuse(format!("cannot be decoded as {format:?}: {e}")))?;
    if (image.width(), image.height()) != (width, height) {
        let (w, h) = (image.width(), image.height());
        return Err(refuse(format!("is {w}x{h}, the camera says {width}x{height}")));
    }
    Ok(image.into_rgb8().into_raw())
}

fn decode_depth(bytes: &[u8], camera: &Intrinsics) -> Result<Image<f32>, FieldError> {
    let refuse = |message: String| FieldError::new("depth", message);
    let limits = coma_depth_codec::Limits { max_pixels: camera.pixels() };
    let depth_m = coma_depth_codec::decode(bytes, limits).map_err(|e| refuse(e.to_string()))?.depth_m;
    let (width, height) = (camera.width as usize, camera.height as usize);
    if (depth_m.width(), depth_m.height()) != (width, height) {
        let (w, h) = (depth_m.width(), depth_m.height());
        return Err(refuse(format!("is {w}x{h}, the camera says {width}x{height}")));
    }
    Ok(depth_m)
}
