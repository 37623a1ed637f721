//! Levenberg-Marquardt over poses.

use crate::isotropic::{Isotropic, Normal};
use crate::residual::{linearise, residual, squared_mahalanobis};
use crate::sparse::{BlockCholesky, BlockSlot, SparseError};
use coma_geometry::{Matrix6, Pose, Tangent, se3};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;

/// One measurement between two nodes, by index.
#[derive(Clone, Debug, PartialEq)]
pub struct Constraint {
    /// Index of node i.
    pub from: usize,
    /// Index of node j.
    pub to: usize,
    /// Measured `i_from_j` (T_ij).
    pub from_from_to: Pose,
    /// Inverse covariance of the residual (eq. 11), order (translation, rotation), m^-2 and rad^-2.
    pub information: Matrix6,
}

impl Constraint {
    /// Squared Mahalanobis error at these poses.
    pub fn squared_error(&self, poses: &[Pose]) -> f64 {
        let error = residual(&poses[self.from], &poses[self.to], &self.from_from_to);
        squared_mahalanobis(&error, &self.information)
    }
}

/// A pose graph by index: what to estimate and what was measured.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Problem {
    /// Number of nodes.
    pub nodes: usize,
    /// The measurements, in the order in which they are summed.
    pub constraints: Vec<Constraint>,
    /// `fixed[node]`: the node keeps its start. At least one per connected part, or nothing holds it.
    pub fixed: Vec<bool>,
}

/// What is minimised.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Objective {
    /// Eq. 10: half the sum of squared Mahalanobis errors, with the full information matrices.
    #[default]
    Mahalanobis,
    /// SE-Sync's ([`crate::isotropic`]), of which optimality can be certified.
    Isotropic,
}

/// When to stop, and how to damp.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SolverSettings {
    /// Most linear solves. Chordal starts need fewer than 20 on the public data sets.
    pub max_iterations: u32,
    /// Stop when the cost falls by less than this share in one step.
    pub relative_decrease: f64,
    /// Stop when the cost (half the sum of squared Mahalanobis errors) is below this.
    pub absolute_cost: f64,
    /// First damping, as a share of the diagonal. GTSAM starts at 1e-5.
    pub initial_damping: f64,
    /// Give up when the damping passes this share of the diagonal.
    pub max_damping: f64,
}

impl Default for SolverSettings {
    fn default() -> Self {
        SolverSettings {
            max_iterations: 100,
            relative_decrease: 1e-10,
            absolute_cost: 1e-16,
            initial_damping: 1e-6,
            max_damping: 1e10,
        }
    }
}

/// Why there is no solution.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SolveError {
    /// Arrays do not fit together.
    #[error("{what}: {found} given, {needed} needed")]
    Size {
        /// Which array.
        what: &'static str,
        /// Its length.
        found: usize,
        /// The length that fits.
        needed: usize,
    },
    /// A constraint names a node that is not there, or the same node twice.
    #[error("constraint {constraint} joins nodes {from} and {to} of {nodes}")]
    BadConstraint {
        /// Index of the constraint.
        constraint: usize,
        /// Its first node.
        from: usize,
        /// Its second node.
        to: usize,
        /// Number of nodes.
        nodes: usize,
    },
    /// A node that no constraint connects with a fixed node.
    #[error("node {node} is not connected with any fixed node")]
    NotConnected {
        /// The node.
        node: usize,
    },
    /// The start has an infinite or undefined cost.
    #[error("the start has no finite cost")]
    NotFinite,
    /// The linear system failed.
    #[error(transparent)]
    Sparse(#[from] SparseError),
}

/// What a solve ended with.
#[derive(Clone, Debug, PartialEq)]
pub struct Solved {
    /// One pose per node.
    pub poses: Vec<Pose>,
    /// The objective at the start: half the weighted sum of squared Mahalanobis errors, or SE-Sync's.
    pub initial_cost: f64,
    /// The same at the end.
    pub cost: f64,
    /// Linear solves.
    pub iterations: u32,
    /// False if the iteration limit ended it.
    pub converged: bool,
}

impl Problem {
    /// Half the weighted sum of squared Mahalanobis errors (eq. 10). `weights` is one per constraint.
    pub fn cost(&self, poses: &[Pose], weights: &[f64]) -> f64 {
        let sum: f64 = self
            .constraints
            .iter()
            .zip(weights)
            .filter(|(_, w)| **w > 0.0)
            .map(|(c, w)| w * c.squared_error(poses))
            .sum();
        0.5 * sum
    }

    /// Refuses indices that do not exist and nodes that nothing holds.
    pub fn check(&self, weights: &[f64]) -> Result<(), SolveError> {
        let size = |what, found, needed| {
            if found == needed { Ok(()) } else { Err(SolveError::Size { what, found, needed }) }
        };
        size("fixed flags", self.fixed.len(), self.nodes)?;
        size("weights", weights.len(), self.constraints.len())?;
        let mut neighbours = vec![Vec::new(); self.nodes];
        for (constraint, c) in self.constraints.iter().enumerate() {
            let (from, to) = (c.from, c.to);
            if from >= self.nodes || to >= self.nodes || from == to {
                return Err(SolveError::BadConstraint { constraint, from, to, nodes: self.nodes });
            }
            if weights[constraint] > 0.0 {
                neighbours[from].push(to);
                neighbours[to].push(from);
            }
        }
        let mut reached = self.fixed.clone();
        let mut open: Vec<usize> = (0..self.nodes).filter(|&n| reached[n]).collect();
        while let Some(node) = open.pop() {
            for &next in &neighbours[node] {
                if !std::mem::replace(&mut reached[next], true) {
                    open.push(next);
                }
            }
        }
        match reached.iter().position(|r| !r) {
            Some(node) => Err(SolveError::NotConnected { node }),
            None => Ok(()),
        }
    }

    /// Minimises the cost from `start`. Deterministic: one thread, one order of summation.
    pub fn solve(
        &self,
        start: &[Pose],
        weights: &[f64],
        settings: &SolverSettings,
    ) -> Result<Solved, SolveError> {
        Solver::new(self, weights)?.solve(start, weights, settings)
    }
}

/// A problem with its ordering and symbolic factorisation, to be solved many times with changing weights.
pub struct Solver<'a> {
    problem: Cow<'a, Problem>,
    /// Node to variable; `None` for fixed nodes.
    variable: Vec<Option<usize>>,
    system: BlockCholesky<6>,
    slots: Vec<ConstraintSlots>,
    /// One per constraint; `None` for the full information.
    isotropic: Option<Vec<Isotropic>>,
}

#[derive(Clone, Copy, Default)]
struct ConstraintSlots {
    from: Option<BlockSlot>,
    to: Option<BlockSlot>,
    cross: Option<BlockSlot>,
}

impl<'a> Solver<'a> {
    /// Checks the problem with the given weights, orders it and analyses its pattern. The pattern holds every
    /// constraint, so that weights may change from and to zero.
    pub fn new(problem: &'a Problem, weights: &[f64]) -> Result<Self, SolveError> {
        Self::over(Cow::Borrowed(problem), weights, |_| true)
    }

    /// The same without a place for the constraints that `in_pattern` leaves out; their weights must stay zero. False
    /// loops between far places would make the factor much larger.
    pub fn with_pattern(
        problem: &'a Problem,
        weights: &[f64],
        in_pattern: &[bool],
    ) -> Result<Self, SolveError> {
        Self::over(Cow::Borrowed(problem), weights, |k| in_pattern.get(k).copied().unwrap_or(false))
    }

    /// The same for a problem that it keeps.
    pub fn owning(problem: Problem, weights: &[f64]) -> Result<Solver<'static>, SolveError> {
        Solver::over(Cow::Owned(problem), weights, |_| true)
    }

    /// What is solved.
    pub fn problem(&self) -> &Problem {
        &self.problem
    }

    fn over(
        problem: Cow<'a, Problem>,
        weights: &[f64],
        in_pattern: impl Fn(usize) -> bool,
    ) -> Result<Self, SolveError> {
        problem.check(weights)?;
        let mut next = 0;
        let variable: Vec<Option<usize>> = problem
            .fixed
            .iter()
            .map(|&fixed| {
                (!fixed).then(|| {
                    next += 1;
                    next - 1
                })
            })
            .collect();
        let ends = |c: &Constraint| (variable[c.from], variable[c.to]);
        let pairs: Vec<(usize, usize)> = problem
            .constraints
            .iter()
            .enumerate()
            .filter(|(k, _)| in_pattern(*k))
            .filter_map(|(_, c)| {
                let (a, b) = ends(c);
                a.zip(b)
            })
            .collect();
        let system = BlockCholesky::new(next, &pairs)?;
        let slots = problem
            .constraints
            .iter()
            .map(|c| {
                let (a, b) = ends(c);
                ConstraintSlots {
                    from: a.and_then(|a| system.slot(a, a)),
                    to: b.and_then(|b| system.slot(b, b)),
                    cross: a.zip(b).and_then(|(a, b)| system.slot(a, b)),
                }
            })
            .collect();
        Ok(Solver { problem, variable, system, slots, isotropic: None })
    }

    /// The same for another objective.
    pub fn with_objective(
        problem: &'a Problem,
        weights: &[f64],
        objective: Objective,
    ) -> Result<Self, SolveError> {
        let isotropic = match objective {
            Objective::Mahalanobis => None,
            Objective::Isotropic => {
                Some(problem.constraints.iter().map(|c| Isotropic::of(&c.information)).collect())
            }
        };
        Ok(Solver { isotropic, ..Solver::new(problem, weights)? })
    }

    /// The objective at these poses.
    pub fn cost(&self, poses: &[Pose], weights: &[f64]) -> f64 {
        let Some(isotropic) = &self.isotropic else { return self.problem.cost(poses, weights) };
        let used = self.problem.constraints.iter().zip(isotropic).zip(weights).filter(|(_, w)| **w > 0.0);
        used.map(|((c, term), w)| w * term.term(&poses[c.from], &poses[c.to], &c.from_from_to)).sum()
    }

    /// What constraint `k` adds to the normal equations, before its weight.
    fn normal(&self, k: usize, poses: &[Pose]) -> Normal {
        let c = &self.problem.constraints[k];
        if let Some(isotropic) = &self.isotropic {
            return isotropic[k].normal(&poses[c.from], &poses[c.to], &c.from_from_to);
        }
        let at = linearise(&poses[c.from], &poses[c.to], &c.from_from_to);
        let i_omega = at.wrt_i.transpose() * c.information;
        let j_omega = at.wrt_j.transpose() * c.information;
        Normal {
            ii: i_omega * at.wrt_i,
            ij: i_omega * at.wrt_j,
            jj: j_omega * at.wrt_j,
            g_i: i_omega * at.error,
            g_j: j_omega * at.error,
        }
    }

    /// Fills the normal equations `H x = -g` at `poses`; returns the right-hand side `-g`.
    fn linearise(&mut self, poses: &[Pose], weights: &[f64]) -> Vec<f64> {
        self.system.clear();
        let mut rhs = vec![0.0; self.system.blocks() * 6];
        let mut add_rhs = |variable: usize, value: Tangent| {
            for k in 0..6 {
                rhs[variable * 6 + k] -= value[k];
            }
        };
        for (k, &weight) in weights.iter().enumerate() {
            if !(weight > 0.0) {
                continue;
            }
            let (c, slots) = (&self.problem.constraints[k], self.slots[k]);
            let normal = self.normal(k, poses);
            if let (Some(slot), Some(i)) = (slots.from, self.variable[c.from]) {
                self.system.add(slot, &(normal.ii * weight));
                add_rhs(i, normal.g_i * weight);
            }
            if let (Some(slot), Some(j)) = (slots.to, self.variable[c.to]) {
                self.system.add(slot, &(normal.jj * weight));
                add_rhs(j, normal.g_j * weight);
            }
            if let Some(slot) = slots.cross {
                self.system.add(slot, &(normal.ij * weight));
            }
        }
        rhs
    }

    /// Factorises the undamped normal matrix at `poses`, for covariances.
    pub(crate) fn factorise_at(
        &mut self,
        poses: &[Pose],
        weights: &[f64],
    ) -> Result<&mut BlockCholesky<6>, SolveError> {
        self.linearise(poses, weights);
        self.system.factorise()?;
        Ok(&mut self.system)
    }

    /// Squared Mahalanobis errors of the constraints `asked` against a solution that knows nothing of them:
    /// `e^T (Omega^-1 + J Sigma J^T)^-1 e` with the solution's covariance Sigma for one of weight zero, and with a
    /// minus for one that is part of the solution. To first order this is by how much twice the cost rises when the
    /// constraint is taken in, or falls when it is left out. Zero for one that nothing else speaks for or against.
    pub(crate) fn innovations(
        &mut self,
        poses: &[Pose],
        weights: &[f64],
        asked: &[usize],
    ) -> Result<Vec<f64>, SolveError> {
        self.factorise_at(poses, weights)?;
        let (problem, variable, system) = (&self.problem, &self.variable, &mut self.system);
        let n = system.blocks() * 6;
        let mut columns = vec![0.0; n * 6];
        Ok(asked
            .iter()
            .map(|&k| {
                let c = &problem.constraints[k];
                let at = linearise(&poses[c.from], &poses[c.to], &c.from_from_to);
                let ends = [(variable[c.from], at.wrt_i), (variable[c.to], at.wrt_j)];
                // Columns of Sigma J^T.
                columns.fill(0.0);
                for (v, jacobian) in &ends {
                    let Some(v) = v else { continue };
                    for (column, row) in jacobian.row_iter().enumerate() {
                        for (axis, value) in row.iter().enumerate() {
                            columns[column * n + v * 6 + axis] = *value;
                        }
                    }
                }
                system.solve_in_place(&mut columns, 6);
                let mut spread = c.information.try_inverse().unwrap_or_else(Matrix6::zeros);
                let part = weights[k] > 0.0;
                let sign = if part { -1.0 } else { 1.0 };
                for (v, jacobian) in &ends {
                    let Some(v) = v else { continue };
                    spread +=
                        jacobian * Matrix6::from_fn(|row, column| columns[column * n + v * 6 + row]) * sign;
                }
                let spread = (spread + spread.transpose()) * 0.5;
                let alone = if part { 0.0 } else { f64::INFINITY };
                spread.cholesky().map_or(alone, |factor| at.error.dot(&factor.solve(&at.error)))
            })
            .collect())
    }

    /// The variable of a node; `None` for fixed ones.
    pub(crate) fn variable(&self, node: usize) -> Option<usize> {
        self.variable.get(node).copied().flatten()
    }

    /// Minimises the cost from `start` with these weights.
    pub fn solve(
        &mut self,
        start: &[Pose],
        weights: &[f64],
        settings: &SolverSettings,
    ) -> Result<Solved, SolveError> {
        let size = |what, found, needed| {
            if found == needed { Ok(()) } else { Err(SolveError::Size { what, found, needed }) }
        };
        size("start poses", start.len(), self.problem.nodes)?;
        size("weights", weights.len(), self.problem.constraints.len())?;
        let mut poses = start.to_vec();
        let initial_cost = self.cost(&poses, weights);
        if !initial_cost.is_finite() {
            return Err(SolveError::NotFinite);
        }
        let mut cost = initial_cost;
        let mut damping = settings.initial_damping;
        let mut iterations = 0;
        let mut converged = self.system.blocks() == 0 || cost <= settings.absolute_cost;
        while !converged && iterations < settings.max_iterations {
            let rhs = self.linearise(&poses, weights);
            let diagonal = self.system.diagonal();
            let mut added = 0.0;
            // Raise the damping until a step lowers the cost.
            loop {
                iterations += 1;
                // A floor keeps a direction that nothing measures from being singular under damping.
                let increase: Vec<f64> = diagonal.iter().map(|d| (damping - added) * d.max(1e-12)).collect();
                self.system.add_to_diagonal(&increase);
                added = damping;
                let stepped = self.system.factorise().map(|()| {
                    let mut step = rhs.clone();
                    self.system.solve_in_place(&mut step, 1);
                    self.moved(&poses, &step)
                });
                let candidate = match stepped {
                    Ok(candidate) => candidate,
                    Err(e) if damping * 10.0 > settings.max_damping => return Err(e.into()),
                    Err(_) => {
                        damping = (damping * 10.0).max(1e-9);
                        continue;
                    }
                };
                let new_cost = self.cost(&candidate, weights);
                if new_cost <= cost {
                    converged = cost - new_cost <= settings.relative_decrease * cost
                        || new_cost <= settings.absolute_cost;
                    (poses, cost) = (candidate, new_cost);
                    damping *= 0.1;
                    break;
                }
                // At the bottom rounding alone decides whether the cost rises.
                if new_cost - cost <= 1e-13 * cost {
                    converged = true;
                    break;
                }
                damping = (damping * 10.0).max(1e-9);
                if damping > settings.max_damping || iterations >= settings.max_iterations {
                    converged = damping > settings.max_damping;
                    break;
                }
            }
            if damping > settings.max_damping {
                break;
            }
        }
        Ok(Solved { poses, initial_cost, cost, iterations, converged })
    }

    fn moved(&self, poses: &[Pose], step: &[f64]) -> Vec<Pose> {
        poses
            .iter()
            .zip(&self.variable)
            .map(|(pose, variable)| match variable {
                Some(v) => {
                    let mut moved = pose * se3::exp(&Tangent::from_column_slice(&step[v * 6..][..6]));
                    moved.rotation.renormalize();
                    moved
                }
                None => *pose,
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(x: f64, y: f64, yaw: f64) -> Pose {
        se3::exp(&Tangent::new(x, y, 0.0, 0.0, 0.0, yaw))
    }

    fn square() -> (Problem, Vec<Pose>) {
        let step = pose(1.0, 0.0, std::f64::consts::FRAC_PI_2);
        let constraints = (0..4)
            .map(|k| Constraint {
                from: k,
                to: (k + 1) % 4,
                from_from_to: step,
                information: Matrix6::identity() * 100.0,
            })
            .collect();
        let mut truth = vec![Pose::identity()];
        for _ in 0..3 {
            truth.push(truth.last().unwrap() * step);
        }
        (Problem { nodes: 4, constraints, fixed: vec![true, false, false, false] }, truth)
    }

    #[test]
    fn a_disturbed_square_closes_again() {
        let (problem, truth) = square();
        let mut start = truth.clone();
        for (k, p) in start.iter_mut().enumerate().skip(1) {
            *p *= se3::exp(&(Tangent::new(0.2, -0.1, 0.3, 0.2, 0.1, -0.3) * k as f64));
        }
        let solved = problem.solve(&start, &[1.0; 4], &SolverSettings::default()).unwrap();
        assert!(solved.converged && solved.cost < 1e-12, "{} {}", solved.cost, solved.iterations);
        for (found, wanted) in solved.poses.iter().zip(&truth) {
            let (m, rad) = se3::distance(found, wanted);
            assert!(m < 1e-6 && rad < 1e-6);
        }
    }

    #[test]
    fn two_nodes_are_a_graph() {
        let i_from_j = pose(1.0, 2.0, 0.3);
        let problem = Problem {
            nodes: 2,
            constraints: vec![Constraint {
                from: 0,
                to: 1,
                from_from_to: i_from_j,
                information: Matrix6::identity(),
            }],
            fixed: vec![false, true],
        };
        let solved =
            problem.solve(&[Pose::identity(), Pose::identity()], &[1.0], &SolverSettings::default()).unwrap();
        let (m, rad) = se3::distance(&solved.poses[0], &i_from_j.inverse());
        assert!(m < 1e-8 && rad < 1e-8);
    }

    #[test]
    fn a_node_that_nothing_holds_is_named() {
        let (mut problem, truth) = square();
        let error = problem.solve(&truth, &[0.0, 0.0, 0.0, 1.0], &SolverSettings::default()).unwrap_err();
        assert_eq!(error, SolveError::NotConnected { node: 1 });
        problem.constraints[2].to = 9;
        let error = problem.solve(&truth, &[1.0; 4], &SolverSettings::default()).unwrap_err();
        assert_eq!(error, SolveError::BadConstraint { constraint: 2, from: 2, to: 9, nodes: 4 });
    }

    #[test]
    fn a_weight_of_zero_takes_a_constraint_out() {
        let (mut problem, truth) = square();
        problem.constraints[3].from_from_to = pose(9.0, 9.0, 2.0);
        let weights = [1.0, 1.0, 1.0, 0.0];
        let solved = problem.solve(&truth, &weights, &SolverSettings::default()).unwrap();
        assert!(solved.cost < 1e-20);
    }
}
