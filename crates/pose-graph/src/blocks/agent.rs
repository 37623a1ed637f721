//! One agent of a block-by-block solve, as a state machine: [`BlockAgent::receive`] takes what others say,
//! [`BlockAgent::step`] descends once and gives what there is to say. It knows no clock and no network.

use super::coarse::{Coarse, News};
use super::field::{Part, Sight};
use super::local::Local;
use super::message::Boundary;
use super::{Block, BlockId, NodeId};
use crate::gnc::{Kernel, Schedule, Trust, final_weight};
use crate::solver::{Constraint, SolveError, SolverSettings};
use coma_geometry::{Pose, Tangent, se3};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// How an agent descends.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BlockSettings {
    /// Linear solves in one step.
    pub iterations_per_step: u32,
    /// Largest share of the last move that a step carries on with. 0 for plain descent; below 1.
    pub most_momentum: f64,
    /// A node that has moved by less than this since it was last told of, in metres,
    pub still_m: f64,
    /// and by less than this, in radians, is not told of again.
    pub still_rad: f64,
    /// Largest squared Mahalanobis error of a doubted measurement that is believed.
    pub squared_error_6dof: f64,
    /// Factor by which the robust cost gets less convex in each coarse round, or, without those, whenever a block is
    /// nearly still.
    pub convexity_step: f64,
    /// How often a measurement's weight may change under the robust cost itself.
    pub most_changes_of_weight: u32,
    /// Steps between two rounds in which all blocks move together. 0 for none.
    pub coarse_every: u32,
    /// Most points of the grid that such a round moves: more of them bend finer, and make a part larger by some 800 bytes
    /// each.
    pub coarse_points: usize,
}

impl Default for BlockSettings {
    fn default() -> Self {
        BlockSettings {
            iterations_per_step: 1,
            most_momentum: 0.5,
            still_m: 1e-5,
            still_rad: 1e-6,
            squared_error_6dof: 22.458,
            convexity_step: 1.4,
            most_changes_of_weight: 4,
            coarse_every: 6,
            coarse_points: 128,
        }
    }
}

/// So many steps without a descent, and a coarse round is not waited for any more.
const PATIENCE: u32 = 30;
/// So many descents without a coarse round, and an agent goes on with its doubts alone.
const ALONE: u32 = 200;
const KERNEL: Kernel = Kernel::TruncatedLeastSquares;

/// Momentum that was too much is cut to this share,
const KEPT: f64 = 0.7;
/// and is slowly regained, by this factor in each step: what was too much while nodes found their places is not later.
const REGAINED: f64 = 1.005;

/// How far an agent is with its doubts (graduated non-convexity: in coarse rounds all agents together, otherwise each at
/// its own pace).
#[derive(Clone, Copy, Debug)]
enum Doubt {
    /// It was never still yet.
    NotYet,
    /// Under a cost that gets less convex.
    Graduated(Schedule),
    /// Under the robust cost itself.
    Decided,
}

/// What an agent knows of a neighbour.
#[derive(Clone, Debug, Default)]
struct Neighbour {
    /// Last sequence heard from it.
    heard: u64,
    /// It said something that was not answered yet.
    owed: bool,
    /// Last sequence of ours that it has heard.
    has_heard: u64,
    /// Nodes of ours that it has measurements to.
    boundary: Vec<NodeId>,
}

/// The state of one agent.
pub struct BlockAgent {
    block: Block,
    settings: BlockSettings,
    /// `map_from_node` of own nodes that have found their place.
    poses: BTreeMap<NodeId, Pose>,
    /// And of neighbours' nodes, as last heard.
    known: BTreeMap<NodeId, Pose>,
    /// One per measurement of the block.
    weights: Vec<f64>,
    changes_of_weight: Vec<u32>,
    doubt: Doubt,
    neighbours: BTreeMap<BlockId, Neighbour>,
    /// Rises with what others should hear.
    sequence: u64,
    /// Own poses under that sequence.
    said: BTreeMap<NodeId, Pose>,
    /// Share of the last move that the next step carries on with.
    momentum: f64,
    /// How the nodes moved in the last step.
    moved: BTreeMap<NodeId, Tangent>,
    /// Running mean of the distance to the block's own minimum, all nodes together.
    usual_step: f64,
    /// The least that it was since momentum was last cut.
    least_step: f64,
    most_momentum: f64,
    /// How far the farthest were from it in the last step.
    farthest_m: f64,
    farthest_rad: f64,
    /// The problem over what is placed and known at present.
    local: Option<Local>,
    coarse: Coarse,
    /// Descents since the last round that were worth telling, or left something in doubt.
    descents: u32,
    /// A round has moved all, and nothing was done since.
    has_followed: bool,
    /// Steps since the last that descended.
    idle_steps: u32,
    /// Something was heard, or a descent is not finished.
    busy: bool,
    iterations: u64,
}

impl BlockAgent {
    /// Begins. `start` gives the poses of the block's fixed nodes; all others find their place from there.
    pub fn new(block: Block, start: impl Fn(NodeId) -> Pose, settings: BlockSettings) -> Self {
        let mut neighbours: BTreeMap<BlockId, Neighbour> = BTreeMap::new();
        for edge in &block.edges {
            let (from, to) = (edge.constraint.from as NodeId, edge.constraint.to as NodeId);
            for (own, other) in [(from, to), (to, from)] {
                if let Some(id) = block.neighbours.get(&other) {
                    neighbours.entry(*id).or_default().boundary.push(own);
                }
            }
        }
        for neighbour in neighbours.values_mut() {
            neighbour.boundary.sort_unstable();
            neighbour.boundary.dedup();
        }
        let coarse = Coarse::new(block.id, neighbours.keys().copied(), settings.coarse_points);
        BlockAgent {
            poses: block.fixed.iter().filter(|n| block.owns(n)).map(|node| (*node, start(*node))).collect(),
            weights: block.edges.iter().map(|e| e.weight).collect(),
            changes_of_weight: vec![0; block.edges.len()],
            doubt: Doubt::NotYet,
            block,
            settings,
            known: BTreeMap::new(),
            neighbours,
            sequence: 0,
            said: BTreeMap::new(),
            momentum: 0.0,
            moved: BTreeMap::new(),
            usual_step: 0.0,
            least_step: f64::INFINITY,
            most_momentum: settings.most_momentum,
            farthest_m: 0.0,
            farthest_rad: 0.0,
            local: None,
            coarse,
            descents: 0,
            has_followed: false,
            idle_steps: 0,
            busy: true,
            iterations: 0,
        }
    }

    /// The block's number.
    pub fn id(&self) -> BlockId {
        self.block.id
    }

    /// `map_from_node` of the block's nodes that have found their place.
    pub fn poses(&self) -> &BTreeMap<NodeId, Pose> {
        &self.poses
    }

    /// Weights of the measurements that this block decides on, by their index in the whole problem: those within it,
    /// and those to blocks of a larger number.
    pub fn weights(&self) -> impl Iterator<Item = (u32, f64)> + '_ {
        let own = self.block.edges.iter().zip(&self.weights).filter(|(e, _)| self.decides(&e.constraint));
        own.map(|(e, w)| (e.index, *w))
    }

    /// Linear solves so far.
    pub fn iterations(&self) -> u64 {
        self.iterations
    }

    /// Rounds in which all moved together so far.
    pub fn coarse_rounds(&self) -> u64 {
        self.coarse.round
    }

    /// `0.5 * sum of weighted squared errors` of the measurements that this block decides on, where both ends are known:
    /// these sums of all blocks are the cost of the whole problem.
    pub fn cost(&self) -> f64 {
        let edges = (0..self.block.edges.len()).filter(|k| self.decides(&self.block.edges[*k].constraint));
        let weighed = edges.filter(|k| self.weights[*k] > 0.0);
        0.5 * weighed.filter_map(|k| Some(self.weights[k] * self.squared_error(k)?)).sum::<f64>()
    }

    /// Squared error of a measurement of the block, by its index in the whole problem, where both ends are known.
    pub fn squared_error_of(&self, index: u32) -> Option<f64> {
        let found = self.block.edges.binary_search_by_key(&index, |e| e.index).ok()?;
        self.squared_error(found)
    }

    /// The blocks that it has measurements to.
    pub fn neighbours(&self) -> impl Iterator<Item = BlockId> + '_ {
        self.neighbours.keys().copied()
    }

    /// True if the next step descends.
    pub fn is_busy(&self) -> bool {
        self.busy
    }

    /// True if this block would not move by itself, every neighbour has heard where it is, and no round in which all
    /// move is on its way. A round that does not come together, because a block takes no part, is not waited for
    /// forever.
    pub fn is_still(&self) -> bool {
        !self.busy && !self.waits() && self.neighbours.values().all(|n| n.has_heard >= self.sequence)
    }

    /// Forgets what was said and heard, and keeps where its nodes are and what it believes: a neighbour began anew.
    pub fn begin_anew(&mut self) {
        for neighbour in self.neighbours.values_mut() {
            let boundary = std::mem::take(&mut neighbour.boundary);
            *neighbour = Neighbour { boundary, ..Neighbour::default() };
        }
        self.known.clear();
        self.said.clear();
        self.sequence = 0;
        self.forget_motion();
        self.local = None;
        let neighbours = self.neighbours.keys().copied();
        self.coarse = Coarse::new(self.block.id, neighbours, self.settings.coarse_points);
        (self.descents, self.idle_steps) = (0, 0);
        self.busy = true;
    }

    /// True if there is nothing to do and every neighbour has heard all there is to hear.
    pub fn is_settled(&self) -> bool {
        self.is_still() && self.neighbours.values().all(|n| !n.owed)
    }

    fn waits(&self) -> bool {
        self.takes_part() && self.coarse.has_begun() && self.idle_steps < PATIENCE
    }

    fn decides(&self, c: &Constraint) -> bool {
        let other = |node: usize| self.block.neighbours.get(&(node as NodeId)).copied();
        other(c.from).or(other(c.to)).is_none_or(|other| self.block.id < other)
    }

    /// Takes what a neighbour says. What is older than what is known, and what names strangers, changes nothing.
    pub fn receive(&mut self, message: &Boundary) {
        let Some(neighbour) = self.neighbours.get_mut(&message.from) else { return };
        neighbour.has_heard = neighbour.has_heard.max(message.heard.min(self.sequence));
        let News { round, part, field, .. } = &message.coarse;
        neighbour.owed |= message.sequence > 0 || part.is_some() || field.is_some();
        if self.coarse.take(message.from, &message.coarse) {
            self.follow();
        }
        let behind = match self.coarse.round {
            now if *round == now => false,
            now if *round + 1 == now => true,
            // Poses that cannot be told come again.
            _ => return,
        };
        let Some(neighbour) = self.neighbours.get_mut(&message.from) else { return };
        if message.sequence <= neighbour.heard {
            return;
        }
        neighbour.heard = message.sequence;
        for (node, pose) in &message.poses {
            let sound = pose.translation.vector.iter().all(|x| x.is_finite())
                && (pose.rotation.quaternion().norm() - 1.0).abs() < 1e-6;
            if sound && self.block.neighbours.get(node) == Some(&message.from) {
                self.busy = true;
                let pose =
                    if behind && !self.block.fixed.contains(node) { self.coarse.moved(pose) } else { *pose };
                if self.known.insert(*node, pose).is_none() {
                    self.local = None;
                }
            }
        }
        for (index, weight) in &message.weights {
            let found = self.block.edges.binary_search_by_key(index, |e| e.index);
            let foreign = |k: &usize| !self.decides(&self.block.edges[*k].constraint);
            if let Some(k) = found.ok().filter(foreign).filter(|_| (0.0..=1.0).contains(weight)) {
                self.busy |= self.weights[k] != *weight;
                self.weights[k] = *weight;
            }
        }
    }

    /// Descends once if there is news, and says where the boundary is to every neighbour that may not know.
    pub fn step(&mut self) -> Result<Vec<(BlockId, Boundary)>, SolveError> {
        let was_busy = self.busy;
        self.idle_steps = if was_busy { 0 } else { self.idle_steps.saturating_add(1) };
        if was_busy {
            self.busy = false;
            self.place()?;
            self.descend()?;
            let changed = self.reweigh();
            let moved = changed || self.has_moved();
            if moved {
                self.sequence += 1;
                self.said.clone_from(&self.poses);
            }
            // What is at rest needs no round, or there would be no end of them.
            self.descents += u32::from(moved || self.is_in_doubt());
        }
        self.busy |= self.is_in_doubt();
        self.take_part(was_busy);
        let again = self.idle_steps < PATIENCE;
        let news: Vec<(News, bool)> = self.neighbours.keys().map(|id| self.coarse.tell(*id, again)).collect();
        let mut out = Vec::new();
        let decided = |e: &super::BlockEdge| e.trust != Trust::Full && self.decides(&e.constraint);
        for ((id, neighbour), (coarse, due)) in self.neighbours.iter().zip(news) {
            let mut message = Boundary {
                from: self.block.id,
                sequence: 0,
                heard: neighbour.heard,
                poses: Vec::new(),
                weights: Vec::new(),
                coarse,
            };
            if neighbour.has_heard < self.sequence {
                message.sequence = self.sequence;
                let placed = |node: &NodeId| Some((*node, *self.poses.get(node)?));
                message.poses = neighbour.boundary.iter().filter_map(placed).collect();
                let leads_there = |e: &super::BlockEdge| {
                    [e.constraint.from, e.constraint.to]
                        .iter()
                        .any(|n| self.block.neighbours.get(&(*n as NodeId)) == Some(id))
                };
                let edges = self.block.edges.iter().zip(&self.weights);
                let told = edges.filter(|(e, _)| decided(e) && leads_there(e));
                message.weights = told.map(|(e, w)| (e.index, *w)).collect();
            }
            if neighbour.owed || message.sequence > 0 || due && self.takes_part() {
                out.push((*id, message));
            }
        }
        self.neighbours.values_mut().for_each(|n| n.owed = false);
        Ok(out)
    }

    /// Says this block's part in the next coarse round: when it is time, or when someone else has begun it.
    fn take_part(&mut self, was_busy: bool) {
        if !self.takes_part() {
            return;
        }
        let due = was_busy && self.descents >= self.settings.coarse_every || self.coarse.has_begun();
        if due && !self.coarse.has_said() {
            // What is decided shapes no one's doubts any more.
            let undecided = if matches!(self.doubt, Doubt::Decided) { Vec::new() } else { self.doubts() };
            let largest = undecided.iter().map(|(_, squared)| *squared).fold(0.0, f64::max);
            let sight = Sight { own: &self.poses, known: &self.known, weights: &self.weights };
            if let Some(part) = Part::new(&self.block, &sight, self.coarse.grid(), largest) {
                self.coarse.say(part);
            }
        }
        if self.coarse.collect() {
            self.follow();
        }
    }

    fn is_in_doubt(&self) -> bool {
        !matches!(self.doubt, Doubt::Decided) && self.block.edges.iter().any(|e| e.trust != Trust::Full)
    }

    fn takes_part(&self) -> bool {
        self.settings.coarse_every > 0 && !self.neighbours.is_empty()
    }

    /// Moves as the newest round has all move.
    fn follow(&mut self) {
        for (node, pose) in self.poses.iter_mut().chain(&mut self.said).chain(&mut self.known) {
            if !self.block.fixed.contains(node) {
                *pose = self.coarse.moved(pose);
            }
        }
        (self.descents, self.has_followed) = (0, true);
        (self.usual_step, self.least_step) = (0.0, f64::INFINITY);
        self.busy = true;
        if !matches!(self.doubt, Doubt::Decided) && self.graduate(self.coarse.largest_squared()) {
            self.sequence += 1;
            self.said.clone_from(&self.poses);
        }
    }

    /// Sets up the problem over what is known, and gives nodes that can be reached for the first time a place.
    fn place(&mut self) -> Result<(), SolveError> {
        if self.local.is_none() {
            self.local = Local::new(&self.block, &self.known, &self.weights)?;
            if let Some(local) = &self.local {
                let placed = self.poses.len();
                local.place(&mut self.poses, &self.known, &self.weights)?;
                if self.poses.len() > placed {
                    self.forget_motion();
                }
            }
        }
        if std::mem::take(&mut self.has_followed)
            && let Some(local) = &self.local
            && let Some(better) = local.placed_anew(&self.poses, &self.known, &self.weights)?
        {
            self.poses.extend(better);
            self.forget_motion();
        }
        Ok(())
    }

    fn forget_motion(&mut self) {
        self.moved.clear();
        self.momentum = 0.0;
        (self.usual_step, self.least_step) = (0.0, f64::INFINITY);
    }

    /// Moves the block's nodes to the minimum that they have while all others stay, and on in the direction of the last
    /// move (heavy ball). Where the minimum lies against that direction the momentum is lost.
    fn descend(&mut self) -> Result<(), SolveError> {
        let Some(local) = &mut self.local else { return Ok(()) };
        let settings = SolverSettings {
            max_iterations: self.settings.iterations_per_step,
            relative_decrease: 1e-8,
            ..SolverSettings::default()
        };
        let (target, solved) = local.solve(&self.poses, &self.known, &self.weights, &settings)?;
        self.iterations += u64::from(solved.iterations);
        // What is not at its minimum yet goes on without news.
        self.busy |= !solved.converged;
        let to_minimum =
            |(node, goal): (&NodeId, &Pose)| Some((*node, se3::log(&self.poses.get(node)?.inv_mul(goal))));
        let steps: BTreeMap<NodeId, Tangent> = target.iter().filter_map(to_minimum).collect();
        let scale_m = local.rotation_scale_m();
        let dot = |a: &Tangent, b: &Tangent| {
            let turn = a.fixed_rows::<3>(3).dot(&b.fixed_rows::<3>(3));
            a.fixed_rows::<3>(0).dot(&b.fixed_rows::<3>(0)) + scale_m * scale_m * turn
        };
        let length = steps.values().map(|step| dot(step, step)).sum::<f64>().sqrt();
        self.usual_step = if self.usual_step > 0.0 { 0.8 * self.usual_step + 0.2 * length } else { length };
        self.least_step = self.least_step.min(self.usual_step);
        // Swinging around the minimum is what momentum does; swinging farther and farther is too much of it, as stale
        // news makes it.
        if self.usual_step > 3.0 * self.least_step {
            self.most_momentum *= KEPT;
            self.momentum = 0.0;
            self.moved.clear();
            self.least_step = self.usual_step;
        }
        self.most_momentum = (self.most_momentum * REGAINED).min(self.settings.most_momentum);
        self.momentum = (self.momentum + 0.1).min(self.most_momentum);
        (self.farthest_m, self.farthest_rad) = (0.0, 0.0);
        for (node, step) in steps {
            let Some(pose) = self.poses.get_mut(&node) else { continue };
            self.farthest_m = self.farthest_m.max(step.fixed_rows::<3>(0).norm());
            self.farthest_rad = self.farthest_rad.max(step.fixed_rows::<3>(3).norm());
            let carried = self.moved.get(&node).map_or_else(Tangent::zeros, |moved| moved * self.momentum);
            let step = step + carried;
            *pose *= se3::exp(&step);
            pose.rotation.renormalize();
            self.moved.insert(node, step);
        }
        Ok(())
    }

    fn has_moved(&self) -> bool {
        self.poses.iter().any(|(node, pose)| match self.said.get(node) {
            Some(said) => {
                let (m, rad) = se3::distance(pose, said);
                m > self.settings.still_m || rad > self.settings.still_rad
            }
            None => true,
        })
    }

    /// Once the block is nearly still, doubted measurements are weighed by how they fit. True if a weight has changed.
    fn reweigh(&mut self) -> bool {
        let settled = self.farthest_m < 1e3 * self.settings.still_m
            && self.farthest_rad < 1e3 * self.settings.still_rad;
        if !settled || self.local.is_none() {
            return false;
        }
        if !matches!(self.doubt, Doubt::Decided) {
            // In coarse rounds all agents go on together.
            let largest = self.doubts().iter().map(|(_, squared)| *squared).fold(0.0, f64::max);
            let alone = !self.takes_part() || self.descents > ALONE;
            return alone && self.graduate(largest);
        }
        let mut next = self.weights.clone();
        for (k, squared) in self.doubts() {
            let weight = final_weight(KERNEL, self.settings.squared_error_6dof, squared);
            if weight != next[k] && self.changes_of_weight[k] < self.settings.most_changes_of_weight {
                self.changes_of_weight[k] += 1;
                next[k] = weight;
            }
        }
        self.weigh(next)
    }

    /// One step of graduated non-convexity; `largest` is the largest squared error where it begins. True if a weight has
    /// changed.
    fn graduate(&mut self, largest: f64) -> bool {
        let begin = || {
            let limit = self.settings.squared_error_6dof;
            Schedule::new(KERNEL, limit, self.settings.convexity_step, largest)
        };
        let schedule = match self.doubt {
            Doubt::Graduated(schedule) => Some(schedule),
            _ => begin(),
        };
        let Some(mut schedule) = schedule else {
            self.doubt = Doubt::Decided;
            return false;
        };
        let mut next = self.weights.clone();
        self.doubts().into_iter().for_each(|(k, squared)| next[k] = schedule.weight(squared));
        self.doubt = if schedule.advance() { Doubt::Graduated(schedule) } else { Doubt::Decided };
        self.busy = true;
        self.weigh(next)
    }

    fn weigh(&mut self, next: Vec<f64>) -> bool {
        // Never let go of the last measurement that holds a node.
        let holds = self.local.as_ref().is_some_and(|local| local.holds(&next));
        if next == self.weights || !holds {
            return false;
        }
        self.weights = next;
        self.busy = true;
        true
    }

    /// The doubted measurements that this block decides on, with their squared errors where both ends are known; those
    /// that something speaks against are asked last.
    fn doubts(&self) -> Vec<(usize, f64)> {
        let suspended_too = matches!(self.doubt, Doubt::Decided);
        let doubted = |trust: Trust| match trust {
            Trust::Full => false,
            Trust::Doubted => true,
            Trust::Suspended => suspended_too,
        };
        let asked =
            |k: &usize| doubted(self.block.edges[*k].trust) && self.decides(&self.block.edges[*k].constraint);
        let edges = (0..self.block.edges.len()).filter(asked);
        edges.filter_map(|k| Some((k, self.squared_error(k)?))).collect()
    }

    /// Of a measurement, where both its ends are known.
    fn squared_error(&self, edge: usize) -> Option<f64> {
        let c = &self.block.edges[edge].constraint;
        let pose = |node: usize| {
            let node = node as NodeId;
            self.poses.get(&node).or_else(|| self.known.get(&node))
        };
        let error = crate::residual::residual(pose(c.from)?, pose(c.to)?, &c.from_from_to);
        Some(crate::residual::squared_mahalanobis(&error, &c.information))
    }
}
