//! The definition: a brute-force renderer in double precision, without tiles, bounds or early termination.
//!
//! It is what [`crate::render`] is compared with, and what finite differences are taken of.

use crate::{ALPHA_MAX, RenderSettings, SubmapView};
use coma_geometry::Intrinsics;
use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};

/// A surfel in the camera's frame, in double precision.
#[derive(Clone, Debug)]
pub struct OracleSurfel {
    /// Centre, metres.
    pub center: Vector3<f64>,
    /// Columns e1, e2, n.
    pub axes: Matrix3<f64>,
    /// Standard deviations, metres.
    pub scale: [f64; 2],
    /// 0..1.
    pub opacity: f64,
    /// RGB, 0..1.
    pub color: [f64; 3],
}

/// One pixel's answer.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct OraclePixel {
    /// Blended colour.
    pub color: [f64; 3],
    /// Expected depth D / A, 0 where nothing was hit.
    pub depth: f64,
    /// A.
    pub opacity: f64,
    /// Depth at which half of the light is blocked, 0 where it never is.
    pub median: f64,
    /// Mean depth of the front surface's hits, by the eighth power of their alpha.
    pub surface: f64,
    /// Mean intensity of the front surface's hits, by their alpha.
    pub surface_intensity: f64,
}

/// The surfels of all submaps in the camera's frame.
pub fn in_camera(submaps: &[SubmapView<'_>]) -> Vec<OracleSurfel> {
    let mut out = Vec::new();
    for view in submaps {
        for s in view.surfels.iter() {
            let [w, x, y, z] = s.rotation_wxyz.map(|v| v as f64);
            let own = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
            let center = nalgebra::Point3::from(s.center_m.map(|v| v as f64));
            out.push(OracleSurfel {
                center: (view.camera_from_submap * center).coords,
                axes: *(view.camera_from_submap.rotation * own).to_rotation_matrix().matrix(),
                scale: s.scale_m.map(|v| v as f64),
                opacity: s.opacity as f64,
                color: s.color.map(|v| v as f64),
            });
        }
    }
    out
}

/// Renders pixel by pixel. `[height * width]`, row by row.
pub fn render(surfels: &[OracleSurfel], camera: &Intrinsics, settings: &RenderSettings) -> Vec<OraclePixel> {
    let mut order: Vec<&OracleSurfel> =
        surfels.iter().filter(|s| s.center.z > settings.near_m as f64).collect();
    order.sort_by(|a, b| a.center.z.total_cmp(&b.center.z));
    let mut out = Vec::with_capacity(camera.pixels());
    for y in 0..camera.height {
        for x in 0..camera.width {
            out.push(pixel(&order, x as f64, y as f64, camera, settings));
        }
    }
    out
}

/// Alpha, not yet cut off at its least, and depth of a surfel at a pixel.
pub fn hit(s: &OracleSurfel, x: f64, y: f64, camera: &Intrinsics, settings: &RenderSettings) -> (f64, f64) {
    let ray = camera.ray(x, y);
    let normal: Vector3<f64> = s.axes.column(2).into();
    // The ray t * ray meets the plane n . (p - c) = 0.
    let t = normal.dot(&s.center) / normal.dot(&ray);
    let hit = ray * t - s.center;
    let (u, v) = (s.axes.column(0).dot(&hit) / s.scale[0], s.axes.column(1).dot(&hit) / s.scale[1]);
    let on_plane = u * u + v * v;
    let centre =
        (camera.fx * s.center.x / s.center.z + camera.cx, camera.fy * s.center.y / s.center.z + camera.cy);
    let low_pass = (settings.low_pass_px as f64).powi(2);
    let on_screen = ((x - centre.0).powi(2) + (y - centre.1).powi(2)) / low_pass;
    let (rho, depth) = if on_plane <= on_screen && t > settings.near_m as f64 {
        (on_plane, t)
    } else {
        (on_screen, s.center.z)
    };
    ((s.opacity * (-0.5 * rho).exp()).min(ALPHA_MAX as f64), depth)
}

fn pixel(
    order: &[&OracleSurfel],
    x: f64,
    y: f64,
    camera: &Intrinsics,
    settings: &RenderSettings,
) -> OraclePixel {
    let (mut passing, mut depth_sum) = (1.0f64, 0.0f64);
    let (mut surface, mut surface_sum, mut shaded, mut shades) = (0.0f64, 0.0f64, 0.0f64, 0.0f64);
    let mut out = OraclePixel::default();
    for s in order {
        let (alpha, depth) = hit(s, x, y, camera, settings);
        if alpha < settings.alpha_min as f64 {
            continue;
        }
        let weight = alpha * passing;
        for c in 0..3 {
            out.color[c] += weight * s.color[c];
        }
        depth_sum += weight * depth;
        let after = passing * (1.0 - alpha);
        if passing > 0.5 && after <= 0.5 {
            out.median = depth;
        }
        let together =
            (depth * surface - surface_sum).abs() <= settings.surface_relative as f64 * depth * surface;
        let shade = alpha * (0.299 * s.color[0] + 0.587 * s.color[1] + 0.114 * s.color[2]);
        let weight = alpha.powi(8);
        if together {
            (surface, surface_sum) = (surface + weight, surface_sum + weight * depth);
            (shaded, shades) = (shaded + alpha, shades + shade);
        } else if surface < weight {
            (surface, surface_sum, shaded, shades) = (weight, weight * depth, alpha, shade);
        }
        passing = after;
    }
    out.opacity = 1.0 - passing;
    if surface > 0.0 {
        (out.surface, out.surface_intensity) = (surface_sum / surface, shades / shaded);
    }
    out.depth = if out.opacity > 0.0 { depth_sum / out.opacity } else { 0.0 };
    out
}
