//! Which features of two clouds belong together: nearest neighbours in 33 dimensions, in both directions.

use crate::fpfh::{Feature, STRIDE};
use multiversion::multiversion;
use rayon::prelude::*;

/// A pair of points with similar features.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Match {
    /// Index into the source cloud.
    pub source: u32,
    /// Index into the target cloud.
    pub target: u32,
}

/// Pairs that are among each other's `k` nearest features (`k = 1`: mutual nearest neighbours), ordered by
/// source, then target. Zero features match nothing. Exact: every pair is compared.
pub fn mutual_matches(source: &[Feature], target: &[Feature], k: usize) -> Vec<Match> {
    if source.is_empty() || target.is_empty() || k == 0 {
        return Vec::new();
    }
    let forward = nearest(source, target, k);
    let backward = nearest(target, source, k);
    let mut matches = Vec::new();
    for (s, near) in forward.iter().enumerate() {
        let mut near: Vec<u32> = near.iter().map(|n| n.1).collect();
        near.sort_unstable();
        for t in near {
            if backward[t as usize].iter().any(|n| n.1 == s as u32) {
                matches.push(Match { source: s as u32, target: t });
            }
        }
    }
    matches
}

/// For every query its `k` nearest features: squared distance and index, nearest first, ties by index.
fn nearest(queries: &[Feature], features: &[Feature], k: usize) -> Vec<Vec<(f32, u32)>> {
    queries
        .par_iter()
        .map(|query| {
            let mut best: Vec<(f32, u32)> = Vec::with_capacity(k + 1);
            if query.iter().all(|v| *v == 0.0) {
                return best;
            }
            let mut distances = vec![0.0f32; features.len()];
            squared_distances(query, features, &mut distances);
            let mut limit = f32::INFINITY;
            for (i, &d2) in distances.iter().enumerate() {
                if d2 < limit {
                    let at = best.partition_point(|b| b.0 <= d2);
                    best.insert(at, (d2, i as u32));
                    best.truncate(k);
                    if best.len() == k {
                        limit = best[k - 1].0;
                    }
                }
            }
            best
        })
        .collect()
}

/// Squared Euclidean distances; eight running sums, so that the compiler may use SIMD in a fixed order.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma", "aarch64+neon"))]
fn squared_distances(query: &Feature, features: &[Feature], out: &mut [f32]) {
    for (feature, out) in features.iter().zip(out) {
        let mut sums = [0.0f32; 8];
        for chunk in 0..STRIDE / 8 {
            for lane in 0..8 {
                let d = query[chunk * 8 + lane] - feature[chunk * 8 + lane];
                sums[lane] += d * d;
            }
        }
        *out = (sums[0] + sums[4]) + (sums[1] + sums[5]) + (sums[2] + sums[6]) + (sums[3] + sums[7]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn feature(seed: usize) -> Feature {
        let mut f = [0.0; STRIDE];
        for (b, v) in f.iter_mut().take(33).enumerate() {
            *v = ((seed * 7919 + b * 104_729) % 101) as f32;
        }
        f
    }

    #[test]
    fn a_shuffled_copy_is_matched_one_to_one() {
        let source: Vec<Feature> = (0..60).map(feature).collect();
        let target: Vec<Feature> = (0..60).map(|i| source[(i * 37) % 60]).collect();
        let matches = mutual_matches(&source, &target, 1);
        assert_eq!(matches.len(), 60);
        assert!(matches.iter().all(|m| m.source == (m.target * 37) % 60));
    }

    #[test]
    fn zero_features_match_nothing() {
        let zero = vec![[0.0; STRIDE]; 5];
        assert!(mutual_matches(&zero, &zero, 1).is_empty());
        assert!(mutual_matches(&[], &zero, 1).is_empty());
    }
}
