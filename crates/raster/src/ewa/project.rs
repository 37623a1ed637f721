//! Gaussians as the camera sees them: an ellipse on the screen each, by the projection's derivative at its centre.

use super::{GaussianView, LOW_PASS_PX2, OUTSIDE};
use crate::RenderSettings;
use coma_geometry::Intrinsics;
use nalgebra::{Matrix2, Matrix2x3, Matrix3, Quaternion, UnitQuaternion, Vector2, Vector3};

/// A Gaussian in the camera's frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct InCamera {
    pub center: Vector3<f32>,
    /// Columns are its axes.
    pub axes: Matrix3<f32>,
    pub scale: [f32; 3],
}

impl InCamera {
    pub fn of(view: &GaussianView<'_>, index: usize) -> Self {
        let pose: UnitQuaternion<f32> = view.camera_from_submap.rotation.cast();
        let translation: Vector3<f32> = view.camera_from_submap.translation.vector.cast();
        let [w, x, y, z] = view.gaussians.rotation_wxyz[index];
        let own = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
        InCamera {
            center: pose * Vector3::from(view.gaussians.center_m[index]) + translation,
            axes: *(pose * own).to_rotation_matrix().matrix(),
            scale: view.gaussians.scale_m[index],
        }
    }

    /// Axes, each as long as its standard deviation.
    pub fn spread(&self) -> Matrix3<f32> {
        self.axes * Matrix3::from_diagonal(&Vector3::from(self.scale))
    }

    pub fn covariance(&self) -> Matrix3<f32> {
        self.spread() * self.spread().transpose()
    }
}

/// Derivative of the pixel by the point.
pub(super) fn jacobian(center: &Vector3<f32>, camera: &Intrinsics) -> Matrix2x3<f32> {
    let (fx, fy) = (camera.fx as f32, camera.fy as f32);
    let inv = 1.0 / center.z;
    Matrix2x3::new(fx * inv, 0.0, -fx * center.x * inv * inv, 0.0, fy * inv, -fy * center.y * inv * inv)
}

/// A splat: alpha is `opacity exp(-q / 2)` with `q = d^T conic d`, `d` from the centre to the pixel.
#[derive(Clone, Copy, Debug)]
pub(super) struct Splat {
    /// Which Gaussian, over all views.
    pub slot: u32,
    pub pixel: Vector2<f32>,
    pub conic: Matrix2<f32>,
    pub z: f32,
    pub opacity: f32,
    pub color: [f32; 3],
    /// First and last column and row that it may touch.
    pub bounds: [usize; 4],
}

/// Projects all Gaussians; those that are seen come from near to far.
pub(super) fn splats(
    views: &[GaussianView<'_>],
    camera: &Intrinsics,
    settings: &RenderSettings,
) -> Vec<Splat> {
    let mut out = Vec::new();
    let mut slot = 0;
    for view in views {
        for index in 0..view.gaussians.len() {
            out.extend(splat(view, index, slot, camera, settings));
            slot += 1;
        }
    }
    // Equal depths keep their order.
    out.sort_by(|a, b| a.z.total_cmp(&b.z));
    out
}

fn splat(
    view: &GaussianView<'_>,
    index: usize,
    slot: u32,
    camera: &Intrinsics,
    settings: &RenderSettings,
) -> Option<Splat> {
    let (opacity, color) = (view.gaussians.opacity[index], view.gaussians.color[index]);
    let g = InCamera::of(view, index);
    let finite = g.center.iter().chain(g.axes.iter()).chain(&g.scale).chain(&color).all(|v| v.is_finite());
    let usable = g.center.z > settings.near_m && g.scale.iter().all(|s| *s > 0.0);
    if !(finite && usable && opacity > settings.alpha_min && opacity <= 1.0) {
        return None;
    }
    let (width, height) = (camera.width as f32, camera.height as f32);
    let pixel = Vector2::new(
        camera.fx as f32 * g.center.x / g.center.z + camera.cx as f32,
        camera.fy as f32 * g.center.y / g.center.z + camera.cy as f32,
    );
    let within = |at: f32, size: f32| (at - 0.5 * size).abs() <= OUTSIDE as f32 * 0.5 * size;
    if !(within(pixel.x, width) && within(pixel.y, height)) {
        return None;
    }
    let j = jacobian(&g.center, camera);
    let cov = j * g.covariance() * j.transpose() + Matrix2::identity() * LOW_PASS_PX2;
    let conic = cov.try_inverse().filter(|c| c.iter().all(|v| v.is_finite()))?;
    // Where alpha is at least its least: q <= 2 ln(o / alpha_min).
    let reach = (2.0 * (opacity / settings.alpha_min).ln()).sqrt();
    let (dx, dy) = (reach * cov[(0, 0)].sqrt(), reach * cov[(1, 1)].sqrt());
    let (x0, x1) = ((pixel.x - dx).ceil().max(0.0), (pixel.x + dx).floor().min(width - 1.0));
    let (y0, y1) = ((pixel.y - dy).ceil().max(0.0), (pixel.y + dy).floor().min(height - 1.0));
    if !(x0 <= x1 && y0 <= y1) {
        return None;
    }
    let bounds = [x0 as usize, x1 as usize, y0 as usize, y1 as usize];
    Some(Splat { slot, pixel, conic, z: g.center.z, opacity, color, bounds })
}
