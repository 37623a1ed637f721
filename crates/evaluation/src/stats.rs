//! A set of errors in a few numbers.

use serde::{Deserialize, Serialize};

/// How errors spread; the unit is in the name of the field that holds it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// How many.
    pub count: usize,
    /// Root of the mean square.
    pub rmse: f64,
    /// Mean.
    pub mean: f64,
    /// The middle one, or the mean of the two in the middle.
    pub median: f64,
    /// Largest.
    pub max: f64,
}

impl Spread {
    /// Of errors of 0 and more; `None` if there are none, or one isn't finite.
    pub fn of(errors: &[f64]) -> Option<Self> {
        if errors.is_empty() || !errors.iter().all(|e| e.is_finite()) {
            return None;
        }
        let count = errors.len() as f64;
        Some(Spread {
            count: errors.len(),
            rmse: (errors.iter().map(|e| e * e).sum::<f64>() / count).sqrt(),
            mean: errors.iter().sum::<f64>() / count,
            median: percentile(errors, 50.0)?,
            max: errors.iter().copied().fold(f64::NEG_INFINITY, f64::max),
        })
    }
}

/// The mean; `None` without values.
pub(crate) fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

/// The value below which `percent` of the values lie, linear between neighbours (as NumPy does); `None` without
/// values.
pub fn percentile(values: &[f64], percent: f64) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let last = sorted.len().checked_sub(1)?;
    let place = percent.clamp(0.0, 100.0) / 100.0 * last as f64;
    let (below, above) = (place.floor() as usize, place.ceil() as usize);
    Some(sorted[below] + (sorted[above] - sorted[below]) * (place - below as f64))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_spread_names_root_mean_square_mean_middle_and_largest() {
        let spread = Spread::of(&[3.0, 0.0, 4.0, 1.0]).unwrap();
        assert_eq!(spread, Spread { count: 4, rmse: 6.5f64.sqrt(), mean: 2.0, median: 2.0, max: 4.0 });
    }

    #[test]
    fn no_errors_and_errors_that_are_no_numbers_have_no_spread() {
        assert_eq!(Spread::of(&[]), None);
        assert_eq!(Spread::of(&[1.0, f64::NAN]), None);
    }

    #[test]
    fn percentiles_lie_between_their_neighbours() {
        let values: Vec<f64> = (0..=20).rev().map(f64::from).collect();
        assert_eq!(percentile(&values, 95.0), Some(19.0));
        assert_eq!(percentile(&[1.0, 2.0], 75.0), Some(1.75));
        assert_eq!(percentile(&[], 50.0), None);
    }
}
