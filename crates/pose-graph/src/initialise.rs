//! Where to start: poses good enough for the solver to end at the right place.

use crate::isotropic::Isotropic;
use crate::solver::{Problem, SolveError};
use crate::sparse::BlockCholesky;
use coma_geometry::Pose;
use nalgebra::{Matrix3, Rotation3, SMatrix, Translation3, UnitQuaternion, Vector3};
use std::collections::VecDeque;

/// Composes measurements outwards from the fixed nodes, breadth first, constraints in their order.
/// Constraints of weight zero are not used. `start` gives the poses of the fixed nodes.
pub fn spanning_tree(problem: &Problem, start: &[Pose], weights: &[f64]) -> Result<Vec<Pose>, SolveError> {
    problem.check(weights)?;
    if start.len() != problem.nodes {
        return Err(SolveError::Size { what: "start poses", found: start.len(), needed: problem.nodes });
    }
    let mut neighbours = vec![Vec::new(); problem.nodes];
    for (index, c) in problem.constraints.iter().enumerate().filter(|(k, _)| weights[*k] > 0.0) {
        neighbours[c.from].push(index);
        neighbours[c.to].push(index);
    }
    let mut poses = start.to_vec();
    let mut reached = problem.fixed.clone();
    let mut open: VecDeque<usize> = (0..problem.nodes).filter(|&n| reached[n]).collect();
    while let Some(node) = open.pop_front() {
        for &index in &neighbours[node] {
            let c = &problem.constraints[index];
            let (next, next_pose) = if c.from == node {
                (c.to, poses[node] * c.from_from_to)
            } else {
                (c.from, poses[node] * c.from_from_to.inverse())
            };
            if !std::mem::replace(&mut reached[next], true) {
                poses[next] = next_pose;
                open.push_back(next);
            }
        }
    }
    Ok(poses)
}

/// Chordal initialisation (Carlone et al., ICRA 2015): rotations from the relaxed linear problem
/// `min sum kappa |R_j - R_i R_ij|_F^2` over all 3x3 matrices, each projected to the nearest rotation; then
/// translations by linear least squares with these rotations. The fixed nodes keep the poses of `start`.
pub fn chordal(problem: &Problem, start: &[Pose], weights: &[f64]) -> Result<Vec<Pose>, SolveError> {
    problem.check(weights)?;
    if start.len() != problem.nodes {
        return Err(SolveError::Size { what: "start poses", found: start.len(), needed: problem.nodes });
    }
    let rotations = chordal_rotations(problem, start, weights)?;
    let translations = linear_translations(problem, start, weights, &rotations)?;
    Ok(rotations
        .iter()
        .zip(&translations)
        .map(|(r, t)| {
            Pose::from_parts(
                Translation3::from(*t),
                UnitQuaternion::from_matrix_eps(
                    r,
                    1e-15,
                    200,
                    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(*r)),
                ),
            )
        })
        .zip(start.iter().zip(&problem.fixed))
        .map(|(found, (given, fixed))| if *fixed { *given } else { found })
        .collect())
}

/// Free nodes get a variable, in order.
fn variables(problem: &Problem) -> (Vec<Option<usize>>, usize) {
    let mut count = 0;
    let variable = problem
        .fixed
        .iter()
        .map(|&fixed| {
            (!fixed).then(|| {
                count += 1;
                count - 1
            })
        })
        .collect();
    (variable, count)
}

/// One term `weight |x_to - A x_from - b|^2` of a linear problem over the nodes.
struct LinearTerm<const B: usize> {
    from: usize,
    to: usize,
    weight: f64,
    a: SMatrix<f64, B, B>,
    b: SMatrix<f64, B, 3>,
}

/// Least squares over `B`x3 unknowns per free node; fixed nodes have given values.
fn linear_least_squares<const B: usize>(
    problem: &Problem,
    given: &[SMatrix<f64, B, 3>],
    terms: &[LinearTerm<B>],
) -> Result<Vec<SMatrix<f64, B, 3>>, SolveError> {
    let (variable, count) = variables(problem);
    let pairs: Vec<_> = terms.iter().filter_map(|t| variable[t.from].zip(variable[t.to])).collect();
    let mut system = BlockCholesky::<B>::new(count, &pairs)?;
    let n = count * B;
    let mut rhs = vec![0.0; n * 3];
    let mut add_rhs = |variable: usize, value: SMatrix<f64, B, 3>| {
        for column in 0..3 {
            for row in 0..B {
                rhs[column * n + variable * B + row] += value[(row, column)];
            }
        }
    };
    let add = |system: &mut BlockCholesky<B>, row, column, value: SMatrix<f64, B, B>| {
        if let Some(slot) = system.slot(row, column) {
            system.add(slot, &value);
        }
    };
    for term in terms {
        let (w, a, b) = (term.weight, &term.a, &term.b);
        match (variable[term.from], variable[term.to]) {
            (Some(i), Some(j)) => {
                add(&mut system, i, i, a.transpose() * a * w);
                add(&mut system, j, j, SMatrix::identity() * w);
                add(&mut system, j, i, -a * w);
                add_rhs(i, -(a.transpose() * b) * w);
                add_rhs(j, b * w);
            }
            (Some(i), None) => {
                add(&mut system, i, i, a.transpose() * a * w);
                add_rhs(i, a.transpose() * (given[term.to] - b) * w);
            }
            (None, Some(j)) => {
                add(&mut system, j, j, SMatrix::identity() * w);
                add_rhs(j, (a * given[term.from] + b) * w);
            }
            (None, None) => {}
        }
    }
    system.factorise()?;
    for column in rhs.chunks_exact_mut(n.max(1)) {
        system.solve_in_place(column, 1);
    }
    Ok((0..problem.nodes)
        .map(|node| match variable[node] {
            Some(v) => SMatrix::from_fn(|row, column| rhs[column * n + v * B + row]),
            None => given[node],
        })
        .collect())
}

/// Rotation matrices `map_from_node`.
fn chordal_rotations(
    problem: &Problem,
    start: &[Pose],
    weights: &[f64],
) -> Result<Vec<Matrix3<f64>>, SolveError> {
    let matrix = |pose: &Pose| *pose.rotation.to_rotation_matrix().matrix();
    // Unknowns are the transposed rotations, whose columns are independent: R_j^T = R_ij^T R_i^T.
    let given: Vec<Matrix3<f64>> = start.iter().map(|p| matrix(p).transpose()).collect();
    let terms: Vec<_> = problem
        .constraints
        .iter()
        .zip(weights)
        .filter(|(_, w)| **w > 0.0)
        .map(|(c, w)| LinearTerm {
            from: c.from,
            to: c.to,
            weight: w * Isotropic::of(&c.information).kappa,
            a: matrix(&c.from_from_to).transpose(),
            b: Matrix3::zeros(),
        })
        .collect();
    let relaxed = linear_least_squares(problem, &given, &terms)?;
    Ok(relaxed.iter().map(|m| nearest_rotation(&m.transpose())).collect())
}

/// The rotation nearest to a matrix in the Frobenius norm; the identity for matrices without one.
pub fn nearest_rotation(matrix: &Matrix3<f64>) -> Matrix3<f64> {
    if !matrix.iter().all(|x| x.is_finite()) {
        return Matrix3::identity();
    }
    let svd = matrix.svd(true, true);
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else { return Matrix3::identity() };
    let mut sign = Matrix3::identity();
    if (u * v_t).determinant() < 0.0 {
        let least = svd.singular_values.imin();
        sign[(least, least)] = -1.0;
    }
    u * sign * v_t
}

fn linear_translations(
    problem: &Problem,
    start: &[Pose],
    weights: &[f64],
    rotations: &[Matrix3<f64>],
) -> Result<Vec<Vector3<f64>>, SolveError> {
    type Row = SMatrix<f64, 1, 3>;
    let given: Vec<Row> = start.iter().map(|p| p.translation.vector.transpose()).collect();
    let terms: Vec<_> = problem
        .constraints
        .iter()
        .zip(weights)
        .filter(|(_, w)| **w > 0.0)
        .map(|(c, w)| LinearTerm {
            from: c.from,
            to: c.to,
            weight: w * Isotropic::of(&c.information).tau,
            a: SMatrix::<f64, 1, 1>::identity(),
            b: (rotations[c.from] * c.from_from_to.translation.vector).transpose(),
        })
        .collect();
    Ok(linear_least_squares(problem, &given, &terms)?.iter().map(|row| row.transpose()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::solver::Constraint;
    use coma_geometry::{Matrix6, Tangent, se3};

    /// A ring with a chord; poses far from the identity, measured exactly.
    fn ring() -> (Problem, Vec<Pose>) {
        let truth: Vec<Pose> = (0..12)
            .map(|k| {
                let a = k as f64;
                se3::exp(&Tangent::new(
                    a.cos() * 3.0,
                    a.sin() * 2.0,
                    0.1 * a,
                    0.4 * a,
                    a.sin(),
                    0.3 - a.cos(),
                ))
            })
            .collect();
        let mut constraints = Vec::new();
        for (from, to) in (0..12).map(|k| (k, (k + 1) % 12)).chain([(2, 9), (11, 4)]) {
            constraints.push(Constraint {
                from,
                to,
                from_from_to: truth[from].inverse() * truth[to],
                information: Matrix6::from_diagonal(&Tangent::new(9.0, 9.0, 4.0, 100.0, 90.0, 80.0)),
            });
        }
        let mut fixed = vec![false; 12];
        fixed[5] = true;
        (Problem { nodes: 12, constraints, fixed }, truth)
    }

    #[test]
    fn both_starts_are_exact_without_noise() {
        let (problem, truth) = ring();
        let mut start = vec![Pose::identity(); 12];
        start[5] = truth[5];
        let weights = vec![1.0; problem.constraints.len()];
        for found in
            [chordal(&problem, &start, &weights).unwrap(), spanning_tree(&problem, &start, &weights).unwrap()]
        {
            for (a, b) in found.iter().zip(&truth) {
                let (m, rad) = se3::distance(a, b);
                assert!(m < 1e-8 && rad < 1e-8, "{m} {rad}");
            }
        }
    }

    #[test]
    fn a_reflection_is_projected_to_a_rotation() {
        let flipped = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -0.9));
        assert!((nearest_rotation(&flipped).determinant() - 1.0).abs() < 1e-12);
    }
}
