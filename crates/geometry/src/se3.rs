//! Exponential, logarithm, adjoint and Jacobians of SE(3).
//!
//! Tangent order `(rho, phi)`: translation first, then the rotation vector. Perturbations act on the
//! right: `pose * exp(xi)`. Formulas: Solà, Deray, Atchuthan, "A micro Lie theory for state
//! estimation in robotics" (2018), appendix D; Barfoot, "State Estimation for Robotics", chapter 8.

use crate::{Matrix6, Pose, Tangent};
use nalgebra::{Matrix3, Translation3, UnitQuaternion, Vector3};

/// Below this angle (radians) series replace the closed forms.
const SMALL_ANGLE_RAD: f64 = 1e-4;

/// The matrix with `skew(a) * b == a.cross(b)`.
pub fn skew(v: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0)
}

/// The pose reached by moving along `xi = (rho, phi)` for one unit of time.
pub fn exp(xi: &Tangent) -> Pose {
    let rho = Vector3::new(xi[0], xi[1], xi[2]);
    let phi = Vector3::new(xi[3], xi[4], xi[5]);
    let translation = so3_left_jacobian(&phi) * rho;
    Pose::from_parts(Translation3::from(translation), so3_exp(&phi))
}

/// The inverse of [`exp`]; the rotation part has a norm of at most pi.
pub fn log(pose: &Pose) -> Tangent {
    let phi = so3_log(&pose.rotation);
    let rho = so3_left_jacobian_inverse(&phi) * pose.translation.vector;
    Tangent::new(rho.x, rho.y, rho.z, phi.x, phi.y, phi.z)
}

/// Rotation by the rotation vector `phi` (radians).
pub fn so3_exp(phi: &Vector3<f64>) -> UnitQuaternion<f64> {
    UnitQuaternion::from_scaled_axis(*phi)
}

/// Rotation vector (radians) of a rotation, of norm at most pi. Stable near 0 and near pi.
pub fn so3_log(rotation: &UnitQuaternion<f64>) -> Vector3<f64> {
    // The quaternion and its negative are one rotation: take the one with a positive real part.
    let sign = if rotation.w < 0.0 { -1.0 } else { 1.0 };
    let imaginary = rotation.imag() * sign;
    let norm = imaginary.norm();
    let half_angle = norm.atan2(rotation.w * sign);
    if norm < 1e-12 { imaginary * 2.0 } else { imaginary * (2.0 * half_angle / norm) }
}

/// Left Jacobian of SO(3).
pub fn so3_left_jacobian(phi: &Vector3<f64>) -> Matrix3<f64> {
    let angle = phi.norm();
    let s = skew(phi);
    let (a, b) = if angle < SMALL_ANGLE_RAD {
        (0.5 - angle * angle / 24.0, 1.0 / 6.0 - angle * angle / 120.0)
    } else {
        ((1.0 - angle.cos()) / (angle * angle), (angle - angle.sin()) / (angle * angle * angle))
    };
    Matrix3::identity() + s * a + s * s * b
}

/// Inverse of [`so3_left_jacobian`].
pub fn so3_left_jacobian_inverse(phi: &Vector3<f64>) -> Matrix3<f64> {
    let angle = phi.norm();
    let s = skew(phi);
    let b = if angle < SMALL_ANGLE_RAD {
        1.0 / 12.0 + angle * angle / 720.0
    } else {
        let half = 0.5 * angle;
        (1.0 - half * half.cos() / half.sin()) / (angle * angle)
    };
    Matrix3::identity() - s * 0.5 + s * s * b
}

/// `pose * exp(xi) * pose^-1 == exp(adjoint(pose) * xi)`.
pub fn adjoint(pose: &Pose) -> Matrix6 {
    let r = *pose.rotation.to_rotation_matrix().matrix();
    let mut out = Matrix6::zeros();
    out.fixed_view_mut::<3, 3>(0, 0).copy_from(&r);
    out.fixed_view_mut::<3, 3>(0, 3).copy_from(&(skew(&pose.translation.vector) * r));
    out.fixed_view_mut::<3, 3>(3, 3).copy_from(&r);
    out
}

/// Barfoot's Q(rho, phi): the upper right block of the left Jacobian of SE(3).
fn q_block(rho: &Vector3<f64>, phi: &Vector3<f64>) -> Matrix3<f64> {
    let p = skew(phi);
    let r = skew(rho);
    let angle = phi.norm();
    let a2 = angle * angle;
    let (c1, c2, c3) = if angle < 1e-2 {
        (
            1.0 / 6.0 - a2 / 120.0 + a2 * a2 / 5040.0,
            1.0 / 24.0 - a2 / 720.0 + a2 * a2 / 40320.0,
            1.0 / 120.0 - a2 / 2520.0 + a2 * a2 / 120_960.0,
        )
    } else {
        let (sin, cos) = angle.sin_cos();
        let a4 = a2 * a2;
        let c1 = (angle - sin) / (a2 * angle);
        let c2 = (a2 + 2.0 * cos - 2.0) / (2.0 * a4);
        let c3 = (2.0 * angle - 3.0 * sin + angle * cos) / (2.0 * a4 * angle);
        (c1, c2, c3)
    };
    r * 0.5
        + (p * r + r * p + p * r * p) * c1
        + (p * p * r + r * p * p - p * r * p * 3.0) * c2
        + (p * r * p * p + p * p * r * p) * c3
}

/// Left Jacobian of SE(3): `exp(xi + d) ~= exp(J d) * exp(xi)`.
pub fn left_jacobian(xi: &Tangent) -> Matrix6 {
    let (rho, phi) = split(xi);
    let j = so3_left_jacobian(&phi);
    block(&j, &q_block(&rho, &phi))
}

/// Inverse of [`left_jacobian`].
pub fn left_jacobian_inverse(xi: &Tangent) -> Matrix6 {
    let (rho, phi) = split(xi);
    let j_inv = so3_left_jacobian_inverse(&phi);
    block(&j_inv, &(-(j_inv * q_block(&rho, &phi) * j_inv)))
}

/// Right Jacobian of SE(3): `exp(xi + d) ~= exp(xi) * exp(J d)`.
pub fn right_jacobian(xi: &Tangent) -> Matrix6 {
    left_jacobian(&-xi)
}

/// Inverse of [`right_jacobian`]: `log(exp(xi) * exp(d)) ~= xi + J^-1 d`.
pub fn right_jacobian_inverse(xi: &Tangent) -> Matrix6 {
    left_jacobian_inverse(&-xi)
}

/// Distance in metres and radians between two poses.
pub fn distance(a: &Pose, b: &Pose) -> (f64, f64) {
    let between = a.inv_mul(b);
    (between.translation.vector.norm(), so3_log(&between.rotation).norm())
}

fn split(xi: &Tangent) -> (Vector3<f64>, Vector3<f64>) {
    (Vector3::new(xi[0], xi[1], xi[2]), Vector3::new(xi[3], xi[4], xi[5]))
}

fn block(diagonal: &Matrix3<f64>, upper: &Matrix3<f64>) -> Matrix6 {
    let mut out = Matrix6::zeros();
    out.fixed_view_mut::<3, 3>(0, 0).copy_from(diagonal);
    out.fixed_view_mut::<3, 3>(3, 3).copy_from(diagonal);
    out.fixed_view_mut::<3, 3>(0, 3).copy_from(upper);
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    fn samples() -> Vec<Tangent> {
        vec![
            Tangent::zeros(),
            Tangent::new(0.1, -0.2, 0.3, 1e-9, 2e-9, -1e-9),
            Tangent::new(1.0, 2.0, -0.5, 3e-5, 2e-5, -4e-5),
            Tangent::new(1.0, 2.0, -0.5, 3e-3, 4e-3, -5e-3),
            Tangent::new(0.4, -0.3, 0.9, 0.5, -0.7, 0.2),
            Tangent::new(-2.0, 0.3, 0.9, 1.5, -1.7, 1.2),
            Tangent::new(-2.0, 0.3, 0.9, 0.0, 3.1, 0.0),
        ]
    }

    #[test]
    fn log_undoes_exp() {
        for xi in samples() {
            assert!((log(&exp(&xi)) - xi).norm() < 1e-9, "{xi:?}");
        }
    }

    #[test]
    fn tangent_is_translation_then_rotation() {
        let pose = exp(&Tangent::new(1.0, 2.0, 3.0, 0.0, 0.0, 0.0));
        assert_eq!(pose.translation.vector, Vector3::new(1.0, 2.0, 3.0));
        assert!(pose.rotation.angle() < 1e-15);
    }

    #[test]
    fn perturbations_act_on_the_right() {
        let pose = exp(&samples()[4]);
        let moved = pose * exp(&Tangent::new(0.0, 0.0, 1.0, 0.0, 0.0, 0.0));
        let forward = pose.rotation * Vector3::z();
        assert!((moved.translation.vector - pose.translation.vector - forward).norm() < 1e-12);
    }

    #[test]
    fn adjoint_moves_a_tangent_across_a_pose() {
        let pose = exp(&samples()[5]);
        let xi = samples()[4];
        let left = pose * exp(&xi) * pose.inverse();
        let right = exp(&(adjoint(&pose) * xi));
        assert!((left.to_homogeneous() - right.to_homogeneous()).norm() < 1e-10);
    }

    #[test]
    fn jacobians_agree_with_differences() {
        let step = 1e-6;
        for xi in samples() {
            let (left, right) = (left_jacobian(&xi), right_jacobian(&xi));
            for axis in 0..6 {
                let mut d = Tangent::zeros();
                d[axis] = step;
                let numeric_left = (log(&(exp(&(xi + d)) * exp(&xi).inverse()))
                    - log(&(exp(&(xi - d)) * exp(&xi).inverse())))
                    / (2.0 * step);
                let numeric_right = (log(&(exp(&xi).inverse() * exp(&(xi + d))))
                    - log(&(exp(&xi).inverse() * exp(&(xi - d)))))
                    / (2.0 * step);
                assert!((left.column(axis) - numeric_left).norm() < 1e-7, "left {xi:?} axis {axis}");
                assert!((right.column(axis) - numeric_right).norm() < 1e-7, "right {xi:?} axis {axis}");
            }
        }
    }

    #[test]
    fn inverse_jacobians_invert() {
        for xi in samples() {
            let product = right_jacobian(&xi) * right_jacobian_inverse(&xi);
            assert!((product - Matrix6::identity()).norm() < 1e-9, "{xi:?}");
        }
    }

    #[test]
    fn a_from_b_maps_points_of_b_and_names_that_touch_compose() {
        // The submap lies 1 m along the map's x, turned by 90 degrees about z; the camera 2 m along its x.
        let quarter_turn = UnitQuaternion::from_scaled_axis(Vector3::z() * std::f64::consts::FRAC_PI_2);
        let map_from_submap = Pose::from_parts(Translation3::new(1.0, 0.0, 0.0), quarter_turn);
        let submap_from_camera = Pose::translation(2.0, 0.0, 0.0);
        let map_from_camera = map_from_submap * submap_from_camera;
        let camera_in_map = map_from_camera * nalgebra::Point3::origin();
        assert!((camera_in_map.coords - Vector3::new(1.0, 2.0, 0.0)).norm() < 1e-12, "{camera_in_map}");
    }

    #[test]
    fn distances_are_metres_and_radians() {
        let quarter_turn = UnitQuaternion::from_scaled_axis(Vector3::y() * std::f64::consts::FRAC_PI_2);
        let (metres, radians) =
            distance(&Pose::identity(), &Pose::from_parts(Translation3::new(3.0, 0.0, 4.0), quarter_turn));
        assert!((metres - 5.0).abs() < 1e-12 && (radians - std::f64::consts::FRAC_PI_2).abs() < 1e-12);
    }
}
