//! The definition: every pixel looks at every Gaussian, in double precision, without tiles or bounds.

use super::{GaussianView, LOW_PASS_PX2, OUTSIDE};
use crate::oracle::OraclePixel;
use crate::{ALPHA_MAX, RenderSettings};
use coma_geometry::Intrinsics;
use nalgebra::{Matrix2, Matrix2x3, Matrix3, Point3, Quaternion, UnitQuaternion, Vector2, Vector3};

/// A Gaussian in the camera's frame.
#[derive(Clone, Debug)]
pub struct OracleGaussian {
    /// Centre, metres.
    pub center: Vector3<f64>,
    /// Columns are its axes.
    pub axes: Matrix3<f64>,
    /// Standard deviations, metres.
    pub scale: [f64; 3],
    /// 0..1.
    pub opacity: f64,
    /// RGB, 0..1.
    pub color: [f64; 3],
}

/// The Gaussians of all views in the camera's frame.
pub fn in_camera(views: &[GaussianView<'_>]) -> Vec<OracleGaussian> {
    let mut out = Vec::new();
    for view in views {
        for g in view.gaussians.iter() {
            let [w, x, y, z] = g.rotation_wxyz.map(f64::from);
            let own = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
            out.push(OracleGaussian {
                center: (view.camera_from_submap * Point3::from(g.center_m.map(f64::from))).coords,
                axes: *(view.camera_from_submap.rotation * own).to_rotation_matrix().matrix(),
                scale: g.scale_m.map(f64::from),
                opacity: f64::from(g.opacity),
                color: g.color.map(f64::from),
            });
        }
    }
    out
}

/// Renders pixel by pixel, row by row; the surface depth is not made.
pub fn render(
    gaussians: &[OracleGaussian],
    camera: &Intrinsics,
    settings: &RenderSettings,
) -> Vec<OraclePixel> {
    let mut order: Vec<&OracleGaussian> = gaussians.iter().filter(|g| is_seen(g, camera, settings)).collect();
    order.sort_by(|a, b| a.center.z.total_cmp(&b.center.z));
    let pixels = (0..camera.height).flat_map(|y| (0..camera.width).map(move |x| (x as f64, y as f64)));
    pixels.map(|(x, y)| pixel(&order, x, y, camera, settings)).collect()
}

fn center_px(g: &OracleGaussian, camera: &Intrinsics) -> Vector2<f64> {
    let c = g.center;
    Vector2::new(camera.fx * c.x / c.z + camera.cx, camera.fy * c.y / c.z + camera.cy)
}

fn is_seen(g: &OracleGaussian, camera: &Intrinsics, settings: &RenderSettings) -> bool {
    let px = center_px(g, camera);
    let within = |at: f64, size: u32| (at - 0.5 * size as f64).abs() <= OUTSIDE * 0.5 * size as f64;
    g.center.z > settings.near_m as f64 && within(px.x, camera.width) && within(px.y, camera.height)
}

/// Zwicker et al. 2001: the covariance on the screen is J M J^T, J the derivative of the projection at the centre.
fn alpha(g: &OracleGaussian, x: f64, y: f64, camera: &Intrinsics) -> f64 {
    let c = g.center;
    let j = Matrix2x3::new(
        camera.fx / c.z,
        0.0,
        -camera.fx * c.x / (c.z * c.z),
        0.0,
        camera.fy / c.z,
        -camera.fy * c.y / (c.z * c.z),
    );
    let squares = Vector3::from(g.scale.map(|s| s * s));
    let covariance = g.axes * Matrix3::from_diagonal(&squares) * g.axes.transpose();
    let on_screen = j * covariance * j.transpose() + Matrix2::identity() * f64::from(LOW_PASS_PX2);
    let d = Vector2::new(x, y) - center_px(g, camera);
    let q = on_screen.try_inverse().map_or(f64::INFINITY, |conic| d.dot(&(conic * d)));
    (g.opacity * (-0.5 * q).exp()).min(f64::from(ALPHA_MAX))
}

fn pixel(
    order: &[&OracleGaussian],
    x: f64,
    y: f64,
    camera: &Intrinsics,
    settings: &RenderSettings,
) -> OraclePixel {
    let (mut passing, mut depth_sum) = (1.0f64, 0.0f64);
    let mut out = OraclePixel::default();
    for g in order {
        let alpha = alpha(g, x, y, camera);
        if alpha < f64::from(settings.alpha_min) {
            continue;
        }
        for c in 0..3 {
            out.color[c] += alpha * passing * g.color[c];
        }
        depth_sum += alpha * passing * g.center.z;
        let after = passing * (1.0 - alpha);
        if passing > 0.5 && after <= 0.5 {
            out.median = g.center.z;
        }
        passing = after;
    }
    out.opacity = 1.0 - passing;
    out.depth = if out.opacity > 0.0 { depth_sum / out.opacity } else { 0.0 };
    out
}
