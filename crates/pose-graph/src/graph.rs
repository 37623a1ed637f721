//! What is known: submaps, odometry between them, and loops. And which of it can be used.

use coma_geometry::{AgentId, Epoch, Matrix6, Pose, SubmapId};
use std::collections::{BTreeMap, BTreeSet};

/// The log entry that an edge came in. Sorting by it is the canonical order.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct EdgeKey {
    /// Whose log.
    pub agent: AgentId,
    /// Which life of that agent.
    pub epoch: Epoch,
    /// Position in that log.
    pub sequence: u64,
}

/// Where a measurement comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum EdgeKind {
    /// Tracking, between consecutive submaps of one epoch of one agent. Believed as it is.
    Odometry,
    /// An accepted registration of two places. May be false: weighted robustly.
    Loop,
}

/// A measurement between two submaps.
#[derive(Clone, Debug, PartialEq)]
pub struct Edge {
    /// Its log entry.
    pub key: EdgeKey,
    /// Odometry or loop.
    pub kind: EdgeKind,
    /// Submap i.
    pub from: SubmapId,
    /// Submap j.
    pub to: SubmapId,
    /// Measured `i_from_j` (T_ij).
    pub from_from_to: Pose,
    /// Inverse covariance of eq. 11's residual, order (translation, rotation), m^-2 and rad^-2.
    pub information: Matrix6,
}

/// A submap as its agent knows it.
#[derive(Clone, Debug, PartialEq)]
pub struct NodeInfo {
    /// Frame index of its anchor within its agent.
    pub first_frame: u64,
    /// By odometry alone.
    pub agent_from_submap: Pose,
}

/// Everything that a solve takes: a set; order and duplicates do not matter.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GraphEntries {
    /// The submaps.
    pub nodes: BTreeMap<SubmapId, NodeInfo>,
    /// Odometry and accepted loops, in any order.
    pub edges: Vec<Edge>,
    /// Withdrawn loops, each with the log entry that withdrew it (an entry of the loop's own author).
    pub withdrawn: BTreeMap<EdgeKey, EdgeKey>,
    /// The agents' anchor priorities; [`DEFAULT_ANCHOR_PRIORITY`] for those not named.
    pub anchor_priority: BTreeMap<AgentId, u32>,
}

/// The priority of an agent that states none; the smallest holds the map's frame.
pub const DEFAULT_ANCHOR_PRIORITY: u32 = 100;

/// The position up to which each agent's log was used.
pub type Cut = BTreeMap<(AgentId, Epoch), u64>;

/// Why an entry was not used.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EntryProblem {
    /// A pose with NaN or infinity.
    #[error("the pose is not finite")]
    PoseNotFinite,
    /// A quaternion that is far from unit length.
    #[error("the rotation's quaternion has length {length}, 1 is needed")]
    RotationNotUnit {
        /// The length found.
        length: f64,
    },
    /// A translation beyond [`MAX_TRANSLATION_M`].
    #[error("the translation is {length_m} m, at most {MAX_TRANSLATION_M} m is allowed")]
    TranslationTooLarge {
        /// The length found.
        length_m: f64,
    },
    /// An information matrix with NaN, infinity or numbers beyond [`MAX_INFORMATION`].
    #[error("the information matrix is not finite or holds more than {MAX_INFORMATION}")]
    InformationNotFinite,
    /// An information matrix that is not its own transpose.
    #[error("the information matrix is not symmetric: [{row}][{column}] differs from its mirror image")]
    InformationNotSymmetric {
        /// Row of the first offending element.
        row: usize,
        /// Its column.
        column: usize,
    },
    /// An information matrix with an eigenvalue that is not clearly positive.
    #[error("the information matrix is not positive definite: its smallest eigenvalue is {smallest}")]
    InformationNotPositiveDefinite {
        /// The smallest eigenvalue.
        smallest: f64,
    },
    /// An edge to a submap that is not among the nodes.
    #[error("submap {submap} is not known")]
    UnknownNode {
        /// The missing submap.
        submap: SubmapId,
    },
    /// An edge from a submap to itself.
    #[error("both ends are the same submap")]
    SelfEdge,
    /// Odometry that does not stay within one epoch of one agent.
    #[error("odometry joins {from} and {to}: it must stay within one epoch of one agent")]
    OdometryBetweenAgents {
        /// One end.
        from: SubmapId,
        /// The other end.
        to: SubmapId,
    },
    /// Two different edges under one key: neither is used.
    #[error("two different edges have this key")]
    ConflictingKey,
    /// Another edge of the same kind joins the same submaps and has a smaller key.
    #[error("the entry {}/{}/{} already joins these submaps", by.agent, by.epoch.0, by.sequence)]
    Superseded {
        /// The edge that counts.
        by: EdgeKey,
    },
    /// The author took it back.
    #[error("withdrawn by entry {}/{}/{}", by.agent, by.epoch.0, by.sequence)]
    Withdrawn {
        /// The entry that did so.
        by: EdgeKey,
    },
    /// A withdrawal by another agent than the author.
    #[error("only {} may withdraw this loop, not {}", .author, .by.agent)]
    NotTheAuthor {
        /// Who wrote the loop.
        author: AgentId,
        /// The entry that tried.
        by: EdgeKey,
    },
}

/// The longest translation that an edge or node may have, in metres.
pub const MAX_TRANSLATION_M: f64 = 1e6;
/// The largest number in an information matrix.
pub const MAX_INFORMATION: f64 = 1e12;

/// What an [`EntryProblem`] speaks of.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum EntryName {
    /// A submap.
    Node(SubmapId),
    /// An edge.
    Edge(EdgeKey),
    /// The withdrawal of this edge.
    Withdrawal(EdgeKey),
}

/// The entries that can be used, in canonical order, and the others with their reasons.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct UsableGraph {
    /// Submaps with sound poses.
    pub nodes: BTreeMap<SubmapId, NodeInfo>,
    /// Odometry edges by key, one per pair of submaps.
    pub odometry: Vec<Edge>,
    /// Loops by key, one per pair of submaps.
    pub loops: Vec<Edge>,
    /// Entries that were left out.
    pub rejected: Vec<(EntryName, EntryProblem)>,
    /// See [`UsableGraph::new`].
    pub cut: Cut,
}

/// A pose with a normalised quaternion, or what is wrong with it.
fn checked_pose(pose: &Pose) -> Result<Pose, EntryProblem> {
    let length = pose.rotation.quaternion().norm();
    let length_m = pose.translation.vector.norm();
    if !(length.is_finite() && length_m.is_finite()) {
        return Err(EntryProblem::PoseNotFinite);
    }
    if !((length - 1.0).abs() < 1e-3) {
        return Err(EntryProblem::RotationNotUnit { length });
    }
    if !(length_m <= MAX_TRANSLATION_M) {
        return Err(EntryProblem::TranslationTooLarge { length_m });
    }
    let mut pose = *pose;
    pose.rotation.renormalize();
    Ok(pose)
}

/// An exactly symmetric information matrix, or what is wrong with it.
fn checked_information(information: &Matrix6) -> Result<Matrix6, EntryProblem> {
    if !information.iter().all(|x| x.abs() <= MAX_INFORMATION) {
        return Err(EntryProblem::InformationNotFinite);
    }
    let tolerance = 1e-6 * information.amax();
    for row in 0..6 {
        for column in 0..row {
            if !((information[(row, column)] - information[(column, row)]).abs() <= tolerance) {
                return Err(EntryProblem::InformationNotSymmetric { row, column });
            }
        }
    }
    let symmetric = (information + information.transpose()) * 0.5;
    let smallest = symmetric.symmetric_eigenvalues().min();
    // Metres and radians may differ in scale by a lot; what is below this share is rounding.
    if !(smallest > 1e-12 * symmetric.amax() && smallest > 1e-9) {
        return Err(EntryProblem::InformationNotPositiveDefinite { smallest });
    }
    Ok(symmetric)
}

/// An edge with a sound pose and information between two known submaps, or what is wrong with it.
pub(crate) fn checked_edge(edge: &Edge, known: impl Fn(&SubmapId) -> bool) -> Result<Edge, EntryProblem> {
    if edge.from == edge.to {
        return Err(EntryProblem::SelfEdge);
    }
    let same_life = edge.from.agent == edge.to.agent && edge.from.epoch == edge.to.epoch;
    if edge.kind == EdgeKind::Odometry && !same_life {
        return Err(EntryProblem::OdometryBetweenAgents { from: edge.from.clone(), to: edge.to.clone() });
    }
    let from_from_to = checked_pose(&edge.from_from_to)?;
    let information = checked_information(&edge.information)?;
    if let Some(submap) = [&edge.from, &edge.to].into_iter().find(|s| !known(s)) {
        return Err(EntryProblem::UnknownNode { submap: submap.clone() });
    }
    Ok(Edge { from_from_to, information, ..edge.clone() })
}

/// Everything an edge states besides its key, comparable and total (NaN included).
fn content(edge: &Edge) -> (EdgeKind, &SubmapId, &SubmapId, Vec<u64>) {
    let t = edge.from_from_to.translation.vector;
    let numbers = t.iter().chain(edge.from_from_to.rotation.coords.iter()).chain(edge.information.iter());
    (edge.kind, &edge.from, &edge.to, numbers.map(|x| x.to_bits()).collect())
}

/// Copies of one edge become one; different edges under one key are all left out.
fn one_per_key(edges: &[Edge], rejected: &mut Vec<(EntryName, EntryProblem)>) -> Vec<Edge> {
    let mut sorted: Vec<(&Edge, _)> = edges.iter().map(|e| (e, content(e))).collect();
    sorted.sort_by(|(a, a_content), (b, b_content)| (&a.key, a_content).cmp(&(&b.key, b_content)));
    sorted.dedup_by(|(a, a_content), (b, b_content)| a.key == b.key && a_content == b_content);
    let mut kept = Vec::new();
    for group in sorted.chunk_by(|(a, _), (b, _)| a.key == b.key) {
        match group {
            [(edge, _)] => kept.push((*edge).clone()),
            _ => rejected.push((EntryName::Edge(group[0].0.key.clone()), EntryProblem::ConflictingKey)),
        }
    }
    kept
}

impl UsableGraph {
    /// Checks and sorts. Of several edges of one kind between the same two submaps the smallest key counts.
    ///
    /// The cut is the smallest version vector that holds every usable loop, the odometry up to both its ends,
    /// and every withdrawal. It depends on the set of entries alone, not on the order of their arrival.
    pub fn new(entries: &GraphEntries) -> Self {
        let mut graph = UsableGraph::default();
        for (id, node) in &entries.nodes {
            match checked_pose(&node.agent_from_submap) {
                Ok(agent_from_submap) => {
                    let node = NodeInfo { agent_from_submap, first_frame: node.first_frame };
                    graph.nodes.insert(id.clone(), node);
                }
                Err(problem) => graph.rejected.push((EntryName::Node(id.clone()), problem)),
            }
        }
        let mut counted: BTreeMap<(EdgeKind, SubmapId, SubmapId), EdgeKey> = BTreeMap::new();
        let mut also_in_cut = BTreeSet::new();
        for edge in one_per_key(&entries.edges, &mut graph.rejected) {
            let name = EntryName::Edge(edge.key.clone());
            let edge = match checked_edge(&edge, |s| graph.nodes.contains_key(s)) {
                Ok(edge) => edge,
                Err(problem) => {
                    graph.rejected.push((name, problem));
                    continue;
                }
            };
            if let Some(by) = entries.withdrawn.get(&edge.key).filter(|_| edge.kind == EdgeKind::Loop) {
                if by.agent == edge.key.agent {
                    also_in_cut.insert(by.clone());
                    also_in_cut.insert(edge.key.clone());
                    graph.rejected.push((name, EntryProblem::Withdrawn { by: by.clone() }));
                    continue;
                }
                let author = edge.key.agent.clone();
                let problem = EntryProblem::NotTheAuthor { author, by: by.clone() };
                graph.rejected.push((EntryName::Withdrawal(edge.key.clone()), problem));
            }
            let (low, high) =
                (edge.from.clone().min(edge.to.clone()), edge.from.clone().max(edge.to.clone()));
            let pair = (edge.kind, low, high);
            if let Some(by) = counted.get(&pair) {
                // A double verdict is an entry all the same: the cut holds it, so that withdrawing the first
                // brings the second forward on every agent alike.
                if edge.kind == EdgeKind::Loop {
                    also_in_cut.insert(edge.key.clone());
                }
                graph.rejected.push((name, EntryProblem::Superseded { by: by.clone() }));
                continue;
            }
            counted.insert(pair, edge.key.clone());
            match edge.kind {
                EdgeKind::Odometry => graph.odometry.push(edge),
                EdgeKind::Loop => graph.loops.push(edge),
            }
        }
        graph.cut = cut(&graph.loops, &graph.odometry, &also_in_cut);
        graph
    }
}

fn cut(loops: &[Edge], odometry: &[Edge], others: &BTreeSet<EdgeKey>) -> Cut {
    let mut cut = Cut::new();
    let mut include = |key: &EdgeKey| {
        let entry = cut.entry((key.agent.clone(), key.epoch)).or_insert(0);
        *entry = (*entry).max(key.sequence);
    };
    // The entry that brought a submap is the one with the edge to its predecessor.
    let mut arrival: BTreeMap<&SubmapId, &EdgeKey> = BTreeMap::new();
    for edge in odometry {
        let later = (&edge.from).max(&edge.to);
        let known = arrival.entry(later).or_insert(&edge.key);
        *known = (*known).max(&edge.key);
    }
    for edge in loops {
        include(&edge.key);
        for end in [&edge.from, &edge.to] {
            if let Some(key) = arrival.get(end) {
                include(key);
            }
        }
    }
    others.iter().for_each(&mut include);
    cut
}

/// True if the log entry lies within the cut.
pub fn within(cut: &Cut, key: &EdgeKey) -> bool {
    cut.get(&(key.agent.clone(), key.epoch)).is_some_and(|last| key.sequence <= *last)
}
