//! Do two views agree at a pose? Overlap, free-space conflicts, brightness: projective, in both directions.

use crate::outcome::Reason;
use crate::settings::Settings;
use crate::view::{Prepared, bilinear};
use coma_geometry::Pose;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// What both views say about a pose.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Evidence {
    /// Share of a view's points that the other sees at its own depth, the lesser direction.
    pub overlap: f64,
    /// Share of points, of those in agreement or conflict, in front of what the other view measured there.
    pub conflicts: f64,
    /// Correlation of intensities of agreeing points; `None` if they are too plain to say.
    pub correlation: Option<f64>,
    /// The same of their detail ([`crate::detail`]), the lesser direction.
    pub detail_correlation: Option<f64>,
    /// Share of agreeing points minus twice that of conflicting ones, of all points: ranks hypotheses.
    pub score: f64,
    /// Share of agreeing points among those that fall onto a measurement of the other view.
    pub consistency: f64,
}

/// Detail with a standard deviation below this is noise.
const MIN_DETAIL: f64 = 0.2;

/// What happened to one view's points in the other.
#[derive(Clone, Copy, Debug, Default)]
struct Counts {
    points: usize,
    agree: usize,
    conflict: usize,
    occluded: usize,
}

/// Running moments of pairs of intensities.
#[derive(Clone, Copy, Debug, Default)]
struct Moments {
    n: f64,
    a: f64,
    b: f64,
    aa: f64,
    bb: f64,
    ab: f64,
}

impl Moments {
    fn add(&mut self, a: f64, b: f64) {
        self.n += 1.0;
        self.a += a;
        self.b += b;
        self.aa += a * a;
        self.bb += b * b;
        self.ab += a * b;
    }

    /// Zero-mean normalised correlation: gain and offset do not matter.
    fn correlation(&self, min_contrast: f64) -> Option<f64> {
        if self.n < 20.0 {
            return None;
        }
        let (ma, mb) = (self.a / self.n, self.b / self.n);
        let (sa, sb) =
            ((self.aa / self.n - ma * ma).max(0.0).sqrt(), (self.bb / self.n - mb * mb).max(0.0).sqrt());
        (sa >= min_contrast && sb >= min_contrast).then(|| (self.ab / self.n - ma * mb) / (sa * sb))
    }
}

/// Looks at a pose from both sides.
pub fn evidence(
    source: &Prepared,
    target: &Prepared,
    target_from_source: &Pose,
    settings: &Settings,
) -> Evidence {
    let mut moments = Moments::default();
    let (mut there, mut back) = (Moments::default(), Moments::default());
    let forward = look(source, target, target_from_source, settings, 1, |at, (u, v)| {
        moments.add(source.intensity[at] as f64, bilinear(&target.intensity, u, v) as f64);
        there.add(source.detail[at] as f64, bilinear(&target.detail, u, v) as f64);
    });
    let backward = look(target, source, &target_from_source.inverse(), settings, 1, |at, (u, v)| {
        moments.add(bilinear(&source.intensity, u, v) as f64, target.intensity[at] as f64);
        back.add(bilinear(&source.detail, u, v) as f64, target.detail[at] as f64);
    });
    let details = there.correlation(MIN_DETAIL).zip(back.correlation(MIN_DETAIL));
    Evidence {
        correlation: moments.correlation(settings.min_contrast),
        detail_correlation: details.map(|(there, back)| there.min(back)),
        ..summary(&forward, &backward)
    }
}

/// [`Evidence::score`] of many poses, from every third point; in the order given.
pub fn scores(source: &Prepared, target: &Prepared, poses: &[Pose], settings: &Settings) -> Vec<f64> {
    poses
        .par_iter()
        .map(|pose| {
            let forward = look(source, target, pose, settings, 3, |_, _| ());
            let backward = look(target, source, &pose.inverse(), settings, 3, |_, _| ());
            summary(&forward, &backward).score
        })
        .collect()
}

/// What the counts say, without the pictures.
fn summary(forward: &Counts, backward: &Counts) -> Evidence {
    let share = |part: usize, of: usize| if of == 0 { 0.0 } else { part as f64 / of as f64 };
    let agree = forward.agree + backward.agree;
    let conflict = forward.conflict + backward.conflict;
    let hit = agree + conflict + forward.occluded + backward.occluded;
    let points = forward.points + backward.points;
    Evidence {
        overlap: share(forward.agree, forward.points).min(share(backward.agree, backward.points)),
        conflicts: share(conflict, agree + conflict),
        correlation: None,
        detail_correlation: None,
        score: share(agree, points) - 2.0 * share(conflict, points),
        consistency: share(agree, hit),
    }
}

/// Moves one view's grid points into the other and compares depths. `pair` gets the pixel of each agreeing point and
/// where the other view should show it.
fn look(
    from: &Prepared,
    into: &Prepared,
    into_from_from: &Pose,
    settings: &Settings,
    step: usize,
    mut pair: impl FnMut((usize, usize), (f32, f32)),
) -> Counts {
    let mut counts = Counts::default();
    let (width, height) = (into.depth_m.width(), into.depth_m.height());
    for &(x, y, z) in from.grid.iter().step_by(step) {
        counts.points += 1;
        let moved = into_from_from * from.camera.back_project(x as f64, y as f64, z as f64);
        let Some(pixel) = into.camera.project(&moved) else { continue };
        let (u, v) = (pixel.x.round(), pixel.y.round());
        if !(u >= 0.0 && v >= 0.0 && u < width as f64 && v < height as f64) {
            continue;
        }
        let (u, v) = (u as usize, v as usize);
        if !(into.depth_m[(u, v)] > 0.0) {
            continue;
        }
        let expected = moved.z as f32;
        // The neighbour that fits best: a pose that is off by a pixel is no conflict at an edge.
        let (mut nearest, mut miss) = (f32::INFINITY, f32::INFINITY);
        for ny in v.saturating_sub(1)..=(v + 1).min(height - 1) {
            for nx in u.saturating_sub(1)..=(u + 1).min(width - 1) {
                let there = into.depth_m[(nx, ny)];
                if there > 0.0 {
                    nearest = nearest.min(there);
                    miss = miss.min((there - expected).abs());
                }
            }
        }
        let sigma = from.noise.sigma_m(z).hypot(into.noise.sigma_m(expected));
        let tolerance = settings.depth_tolerance_m + settings.depth_tolerance_sigmas * sigma;
        if miss <= tolerance {
            counts.agree += 1;
            pair((x as usize, y as usize), (pixel.x as f32, pixel.y as f32));
        } else if expected < nearest - tolerance {
            counts.conflict += 1;
        } else {
            counts.occluded += 1;
        }
    }
    counts
}

/// The verdict on a pose: its evidence, or why it cannot be right.
pub fn verify(
    source: &Prepared,
    target: &Prepared,
    target_from_source: &Pose,
    settings: &Settings,
) -> Result<Evidence, Reason> {
    let evidence = evidence(source, target, target_from_source, settings);
    if !(evidence.overlap >= settings.min_overlap) {
        return Err(Reason::LowOverlap { overlap: evidence.overlap, needed: settings.min_overlap });
    }
    if !(evidence.conflicts <= settings.max_conflict) {
        return Err(Reason::Conflict { conflicts: evidence.conflicts, allowed: settings.max_conflict });
    }
    if let Some(correlation) = evidence.correlation
        && !(correlation >= settings.min_correlation)
    {
        return Err(Reason::PhotometricMismatch { correlation, needed: settings.min_correlation });
    }
    if let Some(correlation) = evidence.detail_correlation
        && !(correlation >= settings.min_detail_correlation)
    {
        return Err(Reason::DetailMismatch { correlation, needed: settings.min_detail_correlation });
    }
    Ok(evidence)
}
