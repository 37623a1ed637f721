//! A block's own problem: its nodes, with the neighbours' nodes that are known held where they are.

use super::{Block, NodeId};
use crate::initialise::chordal;
use crate::solver::{Constraint, Problem, SolveError, Solved, Solver, SolverSettings};
use coma_geometry::Pose;
use std::collections::BTreeMap;

pub(super) struct Local {
    /// Of the whole problem, by index here.
    nodes: Vec<NodeId>,
    /// Which nodes are the block's own and free.
    free: Vec<bool>,
    /// Which of the block's edges the constraints are.
    edges: Vec<usize>,
    solver: Solver<'static>,
    rotation_scale_m: f64,
}

impl Local {
    /// Over the nodes that measurements of positive weight connect with a node that is held. `None` without any.
    pub fn new(
        block: &Block,
        known: &BTreeMap<NodeId, Pose>,
        weights: &[f64],
    ) -> Result<Option<Self>, SolveError> {
        let ends = |c: &Constraint| [c.from as NodeId, c.to as NodeId];
        let own = |node: &NodeId| block.owns(node);
        let mut neighbours: BTreeMap<NodeId, Vec<NodeId>> = BTreeMap::new();
        for (edge, _) in block.edges.iter().zip(weights).filter(|(_, w)| **w > 0.0) {
            let [from, to] = ends(&edge.constraint);
            neighbours.entry(from).or_default().push(to);
            neighbours.entry(to).or_default().push(from);
        }
        let mut reached: BTreeMap<NodeId, bool> = known.keys().map(|node| (*node, false)).collect();
        reached.extend(block.fixed.iter().filter(|n| own(n)).map(|node| (*node, false)));
        let mut open: Vec<NodeId> = reached.keys().copied().collect();
        while let Some(node) = open.pop() {
            for next in neighbours.get(&node).into_iter().flatten().filter(|n| own(n)) {
                if !reached.contains_key(next) {
                    reached.insert(*next, true);
                    open.push(*next);
                }
            }
        }
        if !reached.values().any(|free| *free) {
            return Ok(None);
        }
        let index: BTreeMap<NodeId, usize> = reached.keys().enumerate().map(|(k, node)| (*node, k)).collect();
        let inside = |k: &usize| ends(&block.edges[*k].constraint).iter().all(|n| index.contains_key(n));
        let edges: Vec<usize> = (0..block.edges.len()).filter(inside).collect();
        let constraint = |k: &usize| {
            let c = &block.edges[*k].constraint;
            let [from, to] = ends(c).map(|node| index[&node]);
            Constraint { from, to, ..c.clone() }
        };
        let problem = Problem {
            nodes: index.len(),
            constraints: edges.iter().map(constraint).collect(),
            fixed: reached.values().map(|free| !free).collect(),
        };
        let lengths = problem.constraints.iter().map(|c| c.from_from_to.translation.vector.norm());
        let rotation_scale_m = lengths.sum::<f64>() / problem.constraints.len().max(1) as f64;
        let solver = Solver::owning(problem, &edges.iter().map(|k| weights[*k]).collect::<Vec<_>>())?;
        Ok(Some(Local {
            nodes: reached.keys().copied().collect(),
            free: reached.values().copied().collect(),
            edges,
            solver,
            rotation_scale_m,
        }))
    }

    /// Metres that a radian weighs as much as: the mean length of a measurement.
    pub fn rotation_scale_m(&self) -> f64 {
        self.rotation_scale_m
    }

    fn weights(&self, of_block: &[f64]) -> Vec<f64> {
        self.edges.iter().map(|k| of_block[*k]).collect()
    }

    /// True if these weights leave no node without hold.
    pub fn holds(&self, weights: &[f64]) -> bool {
        self.solver.problem().check(&self.weights(weights)).is_ok()
    }

    fn poses(&self, own: &BTreeMap<NodeId, Pose>, known: &BTreeMap<NodeId, Pose>) -> Vec<Option<Pose>> {
        self.nodes.iter().map(|node| own.get(node).or_else(|| known.get(node)).copied()).collect()
    }

    /// Gives nodes without a pose one, by the chordal relaxation with all others held.
    pub fn place(
        &self,
        own: &mut BTreeMap<NodeId, Pose>,
        known: &BTreeMap<NodeId, Pose>,
        weights: &[f64],
    ) -> Result<(), SolveError> {
        let poses = self.poses(own, known);
        if poses.iter().all(Option::is_some) {
            return Ok(());
        }
        let held =
            Problem { fixed: poses.iter().map(Option::is_some).collect(), ..self.solver.problem().clone() };
        let start: Vec<Pose> = poses.iter().map(|p| p.unwrap_or_default()).collect();
        let found = chordal(&held, &start, &self.weights(weights))?;
        for (k, pose) in found.into_iter().enumerate() {
            if self.free[k] {
                own.entry(self.nodes[k]).or_insert(pose);
            }
        }
        Ok(())
    }

    /// Where the block's own nodes lie if they are placed anew, by the chordal relaxation with all others held. `None`
    /// unless that costs less than where they are: then descent is caught in a minimum that is not the lowest.
    pub fn placed_anew(
        &self,
        own: &BTreeMap<NodeId, Pose>,
        known: &BTreeMap<NodeId, Pose>,
        weights: &[f64],
    ) -> Result<Option<BTreeMap<NodeId, Pose>>, SolveError> {
        let here: Vec<Pose> = self.poses(own, known).iter().map(|p| p.unwrap_or_default()).collect();
        let weights = self.weights(weights);
        let found = chordal(self.solver.problem(), &here, &weights)?;
        let better = self.solver.cost(&found, &weights) < self.solver.cost(&here, &weights);
        let free = self.nodes.iter().zip(found).zip(&self.free).filter(|(_, free)| **free);
        Ok(better.then(|| free.map(|(placed, _)| (*placed.0, placed.1)).collect()))
    }

    /// The minimum over the block's own nodes, from where they are.
    pub fn solve(
        &mut self,
        own: &BTreeMap<NodeId, Pose>,
        known: &BTreeMap<NodeId, Pose>,
        weights: &[f64],
        settings: &SolverSettings,
    ) -> Result<(BTreeMap<NodeId, Pose>, Solved), SolveError> {
        let start: Vec<Pose> = self.poses(own, known).iter().map(|p| p.unwrap_or_default()).collect();
        let weights = self.weights(weights);
        let solved = self.solver.solve(&start, &weights, settings)?;
        let free = self.nodes.iter().zip(&solved.poses).zip(&self.free).filter(|(_, free)| **free);
        Ok((free.map(|((node, pose), _)| (*node, *pose)).collect(), solved))
    }
}
