//! How sure the poses of chosen nodes are.

use crate::solver::{Problem, SolveError, Solver};
use coma_geometry::{Matrix6, Pose};

/// Marginal covariances of `nodes` at `poses`: of the right perturbation `map_from_node * exp(xi)`, order
/// (translation, rotation), m^2 and rad^2, with the fixed nodes taken as exact (their covariance is zero).
/// Columns of the inverse normal matrix: one solve per node.
pub fn marginals(
    problem: &Problem,
    poses: &[Pose],
    weights: &[f64],
    nodes: &[usize],
) -> Result<Vec<Matrix6>, SolveError> {
    if poses.len() != problem.nodes {
        return Err(SolveError::Size { what: "poses", found: poses.len(), needed: problem.nodes });
    }
    if let Some(&node) = nodes.iter().find(|n| **n >= problem.nodes) {
        return Err(SolveError::Size { what: "node index", found: node, needed: problem.nodes });
    }
    let mut solver = Solver::new(problem, weights)?;
    let variables: Vec<Option<usize>> = nodes.iter().map(|&n| solver.variable(n)).collect();
    let system = solver.factorise_at(poses, weights)?;
    let n = system.blocks() * 6;
    let mut columns = vec![0.0; n * 6];
    Ok(variables
        .into_iter()
        .map(|variable| {
            let Some(v) = variable else { return Matrix6::zeros() };
            columns.fill(0.0);
            for k in 0..6 {
                columns[k * n + v * 6 + k] = 1.0;
            }
            system.solve_in_place(&mut columns, 6);
            let block = Matrix6::from_fn(|row, column| columns[column * n + v * 6 + row]);
            (block + block.transpose()) * 0.5
        })
        .collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::solver::Constraint;
    use coma_geometry::{Tangent, se3};

    #[test]
    fn covariance_grows_along_a_chain_as_composition_says() {
        let step = se3::exp(&Tangent::new(1.0, 0.2, 0.0, 0.1, 0.0, 0.3));
        let covariance = Matrix6::from_diagonal(&Tangent::new(1e-4, 2e-4, 3e-4, 1e-5, 2e-5, 3e-5));
        let information = covariance.try_inverse().unwrap();
        let constraints =
            (0..3).map(|k| Constraint { from: k, to: k + 1, from_from_to: step, information }).collect();
        let problem = Problem { nodes: 4, constraints, fixed: vec![true, false, false, false] };
        let mut poses = vec![Pose::identity()];
        let mut expected = vec![Matrix6::zeros()];
        for k in 0..3 {
            poses.push(poses[k] * step);
            let carry = se3::adjoint(&step.inverse());
            expected.push(carry * expected[k] * carry.transpose() + covariance);
        }
        let found = marginals(&problem, &poses, &[1.0; 3], &[0, 1, 2, 3]).unwrap();
        for (a, b) in found.iter().zip(&expected) {
            assert!((a - b).norm() < 1e-12, "{a} {b}");
        }
    }
}
