//! Surfels follow what later frames measure: one Kalman filter per surfel, along its normal, and one for its intensity.
//!
//! Depth noise is averaged out frame by frame, as a fused volume (Curless and Levoy 1996) or surfel fusion (Keller et
//! al. 2013, "Real-time 3D reconstruction in dynamic scenes using point-based fusion") does it, at the cost of one look
//! at each surfel. The optimiser is left with what depth doesn't say: colour, opacity and extent.
//!
//! What is measured of intensity is for tracking alone. The optimiser makes colours that look right once they are blended,
//! which is not how the surface is shaded: where a surface inclines, they make up for being drawn away from the camera.

use crate::tracking::align::Brightness;
use crate::tracking::view::TrackingView;
use coma_geometry::Pose;
use coma_surfel::SurfelCloud;
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// How surfels follow measurements.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FuseSettings {
    /// Off: surfels stay where they were born, or where the optimiser moves them.
    pub enabled: bool,
    /// A measurement within so many standard deviations is of the surfel's surface ...
    pub gate_sigma: f32,
    /// ... and also one within this share of the depth.
    pub gate_relative: f32,
    /// A surfel is never surer than after so many independent frames.
    pub most_frames: f32,
}

impl Default for FuseSettings {
    fn default() -> Self {
        FuseSettings { enabled: true, gate_sigma: 3.0, gate_relative: 0.005, most_frames: 40.0 }
    }
}

/// What frames have measured of surfels, one of each for each.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Measured {
    /// Of the position along the normal.
    pub variance_m2: Vec<f32>,
    /// 0..1, at the session's brightness.
    pub intensity: Vec<f32>,
}

impl Measured {
    /// One more surfel.
    pub fn push(&mut self, variance_m2: f32, intensity: f32) {
        self.variance_m2.push(variance_m2);
        self.intensity.push(intensity);
    }
}

/// Surfels of one task.
const PART: usize = 4096;
/// Normals that differ by more than 45 degrees are of different surfaces.
const ALIKE_COS: f32 = 0.7;

/// Moves and shades surfels by what `view`, seen from `camera_from_submap`, measures of them.
pub fn fuse(
    surfels: &mut SurfelCloud,
    measured: &mut Measured,
    view: &TrackingView,
    brightness: Brightness,
    camera_from_submap: &Pose,
    settings: &FuseSettings,
) {
    let brightness = brightness.gain as f32;
    let rotation = camera_from_submap.rotation.to_rotation_matrix().matrix().cast::<f32>();
    let translation: Vector3<f32> = camera_from_submap.translation.vector.cast();
    // Half the resolution: depth of four pixels averaged.
    let level = &view.levels[1.min(view.levels.len() - 1)];
    let camera = &level.camera;
    let (fx, fy, cx, cy) = (camera.fx as f32, camera.fy as f32, camera.cx as f32, camera.cy as f32);
    let one = |center: &mut [f32; 3], turn: &mut [f32; 4], variance: &mut f32, intensity: &mut f32| {
        let p = rotation * Vector3::from(*center) + translation;
        let Some(place) = level.place(&p) else { return };
        let Some(pixel) = level.pixel(place) else { return };
        let (z, seen) = (level.depth_m[pixel], Vector3::from(level.normal[pixel]));
        if !(z > 0.0) || seen == Vector3::zeros() {
            return;
        }
        let [qw, qx, qy, qz] = *turn;
        let orientation = UnitQuaternion::new_unchecked(Quaternion::new(qw, qx, qy, qz));
        let submap_normal = orientation * Vector3::z();
        let own = rotation * submap_normal;
        // Seeded surfels face the camera; one that is seen from behind is another surface.
        if !(own.dot(&seen) > ALIKE_COS) {
            return;
        }
        let ray = Vector3::new((pixel.0 as f32 - cx) / fx, (pixel.1 as f32 - cy) / fy, 1.0);
        let along = own.dot(&ray);
        let sigma = view.noise.sigma_m(z);
        let off = own.dot(&(ray * z - p));
        let off_z = off / along.abs().max(0.1);
        if !(off_z.abs()
            <= settings.gate_sigma * (*variance + sigma * sigma).sqrt() + settings.gate_relative * z)
        {
            return;
        }
        let least = sigma * sigma / settings.most_frames;
        let gain = *variance / (*variance + sigma * sigma);
        *variance = (*variance * (1.0 - gain)).max(least);
        *intensity += gain * (brightness * level.intensity_at(place) - *intensity);
        let step = submap_normal * (gain * off);
        for (c, by) in center.iter_mut().zip(step.iter()) {
            *c += by;
        }
        let wanted = rotation.tr_mul(&seen);
        let turned = (submap_normal * (1.0 - gain) + wanted * gain).normalize();
        if let Some(by) = UnitQuaternion::rotation_between(&submap_normal, &turned) {
            let q = UnitQuaternion::new_normalize((by * orientation).into_inner());
            *turn = [q.w, q.i, q.j, q.k];
        }
    };
    (
        surfels.center_m.par_chunks_mut(PART),
        surfels.rotation_wxyz.par_chunks_mut(PART),
        measured.variance_m2.par_chunks_mut(PART),
        measured.intensity.par_chunks_mut(PART),
    )
        .into_par_iter()
        .for_each(|(centers, turns, variances, intensities)| {
            let all = centers.iter_mut().zip(turns).zip(variances).zip(intensities);
            for (((center, turn), variance), intensity) in all {
                one(center, turn, variance, intensity);
            }
        });
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_frame::{DepthNoise, Image};
    use coma_geometry::Intrinsics;
    use coma_surfel::Surfel;

    const CAMERA: Intrinsics = Intrinsics { width: 32, height: 24, fx: 30.0, fy: 30.0, cx: 15.5, cy: 11.5 };
    const NOISE: DepthNoise = DepthNoise { base_m: 0.01, quadratic_per_m: 0.0 };

    /// A wall as the sensor sees it.
    fn wall(depth_m: f32, intensity: f32) -> TrackingView {
        TrackingView::build(
            CAMERA,
            Image::filled(32, 24, depth_m),
            Image::filled(32, 24, intensity),
            NOISE,
            1,
        )
    }

    fn fuse_one(cloud: &mut SurfelCloud, measured: &mut Measured, view: &TrackingView, gain: f64) {
        fuse(cloud, measured, view, Brightness { gain }, &Pose::identity(), &FuseSettings::default());
    }

    fn born() -> Measured {
        Measured { variance_m2: vec![1e-4], intensity: vec![0.4] }
    }

    /// One surfel that faces the camera, in the middle of the picture.
    fn surfel(depth_m: f32) -> SurfelCloud {
        let surfel = Surfel {
            center_m: [0.0, 0.0, depth_m],
            rotation_wxyz: [0.0, 1.0, 0.0, 0.0],
            scale_m: [0.05; 2],
            opacity: 0.9,
            color: [0.5; 3],
        };
        [surfel].into_iter().collect()
    }

    #[test]
    fn a_surfel_ends_at_the_mean_of_what_was_measured() {
        let (mut cloud, mut measured) = (surfel(2.0), born());
        let depths = [2.01, 1.99, 2.02, 2.01, 2.00, 1.98];
        let shades = [0.5, 0.45, 0.4, 0.5, 0.55, 0.5];
        for (depth_m, shade) in depths.into_iter().zip(shades) {
            // The frame is half as bright as the map.
            fuse_one(&mut cloud, &mut measured, &wall(depth_m, 0.5 * shade), 2.0);
        }
        // The birth counts as one measurement of the same noise.
        let mean = (2.0 + depths.iter().sum::<f32>()) / 7.0;
        assert!((cloud.center_m[0][2] - mean).abs() < 1e-5, "{:?}", cloud.center_m);
        assert!((measured.variance_m2[0] - 1e-4 / 7.0).abs() < 1e-8, "{measured:?}");
        let shade = (0.4 + shades.iter().sum::<f32>()) / 7.0;
        assert!((measured.intensity[0] - shade).abs() < 1e-4, "{measured:?}, {shade} expected");
    }

    #[test]
    fn another_surface_moves_nothing() {
        for depth_m in [1.9, 2.1, 0.0] {
            let (mut cloud, mut measured) = (surfel(2.0), born());
            fuse_one(&mut cloud, &mut measured, &wall(depth_m, 0.5), 1.0);
            assert_eq!((cloud, measured), (surfel(2.0), born()), "a wall at {depth_m} m");
        }
    }
}
