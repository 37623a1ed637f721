//! RANSAC over feature matches (Fischler & Bolles 1981), guided by pairwise compatibility: a rigid motion
//! keeps distances and angles between normals, so a sample is grown only among matches that do. Even with
//! a few inliers in a hundred a few thousand samples then hit them many times.

use crate::cloud::PointCloud;
use crate::matching::Match;
use crate::settings::Settings;
use coma_geometry::alignment::rigid_alignment;
use coma_geometry::{Pose, se3};
use nalgebra::{Point3, Vector3};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

/// A motion and how many matches it explains.
#[derive(Clone, Debug, PartialEq)]
pub struct Consensus {
    /// Maps source points to the target.
    pub target_from_source: Pose,
    /// Matches within the inlier distance.
    pub inliers: usize,
}

/// Samples of one batch; batches draw from streams of their own, so that threads do not matter.
const BATCH: usize = 256;
/// Batches between two looks at whether to stop.
const BATCHES_PER_ROUND: usize = 8;
/// Matches of one sample are at least this far apart, metres: two voxels say nothing of a rotation.
const MIN_EDGE_M: f32 = 0.15;
/// More matches than this are thinned out evenly.
const MAX_MATCHES: usize = 3000;
/// Motions closer than this are one hypothesis.
const DISTINCT_M: f64 = 0.10;
/// See [`DISTINCT_M`].
const DISTINCT_RAD: f64 = 0.10;

/// Up to `settings.hypotheses` distinct motions, most inliers first. Fewer than `settings.min_inliers`
/// matches make none; the second value is the most inliers that any sample had.
pub fn hypotheses(
    source: &PointCloud,
    target: &PointCloud,
    matches: &[Match],
    settings: &Settings,
    seed: u64,
) -> (Vec<Consensus>, usize) {
    let keep = matches.len().min(MAX_MATCHES);
    let pairs: Vec<Pair> =
        (0..keep).map(|i| Pair::new(source, target, &matches[i * matches.len() / keep.max(1)])).collect();
    if pairs.len() < 3 {
        return (Vec::new(), 0);
    }
    let compatible = Compatibility::new(&pairs, settings);
    let mut found: Vec<Consensus> = Vec::new();
    let mut most = 0;
    let rounds = settings.samples.div_ceil(BATCH * BATCHES_PER_ROUND);
    for round in 0..rounds {
        let batches: Vec<Vec<Consensus>> = (0..BATCHES_PER_ROUND)
            .into_par_iter()
            .map(|b| batch(&pairs, &compatible, settings, seed, (round * BATCHES_PER_ROUND + b) as u64))
            .collect();
        for hypothesis in batches.into_iter().flatten() {
            most = most.max(hypothesis.inliers);
            if hypothesis.inliers >= settings.min_inliers {
                found.push(hypothesis);
            }
        }
        // A sample starts at an inlier with probability w, goes on to another with about w / q (q: share of
        // compatible pairs), and the third then follows at least every other time.
        let w = most as f64 / pairs.len() as f64;
        let hit = 0.5 * w * (w / compatible.density).min(1.0);
        let drawn = ((round + 1) * BATCHES_PER_ROUND * BATCH) as f64;
        if most >= settings.min_inliers && drawn * (1.0 - hit).ln() < settings.miss_probability.ln() {
            break;
        }
    }
    // Stable: equal counts keep the order of drawing.
    found.sort_by_key(|h| std::cmp::Reverse(h.inliers));
    let mut distinct: Vec<Consensus> = Vec::new();
    for hypothesis in found {
        if distinct.len() == settings.hypotheses {
            break;
        }
        let is_new = distinct.iter().all(|kept| {
            let (m, rad) = se3::distance(&kept.target_from_source, &hypothesis.target_from_source);
            m > DISTINCT_M || rad > DISTINCT_RAD
        });
        if is_new {
            distinct.push(hypothesis);
        }
    }
    let mut refitted: Vec<Consensus> =
        distinct.into_par_iter().map(|h| refit(&pairs, h, settings.inlier_m)).collect();
    refitted.sort_by_key(|h| std::cmp::Reverse(h.inliers));
    (refitted, most)
}

/// Both ends of a match.
struct Pair {
    source: Point3<f32>,
    target: Point3<f32>,
    source_normal: Vector3<f32>,
    target_normal: Vector3<f32>,
}

impl Pair {
    fn new(source: &PointCloud, target: &PointCloud, m: &Match) -> Self {
        let (s, t) = (m.source as usize, m.target as usize);
        Pair {
            source: source.points[s],
            target: target.points[t],
            source_normal: source.normals[s],
            target_normal: target.normals[t],
        }
    }

    /// The edge-length check and its kin for angles: all that a rigid motion cannot change.
    fn agrees_with(&self, other: &Pair, settings: &Settings) -> bool {
        let (a, b) = (other.source - self.source, other.target - self.target);
        let (la, lb) = (a.norm(), b.norm());
        if !((la - lb).abs() <= settings.edge_tolerance_m && la.min(lb) >= MIN_EDGE_M) {
            return false;
        }
        let angle = |x: f32| x.clamp(-1.0, 1.0).acos();
        let close = |x: f32, y: f32| (angle(x) - angle(y)).abs() <= settings.normal_tolerance_rad;
        close(self.source_normal.dot(&other.source_normal), self.target_normal.dot(&other.target_normal))
            && close(self.source_normal.dot(&a) / la, self.target_normal.dot(&b) / lb)
            && close(other.source_normal.dot(&a) / la, other.target_normal.dot(&b) / lb)
    }
}

/// Which pairs of matches agree, as rows of bits.
struct Compatibility {
    rows: Vec<Vec<u64>>,
    density: f64,
}

impl Compatibility {
    fn new(pairs: &[Pair], settings: &Settings) -> Self {
        let words = pairs.len().div_ceil(64);
        let rows: Vec<Vec<u64>> = pairs
            .par_iter()
            .enumerate()
            .map(|(i, pair)| {
                let mut row = vec![0u64; words];
                for (j, other) in pairs.iter().enumerate() {
                    if i != j && pair.agrees_with(other, settings) {
                        row[j / 64] |= 1 << (j % 64);
                    }
                }
                row
            })
            .collect();
        let ones: usize = rows.iter().flatten().map(|w| w.count_ones() as usize).sum();
        let density = (ones as f64 / (pairs.len() * pairs.len()) as f64).max(1e-9);
        Compatibility { rows, density }
    }
}

/// A random set bit; `None` if there is none.
fn random_bit(row: &[u64], rng: &mut ChaCha8Rng) -> Option<usize> {
    let ones: u32 = row.iter().map(|w| w.count_ones()).sum();
    if ones == 0 {
        return None;
    }
    let mut skip = below(rng, ones);
    for (i, &word) in row.iter().enumerate() {
        let here = word.count_ones();
        if skip < here {
            let mut word = word;
            for _ in 0..skip {
                word &= word - 1;
            }
            return Some(i * 64 + word.trailing_zeros() as usize);
        }
        skip -= here;
    }
    None
}

/// A number in `0..n` (Lemire's multiply-shift; its bias of n / 2^32 does not matter here).
fn below(rng: &mut ChaCha8Rng, n: u32) -> u32 {
    ((rng.next_u32() as u64 * n as u64) >> 32) as u32
}

/// Draws one batch of samples and counts the inliers of each.
fn batch(
    pairs: &[Pair],
    compatible: &Compatibility,
    settings: &Settings,
    seed: u64,
    stream: u64,
) -> Vec<Consensus> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(stream);
    let mut found = Vec::new();
    let mut both = vec![0u64; compatible.rows[0].len()];
    for _ in 0..BATCH {
        let i = below(&mut rng, pairs.len() as u32) as usize;
        let Some(j) = random_bit(&compatible.rows[i], &mut rng) else { continue };
        for (out, (a, b)) in both.iter_mut().zip(compatible.rows[i].iter().zip(&compatible.rows[j])) {
            *out = a & b;
        }
        let Some(k) = random_bit(&both, &mut rng) else { continue };
        let sample = [i, j, k];
        let source = sample.map(|m| pairs[m].source.cast::<f64>());
        let target = sample.map(|m| pairs[m].target.cast::<f64>());
        let Some(pose) = rigid_alignment(&source, &target) else { continue };
        // The distance check.
        let limit = settings.inlier_m as f64;
        if !source.iter().zip(&target).all(|(s, t)| (pose * s - t).norm() <= limit) {
            continue;
        }
        let inliers = inliers(pairs, &pose, settings.inlier_m).count();
        found.push(Consensus { target_from_source: pose, inliers });
    }
    found
}

/// Matches that a motion explains.
fn inliers<'a>(pairs: &'a [Pair], pose: &Pose, limit_m: f32) -> impl Iterator<Item = &'a Pair> {
    let pose = pose.cast::<f32>();
    let rotation = *pose.rotation.to_rotation_matrix().matrix();
    pairs.iter().filter(move |p| {
        let moved = rotation * p.source.coords + pose.translation.vector;
        (moved - p.target.coords).norm_squared() <= limit_m * limit_m
            && (rotation * p.source_normal).dot(&p.target_normal) > 0.5
    })
}

/// Least squares over the inliers, twice; kept only where it explains no fewer.
fn refit(pairs: &[Pair], mut best: Consensus, limit_m: f32) -> Consensus {
    for _ in 0..2 {
        let (source, target): (Vec<_>, Vec<_>) = inliers(pairs, &best.target_from_source, limit_m)
            .map(|p| (p.source.cast::<f64>(), p.target.cast::<f64>()))
            .unzip();
        let Some(pose) = rigid_alignment(&source, &target) else { break };
        let count = inliers(pairs, &pose, limit_m).count();
        if count < best.inliers {
            break;
        }
        best = Consensus { target_from_source: pose, inliers: count };
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_geometry::Tangent;

    /// 20 true matches among `wrong` false ones.
    fn scene(wrong: usize) -> (PointCloud, PointCloud, Vec<Match>, Pose) {
        let truth = se3::exp(&Tangent::new(0.5, -0.2, 0.3, 0.2, 0.4, -0.3));
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut unit = || below(&mut rng, 1 << 24) as f32 / (1 << 24) as f32;
        let (mut source, mut target, mut matches) =
            (PointCloud::default(), PointCloud::default(), Vec::new());
        let motion = truth.cast::<f32>();
        for i in 0..20 + wrong {
            let mut point = || Point3::new(unit() * 3.0 - 1.5, unit() * 2.0 - 1.0, unit() * 2.0 + 1.0);
            let (p, q) = (point(), point());
            let mut normal = || Vector3::new(unit() - 0.5, unit() - 0.5, unit() - 0.5).normalize();
            let (n, m) = (normal(), normal());
            source.points.push(p);
            source.normals.push(n);
            let is_true = i % (1 + wrong / 20) == 0 && i / (1 + wrong / 20) < 20;
            target.points.push(if is_true { motion * p } else { q });
            target.normals.push(if is_true { motion * n } else { m });
            matches.push(Match { source: i as u32, target: i as u32 });
        }
        (source, target, matches, truth)
    }

    #[test]
    fn five_true_matches_in_a_hundred_are_enough() {
        let (source, target, matches, truth) = scene(380);
        let (found, _) = hypotheses(&source, &target, &matches, &Settings::default(), 1);
        let (m, rad) = se3::distance(&truth, &found[0].target_from_source);
        assert!(found[0].inliers >= 20 && m < 0.02 && rad < 0.02, "{m} {rad} {}", found[0].inliers);
    }

    #[test]
    fn the_seed_decides_and_the_threads_do_not() {
        let (source, target, matches, _) = scene(380);
        // Chance agreements are kept, so that there is something to differ in.
        let settings = Settings { min_inliers: 3, ..Settings::default() };
        let run = |threads, seed| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| hypotheses(&source, &target, &matches, &settings, seed))
        };
        assert_eq!(run(1, 3), run(4, 3));
        assert_ne!(run(1, 3).0, run(1, 4).0);
    }

    #[test]
    fn two_matches_make_no_hypothesis() {
        let (source, target, matches, _) = scene(0);
        assert!(hypotheses(&source, &target, &matches[..2], &Settings::default(), 1).0.is_empty());
    }
}
