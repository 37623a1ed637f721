//! Whether edges of the pose graph are as certain as they claim.

use coma_geometry::{Matrix6, Pose, se3};
use serde::{Deserialize, Serialize};

/// A measured motion, what it claims to know, and what the motion was.
#[derive(Clone, Debug, PartialEq)]
pub struct Edge {
    /// Measured `i_from_j`.
    pub measured: Pose,
    /// Inverse covariance of `measured * exp(xi)`, order (translation, rotation).
    pub information: Matrix6,
    /// True `i_from_j`.
    pub truth: Pose,
}

impl Edge {
    /// `e^T Omega e`; its mean is 6, the degrees of freedom, where the information is right.
    /// `None` if it is no finite number of 0 or more.
    pub fn normalised_squared_error(&self) -> Option<f64> {
        // Eq. (11): e = log(T_ij^-1 T_i^-1 T_j)
        let e = se3::log(&self.measured.inv_mul(&self.truth));
        let squared = (e.transpose() * self.information * e)[(0, 0)];
        (squared >= 0.0 && squared.is_finite()).then_some(squared)
    }
}

/// Normalised squared errors of a kind of edges.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct NormalisedErrors {
    /// Edges that count here.
    pub edges: usize,
    /// Edges left out, because their error or information is no number or their information is negative.
    pub unusable: usize,
    /// Mean of `e^T Omega e`.
    pub mean: f64,
    /// The middle one.
    pub median: f64,
    /// The largest.
    pub max: f64,
}

impl NormalisedErrors {
    /// Means between these are calibrated: edges claim neither far more nor far less than they know.
    pub const CALIBRATED: std::ops::RangeInclusive<f64> = 3.0..=12.0;

    /// Over some edges; `None` if there is no usable one.
    pub fn of(edges: &[Edge]) -> Option<Self> {
        let errors: Vec<f64> = edges.iter().filter_map(Edge::normalised_squared_error).collect();
        let spread = crate::Spread::of(&errors)?;
        Some(NormalisedErrors {
            edges: errors.len(),
            unusable: edges.len() - errors.len(),
            mean: spread.mean,
            median: spread.median,
            max: spread.max,
        })
    }

    /// True if the mean lies in [`Self::CALIBRATED`].
    pub fn is_calibrated(&self) -> bool {
        Self::CALIBRATED.contains(&self.mean)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_geometry::Tangent;
    use rand::{Rng, SeedableRng};

    fn edge(xi: Tangent, information: Matrix6) -> Edge {
        let measured = se3::exp(&Tangent::new(0.3, -1.0, 2.0, 0.4, 2.0, -1.0));
        Edge { measured, information, truth: measured * se3::exp(&xi) }
    }

    #[test]
    fn an_error_is_weighed_by_the_information_in_tangent_order() {
        let mut information = Matrix6::identity();
        information[(0, 0)] = 100.0;
        information[(5, 5)] = 400.0;
        let moved = edge(Tangent::new(0.1, 0.0, 0.0, 0.0, 0.0, 0.0), information);
        assert!((moved.normalised_squared_error().unwrap() - 1.0).abs() < 1e-9);
        let turned = edge(Tangent::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.1), information);
        assert!((turned.normalised_squared_error().unwrap() - 4.0).abs() < 1e-9);
    }

    #[test]
    fn errors_as_large_as_claimed_are_calibrated_and_overconfident_ones_are_not() {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        // The sum of 12 uniform values has a variance of 1.
        let mut gaussian = || (0..12).map(|_| random.next_u32() as f64 / u32::MAX as f64 - 0.5).sum::<f64>();
        let deviation = Tangent::new(0.02, 0.01, 0.03, 0.002, 0.001, 0.004);
        let information = Matrix6::from_diagonal(&deviation.map(|d| 1.0 / (d * d)));
        let edges: Vec<Edge> = (0..2000)
            .map(|_| edge(Tangent::from_fn(|_, _| gaussian()).component_mul(&deviation), information))
            .collect();
        let honest = NormalisedErrors::of(&edges).unwrap();
        assert!((honest.mean - 6.0).abs() < 0.3 && honest.is_calibrated(), "{honest:?}");
        let boasting: Vec<Edge> =
            edges.iter().map(|e| Edge { information: e.information * 25.0, ..e.clone() }).collect();
        assert!(!NormalisedErrors::of(&boasting).unwrap().is_calibrated());
    }

    #[test]
    fn edges_that_cannot_be_weighed_are_left_out_and_counted() {
        let good = edge(Tangent::zeros(), Matrix6::identity());
        let negative = edge(Tangent::new(1.0, 0.0, 0.0, 0.0, 0.0, 0.0), -Matrix6::identity());
        let nan = edge(Tangent::zeros(), Matrix6::repeat(f64::NAN));
        let errors = NormalisedErrors::of(&[good, negative.clone(), nan]).unwrap();
        assert_eq!((errors.edges, errors.unusable), (1, 2));
        assert_eq!(NormalisedErrors::of(&[negative]), None);
    }
}
