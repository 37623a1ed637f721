//! Pinhole cameras. A pixel's centre has integer coordinates: the first pixel's centre is (0, 0).

use nalgebra::{Point3, Vector2, Vector3};
use serde::{Deserialize, Serialize};

/// A pinhole camera, x right, y down, z forward. Focal lengths and principal point are in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Intrinsics {
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Focal length along x.
    pub fx: f64,
    /// Focal length along y.
    pub fy: f64,
    /// Principal point, x.
    pub cx: f64,
    /// Principal point, y.
    pub cy: f64,
}

/// Why intrinsics were refused; names the field and its value.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("{field} = {value} is out of range: {needed}")]
pub struct IntrinsicsError {
    /// The field at fault.
    pub field: &'static str,
    /// Its value.
    pub value: f64,
    /// What would have been accepted.
    pub needed: &'static str,
}

/// The largest image side that is accepted, in pixels.
pub const MAX_IMAGE_SIDE: u32 = 8192;

impl Intrinsics {
    /// Checks every field; NaN and zero are refused.
    pub fn validated(self) -> Result<Self, IntrinsicsError> {
        let side = |field, value: u32| {
            if (8..=MAX_IMAGE_SIDE).contains(&value) {
                Ok(())
            } else {
                Err(IntrinsicsError { field, value: value as f64, needed: "8 to 8192 pixels" })
            }
        };
        side("width", self.width)?;
        side("height", self.height)?;
        for (field, value) in [("fx", self.fx), ("fy", self.fy)] {
            if !(1.0..=1e6).contains(&value) {
                return Err(IntrinsicsError { field, value, needed: "1 to 1e6 pixels" });
            }
        }
        for (field, value, side) in [("cx", self.cx, self.width), ("cy", self.cy, self.height)] {
            let side = side as f64;
            if !(-side..=2.0 * side).contains(&value) {
                return Err(IntrinsicsError { field, value, needed: "within one image size of the image" });
            }
        }
        Ok(self)
    }

    /// Number of pixels.
    pub fn pixels(&self) -> usize {
        self.width as usize * self.height as usize
    }

    /// The point at depth `z_m` (along z, not along the ray) behind pixel `(u, v)`.
    pub fn back_project(&self, u: f64, v: f64, z_m: f64) -> Point3<f64> {
        Point3::new((u - self.cx) / self.fx * z_m, (v - self.cy) / self.fy * z_m, z_m)
    }

    /// Pixel coordinates of a point in front of the camera; `None` at or behind its plane.
    pub fn project(&self, point: &Point3<f64>) -> Option<Vector2<f64>> {
        if !(point.z > 1e-9) {
            return None;
        }
        Some(Vector2::new(self.fx * point.x / point.z + self.cx, self.fy * point.y / point.z + self.cy))
    }

    /// The ray through a pixel, with z = 1.
    pub fn ray(&self, u: f64, v: f64) -> Vector3<f64> {
        Vector3::new((u - self.cx) / self.fx, (v - self.cy) / self.fy, 1.0)
    }

    /// The camera of an image whose sides were divided by `2^levels` by averaging 2x2 blocks (odd rows
    /// and columns at the end are dropped).
    pub fn halved(&self) -> Self {
        Intrinsics {
            width: self.width / 2,
            height: self.height / 2,
            fx: self.fx * 0.5,
            fy: self.fy * 0.5,
            cx: (self.cx - 0.5) * 0.5,
            cy: (self.cy - 0.5) * 0.5,
        }
    }
}

/// Brown-Conrady lens distortion, in OpenCV's order and units.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Distortion {
    /// Radial, r^2.
    pub k1: f64,
    /// Radial, r^4.
    pub k2: f64,
    /// Tangential.
    pub p1: f64,
    /// Tangential.
    pub p2: f64,
    /// Radial, r^6.
    pub k3: f64,
}

impl Distortion {
    /// True if the lens is an ideal pinhole.
    pub fn is_none(&self) -> bool {
        *self == Distortion::default()
    }

    /// Where the normalised image point `(x, y)` (z = 1) of an ideal camera lands in the distorted one.
    pub fn distort(&self, x: f64, y: f64) -> (f64, f64) {
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3));
        (
            x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x),
            y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Intrinsics =
        Intrinsics { width: 600, height: 340, fx: 300.0, fy: 300.0, cx: 299.5, cy: 169.5 };

    #[test]
    fn the_first_pixel_s_centre_is_at_zero() {
        let centred = Intrinsics { cx: 0.0, cy: 0.0, ..CAMERA };
        assert_eq!(centred.back_project(0.0, 0.0, 2.0), Point3::new(0.0, 0.0, 2.0));
    }

    #[test]
    fn depth_is_along_z_and_projection_inverts_it() {
        let point = CAMERA.back_project(10.0, 300.0, 2.5);
        assert_eq!(point.z, 2.5);
        assert!((CAMERA.project(&point).unwrap() - Vector2::new(10.0, 300.0)).norm() < 1e-9);
    }

    #[test]
    fn halving_keeps_rays() {
        // The centre of the first 2x2 block, (0.5, 0.5), becomes pixel (0, 0).
        let half = CAMERA.halved();
        assert!((CAMERA.ray(0.5, 0.5) - half.ray(0.0, 0.0)).norm() < 1e-12);
    }

    #[test]
    fn bad_intrinsics_name_their_field() {
        let refused = |c: Intrinsics| c.validated().unwrap_err().field;
        assert_eq!(refused(Intrinsics { fx: f64::NAN, ..CAMERA }), "fx");
        assert_eq!(refused(Intrinsics { fy: 0.0, ..CAMERA }), "fy");
        assert_eq!(refused(Intrinsics { width: 0, ..CAMERA }), "width");
        assert_eq!(refused(Intrinsics { cy: f64::INFINITY, ..CAMERA }), "cy");
    }

    #[test]
    fn camera_axes_point_right_down_and_forward() {
        let pixel = |x, y, z| CAMERA.project(&Point3::new(x, y, z));
        let centre = pixel(0.0, 0.0, 1.0).unwrap();
        assert!(pixel(0.1, 0.0, 1.0).unwrap().x > centre.x, "x is to the right");
        assert!(pixel(0.0, 0.1, 1.0).unwrap().y > centre.y, "y is down, as image rows are");
        assert!(pixel(0.0, 0.0, -1.0).is_none(), "what lies behind is not seen");
    }

    #[test]
    fn distortion_has_opencv_s_order_and_meaning() {
        // cv2.projectPoints of (0.3, -0.2, 1) with the coefficients (k1, k2, p1, p2, k3) below.
        let lens = Distortion { k1: -0.2, k2: 0.05, p1: 0.001, p2: -0.002, k3: 0.03 };
        let (x, y) = lens.distort(0.3, -0.2);
        assert!((x - 0.291733273).abs() < 1e-12 && (y - (-0.194532182)).abs() < 1e-12, "{x} {y}");
    }
}
