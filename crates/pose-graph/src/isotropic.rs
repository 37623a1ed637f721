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

    /// Gauss-Newton blocks of the term, for right perturbations of both poses.
    pub(crate) fn normal(&self, map_from_i: &Pose, map_from_j: &Pose, i_from_j: &Pose) -> Normal {
        let e = errors(map_from_i, map_from_j, i_from_j);
        let (r_i, r_j) = (matrix(map_from_i), matrix(map_from_j));
        let r_ij = matrix(i_from_j);
        // f = 1/2 |e|^2 with weights 2 kappa, 2 tau. Columns: translation, then rotation.
        let (k, t) = (2.0 * self.kappa, 2.0 * self.tau);
        let mut normal = Normal::zeros();
        let generators = [Vector3::x(), Vector3::y(), Vector3::z()].map(|axis| se3::skew(&axis));
        let by_i = generators.map(|g| -(r_i * g * r_ij));
        let by_j = generators.map(|g| r_j * g);
        for a in 0..3 {
            normal.g_i[3 + a] = k * by_i[a].dot(&e.rotation);
            normal.g_j[3 + a] = k * by_j[a].dot(&e.rotation);
            for b in 0..3 {
                normal.ij[(3 + a, 3 + b)] = k * by_i[a].dot(&by_j[b]);
            }
            // |R [e]x|_F^2 = 2, and the axes are perpendicular to each other.
            normal.ii[(3 + a, 3 + a)] = 2.0 * k;
            normal.jj[(3 + a, 3 + a)] = 2.0 * k;
        }
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

/// The isotropic objective; `weights` is one per constraint.
pub fn objective(constraints: &[Constraint], poses: &[Pose], weights: &[f64]) -> f64 {
    let used = constraints.iter().zip(weights).filter(|(_, w)| **w > 0.0);
    used.map(|(c, w)| {
        w * Isotropic::of(&c.information).term(&poses[c.from], &poses[c.to], &c.from_from_to)
    })
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
    fn gradients_agree_with_finite_differences_and_blocks_with_the_curvature_of_an_exact_fit() {
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
            assert!((normal.g_i[axis] - by_i).abs() < 1e-6 && (normal.g_j[axis] - by_j).abs() < 1e-6, "{axis}");
            // Without an error Gauss-Newton's matrix is the Hessian.
            let gradient = |a: &Pose, b: &Pose| weight.normal(a, b, &exact);
            let (up, down) = (gradient(&(i * plus), &j), gradient(&(i * minus), &j));
            let column = (up.g_i - down.g_i) / (2.0 * step);
            assert!((column - fit.ii.column(axis)).norm() < 1e-4, "{axis}: {column} {}", fit.ii);
            let cross = (up.g_j - down.g_j) / (2.0 * step);
            assert!((cross.transpose() - fit.ij.row(axis)).norm() < 1e-4, "{axis}");
        }
    }
}
