//! Surfels as the camera sees them: the plane and axes that every ray is intersected with, and bounds.

use crate::{RenderSettings, SubmapView};
use coma_geometry::Intrinsics;
use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};
use rayon::prelude::*;

/// One visible surfel. A ray `d = ((x - cx) / fx, (y - cy) / fy, 1)` meets its plane at depth
/// `k / (n . d)`, at `(u, v) = (a . d, b . d) / (n . d)` in units of its scales.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Projected {
    pub a: [f32; 3],
    pub b: [f32; 3],
    pub n: [f32; 3],
    pub k: f32,
    /// Centre in pixels.
    pub pixel: [f32; 2],
    /// Depth of the centre, metres.
    pub z: f32,
    pub opacity: f32,
    pub color: [f32; 3],
    /// First and last pixel with alpha over the least, inclusive: x0, y0, x1, y1.
    pub bounds: [i32; 4],
    /// Which submap and which of its surfels.
    pub submap: u32,
    pub index: u32,
}

/// A surfel in the camera's frame.
pub(crate) struct InCamera {
    pub center: Vector3<f32>,
    /// Columns e1, e2, n.
    pub axes: Matrix3<f32>,
    pub scale: [f32; 2],
}

pub(crate) fn in_camera(view: &SubmapView<'_>, index: usize) -> InCamera {
    let rotation = view.camera_from_submap.rotation.cast::<f32>();
    let translation: Vector3<f32> = view.camera_from_submap.translation.vector.cast();
    let surfels = view.surfels;
    let [w, x, y, z] = surfels.rotation_wxyz[index];
    let own = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
    InCamera {
        center: rotation * Vector3::from(surfels.center_m[index]) + translation,
        axes: *(rotation * own).to_rotation_matrix().matrix(),
        scale: surfels.scale_m[index],
    }
}

/// All visible surfels, from near to far; equal depths in the order of submaps and surfels.
pub(crate) fn project(
    submaps: &[SubmapView<'_>],
    camera: &Intrinsics,
    settings: &RenderSettings,
) -> Vec<Projected> {
    let mut out: Vec<Projected> = Vec::new();
    for (submap, view) in submaps.iter().enumerate() {
        let visible = (0..view.surfels.len())
            .into_par_iter()
            .with_min_len(512)
            .filter_map(|index| project_one(view, submap as u32, index as u32, camera, settings));
        out.par_extend(visible);
    }
    // Depths are positive, so their bits sort as they do.
    out.par_sort_unstable_by_key(|p| (p.z.to_bits(), p.submap, p.index));
    out
}

fn project_one(
    view: &SubmapView<'_>,
    submap: u32,
    index: u32,
    camera: &Intrinsics,
    settings: &RenderSettings,
) -> Option<Projected> {
    let i = index as usize;
    let (opacity, color) = (view.surfels.opacity[i], view.surfels.color[i]);
    let s = in_camera(view, i);
    let z = s.center.z;
    let finite = s.center.iter().chain(s.axes.iter()).chain(&s.scale).chain(&color).all(|v| v.is_finite());
    let usable = z > settings.near_m && s.scale[0] > 0.0 && s.scale[1] > 0.0 && opacity > settings.alpha_min;
    if !(finite && usable && opacity <= 1.0) {
        return None;
    }
    let n: Vector3<f32> = s.axes.column(2).into();
    let k = n.dot(&s.center);
    let axis = |column: usize| {
        let e: Vector3<f32> = s.axes.column(column).into();
        (e * k - n * e.dot(&s.center)) / s.scale[column]
    };
    let (a, b) = (axis(0), axis(1));
    let (fx, fy) = (camera.fx as f32, camera.fy as f32);
    let pixel = [fx * s.center.x / z + camera.cx as f32, fy * s.center.y / z + camera.cy as f32];
    let bounds = bounds(&s, pixel, opacity, camera, settings)?;
    Some(Projected {
        a: a.into(),
        b: b.into(),
        n: n.into(),
        k,
        pixel,
        z,
        opacity,
        color,
        bounds,
        submap,
        index,
    })
}

/// The pixels at which alpha can reach its least value: the box of the disc's conic, and that of the low-pass
/// circle. `None` outside the image.
fn bounds(
    s: &InCamera,
    pixel: [f32; 2],
    opacity: f32,
    camera: &Intrinsics,
    settings: &RenderSettings,
) -> Option<[i32; 4]> {
    let r2 = 2.0 * (opacity / settings.alpha_min).ln();
    let circle = r2.sqrt() * settings.low_pass_px;
    let (width, height) = (camera.width as f32, camera.height as f32);
    let e1 = s.axes.column(0) * s.scale[0];
    let e2 = s.axes.column(1) * s.scale[1];
    let c = s.center;
    // Where the tangents of the conic of radius r touch (2D Gaussian Splatting, section 4.2).
    let d = r2 * (e1.z * e1.z + e2.z * e2.z) - c.z * c.z;
    let side = |row: usize, focal: f32, principal: f32, limit: f32| {
        if !(d < 0.0) {
            // The disc reaches the camera's plane: it may be anywhere.
            return (0.0, limit);
        }
        let p = |v: &Vector3<f32>| focal * v[row] + principal * v.z;
        let (p1, p2, pc) = (p(&e1.into()), p(&e2.into()), p(&c));
        let middle = (r2 * (p1 * e1.z + p2 * e2.z) - pc * c.z) / d;
        let half = (middle * middle - (r2 * (p1 * p1 + p2 * p2) - pc * pc) / d).max(0.0).sqrt();
        ((middle - half).min(pixel[row] - circle), (middle + half).max(pixel[row] + circle))
    };
    let (x0, x1) = side(0, camera.fx as f32, camera.cx as f32, width);
    let (y0, y1) = side(1, camera.fy as f32, camera.cy as f32, height);
    let (x0, x1) = (x0.ceil().max(0.0), x1.floor().min(width - 1.0));
    let (y0, y1) = (y0.ceil().max(0.0), y1.floor().min(height - 1.0));
    (x0 <= x1 && y0 <= y1).then_some([x0 as i32, y0 as i32, x1 as i32, y1 as i32])
}
