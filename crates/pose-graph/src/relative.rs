//! Relative phase (eq. 12): where two chains stand to each other, from all loops between them; and whether that
//! is sure enough to join them.

use crate::chain::Trunk;
use crate::clique::{Adjacency, CliqueSettings, largest};
use crate::consistency::{Bridge, largest_consistent_set};
use crate::gnc::{RobustSettings, Schedule, final_weight};
use crate::graph::NodeInfo;
use crate::initialise::nearest_rotation;
use crate::uncertain::UncertainPose;
use coma_geometry::{Matrix6, Pose, SubmapId, se3};
use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// What two chains need before they share a map.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct JoinSettings {
    /// Consistent loops that are independent of each other, pair by pair.
    pub independent_loops: usize,
    /// Two loops are independent if their ends in one agent lie more than this many frames apart,
    pub apart_frames: u64,
    /// or more than this far, in metres,
    pub apart_m: f64,
    /// or more than this angle, in radians (30 degrees).
    pub apart_rad: f64,
    /// Limits of the search for the largest consistent set.
    pub clique: CliqueSettings,
}

impl Default for JoinSettings {
    fn default() -> Self {
        JoinSettings {
            independent_loops: 2,
            apart_frames: 20,
            apart_m: 0.5,
            apart_rad: 30f64.to_radians(),
            clique: CliqueSettings::default(),
        }
    }
}

/// Why two chains did not join. Users ask for this most of all.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum NotJoined {
    /// Too few loops at all.
    #[error("{found} loop(s) between them, {needed} are needed")]
    TooFewLoops {
        /// Loops between the two.
        found: usize,
        /// The setting.
        needed: usize,
    },
    /// Loops that contradict each other.
    #[error("{found} of {total} loops agree with each other, {needed} are needed")]
    TooFewConsistentLoops {
        /// The largest set that agrees.
        found: usize,
        /// Loops between the two.
        total: usize,
        /// The setting.
        needed: usize,
    },
    /// Loops that agree but come from the same place.
    #[error("{found} of {consistent} consistent loops are independent of each other, {needed} are needed")]
    TooFewIndependentLoops {
        /// The largest independent set.
        found: usize,
        /// Loops that agree with each other.
        consistent: usize,
        /// The setting.
        needed: usize,
    },
}

/// How two chains stand to each other.
#[derive(Clone, Debug, PartialEq)]
pub struct Joined {
    /// T_st between the chains' frames (those of their first submaps).
    pub s_from_t: Pose,
    /// `consistent[bridge]`: the loop belongs to the largest consistent set and fits `s_from_t`.
    pub consistent: Vec<bool>,
    /// Size of the largest independent set among the consistent loops.
    pub independent: usize,
}

/// Robust T_st from all loops between two chains, or why there is none.
///
/// The largest pairwise consistent set is found first; in it, rotation and then translation are estimated by
/// graduated non-convexity; and what fits must hold enough independent loops.
pub fn join(
    bridges: &[Bridge],
    s: &Trunk,
    t: &Trunk,
    nodes: &BTreeMap<SubmapId, NodeInfo>,
    settings: &JoinSettings,
    robust: &RobustSettings,
) -> Result<Joined, NotJoined> {
    let needed = settings.independent_loops.max(1);
    let total = bridges.len();
    if total < needed {
        return Err(NotJoined::TooFewLoops { found: total, needed });
    }
    let clique = largest_consistent_set(bridges, s, t, robust.squared_error_6dof, &settings.clique);
    let few = |found| NotJoined::TooFewConsistentLoops { found, total, needed };
    if clique.members.len() < needed {
        return Err(few(clique.members.len()));
    }
    let candidates = candidates(bridges, &clique.members, s, t);
    let (s_from_t, weights) = two_stage(&candidates, robust).ok_or_else(|| few(0))?;
    let mut consistent = vec![false; total];
    let mut inliers = Vec::new();
    for (candidate, weight) in candidates.iter().zip(&weights) {
        if *weight >= 0.5 {
            consistent[candidate.bridge] = true;
            inliers.push(&bridges[candidate.bridge]);
        }
    }
    if inliers.len() < needed {
        return Err(few(inliers.len()));
    }
    let independent = largest_independent_set(&inliers, nodes, settings);
    if independent < needed {
        let consistent = inliers.len();
        return Err(NotJoined::TooFewIndependentLoops { found: independent, consistent, needed });
    }
    Ok(Joined { s_from_t, consistent, independent })
}

/// One loop's own idea of T_st.
struct Candidate {
    bridge: usize,
    s_from_t: UncertainPose,
    /// The loop's end in t, in t's frame: where translation is compared, so that a small error of rotation does
    /// not act over the distance from t's origin.
    t_from_j: Vector3<f64>,
}

/// Each member's T_st. Drift is counted from the ends of the middle member, so that what all have in common
/// does not matter.
fn candidates(bridges: &[Bridge], members: &[usize], s: &Trunk, t: &Trunk) -> Vec<Candidate> {
    let pivot = &bridges[members[members.len() / 2]];
    members
        .iter()
        .filter_map(|&bridge| {
            let b = &bridges[bridge];
            let s_pivot_from_i = s.between(&pivot.in_s, &b.in_s)?;
            let j_from_t_pivot = t.between(&b.in_t, &pivot.in_t)?;
            let between = s_pivot_from_i.compose(&b.i_from_j).compose(&j_from_t_pivot);
            let (s_root, t_root) =
                (s.chain_from_submap.get(&pivot.in_s)?, t.chain_from_submap.get(&pivot.in_t)?);
            let exact = |pose| UncertainPose { pose, covariance: Matrix6::zeros() };
            let s_from_t = exact(*s_root).compose(&between).compose(&exact(t_root.inverse()));
            let t_from_j = t.chain_from_submap.get(&b.in_t)?.translation.vector;
            Some(Candidate { bridge, s_from_t, t_from_j })
        })
        .collect()
}

/// Rotation by robust averaging, then translation by robust least squares. `None` without candidates.
fn two_stage(candidates: &[Candidate], robust: &RobustSettings) -> Option<(Pose, Vec<f64>)> {
    let (rotation, rotation_weights) = robust_rotation(candidates, robust)?;
    let (translation, translation_weights) =
        robust_translation(candidates, &rotation, &rotation_weights, robust)?;
    let weights = rotation_weights.iter().zip(&translation_weights).map(|(a, b)| a.min(*b)).collect();
    Some((Pose::from_parts(Translation3::from(translation), rotation), weights))
}

/// Graduated non-convexity over a model that is fitted in one step: `fit(weights)` gives the model,
/// `squared(model)` the squared residuals.
fn graduated<M>(
    robust: &RobustSettings,
    allowed: &[f64],
    fit: impl Fn(&[f64]) -> Option<M>,
    squared: impl Fn(&M) -> Vec<f64>,
) -> Option<(M, Vec<f64>)> {
    let limit = robust.squared_error_3dof;
    let mut weights = allowed.to_vec();
    let mut model = fit(&weights)?;
    let worst = |model: &M| {
        squared(model).iter().zip(allowed).map(|(r, a)| if *a > 0.0 { *r } else { 0.0 }).fold(0.0, f64::max)
    };
    if let Some(mut schedule) = Schedule::new(robust.kernel, limit, robust.convexity_step, worst(&model)) {
        let reweighted = |model: &M, weight: &dyn Fn(f64) -> f64| -> Vec<f64> {
            squared(model).iter().zip(allowed).map(|(r, a)| a * weight(*r)).collect()
        };
        for _ in 0..robust.max_rounds {
            let Some(refitted) = fit(&reweighted(&model, &|r| schedule.weight(r))) else { break };
            model = refitted;
            if !schedule.advance() {
                break;
            }
        }
        weights = reweighted(&model, &|r| final_weight(robust.kernel, limit, r));
        if let Some(refitted) = fit(&weights) {
            model = refitted;
        }
    }
    Some((model, weights))
}

fn robust_rotation(
    candidates: &[Candidate],
    robust: &RobustSettings,
) -> Option<(UnitQuaternion<f64>, Vec<f64>)> {
    let information: Vec<Matrix3<f64>> = candidates
        .iter()
        .map(|c| c.s_from_t.covariance.fixed_view::<3, 3>(3, 3).into_owned().try_inverse())
        .collect::<Option<_>>()?;
    let error =
        |c: &Candidate, r: &UnitQuaternion<f64>| se3::so3_log(&(c.s_from_t.pose.rotation.inverse() * r));
    let fit = |weights: &[f64]| {
        // Start from the chordal mean, then Gauss-Newton on the weighted squared angles.
        let mut sum = Matrix3::zeros();
        for ((c, omega), w) in candidates.iter().zip(&information).zip(weights) {
            sum += c.s_from_t.pose.rotation.to_rotation_matrix().matrix() * (w * omega.trace());
        }
        if !(sum.norm() > 0.0) {
            return None;
        }
        let mean = Rotation3::from_matrix_unchecked(nearest_rotation(&sum));
        let mut rotation = UnitQuaternion::from_rotation_matrix(&mean);
        for _ in 0..10 {
            let (mut h, mut g) = (Matrix3::zeros(), Vector3::zeros());
            for ((c, omega), w) in candidates.iter().zip(&information).zip(weights) {
                let e = error(c, &rotation);
                // Right Jacobian: the left one of the negative.
                let j = se3::so3_left_jacobian_inverse(&-e);
                h += j.transpose() * omega * j * *w;
                g += j.transpose() * omega * e * *w;
            }
            let step = h.cholesky()?.solve(&-g);
            rotation *= se3::so3_exp(&step);
            if step.norm() < 1e-12 {
                break;
            }
        }
        Some(rotation)
    };
    let squared = |r: &UnitQuaternion<f64>| {
        candidates
            .iter()
            .zip(&information)
            .map(|(c, omega)| {
                let e = error(c, r);
                e.dot(&(omega * e))
            })
            .collect()
    };
    graduated(robust, &vec![1.0; candidates.len()], fit, squared)
}

fn robust_translation(
    candidates: &[Candidate],
    rotation: &UnitQuaternion<f64>,
    allowed: &[f64],
    robust: &RobustSettings,
) -> Option<(Vector3<f64>, Vec<f64>)> {
    // Of each loop: where its end j lies in s (with covariance in s's axes), and where the rotation alone puts it.
    let mut points = Vec::new();
    for c in candidates {
        let at_j = Pose::from_parts(Translation3::from(c.t_from_j), UnitQuaternion::identity());
        let s_from_j = c.s_from_t.pose * at_j;
        let carry = se3::adjoint(&at_j.inverse());
        let covariance = carry * c.s_from_t.covariance * carry.transpose();
        let turn = *s_from_j.rotation.to_rotation_matrix().matrix();
        let in_s = turn * covariance.fixed_view::<3, 3>(0, 0) * turn.transpose();
        let offset = s_from_j.translation.vector - rotation * c.t_from_j;
        points.push((offset, in_s.try_inverse()?));
    }
    let fit = |weights: &[f64]| {
        let (mut h, mut g) = (Matrix3::zeros(), Vector3::zeros());
        for ((offset, omega), w) in points.iter().zip(weights) {
            h += omega * *w;
            g += omega * offset * *w;
        }
        h.cholesky().map(|factor| factor.solve(&g))
    };
    let squared = |t: &Vector3<f64>| {
        points.iter().map(|(offset, omega)| (offset - t).dot(&(omega * (offset - t)))).collect()
    };
    graduated(robust, allowed, fit, squared)
}

/// Size of the largest set of loops that are independent of each other, pair by pair.
fn largest_independent_set(
    bridges: &[&Bridge],
    nodes: &BTreeMap<SubmapId, NodeInfo>,
    settings: &JoinSettings,
) -> usize {
    let apart = |a: &SubmapId, b: &SubmapId| {
        let (Some(a), Some(b)) = (nodes.get(a), nodes.get(b)) else { return false };
        let (metres, radians) = se3::distance(&a.agent_from_submap, &b.agent_from_submap);
        a.first_frame.abs_diff(b.first_frame) > settings.apart_frames
            || metres > settings.apart_m
            || radians > settings.apart_rad
    };
    let mut independent = Adjacency::new(bridges.len());
    for a in 0..bridges.len() {
        for b in 0..a {
            if apart(&bridges[a].in_s, &bridges[b].in_s) || apart(&bridges[a].in_t, &bridges[b].in_t) {
                independent.join(a, b);
            }
        }
    }
    largest(&independent, &settings.clique).members.len()
}
