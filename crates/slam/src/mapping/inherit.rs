//! What a new submap takes over from the one before: the surfels that its anchor sees. Their geometry has been averaged
//! over many frames, where the anchor alone would give one frame's noise.

use crate::tracking::view::TrackingView;
use coma_geometry::Pose;
use coma_surfel::SurfelCloud;
use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

/// What a new submap takes over.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct InheritSettings {
    /// Off: submaps begin empty (the paper's way).
    pub enabled: bool,
    /// Surfels outside the anchor's picture by up to this share of its size come along.
    pub margin: f32,
    /// Surfels within this share of the measured depth are seen.
    pub relative: f32,
    /// Surfels that look smaller than this share of what a new one would be are seeded anew, ...
    pub min_size: f32,
    /// ... and also those that look larger than this.
    pub max_size: f32,
}

impl Default for InheritSettings {
    fn default() -> Self {
        InheritSettings { enabled: true, margin: 0.1, relative: 0.02, min_size: 0.6, max_size: 1.5 }
    }
}

/// Surfels in the new submap's frame, and the variances of their positions.
#[derive(Clone, Debug, Default)]
pub struct Inheritance {
    /// In the new submap's frame.
    pub surfels: SurfelCloud,
    /// Along their normals, one for each.
    pub variance_m2: Vec<f32>,
}

/// Takes over what the anchor `view` sees of `surfels`. `seed_px`: standard deviation of a new surfel, pixels.
pub fn inherit(
    surfels: &SurfelCloud,
    variance_m2: &[f32],
    anchor_from_submap: &Pose,
    view: &TrackingView,
    seed_px: f32,
    settings: &InheritSettings,
) -> Inheritance {
    let mut out = Inheritance::default();
    if !settings.enabled {
        return out;
    }
    let turn: UnitQuaternion<f32> = anchor_from_submap.rotation.cast();
    let translation: Vector3<f32> = anchor_from_submap.translation.vector.cast();
    let level = &view.levels[0];
    let (width, height) = (level.depth_m.width() as f32, level.depth_m.height() as f32);
    let (fx, fy) = (level.camera.fx as f32, level.camera.fy as f32);
    let (cx, cy) = (level.camera.cx as f32, level.camera.cy as f32);
    let (beyond_x, beyond_y) = (settings.margin * width, settings.margin * height);
    for (mut surfel, variance) in surfels.iter().zip(variance_m2) {
        let p = turn * Vector3::from(surfel.center_m) + translation;
        if !(p.z > 0.05) {
            continue;
        }
        let (u, v) = (fx * p.x / p.z + cx + 0.5, fy * p.y / p.z + cy + 0.5);
        if !(u >= -beyond_x && v >= -beyond_y && u < width + beyond_x && v < height + beyond_y) {
            continue;
        }
        let inside = u >= 0.0 && v >= 0.0;
        let measured = level.depth_m.get(u as usize, v as usize).copied().filter(|z| inside && *z > 0.0);
        if measured.is_some_and(|z| (z - p.z).abs() > settings.relative * z) {
            continue;
        }
        // The smaller scale isn't stretched along an incline.
        let size = surfel.scale_m[0].min(surfel.scale_m[1]) * fx / p.z / seed_px;
        if !(size >= settings.min_size && size <= settings.max_size) {
            continue;
        }
        let own = UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(
            surfel.rotation_wxyz[0],
            surfel.rotation_wxyz[1],
            surfel.rotation_wxyz[2],
            surfel.rotation_wxyz[3],
        ));
        let q = turn * own;
        surfel.center_m = p.into();
        surfel.rotation_wxyz = [q.w, q.i, q.j, q.k];
        out.surfels.push(surfel);
        out.variance_m2.push(*variance);
    }
    out
}
