//! Cutting a problem into blocks.

use super::{BlockId, NodeId};
use crate::gnc::Trust;
use crate::solver::{Constraint, Problem};
use std::collections::BTreeMap;

/// A measurement of a block; ends are nodes of the whole problem.
#[derive(Clone, Debug, PartialEq)]
pub struct BlockEdge {
    /// Its index in the whole problem.
    pub index: u32,
    /// As measured.
    pub constraint: Constraint,
    /// Its weight at the start, 0 to 1.
    pub weight: f64,
    /// Whether it may be weighted by its residual, and from when on.
    pub trust: Trust,
}

/// What one agent holds.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Block {
    /// Its number.
    pub id: BlockId,
    /// Its nodes, ascending.
    pub nodes: Vec<NodeId>,
    /// Those of them, and of the neighbours', that keep the pose they start with.
    pub fixed: Vec<NodeId>,
    /// Measurements with at least one end here.
    pub edges: Vec<BlockEdge>,
    /// The block of every node elsewhere that a measurement leads to.
    pub neighbours: BTreeMap<NodeId, BlockId>,
}

impl Block {
    /// True for one of the block's own nodes, false for its neighbours'.
    pub(super) fn owns(&self, node: &NodeId) -> bool {
        !self.neighbours.contains_key(node)
    }
}

/// Cuts a problem into `count` blocks of consecutive nodes of nearly equal size. `doubted` is one per constraint.
pub fn blocks(problem: &Problem, weights: &[f64], doubted: &[bool], count: usize) -> Vec<Block> {
    let count = count.clamp(1, problem.nodes.max(1));
    let of: Vec<BlockId> = (0..problem.nodes).map(|node| (node * count / problem.nodes) as BlockId).collect();
    blocks_of(problem, weights, doubted, &of)
}

/// Cuts a problem where `block_of_node` says. Numbers without a node make empty blocks.
pub fn blocks_of(
    problem: &Problem,
    weights: &[f64],
    doubted: &[bool],
    block_of_node: &[BlockId],
) -> Vec<Block> {
    let count = block_of_node.iter().max().map_or(0, |most| *most as usize + 1);
    let mut blocks: Vec<Block> =
        (0..count).map(|id| Block { id: id as BlockId, ..Block::default() }).collect();
    for (node, &block) in block_of_node.iter().enumerate() {
        blocks[block as usize].nodes.push(node as NodeId);
        if problem.fixed[node] {
            blocks[block as usize].fixed.push(node as NodeId);
        }
    }
    for (index, constraint) in problem.constraints.iter().enumerate() {
        let (from, to) = (block_of_node[constraint.from], block_of_node[constraint.to]);
        let edge = BlockEdge {
            index: index as u32,
            constraint: constraint.clone(),
            weight: weights[index],
            trust: if doubted[index] { Trust::Doubted } else { Trust::Full },
        };
        if from != to {
            let other = &mut blocks[to as usize];
            other.neighbours.insert(constraint.from as NodeId, from);
            other.edges.push(edge.clone());
            blocks[from as usize].neighbours.insert(constraint.to as NodeId, to);
            for (block, beyond) in [(to, constraint.from), (from, constraint.to)] {
                let fixed = &mut blocks[block as usize].fixed;
                if problem.fixed[beyond] && !fixed.contains(&(beyond as NodeId)) {
                    fixed.push(beyond as NodeId);
                }
            }
        }
        blocks[from as usize].edges.push(edge);
    }
    blocks
}
