//! Previews: what a new measurement does to the last result, within milliseconds. They start from the last solution and
//! are provisional: what is published is always the cold solve of [`crate::global`].

use crate::global::GlobalSettings;
use crate::gnc::final_weight;
use crate::graph::{Edge, EdgeKind, EntryProblem, GraphEntries, UsableGraph, checked_edge};
use crate::residual::{residual, squared_mahalanobis};
use crate::sets::Sets;
use crate::solution::Component;
use crate::solver::{Constraint, Problem, SolveError, Solver, SolverSettings};
use coma_geometry::{Pose, SubmapId, se3};
use std::collections::BTreeMap;

/// What became of a new measurement.
#[derive(Clone, Debug, PartialEq)]
pub enum Added {
    /// Odometry to a new submap: it was placed by composition.
    Composed,
    /// A loop, or odometry between submaps that were there: the graph was solved again.
    Solved {
        /// 0 to 1.
        weight: f64,
        /// Squared Mahalanobis error against what the graph knew before, its uncertainty counted.
        squared_error: f64,
        /// Linear solves.
        iterations: u32,
        /// Farthest that a submap moved.
        moved_m: f64,
    },
    /// It leads out of this component: only a cold solve can join components.
    Elsewhere,
    /// It cannot be used.
    Refused(EntryProblem),
}

/// A component that follows new measurements.
#[derive(Clone, Debug)]
pub struct Preview {
    submaps: Vec<SubmapId>,
    index: BTreeMap<SubmapId, usize>,
    problem: Problem,
    weights: Vec<f64>,
    poses: Vec<Pose>,
    /// What odometry connects.
    chains: Sets,
    settings: GlobalSettings,
}

impl Preview {
    /// Starts from a published component and the entries that it was solved from.
    pub fn new(component: &Component, entries: &GraphEntries, settings: &GlobalSettings) -> Self {
        let submaps: Vec<SubmapId> = component.map_from_submap.keys().cloned().collect();
        let index: BTreeMap<SubmapId, usize> =
            submaps.iter().enumerate().map(|(k, submap)| (submap.clone(), k)).collect();
        let mut preview = Preview {
            problem: Problem {
                nodes: submaps.len(),
                constraints: Vec::new(),
                fixed: submaps.iter().map(|submap| *submap == component.gauge).collect(),
            },
            poses: component.map_from_submap.values().copied().collect(),
            chains: Sets::new(submaps.len()),
            submaps,
            index,
            weights: Vec::new(),
            settings: *settings,
        };
        let graph = UsableGraph::new(entries);
        let weights: BTreeMap<_, f64> = component.loops.iter().map(|l| (&l.key, l.weight)).collect();
        for edge in &graph.odometry {
            preview.push(edge, 1.0);
        }
        for edge in &graph.loops {
            if let Some(weight) = weights.get(&edge.key) {
                preview.push(edge, *weight);
            }
        }
        preview
    }

    /// `map_from_submap`, provisional.
    pub fn map_from_submap(&self) -> BTreeMap<SubmapId, Pose> {
        self.submaps.iter().cloned().zip(self.poses.iter().copied()).collect()
    }

    /// Takes one more measurement. A loop is weighed against what the graph knew before.
    pub fn add(&mut self, edge: &Edge) -> Result<Added, SolveError> {
        let edge = match checked_edge(edge, |_| true) {
            Ok(edge) => edge,
            Err(problem) => return Ok(Added::Refused(problem)),
        };
        let (from, to) = (self.index.get(&edge.from).copied(), self.index.get(&edge.to).copied());
        match (edge.kind, from, to) {
            (EdgeKind::Odometry, Some(from), None) => {
                self.place(&edge.to, self.poses[from] * edge.from_from_to);
                self.push(&edge, 1.0);
                Ok(Added::Composed)
            }
            (EdgeKind::Odometry, None, Some(to)) => {
                self.place(&edge.from, self.poses[to] * edge.from_from_to.inverse());
                self.push(&edge, 1.0);
                Ok(Added::Composed)
            }
            (_, Some(_), Some(_)) => self.solve_with(&edge),
            _ => Ok(Added::Elsewhere),
        }
    }

    fn place(&mut self, submap: &SubmapId, pose: Pose) {
        self.index.insert(submap.clone(), self.submaps.len());
        self.submaps.push(submap.clone());
        self.poses.push(pose);
        self.chains.push();
        self.problem.nodes += 1;
        self.problem.fixed.push(false);
    }

    fn push(&mut self, edge: &Edge, weight: f64) {
        if let (Some(&from), Some(&to)) = (self.index.get(&edge.from), self.index.get(&edge.to)) {
            if edge.kind == EdgeKind::Odometry {
                self.chains.join(from, to);
            }
            let (from_from_to, information) = (edge.from_from_to, edge.information);
            self.problem.constraints.push(Constraint { from, to, from_from_to, information });
            self.weights.push(weight);
        }
    }

    fn solve_with(&mut self, edge: &Edge) -> Result<Added, SolveError> {
        let new = self.problem.constraints.len();
        self.push(edge, 0.0);
        let mut solver = Solver::new(&self.problem, &self.weights)?;
        let squared_error = solver.innovations(&self.poses, &self.weights, &[new])?[0];
        let robust = &self.settings.robust;
        let weight = match edge.kind {
            EdgeKind::Odometry => 1.0,
            EdgeKind::Loop => {
                let Constraint { from, to, .. } = self.problem.constraints[new];
                final_weight(robust.kernel, robust.limit(self.chains.same(from, to)), squared_error)
            }
        };
        self.weights[new] = weight;
        let (mut iterations, mut moved_m) = (0, 0.0f64);
        if weight > 0.0 {
            let c = &self.problem.constraints[new];
            let error = residual(&self.poses[c.from], &self.poses[c.to], &c.from_from_to);
            let settings = SolverSettings {
                max_iterations: PREVIEW_ITERATIONS,
                relative_decrease: PREVIEW_DECREASE,
                // What the graph costs is known: the new measurement brings at most this.
                absolute_cost: PREVIEW_DECREASE * squared_mahalanobis(&error, &c.information),
                ..self.settings.solver
            };
            let solved = solver.solve(&self.poses, &self.weights, &settings)?;
            iterations = solved.iterations;
            for (before, after) in self.poses.iter().zip(&solved.poses) {
                moved_m = moved_m.max(se3::distance(before, after).0);
            }
            self.poses = solved.poses;
        }
        Ok(Added::Solved { weight, squared_error, iterations, moved_m })
    }
}

/// Linear solves that a preview may take; two are usual.
const PREVIEW_ITERATIONS: u32 = 5;
/// A preview ends when the cost falls by less than this share: a hundredth of a standard deviation of one measurement in
/// a graph of a hundred.
const PREVIEW_DECREASE: f64 = 1e-6;
