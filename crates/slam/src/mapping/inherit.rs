//! What a new submap takes over from the one before: the surfels that its anchor sees. Their geometry has been averaged
//! over many frames, where the anchor alone would give one frame's noise.

use super::fuse::Measured;
use crate::tracking::view::TrackingView;
use coma_geometry::Pose;
use coma_surfel::SurfelCloud;
use nalgebra::Vector3;
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
        InheritSettings { enabled: true, margin: 0.1, relative: 0.02, min_size: 0.6, max_size: 3.0 }
    }
}

/// Surfels in the new submap's frame, and what was measured of them.
#[derive(Clone, Debug, Default)]
pub struct Inheritance {
    /// In the new submap's frame.
    pub surfels: SurfelCloud,
    /// One for each.
    pub measured: Measured,
    /// Of all surfels that were there, one for each: true for those that come along.
    pub taken: Vec<bool>,
}

/// Takes over what the anchor `view` sees of `surfels`. `seed_px`: standard deviation of a new surfel, pixels.
pub fn inherit(
    surfels: &SurfelCloud,
    measured: &Measured,
    anchor_from_submap: &Pose,
    view: &TrackingView,
    seed_px: f32,
    settings: &InheritSettings,
) -> Inheritance {
    let mut out = Inheritance { taken: vec![false; surfels.len()], ..Inheritance::default() };
    if !settings.enabled {
        return out;
    }
    let level = &view.levels[0];
    let (width, height) = (level.depth_m.width() as f32, level.depth_m.height() as f32);
    let (beyond_x, beyond_y) = (settings.margin * width, settings.margin * height);
    for (index, surfel) in surfels.iter().enumerate() {
        let surfel = surfel.moved(anchor_from_submap);
        let center = Vector3::from(surfel.center_m);
        let Some((u, v)) = level.place(&center) else { continue };
        if !(u >= -beyond_x && v >= -beyond_y && u < width + beyond_x && v < height + beyond_y) {
            continue;
        }
        let seen = level.pixel((u, v)).map(|pixel| level.depth_m[pixel]).filter(|z| *z > 0.0);
        if seen.is_some_and(|z| (z - center.z).abs() > settings.relative * z) {
            continue;
        }
        // The smaller scale isn't stretched along an incline.
        let size = surfel.scale_m[0].min(surfel.scale_m[1]) * level.camera.fx as f32 / center.z / seed_px;
        if size >= settings.min_size && size <= settings.max_size {
            out.taken[index] = true;
            out.surfels.push(surfel);
            out.measured.push(measured.variance_m2[index], measured.intensity[index]);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_frame::{DepthNoise, Image};
    use coma_geometry::Intrinsics;
    use coma_surfel::Surfel;

    #[test]
    fn what_the_anchor_sees_at_its_own_size_comes_along() {
        let camera = Intrinsics { width: 32, height: 24, fx: 30.0, fy: 30.0, cx: 15.5, cy: 11.5 };
        let gray = Image::filled(32, 24, 0.5);
        let view = TrackingView::build(camera, Image::filled(32, 24, 2.0), gray, DepthNoise::default(), 1);
        // Where in the anchor's camera, how large in pixels, and whether it comes along.
        let cases = [
            ([0.0, 0.0, 2.0], 1.6, true),
            ([0.0, 0.0, 3.0], 1.6, false),  // behind the wall
            ([0.0, 0.0, -2.0], 1.6, false), // behind the camera
            ([1.1, 0.0, 2.0], 1.6, true),   // half a pixel beside the picture
            ([2.0, 0.0, 2.0], 1.6, false),  // far beside it
            ([0.0, 0.0, 2.0], 0.5, false),  // too fine
            ([0.0, 0.0, 2.0], 6.0, false),  // too coarse
        ];
        let anchor_from_submap = Pose::translation(0.5, 0.0, 0.0);
        for (center_m, size_px, comes) in cases {
            let seen = Surfel {
                center_m,
                rotation_wxyz: [0.0, 1.0, 0.0, 0.0],
                scale_m: [size_px * 2.0 / 30.0; 2],
                opacity: 0.9,
                color: [0.5; 3],
            };
            let cloud = [seen.moved(&anchor_from_submap.inverse())].into_iter().collect();
            let settings = InheritSettings::default();
            let measured = Measured { variance_m2: vec![1e-4], intensity: vec![0.3] };
            let found = inherit(&cloud, &measured, &anchor_from_submap, &view, 1.6, &settings);
            assert_eq!(found.surfels.len(), comes as usize, "{center_m:?}, {size_px} px");
            assert_eq!(found.taken, [comes]);
            if comes {
                assert_eq!(found.measured, measured);
                let off = Vector3::from(found.surfels.center_m[0]) - Vector3::from(center_m);
                assert!(off.norm() < 1e-6, "{off:?}");
            }
        }
    }
}
