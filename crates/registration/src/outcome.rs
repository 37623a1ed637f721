//! How a registration ends: an alignment with its numbers, or the reason why not with its numbers.

use coma_geometry::{Matrix6, Pose};
use serde::{Deserialize, Serialize};
use std::fmt;

/// Which of the two views a reason speaks of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Side {
    /// The view that is moved.
    Source,
    /// The view it is moved onto.
    Target,
}

impl fmt::Display for Side {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Side::Source => "source",
            Side::Target => "target",
        })
    }
}

/// A verified alignment.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Alignment {
    /// Maps points of the source camera to the target camera, metres.
    pub target_from_source: Pose,
    /// Inverse covariance of `target_from_source * exp(xi)`, order (translation, rotation).
    pub information: Matrix6,
    /// Share of a view's points that the other sees at its own depth, the lesser of both directions.
    pub overlap: f64,
    /// Share of points, of those in agreement or conflict, that float in the other view's free space.
    pub conflicts: f64,
    /// Root mean square distance of correspondences along the normal, metres.
    pub rmse_m: f64,
    /// Zero-mean normalised correlation of the intensities of agreeing points; `None` if one view is too plain to say.
    pub photometric_correlation: Option<f64>,
    /// The same of edges and texture, the lesser direction; `None` without any.
    pub detail_correlation: Option<f64>,
    /// Smallest over largest eigenvalue of the Hessian.
    pub eigenvalue_ratio: f64,
    /// Correspondences of the last ICP step.
    pub correspondences: usize,
    /// Feature matches that agree with the coarse alignment; 0 if it was refined from a given pose.
    pub inliers: usize,
    /// Independent residuals that the information stands for.
    pub effective_samples: usize,
    /// How far the translation moves if the focal lengths are wrong by `focal_uncertainty` of the settings, metres.
    pub calibration_m: f64,
}

/// Why two views were not registered.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Reason {
    /// A view contradicts itself (sizes, intrinsics).
    InvalidView {
        /// Which view.
        side: Side,
        /// What is wrong, with the numbers.
        detail: String,
    },
    /// Too little depth.
    TooFewPoints {
        /// Which view.
        side: Side,
        /// Usable points.
        found: usize,
        /// Least number.
        needed: usize,
    },
    /// The views have hardly a feature in common.
    TooFewMatches {
        /// Mutual nearest neighbours among the features.
        found: usize,
        /// Least number.
        needed: usize,
    },
    /// No rigid motion explains enough matches.
    TooFewInliers {
        /// Matches of the best motion.
        found: usize,
        /// Least number.
        needed: usize,
    },
    /// Too few correspondences of those points that both views should see.
    LowFitness {
        /// Share found.
        fitness: f64,
        /// Least share.
        needed: f64,
    },
    /// The scene does not pin all six degrees of freedom: a plain wall, a corridor.
    Unobservable {
        /// Smallest over largest eigenvalue of the Hessian.
        eigenvalue_ratio: f64,
        /// Least ratio.
        needed: f64,
    },
    /// The views share too little.
    LowOverlap {
        /// Share found, the lesser of both directions.
        overlap: f64,
        /// Least share.
        needed: f64,
    },
    /// Surfaces of one view lie where the other looks through.
    Conflict {
        /// Share found.
        conflicts: f64,
        /// Largest share allowed.
        allowed: f64,
    },
    /// The surfaces agree, what is on them does not.
    PhotometricMismatch {
        /// Correlation found.
        correlation: f64,
        /// Least correlation.
        needed: f64,
    },
    /// Broad brightness agrees, edges and texture do not: the motion is off by some pixels, or depth and colour of a
    /// frame are of two moments.
    DetailMismatch {
        /// Correlation found, the lesser direction.
        correlation: f64,
        /// Least correlation.
        needed: f64,
    },
    /// The motion hangs on calibration: a focal length that is a little wrong moves it too far.
    PoorlyConstrained {
        /// How far focal lengths wrong by `focal_uncertainty` of the settings move it, metres.
        metres: f64,
        /// Most that is allowed, metres.
        allowed: f64,
    },
    /// Coloured ICP lost its correspondences or its system became singular.
    Diverged {
        /// Correspondences left.
        correspondences: usize,
        /// Least number.
        needed: usize,
    },
}

impl fmt::Display for Reason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let percent = |v: &f64| 100.0 * v;
        match self {
            Reason::InvalidView { side, detail } => write!(f, "the {side} view is invalid: {detail}"),
            Reason::TooFewPoints { side, found, needed } => {
                write!(f, "the {side} view has {found} usable depth points, {needed} are needed")
            }
            Reason::TooFewMatches { found, needed } => {
                write!(f, "the views have {found} matching features, {needed} are needed")
            }
            Reason::TooFewInliers { found, needed } => {
                write!(f, "the best rigid motion explains {found} matches, {needed} are needed")
            }
            Reason::LowFitness { fitness, needed } => write!(
                f,
                "{:.0} % of the points that both views should see correspond, {:.0} % are needed",
                percent(fitness),
                percent(needed)
            ),
            Reason::Unobservable { eigenvalue_ratio, needed } => write!(
                f,
                "the shared scene does not pin the motion (eigenvalue ratio {eigenvalue_ratio:.5}, {needed} is needed)"
            ),
            Reason::LowOverlap { overlap, needed } => {
                write!(
                    f,
                    "the views overlap by {:.0} %, {:.0} % are needed",
                    percent(overlap),
                    percent(needed)
                )
            }
            Reason::Conflict { conflicts, allowed } => write!(
                f,
                "{:.0} % of the points lie in space that the other view saw empty, {:.0} % are allowed",
                percent(conflicts),
                percent(allowed)
            ),
            Reason::PhotometricMismatch { correlation, needed } => write!(
                f,
                "the surfaces agree but their brightness correlates by {correlation:.2}, {needed:.2} is needed"
            ),
            Reason::DetailMismatch { correlation, needed } => write!(
                f,
                "edges and texture on the surfaces correlate by {correlation:.2}, {needed:.2} is needed"
            ),
            Reason::PoorlyConstrained { metres, allowed } => write!(
                f,
                "a focal length that is a little wrong moves the motion by {metres:.3} m, {allowed:.3} m are allowed"
            ),
            Reason::Diverged { correspondences, needed } => write!(
                f,
                "the refinement diverged with {correspondences} correspondences, {needed} are needed"
            ),
        }
    }
}

/// The verdict on a pair of views. Both kinds are worth keeping: users ask why a merge did not happen.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Outcome {
    /// The views show one place, and this is how they fit.
    Accepted(Box<Alignment>),
    /// They do not, or it cannot be told.
    Rejected(Reason),
}

impl Outcome {
    /// The alignment, if accepted.
    pub fn alignment(&self) -> Option<&Alignment> {
        match self {
            Outcome::Accepted(alignment) => Some(alignment),
            Outcome::Rejected(_) => None,
        }
    }
}
