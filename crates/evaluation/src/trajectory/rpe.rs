//! The relative pose error: how far a motion over some frames is from what it was. Needs no alignment.

use crate::Spread;
use coma_geometry::{Pose, se3};
use serde::{Deserialize, Serialize};
use std::num::NonZeroUsize;

/// Over which pairs of frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RpeDelta {
    /// From a pose to the one so many poses later, counted among those that have a truth (as `evo` counts:
    /// a lost frame makes the step across it longer).
    pub frames: NonZeroUsize,
    /// From every pose; else each pair begins where the one before it ends (`evo`'s default).
    pub all_pairs: bool,
}

impl RpeDelta {
    /// Pairs that begin where the one before ends. 0 is taken as 1.
    pub fn consecutive(frames: usize) -> Self {
        RpeDelta { frames: NonZeroUsize::new(frames).unwrap_or(NonZeroUsize::MIN), all_pairs: false }
    }

    /// Pairs from every pose. 0 is taken as 1.
    pub fn all_pairs(frames: usize) -> Self {
        RpeDelta { all_pairs: true, ..Self::consecutive(frames) }
    }
}

/// Relative errors over one delta.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Rpe {
    /// Which pairs.
    pub delta: RpeDelta,
    /// Length of the error's translation, metres.
    pub translation_m: Spread,
    /// Angle of the error's rotation, degrees.
    pub rotation_deg: Spread,
}

/// Relative error of matched poses, `(estimate, truth)`; `None` if they are too few for one pair.
pub fn rpe(poses: &[(Pose, Pose)], delta: RpeDelta) -> Option<Rpe> {
    let frames = delta.frames.get();
    let step = if delta.all_pairs { 1 } else { frames };
    let errors: Vec<(f64, f64)> = (0..poses.len())
        .step_by(step)
        .map_while(|from| Some((poses[from], poses.get(from.checked_add(frames)?)?)))
        .map(|((estimate_i, truth_i), (estimate_j, truth_j))| {
            // Sturm 2012, eq. (2): E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j)
            se3::distance(&truth_i.inv_mul(truth_j), &estimate_i.inv_mul(estimate_j))
        })
        .collect();
    let (translation_m, rotation_deg): (Vec<f64>, Vec<f64>) =
        errors.into_iter().map(|(metres, radians)| (metres, radians.to_degrees())).unzip();
    Some(Rpe { delta, translation_m: Spread::of(&translation_m)?, rotation_deg: Spread::of(&rotation_deg)? })
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_geometry::Tangent;

    /// The estimate runs 1 % too far along x and turns by 1 degree a frame too much.
    fn drifting(count: usize) -> Vec<(Pose, Pose)> {
        let step = |scale: f64, degrees: f64| {
            se3::exp(&Tangent::new(0.0, 0.0, 0.0, 0.0, 0.0, degrees.to_radians()))
                * Pose::translation(0.0, 0.0, 0.1 * scale)
        };
        let chain = |step: Pose| {
            std::iter::successors(Some(Pose::identity()), move |pose| Some(pose * step)).take(count)
        };
        chain(step(1.01, 3.0)).zip(chain(step(1.0, 2.0))).collect()
    }

    #[test]
    fn drift_is_what_a_step_adds() {
        let one = rpe(&drifting(31), RpeDelta::consecutive(1)).unwrap();
        assert_eq!(one.translation_m.count, 30);
        assert!((one.translation_m.rmse - 0.001).abs() < 1e-9, "{one:?}");
        assert!((one.rotation_deg.max - 1.0).abs() < 1e-6, "{one:?}");
        let ten = rpe(&drifting(31), RpeDelta::consecutive(10)).unwrap();
        assert_eq!(ten.translation_m.count, 3);
        assert!(
            (ten.translation_m.mean - 0.01).abs() < 1e-9 && (ten.rotation_deg.median - 10.0).abs() < 1e-6
        );
        assert_eq!(rpe(&drifting(31), RpeDelta::all_pairs(10)).unwrap().translation_m.count, 21);
    }

    #[test]
    fn motions_of_both_worlds_change_nothing() {
        let (a, b) =
            (se3::exp(&Tangent::new(1.0, 2.0, 3.0, 0.4, 2.0, -1.0)), Pose::translation(-5.0, 0.0, 1.0));
        let moved: Vec<(Pose, Pose)> = drifting(20).iter().map(|(e, t)| (a * e, b * t)).collect();
        let (before, after) =
            (rpe(&drifting(20), RpeDelta::consecutive(2)), rpe(&moved, RpeDelta::consecutive(2)));
        assert!((before.unwrap().translation_m.rmse - after.unwrap().translation_m.rmse).abs() < 1e-9);
    }

    #[test]
    fn too_few_poses_make_no_pair() {
        assert_eq!(rpe(&drifting(10), RpeDelta::consecutive(10)), None);
        assert_eq!(rpe(&[], RpeDelta::all_pairs(usize::MAX)), None);
        assert_eq!(rpe(&drifting(3), RpeDelta::all_pairs(usize::MAX)), None);
    }
}
