//! g2o graphs of one or several robots as log entries, so that what solves a cluster's graph solves them too.
//!
//! Public sets of several robots come as one file for each; vertex ids are GTSAM's symbols, whose highest byte is the
//! robot's letter, and an edge between two robots is in both files.

use crate::g2o::{G2oEdge, G2oError, G2oGraph};
use crate::graph::{Edge, EdgeKey, EdgeKind, GraphEntries, NodeInfo};
use coma_geometry::{AgentId, Epoch, InvalidAgentId, Matrix6, Pose, SubmapId, Tangent};
use std::collections::BTreeMap;

/// Which edges are odometry, and so believed as they are; all others are loops.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Believed {
    /// Those between consecutive vertices of a robot.
    Consecutive,
    /// All within a robot.
    WithinARobot,
}

/// Frames between two vertices' anchors: one submap.
const FRAMES_APART: u64 = 21;

/// Why graphs are no team.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum TeamError {
    /// Together they are no whole graph.
    #[error(transparent)]
    G2o(#[from] G2oError),
    /// A vertex that two files hold.
    #[error("vertex {id} is in two files")]
    Duplicate {
        /// The vertex.
        id: u64,
    },
    /// A robot's letter that makes no name.
    #[error("vertex {id}: {reason}")]
    Name {
        /// The vertex.
        id: u64,
        /// What is wrong.
        reason: InvalidAgentId,
    },
}

/// Information of measurements with these standard deviations, in metres and radians.
pub fn information_of(sigma_m: f64, sigma_rad: f64) -> Matrix6 {
    Matrix6::from_diagonal(&Tangent::from_fn(|k, _| if k < 3 { sigma_m } else { sigma_rad }.powi(-2)))
}

/// Graphs that are one together; an edge that is in several files counts once. Edges are in the order of their ends.
pub fn merged(graphs: &[G2oGraph]) -> Result<G2oGraph, TeamError> {
    let mut whole = G2oGraph::default();
    let mut edges: BTreeMap<(u64, u64), &G2oEdge> = BTreeMap::new();
    for graph in graphs {
        for (id, pose) in &graph.vertices {
            if whole.vertices.insert(*id, *pose).is_some() {
                return Err(TeamError::Duplicate { id: *id });
            }
        }
        whole.fixed.extend(&graph.fixed);
        for edge in &graph.edges {
            edges.insert((edge.from, edge.to), edge);
        }
    }
    whole.edges = edges.values().map(|e| (*e).clone()).collect();
    whole.check()?;
    Ok(whole)
}

/// The entries of graphs that are one together, and the vertex of each submap. `information` replaces that of the files.
/// Each loop is written by that of its two robots which has written fewer.
pub fn entries(
    graphs: &[G2oGraph],
    believed: Believed,
    information: Option<Matrix6>,
) -> Result<(GraphEntries, BTreeMap<SubmapId, u64>), TeamError> {
    let whole = merged(graphs)?;
    let mut submaps: BTreeMap<u64, SubmapId> = BTreeMap::new();
    let mut entries = GraphEntries::default();
    let mut next: BTreeMap<AgentId, u32> = BTreeMap::new();
    for id in whole.vertices.keys() {
        let agent = agent(*id)?;
        let number = next.entry(agent.clone()).or_insert(0);
        let submap = SubmapId { agent, epoch: Epoch(0), number: *number };
        *number += 1;
        // What odometry says is not in the files.
        let node =
            NodeInfo { first_frame: FRAMES_APART * number_of(*id), agent_from_submap: Pose::identity() };
        entries.nodes.insert(submap.clone(), node);
        submaps.insert(*id, submap);
    }
    let kind = |edge: &G2oEdge| {
        let (from, to) = (&submaps[&edge.from], &submaps[&edge.to]);
        let odometry = from.agent == to.agent
            && (believed == Believed::WithinARobot || from.number.abs_diff(to.number) == 1);
        if odometry { EdgeKind::Odometry } else { EdgeKind::Loop }
    };
    // A file is a finished run: loops come last, so that the cut of a solve holds all of it.
    let (odometry, loops): (Vec<&G2oEdge>, Vec<&G2oEdge>) =
        whole.edges.iter().partition(|e| kind(e) == EdgeKind::Odometry);
    let mut next: BTreeMap<AgentId, u64> = BTreeMap::new();
    let mut loops_of: BTreeMap<AgentId, u64> = BTreeMap::new();
    for edge in odometry.into_iter().chain(loops) {
        let (from, to) = (submaps[&edge.from].clone(), submaps[&edge.to].clone());
        let kind = kind(edge);
        let count = |agent| loops_of.get(agent).copied().unwrap_or(0);
        let author = if count(&to.agent) < count(&from.agent) { &to.agent } else { &from.agent }.clone();
        if kind == EdgeKind::Loop {
            *loops_of.entry(author.clone()).or_insert(0) += 1;
        }
        let sequence = next.entry(author.clone()).or_insert(0);
        let key = EdgeKey { agent: author, epoch: Epoch(0), sequence: *sequence };
        *sequence += 1;
        entries.edges.push(Edge {
            key,
            kind,
            from,
            to,
            from_from_to: edge.from_from_to,
            information: information.unwrap_or(edge.information),
        });
    }
    Ok((entries, submaps.into_iter().map(|(id, submap)| (submap, id)).collect()))
}

fn number_of(id: u64) -> u64 {
    id & 0x00ff_ffff_ffff_ffff
}

/// The robot's letter, or `robot` and the number in its place.
fn agent(id: u64) -> Result<AgentId, TeamError> {
    let byte = (id >> 56) as u8;
    let name = match byte as char {
        letter @ ('a'..='z' | '0'..='9') => letter.to_string(),
        _ => format!("robot-{byte}"),
    };
    AgentId::new(&name).map_err(|reason| TeamError::Name { id, reason })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::g2o::G2oLimits;

    #[test]
    fn two_files_share_an_edge_and_are_one_graph() {
        let id = |letter: u8, number: u64| (u64::from(letter) << 56) | number;
        let (a0, a1, b0) = (id(b'a', 4), id(b'a', 9), id(b'b', 0));
        let measured = "1 0 0 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1";
        let vertex = |v: u64| format!("VERTEX_SE3:QUAT {v} 0 0 0 0 0 0 1\n");
        let edge = |from: u64, to: u64| format!("EDGE_SE3:QUAT {from} {to} {measured}\n");
        let texts = [vertex(a0) + &vertex(a1) + &edge(a0, a1) + &edge(a1, b0), vertex(b0) + &edge(a1, b0)];
        let parts = texts.map(|t| G2oGraph::parse_part(&t, &G2oLimits::default()).unwrap());
        let sure = information_of(0.1, 0.2);
        let (entries, vertices) = super::entries(&parts, Believed::Consecutive, Some(sure)).unwrap();
        assert_eq!(vertices.values().copied().collect::<Vec<_>>(), [a0, a1, b0]);
        let kinds: Vec<_> =
            entries.edges.iter().map(|e| (e.kind, e.from.to_string(), e.to.to_string())).collect();
        assert_eq!(kinds.len(), 2);
        assert_eq!((kinds[0].0, kinds[1].0), (EdgeKind::Odometry, EdgeKind::Loop));
        assert!((entries.edges[0].information[(3, 3)] - 25.0).abs() < 1e-12);
        let alone = super::entries(&parts[..1], Believed::Consecutive, None).unwrap_err();
        assert_eq!(alone, TeamError::G2o(G2oError::UnknownVertex { edge: 1, id: b0 }));
        let twice = [parts[0].clone(), parts[0].clone()];
        assert_eq!(
            super::entries(&twice, Believed::Consecutive, None).unwrap_err(),
            TeamError::Duplicate { id: a0 }
        );
    }
}
