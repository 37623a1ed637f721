//! Poses with covariances, composed to first order.

use coma_geometry::{Matrix6, Pose, se3};

/// A pose known up to a right perturbation of this covariance: `pose * exp(xi)`, order (translation,
/// rotation), m^2 and rad^2.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UncertainPose {
    /// The mean.
    pub pose: Pose,
    /// Covariance of the right perturbation.
    pub covariance: Matrix6,
}

impl UncertainPose {
    /// A measurement with its information matrix; `None` if that has no inverse.
    pub fn from_information(pose: Pose, information: &Matrix6) -> Option<Self> {
        let covariance = information.cholesky()?.inverse();
        covariance.iter().all(|x| x.is_finite()).then_some(UncertainPose { pose, covariance })
    }

    /// `a_from_c` of `a_from_b` and an independent `b_from_c`.
    pub fn compose(&self, next: &Self) -> Self {
        let carry = se3::adjoint(&next.pose.inverse());
        let covariance = carry * self.covariance * carry.transpose() + next.covariance;
        UncertainPose { pose: self.pose * next.pose, covariance }
    }

    /// `b_from_a` of `a_from_b`.
    pub fn inverse(&self) -> Self {
        let carry = se3::adjoint(&self.pose);
        UncertainPose { pose: self.pose.inverse(), covariance: carry * self.covariance * carry.transpose() }
    }

    /// Squared Mahalanobis distance of this pose from the identity; infinite for a singular covariance.
    pub fn squared_distance_from_identity(&self) -> f64 {
        let error = se3::log(&self.pose);
        match self.covariance.cholesky() {
            Some(factor) => error.dot(&factor.solve(&error)),
            None => f64::INFINITY,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_geometry::Tangent;

    #[test]
    fn inverting_twice_changes_nothing() {
        let pose = se3::exp(&Tangent::new(1.0, -2.0, 0.5, 0.3, 0.9, -0.4));
        let covariance = Matrix6::from_diagonal(&Tangent::new(1.0, 2.0, 3.0, 0.1, 0.2, 0.3));
        let once = UncertainPose { pose, covariance };
        let twice = once.inverse().inverse();
        assert!((twice.covariance - covariance).norm() < 1e-9);
        let round = once.compose(&once.inverse());
        assert!(se3::log(&round.pose).norm() < 1e-12);
    }
}
