//! What every sequence offers, and frames as they lie on disk.

use crate::DatasetError;
use coma_frame::{DepthNoise, Image, RgbdFrame, ingest};
use coma_geometry::{Distortion, Intrinsics, Pose, StampNs};
use image::{ImageDecoder, ImageReader};
use std::io::Cursor;

/// A camera's calibration, stated once per sequence.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibration {
    /// The colour camera.
    pub color: Intrinsics,
    /// The depth camera.
    pub depth: Intrinsics,
    /// Lens of the colour camera.
    pub color_distortion: Distortion,
    /// Lens of the depth camera.
    pub depth_distortion: Distortion,
    /// The depth camera's pose in the colour camera; identity where depth is registered to colour.
    pub color_from_depth: Pose,
    /// Depth codes per metre. Code 0 means no measurement.
    pub depth_units_per_metre: f64,
    /// Nearer depth means no measurement, metres.
    pub depth_min_m: f64,
    /// Farther depth means no measurement, metres. Code 65535, with which several data sets mark missing
    /// depth, always lies beyond.
    pub depth_max_m: f64,
    /// How wrong the depth is.
    pub noise: DepthNoise,
    /// Nominal rate of the sequence.
    pub frames_per_second: f64,
}

impl Calibration {
    /// True if depth shares the colour camera's pixels, lens included.
    pub fn depth_is_registered(&self) -> bool {
        self.color == self.depth
            && self.color_distortion == self.depth_distortion
            && self.color_from_depth == Pose::identity()
    }
}

/// A recorded or rendered RGB-D sequence of one camera.
///
/// Laws: all methods give the same answer however often they are asked; an index below `len` never
/// panics. `stamp_text` and `stamp` panic beyond the end.
#[allow(clippy::len_without_is_empty)] // A sequence without frames isn't opened.
pub trait Sequence: Send {
    /// The camera.
    fn calibration(&self) -> &Calibration;
    /// Number of frames, at least 1.
    fn len(&self) -> usize;
    /// The input's colour stamp, digit for digit; made from index and rate where the format has none.
    fn stamp_text(&self, index: usize) -> &str;
    /// The same in nanoseconds.
    fn stamp(&self, index: usize) -> StampNs;
    /// One frame. An error names the file.
    fn frame(&self, index: usize) -> Result<RawFrame, DatasetError>;
    /// `world_from_camera` of the colour camera, where known.
    fn truth(&self, index: usize) -> Option<Pose>;
}

/// A colour picture.
#[derive(Clone, Debug, PartialEq)]
pub enum ColorBytes {
    /// A JPEG file.
    Jpeg(Vec<u8>),
    /// A PNG file.
    Png(Vec<u8>),
    /// sRGB, `[height, width]`.
    Rgb8(Image<[u8; 3]>),
}

/// A depth picture.
#[derive(Clone, Debug, PartialEq)]
pub enum DepthBytes {
    /// A PNG file of one 16-bit channel.
    Png16(Vec<u8>),
    /// Codes, `[height, width]`; 0 = no measurement.
    Raw16(Image<u16>),
}

/// A frame as it lies on disk.
#[derive(Clone, Debug, PartialEq)]
pub struct RawFrame {
    /// Colour.
    pub color: ColorBytes,
    /// Depth.
    pub depth: DepthBytes,
}

/// Largest memory that decoding one picture may take, bytes.
const MAX_PICTURE_BYTES: u64 = 512 << 20;

fn decoder(
    bytes: &[u8],
    format: image::ImageFormat,
    field: &'static str,
) -> Result<impl ImageDecoder, DatasetError> {
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    let mut limits = image::Limits::default();
    limits.max_image_width = Some(coma_geometry::camera::MAX_IMAGE_SIDE);
    limits.max_image_height = Some(coma_geometry::camera::MAX_IMAGE_SIDE);
    limits.max_alloc = Some(MAX_PICTURE_BYTES);
    reader.limits(limits);
    let decoder = reader.into_decoder().map_err(|e| unreadable(field, e))?;
    let kind = decoder.color_type();
    if field == "depth" && kind != image::ColorType::L16 {
        let reason = format!("pixels are {kind:?} instead of one 16-bit channel");
        return Err(DatasetError::Picture { field, reason });
    }
    Ok(decoder)
}

fn unreadable(field: &'static str, error: image::ImageError) -> DatasetError {
    DatasetError::Picture { field, reason: error.to_string() }
}

fn decoded(
    bytes: &[u8],
    format: image::ImageFormat,
    field: &'static str,
) -> Result<image::DynamicImage, DatasetError> {
    image::DynamicImage::from_decoder(decoder(bytes, format, field)?).map_err(|e| unreadable(field, e))
}

/// Reads a picture's header and compares its size.
fn header(
    bytes: &[u8],
    format: image::ImageFormat,
    field: &'static str,
    camera: &Intrinsics,
) -> Result<(), DatasetError> {
    let (width, height) = decoder(bytes, format, field)?.dimensions();
    same_size(field, camera, width as usize, height as usize)
}

fn same_size(
    field: &'static str,
    camera: &Intrinsics,
    width: usize,
    height: usize,
) -> Result<(), DatasetError> {
    if (width, height) == (camera.width as usize, camera.height as usize) {
        return Ok(());
    }
    let reason = format!("{width}x{height}, but the calibration says {}x{}", camera.width, camera.height);
    Err(DatasetError::Picture { field, reason })
}

impl ColorBytes {
    /// The picture, sRGB, `[height, width]`.
    pub fn decode(&self) -> Result<Image<[u8; 3]>, DatasetError> {
        let picture = match self {
            ColorBytes::Rgb8(image) => return Ok(image.clone()),
            ColorBytes::Jpeg(bytes) => decoded(bytes, image::ImageFormat::Jpeg, "color")?,
            ColorBytes::Png(bytes) => decoded(bytes, image::ImageFormat::Png, "color")?,
        };
        let rgb = picture.into_rgb8();
        let (width, height) = (rgb.width() as usize, rgb.height() as usize);
        let pixels = rgb.pixels().map(|p| p.0).collect();
        Ok(Image::from_pixels(width, height, pixels).expect("one value per pixel"))
    }
}

impl DepthBytes {
    /// Codes, `[height, width]`; 0 = no measurement.
    pub fn decode(&self) -> Result<Image<u16>, DatasetError> {
        match self {
            DepthBytes::Raw16(image) => Ok(image.clone()),
            DepthBytes::Png16(bytes) => {
                let codes = decoded(bytes, image::ImageFormat::Png, "depth")?.into_luma16();
                let (width, height) = (codes.width() as usize, codes.height() as usize);
                Ok(Image::from_pixels(width, height, codes.into_raw()).expect("one value per pixel"))
            }
        }
    }

    /// Metres along z in the depth camera, `[height, width]`; 0 = no measurement.
    pub fn decode_m(&self, calibration: &Calibration) -> Result<Image<f32>, DatasetError> {
        let (min, max) = (calibration.depth_min_m, calibration.depth_max_m);
        Ok(self.decode()?.map(|code| {
            let z = *code as f64 / calibration.depth_units_per_metre;
            if *code > 0 && z >= min && z <= max { z as f32 } else { 0.0 }
        }))
    }
}

impl RawFrame {
    /// Checks, without decoding pixels, that encoded pictures have the calibration's sizes and the right
    /// kind of pixels, and that they are not cut short.
    pub fn check(&self, calibration: &Calibration) -> Result<(), DatasetError> {
        let whole = |field, there: bool| {
            let reason = "the file is cut short".to_owned();
            if there { Ok(()) } else { Err(DatasetError::Picture { field, reason }) }
        };
        let contains = |bytes: &[u8], end: &[u8]| bytes.windows(end.len()).rev().any(|w| w == end);
        match &self.color {
            ColorBytes::Jpeg(bytes) => {
                header(bytes, image::ImageFormat::Jpeg, "color", &calibration.color)?;
                whole("color", contains(bytes, b"\xff\xd9"))?;
            }
            ColorBytes::Png(bytes) => {
                header(bytes, image::ImageFormat::Png, "color", &calibration.color)?;
                whole("color", contains(bytes, b"IEND"))?;
            }
            ColorBytes::Rgb8(_) => {}
        }
        if let DepthBytes::Png16(bytes) = &self.depth {
            header(bytes, image::ImageFormat::Png, "depth", &calibration.depth)?;
            whole("depth", contains(bytes, b"IEND"))?;
        }
        Ok(())
    }

    /// The frame that an estimator sees: lenses undone, depth registered to colour, one ideal camera.
    pub fn decode(
        &self,
        calibration: &Calibration,
        sequence: u64,
        stamp: StampNs,
    ) -> Result<RgbdFrame, DatasetError> {
        let color = self.color.decode()?;
        let depth_m = self.depth.decode_m(calibration)?;
        same_size("color", &calibration.color, color.width(), color.height())?;
        same_size("depth", &calibration.depth, depth_m.width(), depth_m.height())?;
        let depth_m = if calibration.depth_is_registered() {
            ingest::undistort_depth(&depth_m, &calibration.color, &calibration.color_distortion)
        } else {
            ingest::register_depth_to_color(
                &depth_m,
                &calibration.depth,
                &calibration.depth_distortion,
                &calibration.color,
                &calibration.color_from_depth,
            )
        };
        let color = ingest::undistort_color(&color, &calibration.color, &calibration.color_distortion);
        RgbdFrame::new(sequence, stamp, calibration.color, calibration.noise, color, depth_m)
            .map_err(|e| DatasetError::Picture { field: "frame", reason: e.to_string() })
    }
}

/// Frame `index` of a sequence, decoded; its sequence number is `index`.
pub fn rgbd_frame(sequence: &dyn Sequence, index: usize) -> Result<RgbdFrame, DatasetError> {
    let raw = sequence.frame(index)?;
    raw.decode(sequence.calibration(), index as u64, sequence.stamp(index))
}
