//! The whole way from two views to a verdict.

use crate::consensus;
use crate::gicp;
use crate::icp::{self, Searchable, Steps};
use crate::information::{Observability, focal_sensitivity, information};
use crate::matching::mutual_matches;
use crate::outcome::{Alignment, Outcome, Reason, Side};
use crate::pixels::Pixels;
use crate::settings::{Refiner, Settings};
use crate::verify;
use crate::view::{Prepared, View};
use coma_geometry::{Matrix6, Pose, se3};

/// A coarse alignment that the views do not contradict outright.
#[derive(Clone, Debug, PartialEq)]
pub struct Hypothesis {
    /// Maps source points to the target; good to some 5 cm and degrees.
    pub target_from_source: Pose,
    /// Feature matches that it explains.
    pub inliers: usize,
    /// [`Evidence::score`](crate::Evidence::score).
    pub score: f64,
}

/// A refined pose with its information.
#[derive(Clone, Debug, PartialEq)]
pub struct Refined {
    /// Maps source points to the target.
    pub target_from_source: Pose,
    /// Of the right perturbation, (translation, rotation).
    pub information: Matrix6,
    /// Smallest over largest eigenvalue of the Hessian.
    pub eigenvalue_ratio: f64,
    /// Root mean square distance along the normal, robustly weighted, metres.
    pub rmse_m: f64,
    /// Correspondences at the end.
    pub correspondences: usize,
    /// Independent samples that they are worth.
    pub effective_samples: usize,
    /// How far the translation moves if the focal lengths are wrong by `focal_uncertainty`, metres.
    pub calibration_m: f64,
}

/// Registers two views from no initial guess. The same input and seed give the same bits.
pub fn align(source: &View, target: &View, settings: &Settings, seed: u64) -> Outcome {
    let prepared = || {
        Ok((Prepared::new(source, settings, Side::Source)?, Prepared::new(target, settings, Side::Target)?))
    };
    match prepared() {
        Ok((source, target)) => align_prepared(&source, &target, settings, seed),
        Err(reason) => Outcome::Rejected(reason),
    }
}

/// [`align`] for views that are prepared already, with the same settings.
pub fn align_prepared(source: &Prepared, target: &Prepared, settings: &Settings, seed: u64) -> Outcome {
    match coarse(source, target, settings, seed) {
        Ok(hypotheses) => decide(source, target, hypotheses, settings),
        Err(reason) => Outcome::Rejected(reason),
    }
}

/// The second half of [`align_prepared`]: the best of [`coarse`]'s hypotheses are refined and verified, and the
/// one that both views agree with most is the verdict.
pub fn decide(
    source: &Prepared,
    target: &Prepared,
    mut hypotheses: Vec<Hypothesis>,
    settings: &Settings,
) -> Outcome {
    // The best few get a coarse ICP and are ranked again.
    hypotheses.truncate(settings.refined_hypotheses.max(1));
    let (source_coarse, target_coarse) = searchable(source, target, 0, 1500);
    let steps = Steps::from(&settings.scales[0]);
    for hypothesis in &mut hypotheses {
        let initial = hypothesis.target_from_source;
        match refine_scale(&source_coarse, &target_coarse, &initial, &steps, settings) {
            Some(pose) => {
                hypothesis.score = verify::evidence(source, target, &pose, settings).score;
                hypothesis.target_from_source = pose;
            }
            None => hypothesis.score = f64::NEG_INFINITY,
        }
    }
    hypotheses.sort_by(|a, b| b.score.total_cmp(&a.score));
    let pixels = pixel_scales(source, target, settings);
    let clouds = BothClouds::new(source, target, &pixels, settings);
    let mut best: Option<(f64, Alignment)> = None;
    let mut first_reason = None;
    for hypothesis in distinct(hypotheses).iter().take(settings.verified_hypotheses.max(1)) {
        // Refinement gains little on the score: one that lies this far behind will not catch up.
        if best.as_ref().is_some_and(|b| hypothesis.score < 0.8 * b.0) {
            break;
        }
        match judged(source, target, &clouds, hypothesis, settings) {
            Ok((score, alignment)) => {
                if best.as_ref().is_none_or(|b| score > b.0) {
                    best = Some((score, alignment));
                }
            }
            Err(reason) => first_reason = first_reason.or(Some(reason)),
        }
    }
    match (best, first_reason) {
        (Some((_, alignment)), _) => Outcome::Accepted(Box::new(alignment)),
        (None, Some(reason)) => Outcome::Rejected(reason),
        (None, None) => Outcome::Rejected(Reason::TooFewInliers { found: 0, needed: settings.min_inliers }),
    }
}

/// The first of every group of hypotheses that converged to one pose.
fn distinct(hypotheses: Vec<Hypothesis>) -> Vec<Hypothesis> {
    let mut kept: Vec<Hypothesis> = Vec::new();
    for hypothesis in hypotheses {
        let is_new = kept.iter().all(|k| {
            let (m, rad) = se3::distance(&k.target_from_source, &hypothesis.target_from_source);
            m > 0.03 || rad > 0.02
        });
        if is_new {
            kept.push(hypothesis);
        }
    }
    kept
}

/// Refines one hypothesis and verifies it; the score ranks it against others.
fn judged(
    source: &Prepared,
    target: &Prepared,
    clouds: &BothClouds,
    hypothesis: &Hypothesis,
    settings: &Settings,
) -> Result<(f64, Alignment), Reason> {
    let refined = refine_with(source, clouds, &hypothesis.target_from_source, settings)?;
    let evidence = verify::verify(source, target, &refined.target_from_source, settings)?;
    if !(refined.calibration_m <= settings.max_calibration_m) {
        let (metres, allowed) = (refined.calibration_m, settings.max_calibration_m);
        return Err(Reason::PoorlyConstrained { metres, allowed });
    }
    if !(evidence.consistency >= settings.min_fitness) {
        return Err(Reason::LowFitness { fitness: evidence.consistency, needed: settings.min_fitness });
    }
    let alignment = Alignment {
        target_from_source: refined.target_from_source,
        information: refined.information,
        overlap: evidence.overlap,
        conflicts: evidence.conflicts,
        rmse_m: refined.rmse_m,
        photometric_correlation: evidence.correlation,
        detail_correlation: evidence.detail_correlation,
        eigenvalue_ratio: refined.eigenvalue_ratio,
        correspondences: refined.correspondences,
        inliers: hypothesis.inliers,
        effective_samples: refined.effective_samples,
        calibration_m: refined.calibration_m,
    };
    Ok((evidence.score, alignment))
}

/// Features, matches, RANSAC: hypotheses ranked by how well the depth maps agree, best first; never empty.
pub fn coarse(
    source: &Prepared,
    target: &Prepared,
    settings: &Settings,
    seed: u64,
) -> Result<Vec<Hypothesis>, Reason> {
    let matches = mutual_matches(&source.features, &target.features, settings.mutual_nearest);
    if matches.len() < settings.min_matches {
        return Err(Reason::TooFewMatches { found: matches.len(), needed: settings.min_matches });
    }
    let (found, most) = consensus::hypotheses(&source.clouds[0], &target.clouds[0], &matches, settings, seed);
    if found.is_empty() {
        return Err(Reason::TooFewInliers { found: most, needed: settings.min_inliers });
    }
    let poses: Vec<Pose> = found.iter().map(|h| h.target_from_source).collect();
    let scores = verify::scores(source, target, &poses, settings);
    let mut out: Vec<Hypothesis> = found
        .into_iter()
        .zip(scores)
        .map(|(h, score)| Hypothesis { target_from_source: h.target_from_source, inliers: h.inliers, score })
        .collect();
    out.sort_by(|a, b| b.score.total_cmp(&a.score));
    Ok(out)
}

/// Multi-scale refinement from an initial pose (good to about 15 cm and 10 degrees), with information and
/// the test that the scene pins the motion.
pub fn refine(
    source: &Prepared,
    target: &Prepared,
    initial: &Pose,
    settings: &Settings,
) -> Result<Refined, Reason> {
    let pixels = pixel_scales(source, target, settings);
    refine_with(source, &BothClouds::new(source, target, &pixels, settings), initial, settings)
}

/// Both views' points of the pixel scales.
fn pixel_scales(source: &Prepared, target: &Prepared, settings: &Settings) -> Vec<(Pixels, Pixels)> {
    let of = |view: &Prepared, scale| Pixels::new(view, settings.depth_jump, scale);
    settings.pixels.iter().map(|scale| (of(source, scale), of(target, scale))).collect()
}

/// Both clouds of every scale, coarse to fine: made once, for all hypotheses.
struct BothClouds<'a>(Vec<(Searchable<'a>, Searchable<'a>, Steps)>);

impl<'a> BothClouds<'a> {
    fn new(
        source: &'a Prepared,
        target: &'a Prepared,
        pixels: &'a [(Pixels, Pixels)],
        settings: &Settings,
    ) -> Self {
        let voxels = settings.scales.iter().enumerate().map(|(level, scale)| {
            let (s, t) = searchable(source, target, level, settings.icp_points);
            (s, t, Steps::from(scale))
        });
        let pixels = pixels.iter().zip(&settings.pixels).map(|((s, t), scale)| {
            let (s, t) =
                (Searchable::by_projection(s, source.noise), Searchable::by_projection(t, target.noise));
            (s, t, Steps::from(scale))
        });
        BothClouds(voxels.chain(pixels).collect())
    }
}

fn refine_with(
    source: &Prepared,
    clouds: &BothClouds,
    initial: &Pose,
    settings: &Settings,
) -> Result<Refined, Reason> {
    let needed = settings.min_correspondences;
    let diverged = |correspondences| Reason::Diverged { correspondences, needed };
    let mut pose = *initial;
    let mut observability = None;
    let mut residuals = Vec::new();
    for (level, (s, t, steps)) in clouds.0.iter().enumerate() {
        pose = refine_scale(s, t, &pose, steps, settings).ok_or(diverged(0))?;
        // The first scale judges what the scene pins: normals and gradients are calmest there, their noise looks like
        // structure. The last one gives the information.
        if level == 0 || level + 1 == clouds.0.len() {
            residuals = icp::linearise(s, t, &pose, steps.max_correspondence_m);
            if settings.refiner == Refiner::Generalised {
                // What the refiner did not look at pins nothing.
                residuals.iter_mut().for_each(icp::Residual::forget_brightness);
            }
        }
        if level == 0 {
            observability = Observability::new(&residuals, settings);
        }
    }
    let floor = settings.min_eigenvalue_ratio;
    let Some(observability) = observability else {
        return Err(Reason::Unobservable { eigenvalue_ratio: 0.0, needed: floor });
    };
    let eigenvalue_ratio = observability.ratio();
    if !(eigenvalue_ratio >= floor) {
        return Err(Reason::Unobservable { eigenvalue_ratio, needed: floor });
    }
    if residuals.len() < needed {
        return Err(diverged(residuals.len()));
    }
    let by_focal = focal_sensitivity(&residuals, settings)
        .ok_or(Reason::Unobservable { eigenvalue_ratio, needed: floor })?;
    let calibration_m = settings.focal_uncertainty * by_focal.fixed_rows::<3>(0).norm();
    let (information, effective_samples) = information(&residuals, &observability, &source.camera, settings)
        .ok_or(Reason::Unobservable { eigenvalue_ratio, needed: floor })?;
    let scales = icp::Scales::of(&residuals);
    let (sum, weight) = residuals.iter().fold((0.0, 0.0), |(sum, weight), r| {
        let w = scales.weights(r).0;
        (sum + w * r.geometric_m * r.geometric_m, weight + w)
    });
    Ok(Refined {
        target_from_source: pose,
        information,
        eigenvalue_ratio,
        rmse_m: (sum / weight).sqrt(),
        correspondences: residuals.len(),
        effective_samples,
        calibration_m,
    })
}

fn refine_scale(
    source: &Searchable,
    target: &Searchable,
    initial: &Pose,
    steps: &Steps,
    settings: &Settings,
) -> Option<Pose> {
    match settings.refiner {
        Refiner::Coloured => icp::refine_scale(source, target, initial, steps, settings),
        Refiner::Generalised => gicp::refine_scale(source, target, initial, steps),
    }
}

fn searchable<'a>(
    source: &'a Prepared,
    target: &'a Prepared,
    level: usize,
    queries: usize,
) -> (Searchable<'a>, Searchable<'a>) {
    (
        Searchable::new(&source.clouds[level], source.noise, queries),
        Searchable::new(&target.clouds[level], target.noise, queries),
    )
}
