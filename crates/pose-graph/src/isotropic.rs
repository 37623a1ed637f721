//! The isotropic objective of SE-Sync (Rosen et al., IJRR 2019), of which optimality can be certified:
//! `f = sum kappa |R_j - R_i R_ij|_F^2 + tau |t_j - t_i - R_i t_ij|^2`.

use crate::solver::Constraint;
use coma_geometry::{Matrix6, Pose, Tangent, se3};
use nalgebra::{Matrix3, Vector3};

/// A measurement's weights in the isotropic objective.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Isotropic {
    /// Weight of the rotation, rad^-2 halved.
    pub kappa: f64,
    /// Weight of the translation, m^-2.
    pub tau: f64,
}

impl Isotropic {
    /// SE-Sync's choice: harmonic means over the axes, so that a direction which is known badly counts.
    pub fn of(information: &Matrix6) -> Self {
        let harmonic = |block: Matrix3<f64>| {
            let trace = block.try_inverse().map_or(0.0, |inverse| inverse.trace());
            if trace > 0.0 && trace.is_finite() { 3.0 / trace } else { block.trace() / 3.0 }
        };
        let tau = harmonic(information.fixed_view::<3, 3>(0, 0).into_owned());
        let kappa = 0.5 * harmonic(information.fixed_view::<3, 3>(3, 3).into_owned());
        Isotropic { kappa: kappa.max(1e-12), tau: tau.max(1e-12) }
    }

    /// The measurement's term of `f`.
    pub fn term(&self, map_from_i: &Pose, map_from_j: &Pose, i_from_j: &Pose) -> f64 {
        let e = errors(map_from_i, map_from_j, i_from_j);
        self.kappa * e.rotation.norm_squared() + self.tau * e.translation.norm_squared()
    }

    /// Gradient and Hessian of the term, for right perturbations of both poses. What the gradient itself adds to the
    /// Hessian is left out, as it vanishes at a minimum; rotations that are far off get Gauss-Newton's blocks, which are
    /// never indefinite.
    pub(crate) fn normal(&self, map_from_i: &Pose, map_from_j: &Pose, i_from_j: &Pose) -> Normal {
        let e = errors(map_from_i, map_from_j, i_from_j);
        let (r_i, r_j, r_ij) = (matrix(map_from_i), matrix(map_from_j), matrix(i_from_j));
        let mut normal = Normal::zeros();
        // kappa |R_j - R_i R_ij|^2 = kappa (6 - 2 tr E) with E = R_j^T R_i R_ij. Moving both ends makes it
        // exp(-w_j) E exp(R_ij^T w_i). Columns: translation, then rotation.
        let error = r_j.transpose() * r_i * r_ij;
        let k = 2.0 * self.kappa;
        let skewed = error - error.transpose();
        let toward = Vector3::new(skewed[(1, 2)], skewed[(2, 0)], skewed[(0, 1)]) * k;
        normal.g_j.fixed_rows_mut::<3>(3).copy_from(&toward);
        normal.g_i.fixed_rows_mut::<3>(3).copy_from(&-(r_ij * toward));
        let near = error.trace() > NEWTON_TRACE;
        let even = if near { (error + error.transpose()) * 0.5 } else { Matrix3::identity() };
        let full = if near { error } else { Matrix3::identity() };
        let trace = Matrix3::from_diagonal_element(full.trace());
        let own = (trace - even) * k;
        normal.jj.fixed_view_mut::<3, 3>(3, 3).copy_from(&own);
        normal.ii.fixed_view_mut::<3, 3>(3, 3).copy_from(&(r_ij * own * r_ij.transpose()));
        normal.ij.fixed_view_mut::<3, 3>(3, 3).copy_from(&(r_ij * (full - trace) * k));
        let t = 2.0 * self.tau;
        let turn = r_i * se3::skew(&i_from_j.translation.vector);
        let add = |block: &mut Matrix6, row: usize, column: usize, value: Matrix3<f64>| {
            let mut view = block.fixed_view_mut::<3, 3>(row, column);
            view += value * t;
        };
        // Translation: d e = R_j v_j - R_i v_i + R_i [t_ij]x w_i.
        add(&mut normal.ii, 0, 0, Matrix3::identity());
        add(&mut normal.ii, 0, 3, -(r_i.transpose() * turn));
        add(&mut normal.ii, 3, 0, -(turn.transpose() * r_i));
        add(&mut normal.ii, 3, 3, turn.transpose() * turn);
        if near {
            // The arm R_i t_ij turns while it is off by e.
            let (off, arm) = (r_i.transpose() * e.translation, i_from_j.translation.vector);
            let bend = off * arm.transpose();
            let straight = Matrix3::from_diagonal_element(off.dot(&arm));
            add(&mut normal.ii, 3, 3, straight - (bend + bend.transpose()) * 0.5);
        }
        add(&mut normal.jj, 0, 0, Matrix3::identity());
        add(&mut normal.ij, 0, 0, -(r_i.transpose() * r_j));
        add(&mut normal.ij, 3, 0, turn.transpose() * r_j);
        let push = |gradient: &mut Tangent, row: usize, value: Vector3<f64>| {
            let mut view = gradient.fixed_rows_mut::<3>(row);
            view += value * t;
        };
        push(&mut normal.g_i, 0, -(r_i.transpose() * e.translation));
        push(&mut normal.g_i, 3, turn.transpose() * e.translation);
        push(&mut normal.g_j, 0, r_j.transpose() * e.translation);
        normal
    }
}

/// Above this trace of the error's matrix (an angle of 75 degrees) a rotation's true Hessian is used.
const NEWTON_TRACE: f64 = 1.5;

/// The isotropic objective; `weights` is one per constraint.
pub fn objective(constraints: &[Constraint], poses: &[Pose], weights: &[f64]) -> f64 {
    let used = constraints.iter().zip(weights).filter(|(_, w)| **w > 0.0);
    used.map(|(c, w)| w * Isotropic::of(&c.information).term(&poses[c.from], &poses[c.to], &c.from_from_to))
        .sum()
}

/// What one measurement adds to the normal equations.
pub(crate) struct Normal {
    pub ii: Matrix6,
    pub ij: Matrix6,
    pub jj: Matrix6,
    pub g_i: Tangent,
    pub g_j: Tangent,
}

impl Normal {
    fn zeros() -> Self {
        let (block, gradient) = (Matrix6::zeros(), Tangent::zeros());
        Normal { ii: block, ij: block, jj: block, g_i: gradient, g_j: gradient }
    }
}

struct Errors {
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
}

pub(crate) fn matrix(pose: &Pose) -> Matrix3<f64> {
    *pose.rotation.to_rotation_matrix().matrix()
}

fn errors(map_from_i: &Pose, map_from_j: &Pose, i_from_j: &Pose) -> Errors {
    let r_i = matrix(map_from_i);
    let arm = map_from_j.translation.vector - map_from_i.translation.vector;
    Errors {
        rotation: matrix(map_from_j) - r_i * matrix(i_from_j),
        translation: arm - r_i * i_from_j.translation.vector,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gradients_and_hessians_agree_with_finite_differences() {
        let pose = |v: [f64; 6]| se3::exp(&Tangent::from_row_slice(&v));
        let (i, j) = (pose([0.3, -1.0, 2.0, 0.4, 1.1, -0.2]), pose([1.0, 0.2, 0.1, -0.7, 0.3, 0.9]));
        let measured = pose([0.5, 0.4, -0.8, 0.2, -0.4, 1.4]);
        let weight = Isotropic { kappa: 7.0, tau: 3.0 };
        let normal = weight.normal(&i, &j, &measured);
        let (exact, step) = (i.inverse() * j, 1e-6);
        let fit = weight.normal(&i, &j, &exact);
        for axis in 0..6 {
            let mut d = Tangent::zeros();
            d[axis] = step;
            let (plus, minus) = (se3::exp(&d), se3::exp(&-d));
            let f = |a: &Pose, b: &Pose| weight.term(a, b, &measured);
            let by_i = (f(&(i * plus), &j) - f(&(i * minus), &j)) / (2.0 * step);
            let by_j = (f(&i, &(j * plus)) - f(&i, &(j * minus))) / (2.0 * step);
            assert!(
                (normal.g_i[axis] - by_i).abs() < 1e-6 && (normal.g_j[axis] - by_j).abs() < 1e-6,
                "{axis}"
            );
            // Without an error the gradient is zero, and the Hessian has one meaning.
            let gradient = |a: &Pose, b: &Pose| weight.normal(a, b, &exact);
            let (up, down) = (gradient(&(i * plus), &j), gradient(&(i * minus), &j));
            let column = (up.g_i - down.g_i) / (2.0 * step);
            assert!((column - fit.ii.column(axis)).norm() < 1e-4, "{axis}: {column} {}", fit.ii);
            let cross = (up.g_j - down.g_j) / (2.0 * step);
            assert!((cross.transpose() - fit.ij.row(axis)).norm() < 1e-4, "{axis}");
        }
    }

    #[test]
    fn the_curvature_along_a_turn_is_that_of_the_objective() {
        let pose = |v: [f64; 6]| se3::exp(&Tangent::from_row_slice(&v));
        let (i, j) = (pose([0.3, -1.0, 2.0, 0.4, 1.1, -0.2]), pose([1.0, 0.2, 0.1, -0.7, 0.3, 0.9]));
        let measured = i.inverse() * j * pose([0.2, -0.3, 0.1, 0.3, -0.2, 0.4]);
        let weight = Isotropic { kappa: 7.0, tau: 3.0 };
        let normal = weight.normal(&i, &j, &measured);
        let step = 1e-4;
        for axis in 3..6 {
            let mut d = Tangent::zeros();
            d[axis] = step;
            let (plus, minus) = (se3::exp(&d), se3::exp(&-d));
            let f = |a: &Pose, b: &Pose| weight.term(a, b, &measured);
            let middle = f(&i, &j);
            let by_i = (f(&(i * plus), &j) + f(&(i * minus), &j) - 2.0 * middle) / (step * step);
            let by_j = (f(&i, &(j * plus)) + f(&i, &(j * minus)) - 2.0 * middle) / (step * step);
            assert!(
                (normal.ii[(axis, axis)] - by_i).abs() < 1e-3,
                "{axis}: {} {by_i}",
                normal.ii[(axis, axis)]
            );
            assert!(
                (normal.jj[(axis, axis)] - by_j).abs() < 1e-3,
                "{axis}: {} {by_j}",
                normal.jj[(axis, axis)]
            );
        }
    }
}
