//! Surfels as the camera sees them: the plane and axes that every ray is intersected with, and bounds.

use crate::reach::Reach;
use crate::{RenderSettings, SubmapView};
use bytemuck::Zeroable;
use coma_frame::luminance;
use coma_geometry::Intrinsics;
use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};
use rayon::prelude::*;

/// One visible surfel. A ray `d = ((x - cx) / fx, (y - cy) / fy, 1)` meets its plane at depth
/// `k / (n . d)`, at `(u, v) = (a . d, b . d) / (n . d)` in units of its scales.
#[derive(Clone, Copy, Debug, Zeroable)]
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
    pub intensity: f32,
}

/// All surfels of all submaps in one row, each at its slot: submap after submap, in their own order.
#[derive(Debug, Default)]
pub(crate) struct Scene {
    /// Zero where a surfel is not visible.
    pub projected: Vec<Projected>,
    /// Likewise.
    pub reach: Vec<Reach>,
    /// `depth bits << 32 | slot` of every visible surfel, by slot. Depths are positive, so their bits sort as
    /// they do.
    pub keys: Vec<u64>,
}

/// A camera pose in single precision.
pub(crate) struct CameraFromSubmap {
    pub rotation: UnitQuaternion<f32>,
    pub translation: Vector3<f32>,
}

impl From<&SubmapView<'_>> for CameraFromSubmap {
    fn from(view: &SubmapView<'_>) -> Self {
        CameraFromSubmap {
            rotation: view.camera_from_submap.rotation.cast(),
            translation: view.camera_from_submap.translation.vector.cast(),
        }
    }
}

/// A surfel in the camera's frame.
pub(crate) struct InCamera {
    pub center: Vector3<f32>,
    /// Columns e1, e2, n.
    pub axes: Matrix3<f32>,
    pub scale: [f32; 2],
}

impl InCamera {
    pub fn of(view: &SubmapView<'_>, pose: &CameraFromSubmap, index: usize) -> InCamera {
        let surfels = view.surfels;
        let [w, x, y, z] = surfels.rotation_wxyz[index];
        let own = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
        InCamera {
            center: pose.rotation * Vector3::from(surfels.center_m[index]) + pose.translation,
            axes: *(pose.rotation * own).to_rotation_matrix().matrix(),
            scale: surfels.scale_m[index],
        }
    }
}

/// Surfels that one task projects.
const CHUNK: usize = 2048;

/// Projects every surfel of every submap.
///
/// # Panics
/// If there are more than a slot's 32 bits can name.
pub(crate) fn project(submaps: &[SubmapView<'_>], camera: &Intrinsics, settings: &RenderSettings) -> Scene {
    let total = submaps.iter().map(|view| view.surfels.len()).sum::<usize>();
    assert!(u32::try_from(total).is_ok(), "{total} surfels are more than 2^32 - 1");
    let mut projected: Vec<Projected> = bytemuck::zeroed_vec(total);
    let mut reach: Vec<Reach> = bytemuck::zeroed_vec(total);
    let mut tasks = Vec::new();
    let (mut projected_left, mut reach_left) = (&mut projected[..], &mut reach[..]);
    let mut slot = 0;
    for view in submaps {
        for from in (0..view.surfels.len()).step_by(CHUNK) {
            let length = CHUNK.min(view.surfels.len() - from);
            let p = projected_left.split_off_mut(..length).unwrap_or_default();
            let r = reach_left.split_off_mut(..length).unwrap_or_default();
            tasks.push((view, from, slot, p, r));
            slot += length;
        }
    }
    let keys: Vec<Vec<u64>> = tasks
        .into_par_iter()
        .map(|(view, from, slot, projected, reach)| {
            let pose = CameraFromSubmap::from(view);
            let mut keys = Vec::with_capacity(projected.len());
            for (i, (p, r)) in projected.iter_mut().zip(reach).enumerate() {
                if let Some((surfel, region)) = project_one(view, &pose, from + i, camera, settings) {
                    (*p, *r) = (surfel, region);
                    keys.push((surfel.z.to_bits() as u64) << 32 | (slot + i) as u64);
                }
            }
            keys
        })
        .collect();
    Scene { projected, reach, keys: keys.concat() }
}

fn project_one(
    view: &SubmapView<'_>,
    pose: &CameraFromSubmap,
    index: usize,
    camera: &Intrinsics,
    settings: &RenderSettings,
) -> Option<(Projected, Reach)> {
    let (opacity, color) = (view.surfels.opacity[index], view.surfels.color[index]);
    let given = view.intensity.and_then(|all| all.get(index)).copied();
    let intensity = given.unwrap_or_else(|| luminance(color));
    let s = InCamera::of(view, pose, index);
    let z = s.center.z;
    let geometry = s.center.iter().chain(s.axes.iter()).chain(&s.scale);
    let finite = geometry.chain(&color).chain([&intensity]).all(|v| v.is_finite());
    let usable = z > settings.near_m && s.scale[0] > 0.0 && s.scale[1] > 0.0 && opacity > settings.alpha_min;
    if !(finite && usable && opacity <= 1.0) {
        return None;
    }
    let (fx, fy) = (camera.fx as f32, camera.fy as f32);
    let pixel = [fx * s.center.x / z + camera.cx as f32, fy * s.center.y / z + camera.cy as f32];
    let reach = Reach::of(&s, pixel, opacity, camera, settings)?;
    let n: Vector3<f32> = s.axes.column(2).into();
    let k = n.dot(&s.center);
    let axis = |column: usize| {
        let e: Vector3<f32> = s.axes.column(column).into();
        (e * k - n * e.dot(&s.center)) / s.scale[column]
    };
    let (a, b) = (axis(0), axis(1));
    if !a.iter().chain(&b).all(|v| v.is_finite()) {
        return None;
    }
    Some((Projected { a: a.into(), b: b.into(), n: n.into(), k, pixel, z, opacity, color, intensity }, reach))
}
