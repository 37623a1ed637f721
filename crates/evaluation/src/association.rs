//! Which pose of the estimate belongs to which of the truth.

use coma_geometry::StampNs;
use serde::{Deserialize, Serialize};

/// How stamps are matched.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Association {
    /// Equal to the nanosecond: runs repeat the stamps of their input.
    #[default]
    Exact,
    /// The nearest within a tolerance, as `evo` does it: every stamp of the shorter list looks for its nearest in the
    /// longer one; of two equally near ones the earlier is taken.
    Nearest {
        /// Largest difference, nanoseconds (`evo`'s default is 10 ms).
        tolerance_ns: u64,
    },
}

/// Index pairs `(estimate, truth)`, in the order of time. Both lists must grow.
pub fn associate(estimate: &[StampNs], truth: &[StampNs], how: Association) -> Vec<(usize, usize)> {
    let tolerance_ns = match how {
        Association::Exact => 0,
        Association::Nearest { tolerance_ns } => tolerance_ns,
    };
    if estimate.len() > truth.len() {
        nearest(truth, estimate, tolerance_ns).map(|(truth, estimate)| (estimate, truth)).collect()
    } else {
        nearest(estimate, truth, tolerance_ns).collect()
    }
}

fn nearest(short: &[StampNs], long: &[StampNs], tolerance_ns: u64) -> impl Iterator<Item = (usize, usize)> {
    short.iter().enumerate().filter_map(move |(index, stamp)| {
        let after = long.partition_point(|other| other <= stamp);
        let distance_ns = |other: usize| long.get(other).map(|other| other.0.abs_diff(stamp.0));
        let below = after.checked_sub(1).and_then(|below| Some((distance_ns(below)?, below)));
        let above = distance_ns(after).map(|distance_ns| (distance_ns, after));
        let (distance_ns, other) = below.into_iter().chain(above).min()?;
        (distance_ns <= tolerance_ns).then_some((index, other))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stamps(ns: &[i64]) -> Vec<StampNs> {
        ns.iter().map(|ns| StampNs(*ns)).collect()
    }

    #[test]
    fn exact_matches_are_equal_to_the_nanosecond() {
        let (estimate, truth) = (stamps(&[0, 11, 20, 30]), stamps(&[0, 10, 20, 31]));
        assert_eq!(associate(&estimate, &truth, Association::Exact), [(0, 0), (2, 2)]);
    }

    #[test]
    fn the_nearest_within_the_tolerance_is_taken_and_of_two_the_earlier() {
        let how = Association::Nearest { tolerance_ns: 5 };
        let truth = stamps(&[0, 10, 20, 30, 100]);
        assert_eq!(associate(&stamps(&[-6, 4, 15, 31]), &truth, how), [(1, 0), (2, 1), (3, 3)]);
        assert_eq!(associate(&stamps(&[106]), &truth, how), []);
        assert_eq!(associate(&[], &truth, how), []);
    }

    #[test]
    fn the_shorter_list_looks_for_its_nearest_in_the_longer_one() {
        let how = Association::Nearest { tolerance_ns: 5 };
        let estimate = stamps(&[0, 3, 6, 9, 12]);
        assert_eq!(associate(&estimate, &stamps(&[1, 10]), how), [(0, 0), (3, 1)]);
    }

    #[test]
    fn stamps_at_the_ends_of_the_range_do_not_overflow() {
        let ends = stamps(&[i64::MIN, i64::MAX]);
        let how = Association::Nearest { tolerance_ns: u64::MAX };
        assert_eq!(associate(&ends, &ends, how), [(0, 0), (1, 1)]);
    }
}
