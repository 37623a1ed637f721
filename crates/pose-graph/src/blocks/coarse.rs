//! The coarse part of a block-by-block solve: whole blocks move as rigid bodies.
//!
//! Descent block by block carries news one block a step, and a long row of blocks bends back but slowly. Between blocks
//! that move rigidly there is a small problem of six unknowns each: every block says once a round what its measurements
//! to others are worth for that ([`Summary`]), the summaries reach everyone over the neighbours, and whoever has all of
//! a round solves the same small system and moves its own block. Nobody waits: descent goes on meanwhile, and where the
//! summaries never come together it goes on alone.

use super::{Block, BlockId, NodeId};
use crate::residual::linearise;
use crate::sparse::BlockCholesky;
use coma_geometry::{Matrix6, Pose, Tangent, se3};
use std::collections::{BTreeMap, BTreeSet};

/// The largest rotation of a block in one round, radians: what is linearised holds no farther.
const MOST_RAD: f64 = 0.3;
/// Largest magnitude of a number that is believed.
const MOST: f64 = 1e30;

/// What the measurements between two blocks say of their rigid motions `a`, `b` (in the map's frame, on the left):
/// `gradient . (b - a) + (b - a) . hessian (b - a) / 2`.
#[derive(Clone, Debug, PartialEq)]
pub struct Link {
    /// The block `b`; `a` is the summary's.
    pub other: BlockId,
    /// At no motion.
    pub gradient: Tangent,
    /// Symmetric.
    pub hessian: Matrix6,
}

/// One block's part in a round.
#[derive(Clone, Debug, PartialEq)]
pub struct Summary {
    /// Whose.
    pub block: BlockId,
    /// It has a node that is held, and cannot move.
    pub held: bool,
    /// All its neighbours: the round is complete when each has said its part.
    pub neighbours: Vec<BlockId>,
    /// To those of a larger number.
    pub links: Vec<Link>,
    /// Largest squared error of a doubted measurement that it decides on.
    pub largest_squared: f64,
}

impl Summary {
    /// A block's part, from where its nodes and its neighbours' are. `None` while some have not found their place.
    pub(super) fn new(
        block: &Block,
        poses: &BTreeMap<NodeId, Pose>,
        known: &BTreeMap<NodeId, Pose>,
        weights: &[f64],
        largest_squared: f64,
    ) -> Option<Self> {
        let neighbours: BTreeSet<BlockId> = block.neighbours.values().copied().collect();
        let mut links: BTreeMap<BlockId, (Tangent, Matrix6)> = BTreeMap::new();
        for (edge, weight) in block.edges.iter().zip(weights) {
            let c = &edge.constraint;
            let (from, to) = (c.from as NodeId, c.to as NodeId);
            let pose = |node: &NodeId| poses.get(node).or_else(|| known.get(node));
            let (from_pose, to_pose) = (pose(&from)?, pose(&to)?);
            let across = block.neighbours.get(&from).or_else(|| block.neighbours.get(&to));
            let Some(other) = across.filter(|other| **other > block.id) else { continue };
            let at = linearise(from_pose, to_pose, &c.from_from_to);
            // Only how the two blocks move apart matters.
            let towards_other = at.wrt_j * se3::adjoint(&to_pose.inverse());
            let sign = if block.neighbours.contains_key(&to) { 1.0 } else { -1.0 };
            let weighted = towards_other.transpose() * c.information * *weight;
            let (gradient, hessian) =
                links.entry(*other).or_insert_with(|| (Tangent::zeros(), Matrix6::zeros()));
            *gradient += weighted * at.error * sign;
            *hessian += weighted * towards_other;
        }
        let link = |(other, (gradient, hessian))| Link { other, gradient, hessian };
        Some(Summary {
            block: block.id,
            held: !block.fixed.is_empty(),
            neighbours: neighbours.into_iter().collect(),
            links: links.into_iter().map(link).collect(),
            largest_squared,
        })
    }

    /// Size as plain numbers: 4 bytes a block, 8 each of a link's 6 + 21 numbers and of the error.
    pub fn bytes(&self) -> usize {
        4 + 1 + 8 + 4 + 4 * self.neighbours.len() + 4 + self.links.len() * (4 + 27 * 8)
    }

    fn is_sound(&self) -> bool {
        let finite = |x: &f64| x.abs() <= MOST;
        finite(&self.largest_squared)
            && self.links.iter().all(|l| l.gradient.iter().all(finite) && l.hessian.iter().all(finite))
    }
}

/// Rounds as one agent sees them.
#[derive(Default)]
pub(super) struct Coarse {
    /// Rounds that have moved this block.
    pub round: u64,
    /// The summaries that led to this round: neighbours may still need them.
    last: BTreeMap<BlockId, Summary>,
    /// Those known of the next one.
    next: BTreeMap<BlockId, Summary>,
    /// How this round has moved every block.
    moves: BTreeMap<BlockId, Pose>,
}

impl Coarse {
    /// Takes a summary that leads to round `towards`.
    pub fn take(&mut self, towards: u64, summary: &Summary) {
        if towards == self.round + 1 && summary.is_sound() {
            self.next.entry(summary.block).or_insert_with(|| summary.clone());
        }
    }

    /// The blocks whose part in the next round is known.
    pub fn have(&self) -> impl Iterator<Item = BlockId> + '_ {
        self.next.keys().copied()
    }

    /// True if this block's part in the next round is known.
    pub fn has(&self, block: BlockId) -> bool {
        self.next.contains_key(&block)
    }

    /// True if someone has begun the next round.
    pub fn has_begun(&self) -> bool {
        !self.next.is_empty()
    }

    /// What a neighbour at `round` lacks, and to which round it leads.
    pub fn lacking(&self, round: u64, have: &BTreeSet<BlockId>) -> (u64, Vec<Summary>) {
        let (towards, all) = match self.round {
            now if round == now => (now + 1, &self.next),
            now if round + 1 == now => (now, &self.last),
            _ => return (0, Vec::new()),
        };
        (towards, all.values().filter(|s| !have.contains(&s.block)).cloned().collect())
    }

    /// Largest squared error of a doubted measurement, of all blocks, before the newest round.
    pub fn largest_squared(&self) -> f64 {
        self.last.values().map(|s| s.largest_squared).fold(0.0, f64::max)
    }

    /// How the newest round has moved a block.
    pub fn moved(&self, block: BlockId) -> Pose {
        self.moves.get(&block).copied().unwrap_or_default()
    }

    /// Goes to the next round if all have said their part. True if so.
    pub fn advance(&mut self) -> bool {
        let complete = |summary: &Summary| summary.neighbours.iter().all(|n| self.next.contains_key(n));
        if self.next.is_empty() || !self.next.values().all(complete) {
            return false;
        }
        self.last = std::mem::take(&mut self.next);
        self.moves = moves(&self.last);
        self.round += 1;
        true
    }
}

/// How every block moves: the minimum over rigid motions. None moves where that has no answer.
fn moves(summaries: &BTreeMap<BlockId, Summary>) -> BTreeMap<BlockId, Pose> {
    let free: Vec<BlockId> = summaries.values().filter(|s| !s.held).map(|s| s.block).collect();
    let step = minimum(summaries, &free).unwrap_or_else(|| vec![Tangent::zeros(); free.len()]);
    let farthest = step.iter().map(|s| s.fixed_rows::<3>(3).norm()).fold(0.0, f64::max);
    let share = if farthest > MOST_RAD { MOST_RAD / farthest } else { 1.0 };
    free.into_iter().zip(step).map(|(block, step)| (block, se3::exp(&(step * share)))).collect()
}

fn minimum(summaries: &BTreeMap<BlockId, Summary>, free: &[BlockId]) -> Option<Vec<Tangent>> {
    let index = |block: BlockId| free.binary_search(&block).ok();
    let links = || summaries.values().flat_map(|s| s.links.iter().map(move |l| (s.block, l)));
    let pairs: Vec<(usize, usize)> = links().filter_map(|(a, l)| index(a).zip(index(l.other))).collect();
    let mut system = BlockCholesky::<6>::new(free.len(), &pairs).ok()?;
    let mut rhs = vec![0.0; 6 * free.len()];
    for (block, link) in links() {
        let ends = [(index(block), 1.0), (index(link.other), -1.0)];
        for (k, sign) in ends.iter().filter_map(|(k, sign)| Some(((*k)?, sign))) {
            system.add(system.slot(k, k)?, &link.hessian);
            for axis in 0..6 {
                rhs[6 * k + axis] += sign * link.gradient[axis];
            }
        }
        if let (Some(a), Some(b)) = (ends[0].0, ends[1].0) {
            system.add(system.slot(a, b)?, &-link.hessian);
        }
    }
    let damping: Vec<f64> = system.diagonal().iter().map(|d| 1e-9 * d).collect();
    system.add_to_diagonal(&damping);
    system.factorise().ok()?;
    system.solve_in_place(&mut rhs, 1);
    let steps: Vec<Tangent> = rhs.chunks_exact(6).map(Tangent::from_column_slice).collect();
    steps.iter().all(|s| s.iter().all(|x| x.is_finite())).then_some(steps)
}
