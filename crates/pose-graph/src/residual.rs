//! The error of one edge and how it changes with its two poses.

use coma_geometry::{Matrix6, Pose, Tangent, se3};

/// Eq. 11: `e = log(T_ij^-1 T_i^-1 T_j)`, in metres and radians, order (translation, rotation).
pub fn residual(map_from_i: &Pose, map_from_j: &Pose, i_from_j: &Pose) -> Tangent {
    se3::log(&i_from_j.inv_mul(&map_from_i.inv_mul(map_from_j)))
}

/// [`residual`] with its derivatives for right perturbations of both poses.
#[derive(Clone, Copy, Debug)]
pub struct Linearised {
    /// The residual.
    pub error: Tangent,
    /// Change of the error with `map_from_i * exp(xi)`.
    pub wrt_i: Matrix6,
    /// Change of the error with `map_from_j * exp(xi)`.
    pub wrt_j: Matrix6,
}

/// Residual and analytic Jacobians. With `D = T_ij^-1 T_i^-1 T_j`: moving `T_j` gives `D exp(xi)`, moving
/// `T_i` gives `D exp(-Ad((T_i^-1 T_j)^-1) xi)`, and `log(D exp(d)) ~ e + J_r^-1(e) d`.
pub fn linearise(map_from_i: &Pose, map_from_j: &Pose, i_from_j: &Pose) -> Linearised {
    let predicted = map_from_i.inv_mul(map_from_j);
    let error = se3::log(&i_from_j.inv_mul(&predicted));
    let wrt_j = se3::right_jacobian_inverse(&error);
    let wrt_i = -(wrt_j * se3::adjoint(&predicted.inverse()));
    Linearised { error, wrt_i, wrt_j }
}

/// Squared Mahalanobis length `e^T information e`.
pub fn squared_mahalanobis(error: &Tangent, information: &Matrix6) -> f64 {
    error.dot(&(information * error))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn analytic_jacobians_agree_with_finite_differences() {
        let poses = [
            Tangent::new(0.1, -0.4, 0.3, 0.2, -0.1, 0.4),
            Tangent::new(2.0, 1.0, -3.0, 1.2, 0.4, -0.9),
            Tangent::new(0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            Tangent::new(-5.0, 0.7, 1.0, 0.3, 2.4, 0.8),
        ]
        .map(|xi| se3::exp(&xi));
        let step = 1e-6;
        for i in &poses {
            for j in &poses {
                for measured in &poses {
                    let at = linearise(i, j, measured);
                    if at.error.fixed_rows::<3>(3).norm() > 3.0 {
                        continue; // the logarithm jumps at pi
                    }
                    for axis in 0..6 {
                        let mut d = Tangent::zeros();
                        d[axis] = step;
                        let (plus, minus) = (se3::exp(&d), se3::exp(&-d));
                        let by_i = (residual(&(i * plus), j, measured) - residual(&(i * minus), j, measured))
                            / (2.0 * step);
                        let by_j = (residual(i, &(j * plus), measured) - residual(i, &(j * minus), measured))
                            / (2.0 * step);
                        assert!((at.wrt_i.column(axis) - by_i).norm() < 1e-6, "i, axis {axis}");
                        assert!((at.wrt_j.column(axis) - by_j).norm() < 1e-6, "j, axis {axis}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_measurement_that_agrees_has_no_error() {
        let i = se3::exp(&Tangent::new(1.0, 2.0, 3.0, 0.1, 0.2, 0.3));
        let j = se3::exp(&Tangent::new(-1.0, 0.5, 3.0, 2.1, 0.2, 0.3));
        assert!(residual(&i, &j, &(i.inverse() * j)).norm() < 1e-12);
    }
}
