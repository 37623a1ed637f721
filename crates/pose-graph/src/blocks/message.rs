//! What blocks tell each other.

use super::coarse::News;
use super::{BlockId, NodeId};
use coma_geometry::Pose;

/// Where a block's boundary nodes are: those that the reader has measurements to. Newer replaces older.
#[derive(Clone, Debug, PartialEq)]
pub struct Boundary {
    /// Who says so.
    pub from: BlockId,
    /// Rises with every change of the poses.
    pub sequence: u64,
    /// The last sequence heard from the reader: there is no need to repeat up to it. 0 before the first.
    pub heard: u64,
    /// `map_from_node`; empty before the block has found its place.
    pub poses: Vec<(NodeId, Pose)>,
    /// Weights of the measurements between the two blocks that the sender decides on: index in the whole problem.
    pub weights: Vec<(u32, f64)>,
    /// Of the rounds in which all move together; the poses are those of its round.
    pub coarse: News,
}

impl Boundary {
    /// Size as plain numbers: 4 bytes a node, block or measurement, 8 a sequence, a weight, or one of a pose's 7 numbers.
    pub fn bytes(&self) -> usize {
        let poses = 4 + self.poses.len() * (4 + 7 * 8);
        4 + 8 + 8 + poses + 4 + self.weights.len() * (4 + 8) + self.coarse.bytes()
    }
}
