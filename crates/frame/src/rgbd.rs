//! One RGB-D frame as the estimator sees it: depth registered to colour, one ideal pinhole camera.

use crate::{DepthNoise, Image};
use coma_geometry::{Intrinsics, StampNs};

/// A frame. Depth is metres along z in the colour camera; 0 means no measurement.
#[derive(Clone, Debug)]
pub struct RgbdFrame {
    /// Position in its session's stream.
    pub sequence: u64,
    /// Sensor clock.
    pub stamp: StampNs,
    /// The camera of both images.
    pub camera: Intrinsics,
    /// How wrong the depth is.
    pub noise: DepthNoise,
    /// sRGB, `[height, width]`.
    pub color: Image<[u8; 3]>,
    /// Metres, `[height, width]`; 0 = no measurement; never NaN or negative.
    pub depth_m: Image<f32>,
}

/// Why images do not make a frame; names the field.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FrameError {
    /// An image's size is not the camera's.
    #[error("{field} is {width}x{height}, but the camera is {camera_width}x{camera_height}")]
    Size {
        /// `color` or `depth`.
        field: &'static str,
        /// Found.
        width: usize,
        /// Found.
        height: usize,
        /// Stated by the calibration.
        camera_width: u32,
        /// Stated by the calibration.
        camera_height: u32,
    },
}

impl RgbdFrame {
    /// Checks sizes and replaces depth that is NaN, infinite or negative by 0.
    pub fn new(
        sequence: u64,
        stamp: StampNs,
        camera: Intrinsics,
        noise: DepthNoise,
        color: Image<[u8; 3]>,
        mut depth_m: Image<f32>,
    ) -> Result<Self, FrameError> {
        let size = |field, width, height| {
            if width == camera.width as usize && height == camera.height as usize {
                return Ok(());
            }
            Err(FrameError::Size {
                field,
                width,
                height,
                camera_width: camera.width,
                camera_height: camera.height,
            })
        };
        size("color", color.width(), color.height())?;
        size("depth", depth_m.width(), depth_m.height())?;
        for z in depth_m.pixels_mut() {
            if !(z.is_finite() && *z > 0.0) {
                *z = 0.0;
            }
        }
        Ok(RgbdFrame { sequence, stamp, camera, noise, color, depth_m })
    }

    /// Share of pixels with a depth measurement, 0..1.
    pub fn depth_coverage(&self) -> f32 {
        let measured = self.depth_m.pixels().iter().filter(|z| **z > 0.0).count();
        measured as f32 / self.depth_m.pixels().len() as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Intrinsics = Intrinsics { width: 8, height: 8, fx: 8.0, fy: 8.0, cx: 3.5, cy: 3.5 };

    fn frame(color: Image<[u8; 3]>, depth_m: Image<f32>) -> Result<RgbdFrame, FrameError> {
        RgbdFrame::new(0, StampNs(0), CAMERA, DepthNoise::default(), color, depth_m)
    }

    #[test]
    fn zero_depth_is_no_measurement_and_what_is_no_depth_becomes_zero() {
        let mut depth = Image::filled(8, 8, 2.0f32);
        for (x, bad) in [f32::NAN, f32::INFINITY, -1.0, 0.0].into_iter().enumerate() {
            depth[(x, 0)] = bad;
        }
        let frame = frame(Image::filled(8, 8, [0; 3]), depth).unwrap();
        assert_eq!(frame.depth_m.row(0), [0.0, 0.0, 0.0, 0.0, 2.0, 2.0, 2.0, 2.0]);
        assert_eq!(frame.depth_coverage(), 60.0 / 64.0);
    }

    #[test]
    fn images_of_another_size_than_the_camera_are_refused_by_name() {
        let field = |color, depth| match frame(color, depth).unwrap_err() {
            FrameError::Size { field, .. } => field,
        };
        assert_eq!(field(Image::filled(7, 8, [0; 3]), Image::filled(8, 8, 1.0)), "color");
        assert_eq!(field(Image::filled(8, 8, [0; 3]), Image::filled(8, 9, 1.0)), "depth");
    }
}
