//! What descriptors are worth as a means to find places again: they are scored by the true overlap of views.

use coma_place::Thresholds;
use serde::Serialize;

/// Views that share so much show one place.
const SAME: f64 = 0.4;
/// Views that share less show different ones.
const OTHER: f64 = 0.1;
/// A perturbed view is found again if the best match lies within so many frames.
const FOUND_WITHIN_FRAMES: usize = 12;

/// The scores. Only pairs of frames that lie far apart in time count.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Scores {
    /// Frames that were described.
    pub frames: usize,
    /// Frames that have a match, a view that shares at least 40 %.
    pub queries: usize,
    /// Pairs that share at least 40 %.
    pub pairs: usize,
    /// Share of the queries whose best candidate is a match.
    pub recall_at_1: f64,
    /// Average precision of the matches among all pairs.
    pub average_precision: f64,
    /// Share of the matches scored above every pair that shares less than 10 %.
    pub recall_without_false: f64,
    /// The same by the mean similarity over all pairs of both windows.
    pub window_recall_without_false: f64,
    /// Share of the perturbed views whose best candidate lies within 12 frames of the original.
    pub perturbed_hit: f64,
}

/// Shares of pairs that both thresholds let pass.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Passed {
    /// Of those that share at least 40 %.
    pub matches: f64,
    /// Of those that share less than 10 %.
    pub others: f64,
}

/// Everything that is known of some frames.
pub struct Known<'a> {
    /// Index of each frame in its sequence.
    pub ids: &'a [usize],
    /// Frames nearer than this many are no pair.
    pub gap: usize,
    /// Frames to either side that belong to a window.
    pub window: usize,
    /// True overlap, `[frame, frame]`.
    pub overlap: &'a [Vec<f64>],
    /// Cosine, `[frame, frame]`.
    pub similarity: &'a [Vec<f32>],
    /// Perturbed views: which frame each was made of, and its cosine with every frame.
    pub perturbed: &'a [(usize, Vec<f32>)],
}

impl Known<'_> {
    /// Scores them.
    pub fn scores(&self) -> Scores {
        let n = self.ids.len();
        let far = |i: usize, j: usize| self.ids[i].abs_diff(self.ids[j]) > self.gap;
        let (mut queries, mut hits) = (0, 0);
        for i in 0..n {
            let others: Vec<usize> = (0..n).filter(|j| far(i, *j)).collect();
            if !others.iter().any(|j| self.overlap[i][*j] >= SAME) {
                continue;
            }
            queries += 1;
            hits +=
                best(&others, |j| self.similarity[i][j]).is_some_and(|j| self.overlap[i][j] >= SAME) as usize;
        }
        let pairs = |score: &dyn Fn(usize, usize) -> f32| -> Vec<(f32, f64)> {
            let all = (0..n).flat_map(|i| (i + 1..n).map(move |j| (i, j)));
            let mut scored: Vec<_> =
                all.filter(|(i, j)| far(*i, *j)).map(|(i, j)| (score(i, j), self.overlap[i][j])).collect();
            scored.sort_by(|a, b| b.0.total_cmp(&a.0));
            scored
        };
        let single = pairs(&|i, j| self.similarity[i][j]);
        let windows = pairs(&|i, j| self.window_similarity(i, j));
        let everyone: Vec<usize> = (0..n).collect();
        let found = |(of, row): &&(usize, Vec<f32>)| {
            best(&everyone, |j| row[j])
                .is_some_and(|j| self.ids[j].abs_diff(self.ids[*of]) <= FOUND_WITHIN_FRAMES)
        };
        let share = |part: usize, of: usize| part as f64 / of.max(1) as f64;
        Scores {
            frames: n,
            queries,
            pairs: single.iter().filter(|p| p.1 >= SAME).count(),
            recall_at_1: share(hits, queries),
            average_precision: average_precision(&single),
            recall_without_false: recall_without_false(&single),
            window_recall_without_false: recall_without_false(&windows),
            perturbed_hit: share(self.perturbed.iter().filter(found).count(), self.perturbed.len()),
        }
    }

    /// Which pairs would be candidates.
    pub fn passed(&self, thresholds: Thresholds) -> Passed {
        let n = self.ids.len();
        let share = |counts: &dyn Fn(f64) -> bool| {
            let pairs = (0..n).flat_map(|i| (i + 1..n).map(move |j| (i, j)));
            let far = pairs.filter(|(i, j)| self.ids[*i].abs_diff(self.ids[*j]) > self.gap);
            let of: Vec<(usize, usize)> = far.filter(|(i, j)| counts(self.overlap[*i][*j])).collect();
            let passes = |(i, j): &&(usize, usize)| {
                self.similarity[*i][*j] > thresholds.theta_sim
                    && self.window_similarity(*i, *j) > thresholds.theta_multi
            };
            of.iter().filter(passes).count() as f64 / of.len().max(1) as f64
        };
        Passed { matches: share(&|overlap| overlap >= SAME), others: share(&|overlap| overlap < OTHER) }
    }

    /// Mean over all pairs of the two windows.
    fn window_similarity(&self, i: usize, j: usize) -> f32 {
        let around = |k: usize| k.saturating_sub(self.window)..(k + self.window + 1).min(self.ids.len());
        let all: Vec<f32> = around(i).flat_map(|a| around(j).map(move |b| self.similarity[a][b])).collect();
        all.iter().sum::<f32>() / all.len() as f32
    }
}

/// The first of those with the highest score.
fn best(among: &[usize], score: impl Fn(usize) -> f32) -> Option<usize> {
    among.iter().copied().reduce(|a, b| if score(b) > score(a) { b } else { a })
}

/// Of pairs by falling score: the precision at each match, on average.
fn average_precision(pairs: &[(f32, f64)]) -> f64 {
    let (mut found, mut sum) = (0usize, 0.0);
    for (rank, pair) in pairs.iter().enumerate() {
        if pair.1 >= SAME {
            found += 1;
            sum += found as f64 / (rank + 1) as f64;
        }
    }
    sum / found.max(1) as f64
}

fn recall_without_false(pairs: &[(f32, f64)]) -> f64 {
    let worst = pairs.iter().find(|p| p.1 < OTHER).map_or(f32::NEG_INFINITY, |p| p.0);
    let matches = pairs.iter().filter(|p| p.1 >= SAME);
    matches.clone().filter(|p| p.0 > worst).count() as f64 / matches.count().max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn precision_and_recall_are_those_of_a_small_example() {
        // A match, a stranger, a match, one of neither kind, a match.
        let pairs = [(0.9, 0.8), (0.8, 0.0), (0.7, 0.5), (0.6, 0.2), (0.5, 0.4)];
        assert!((average_precision(&pairs) - (1.0 + 2.0 / 3.0 + 3.0 / 5.0) / 3.0).abs() < 1e-12);
        assert!((recall_without_false(&pairs) - 1.0 / 3.0).abs() < 1e-12);
    }

    #[test]
    fn neighbours_in_time_are_no_pair() {
        let ids = [0, 10, 100];
        let overlap = vec![vec![1.0, 0.9, 0.5], vec![0.9, 1.0, 0.0], vec![0.5, 0.0, 1.0]];
        let similarity = vec![vec![1.0, 0.9, 0.5], vec![0.9, 1.0, 0.1], vec![0.5, 0.1, 1.0]];
        let perturbed = [(0, vec![0.8, 0.9, 0.1]), (2, vec![0.9, 0.1, 0.2])];
        let known = Known {
            ids: &ids,
            gap: 25,
            window: 0,
            overlap: &overlap,
            similarity: &similarity,
            perturbed: &perturbed,
        };
        let scores = known.scores();
        assert_eq!((scores.queries, scores.pairs), (2, 1));
        assert_eq!(
            (scores.recall_at_1, scores.average_precision, scores.recall_without_false),
            (1.0, 1.0, 1.0)
        );
        assert_eq!(scores.perturbed_hit, 0.5);
    }
}
