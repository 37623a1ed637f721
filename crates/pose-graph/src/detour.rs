//! What others say of a measurement, bounded cheaply: by the shortest way around it.
//!
//! Whatever else the graph knows of two nodes, it knows no less than what one way between them says. So the covariance
//! along a way bounds that of the whole graph from above, without a solve.

use crate::residual::linearise;
use crate::solver::Problem;
use crate::uncertain::UncertainPose;
use coma_geometry::{Matrix6, Pose, Tangent};
use std::collections::VecDeque;

/// The measurements in use, by node.
pub(crate) struct Detours<'a> {
    problem: &'a Problem,
    poses: &'a [Pose],
    weights: &'a [f64],
    adjacent: Vec<Vec<usize>>,
}

impl<'a> Detours<'a> {
    /// Over the constraints of positive weight.
    pub fn new(problem: &'a Problem, poses: &'a [Pose], weights: &'a [f64]) -> Self {
        let mut adjacent = vec![Vec::new(); problem.nodes];
        for (k, c) in problem.constraints.iter().enumerate().filter(|(k, _)| weights[*k] > 0.0) {
            adjacent[c.from].push(k);
            adjacent[c.to].push(k);
        }
        Detours { problem, poses, weights, adjacent }
    }

    /// A lower bound of the squared error that constraint `k`, which is not in use, has against the graph: a solve need
    /// not be asked where this is too large. 0 without any way around.
    pub fn least_error_outside(&self, k: usize) -> f64 {
        let Some((error, around)) = self.around(k) else { return 0.0 };
        let own = self.problem.constraints[k].information.cholesky().map(|factor| factor.inverse());
        let spread = own.and_then(|own| (own + around).cholesky());
        spread.map_or(0.0, |factor| error.dot(&factor.solve(&error)))
    }

    /// An upper bound of the squared error that the others find in constraint `k`, which is in use. 0 without any way
    /// around: nothing contradicts it then.
    pub fn most_error_inside(&self, k: usize) -> f64 {
        let Some((error, around)) = self.around(k) else { return 0.0 };
        let information = self.problem.constraints[k].information * self.weights[k];
        let known = around.cholesky().map(|factor| factor.inverse() + information);
        let together = known.and_then(|sum| sum.cholesky()).map(|factor| factor.inverse());
        let own = information.cholesky().map(|factor| factor.inverse());
        let left = own.zip(together).and_then(|(own, together)| (own - together).cholesky());
        left.map_or(f64::INFINITY, |factor| error.dot(&factor.solve(&error)))
    }

    /// The error of constraint `k` and its covariance by the shortest way around.
    fn around(&self, k: usize) -> Option<(Tangent, Matrix6)> {
        let c = &self.problem.constraints[k];
        let mut way = UncertainPose {
            pose: self.poses[c.from].inv_mul(&self.poses[c.from]),
            covariance: Matrix6::zeros(),
        };
        for step in self.way(k)? {
            way = way.compose(&self.step(step)?);
        }
        let at = linearise(&self.poses[c.from], &self.poses[c.to], &c.from_from_to);
        let covariance = at.wrt_j * way.covariance * at.wrt_j.transpose();
        Some((at.error, (covariance + covariance.transpose()) * 0.5))
    }

    /// One measurement, walked forwards or backwards, as the present poses have it.
    fn step(&self, (k, forward): (usize, bool)) -> Option<UncertainPose> {
        let c = &self.problem.constraints[k];
        let covariance = (c.information * self.weights[k]).cholesky()?.inverse();
        let ahead = UncertainPose { pose: self.poses[c.from].inv_mul(&self.poses[c.to]), covariance };
        Some(if forward { ahead } else { ahead.inverse() })
    }

    /// The way with the fewest steps that does not use `k` itself.
    fn way(&self, k: usize) -> Option<Vec<(usize, bool)>> {
        let (from, to) = (self.problem.constraints[k].from, self.problem.constraints[k].to);
        let mut came_by: Vec<Option<usize>> = vec![None; self.problem.nodes];
        let mut open = VecDeque::from([from]);
        'search: while let Some(node) = open.pop_front() {
            for &step in self.adjacent[node].iter().filter(|step| **step != k) {
                let c = &self.problem.constraints[step];
                let next = c.from + c.to - node;
                if next != from && came_by[next].is_none() {
                    came_by[next] = Some(step);
                    if next == to {
                        break 'search;
                    }
                    open.push_back(next);
                }
            }
        }
        let (mut way, mut node) = (Vec::new(), to);
        while node != from {
            let step = came_by[node]?;
            let c = &self.problem.constraints[step];
            way.push((step, c.to == node));
            node = c.from + c.to - node;
        }
        way.reverse();
        Some(way)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::solver::{Constraint, Solver};
    use coma_geometry::se3;

    /// A ladder of two rails with all rungs; measurements are a little off.
    fn ladder() -> (Problem, Vec<Pose>) {
        let poses: Vec<Pose> = (0..12)
            .map(|k| {
                let (along, side) = (f64::from(k / 2), f64::from(k % 2));
                se3::exp(&Tangent::new(along, side, 0.1 * along, 0.2 * along, 0.1, 0.3 * side))
            })
            .collect();
        let mut constraints = Vec::new();
        for k in 0..12 {
            for to in [k + 2, k + 1 - k % 2].into_iter().filter(|to| *to < 12 && *to != k) {
                let x = (k * 7 + to) as f64;
                let off = Tangent::from_fn(|axis, _| 0.03 * (x + axis as f64).sin());
                constraints.push(Constraint {
                    from: k,
                    to,
                    from_from_to: poses[k].inverse() * poses[to] * se3::exp(&off),
                    information: Matrix6::from_diagonal(&Tangent::new(
                        900.0, 400.0, 900.0, 2500.0, 900.0, 900.0,
                    )),
                });
            }
        }
        let fixed = (0..12).map(|k| k == 0).collect();
        (Problem { nodes: 12, constraints, fixed }, poses)
    }

    #[test]
    fn the_bounds_hold_the_errors_that_solves_find() {
        let (problem, poses) = ladder();
        for k in 0..problem.constraints.len() {
            let mut weights = vec![1.0; problem.constraints.len()];
            let mut solver = Solver::new(&problem, &weights).unwrap();
            let inside = solver.innovations(&poses, &weights, &[k]).unwrap()[0];
            let most = Detours::new(&problem, &poses, &weights).most_error_inside(k);
            assert!(inside <= most * 1.02 + 1e-9, "{k}: {inside} {most}");
            weights[k] = 0.0;
            let outside = solver.innovations(&poses, &weights, &[k]).unwrap()[0];
            let least = Detours::new(&problem, &poses, &weights).least_error_outside(k);
            assert!(least <= outside * 1.02 + 1e-9 && least > 0.0, "{k}: {least} {outside}");
        }
    }

    #[test]
    fn a_measurement_that_alone_holds_a_node_is_contradicted_by_nothing() {
        let (mut problem, poses) = ladder();
        problem.constraints.retain(|c| c.from != 11 && c.to != 11 || c.from == 9);
        let weights = vec![1.0; problem.constraints.len()];
        let k = problem.constraints.iter().position(|c| c.to == 11).unwrap();
        let detours = Detours::new(&problem, &poses, &weights);
        assert_eq!((detours.most_error_inside(k), detours.least_error_outside(k)), (0.0, 0.0));
    }
}
