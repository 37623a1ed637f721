//! One agent's block of a graph: its submaps, its odometry, its loops, and the ends of these elsewhere.
//!
//! What a loop deserves of trust is decided as in the central solve ([`crate::global`]), by the two agents that it joins
//! alone: loops in the consistent set of two chains that join are doubted from the start, all others are suspended until
//! the blocks have found their places by these. Both ends decide alike if they know the same entries of each other.

use super::{Block, BlockEdge, BlockId, NodeId};
use crate::chain::{Chain, chains, extend_by_composition};
use crate::global::{
    GlobalSettings, Joins, chain_of, chain_pairs, chain_within, contradicting, lay_out, relate, supported,
};
use crate::gnc::Trust;
use crate::graph::{Edge, EdgeKey, GraphEntries, UsableGraph};
use crate::relative::NotJoined;
use crate::solution::LoopWeight;
use crate::solver::Constraint;
use coma_geometry::{AgentId, Pose, SubmapId};
use std::collections::{BTreeMap, BTreeSet};

/// One agent's part of a graph that is solved block by block. Numbers of nodes and measurements are its own.
#[derive(Clone, Debug)]
pub struct OwnBlock {
    /// What its agent descends on.
    pub block: Block,
    /// The submap of each node, ascending; those of other agents are only ends of loops.
    pub submaps: Vec<SubmapId>,
    /// The edge of each measurement: odometry, then loops, each by key.
    pub edges: Vec<Edge>,
    /// All submaps of the agent; those that have no node are placed by odometry.
    pub own: BTreeSet<SubmapId>,
    /// Pairs of chains, by their first submaps, whose loops do not hold them together.
    pub not_joined: Vec<(SubmapId, SubmapId, NotJoined)>,
    /// All odometry of the agent.
    odometry: Vec<Edge>,
    /// Loops that contradict those which joined their chains.
    contradicting: BTreeSet<EdgeKey>,
    settings: GlobalSettings,
}

/// Why an agent has no block.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NoBlock {
    /// Nothing to solve.
    #[error("{agent} has no submap in this graph")]
    NoSubmaps {
        /// The agent.
        agent: AgentId,
    },
    /// Its own submap, but none that is known.
    #[error("the gauge {gauge} is not known")]
    NoGauge {
        /// The submap that was to hold the gauge.
        gauge: SubmapId,
    },
    /// Nothing ties it to the others.
    #[error("{agent} has no loop to any of the others")]
    Alone {
        /// The agent.
        agent: AgentId,
    },
}

impl OwnBlock {
    /// The block of `agent`, in a team (sorted, with the agent itself: blocks are numbered in this order) whose map has the
    /// frame of `gauge`. Loops to strangers are left out.
    pub fn new(
        entries: &GraphEntries,
        agent: &AgentId,
        team: &[AgentId],
        gauge: &SubmapId,
        settings: &GlobalSettings,
    ) -> Result<OwnBlock, NoBlock> {
        let mut graph = UsableGraph::new(entries);
        let own = |submap: &SubmapId| submap.agent == *agent;
        let all_own: BTreeSet<SubmapId> = graph.nodes.keys().filter(|s| own(s)).cloned().collect();
        if all_own.is_empty() {
            return Err(NoBlock::NoSubmaps { agent: agent.clone() });
        }
        if own(gauge) && !all_own.contains(gauge) {
            return Err(NoBlock::NoGauge { gauge: gauge.clone() });
        }
        let number = |agent: &AgentId| team.binary_search(agent).ok().map(|k| k as BlockId);
        let in_team = |e: &Edge| number(&e.from.agent).is_some() && number(&e.to.agent).is_some();
        let own_loops: Vec<Edge> =
            graph.loops.iter().filter(|e| (own(&e.from) || own(&e.to)) && in_team(e)).cloned().collect();
        // Where others stand to each other is not this agent's to decide; what ties their own chains is.
        let others: BTreeSet<AgentId> =
            own_loops.iter().flat_map(|e| [&e.from.agent, &e.to.agent]).cloned().collect();
        if team.len() > 1 && !others.iter().any(|a| a != agent) {
            return Err(NoBlock::Alone { agent: agent.clone() });
        }
        let all = chains(&graph);
        let concerns = |c: &Chain| own(&c.first) || others.contains(&c.first.agent);
        let chains: Vec<Chain> = all.into_iter().filter(concerns).collect();
        let chain_of = chain_of(&chains);
        let within = |e: &Edge| chain_within(&chain_of, e).is_some();
        let laid: Vec<Edge> =
            graph.loops.drain(..).filter(|e| own(&e.from) || own(&e.to) || within(e)).collect();
        let pairs = chain_pairs(&own_loops, &chain_of);
        let trunks = lay_out(&chains, &laid, &chain_of, &pairs, settings);
        let mut joins = Joins::new();
        for (&(s, t), between) in &pairs {
            joins.insert((s, t), relate(between, &trunks[s], &trunks[t], &graph.nodes, settings));
        }
        let supported = supported(&pairs, &joins);
        let trust = |e: &Edge| {
            let believed = match chain_within(&chain_of, e) {
                Some(k) => !trunks[k].lonely.contains(&e.key),
                None => supported.contains(&e.key),
            };
            if believed { Trust::Doubted } else { Trust::Suspended }
        };
        let own_chains = || chains.iter().filter(|c| own(&c.first));
        let mut edges: Vec<(Edge, Trust)> = Vec::new();
        for chain in own_chains() {
            edges.extend(chain.solved_odometry.iter().map(|e| (e.clone(), Trust::Full)));
        }
        edges.extend(own_loops.iter().map(|e| (e.clone(), trust(e))));
        let mut nodes: BTreeSet<&SubmapId> = edges.iter().flat_map(|(e, _)| [&e.from, &e.to]).collect();
        if own(gauge) {
            nodes.insert(gauge);
        }
        let submaps: Vec<SubmapId> = nodes.into_iter().cloned().collect();
        let node = |submap: &SubmapId| submaps.binary_search(submap).unwrap_or(usize::MAX);
        let mut block = Block { id: number(agent).unwrap_or(BlockId::MAX), ..Block::default() };
        for (k, submap) in submaps.iter().enumerate() {
            match number(&submap.agent) {
                _ if own(submap) => block.nodes.push(k as NodeId),
                Some(other) => drop(block.neighbours.insert(k as NodeId, other)),
                None => {}
            }
        }
        // Who has loops to the gauge knows that it stays.
        if let Ok(gauge) = submaps.binary_search(gauge) {
            block.fixed.push(gauge as NodeId);
        }
        for (index, (edge, trust)) in edges.iter().enumerate() {
            let constraint = Constraint {
                from: node(&edge.from),
                to: node(&edge.to),
                from_from_to: edge.from_from_to,
                information: edge.information,
            };
            let weight = if *trust == Trust::Suspended { 0.0 } else { 1.0 };
            block.edges.push(BlockEdge { index: index as u32, constraint, weight, trust: *trust });
        }
        let not_joined = joins.iter().filter_map(|(&(s, t), outcome)| {
            let reason = outcome.as_ref().err()?;
            Some((chains[s].first.clone(), chains[t].first.clone(), reason.clone()))
        });
        Ok(OwnBlock {
            not_joined: not_joined.collect(),
            odometry: own_chains().flat_map(|c| c.odometry.iter().cloned()).collect(),
            contradicting: contradicting(&pairs, &joins),
            own: all_own,
            edges: edges.into_iter().map(|(edge, _)| edge).collect(),
            settings: *settings,
            block,
            submaps,
        })
    }

    /// `map_from_submap` of the agent's own submaps, from those of its nodes; what lies beyond is placed by odometry.
    pub fn poses(&self, of_nodes: &BTreeMap<NodeId, Pose>) -> BTreeMap<SubmapId, Pose> {
        let named = |(node, pose): (&NodeId, &Pose)| Some((self.submaps.get(*node as usize)?.clone(), *pose));
        let mut placed: BTreeMap<SubmapId, Pose> = of_nodes.iter().filter_map(named).collect();
        extend_by_composition(&mut placed, &self.odometry);
        placed
    }

    /// What became of a loop with this weight and squared error; `None` for odometry.
    pub fn loop_weight(&self, index: u32, weight: f64, squared_error: f64) -> Option<LoopWeight> {
        let edge = self.edges.get(index as usize).filter(|e| e.kind == crate::EdgeKind::Loop)?;
        let contradicts = self.contradicting.contains(&edge.key);
        // Blocks believe no loop more than others.
        let limit = self.settings.robust.limit(false);
        Some(LoopWeight::judged(edge, weight, squared_error, contradicts, limit))
    }
}
