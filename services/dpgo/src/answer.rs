//! A solution as the contract says it.

use crate::facts::Graph;
use coma_geometry::{AgentId, SubmapId};
use coma_pose_graph::graph::EntryName;
use coma_pose_graph::relative::NotJoined;
use coma_pose_graph::{Component, EdgeKey, LoopWeight, Solution};
use coma_wire::entries::{EntryKey, VersionVector};
use coma_wire::{Wire, v1};
use std::collections::{BTreeMap, BTreeSet};

/// Rejected entries and pairs of agents that an answer names at most, each.
const MOST_NAMED: usize = 1000;

/// The answer to a solve.
pub fn answer(graph: &Graph, solution: &Solution) -> v1::SolveResponse {
    let cut = cut(graph, solution);
    v1::SolveResponse {
        components: solution.components.iter().map(|c| component(c, &cut)).collect(),
        rejected_entries: rejected(graph, solution),
        not_joined: all_not_joined(graph, solution),
    }
}

/// An entry's name.
pub fn entry_key(key: &EdgeKey) -> v1::EntryKey {
    EntryKey { agent: key.agent.clone(), epoch: key.epoch, sequence: key.sequence }.to_wire()
}

/// The solver names the last sequence that it used of a log; a version vector names the log's length.
fn cut(graph: &Graph, solution: &Solution) -> VersionVector {
    let used = solution.cut.iter().map(|(life, sequence)| (life.clone(), *sequence));
    let deciding = graph.deciding.iter().map(|key| ((key.agent.clone(), key.epoch), key.sequence));
    let mut cut = VersionVector::new();
    for (life, sequence) in used.chain(deciding) {
        let length = cut.entry(life).or_insert(0);
        *length = (*length).max(sequence.saturating_add(1));
    }
    cut
}

fn component(component: &Component, cut: &VersionVector) -> v1::Component {
    v1::Component {
        generation: Some(v1::Generation {
            map_id: Some(component.map_id.to_wire()),
            cut: Some(cut.to_wire()),
            digest: component.digest.to_vec().into(),
        }),
        poses: component
            .map_from_submap
            .iter()
            .map(|(id, pose)| v1::SubmapPose {
                submap_id: Some(id.to_wire()),
                map_from_submap: Some(pose.to_wire()),
            })
            .collect(),
        loops: component.loops.iter().map(loop_weight).collect(),
        cost: component.cost,
        iterations: component.iterations,
    }
}

/// What became of a loop.
pub fn loop_weight(l: &LoopWeight) -> v1::LoopWeight {
    v1::LoopWeight {
        verdict: Some(entry_key(&l.key)),
        from: Some(l.from.to_wire()),
        to: Some(l.to.to_wire()),
        weight: l.weight,
        squared_error: l.squared_error,
        message: l.verdict.to_string(),
    }
}

/// Two chains, by their first submaps, that did not join.
pub fn not_joined(s: &SubmapId, t: &SubmapId, reason: &NotJoined) -> v1::NotJoined {
    // A part of a run that begins later says where.
    let part = |first: &SubmapId| match first.number {
        0 => String::new(),
        _ => format!(" (part of {} that begins with {first})", first.agent),
    };
    v1::NotJoined {
        agent_a: s.agent.to_wire(),
        agent_b: t.agent.to_wire(),
        message: format!("{reason}{}{}", part(s), part(t)),
    }
}

/// Entries that were not used, by key.
fn rejected(graph: &Graph, solution: &Solution) -> Vec<v1::RejectedEntry> {
    let mut out: BTreeMap<EdgeKey, String> = graph.rejected.iter().cloned().collect();
    for (name, problem) in &solution.rejected {
        let key = match name {
            EntryName::Node(submap) => graph.submap_keys.get(submap),
            EntryName::Edge(key) => Some(key),
            EntryName::Withdrawal(of) => graph.entries.withdrawn.get(of),
        };
        if let Some(key) = key {
            out.entry(key.clone()).or_insert_with(|| problem.to_string());
        }
    }
    if out.len() > MOST_NAMED {
        tracing::warn!(rejected = out.len(), named = MOST_NAMED, "not every rejected entry is named");
    }
    let rejected =
        |(key, message): (EdgeKey, String)| v1::RejectedEntry { key: Some(entry_key(&key)), message };
    out.into_iter().take(MOST_NAMED).map(rejected).collect()
}

/// Pairs of agents, or of parts of their runs, that are in different components, each with its reason.
fn all_not_joined(graph: &Graph, solution: &Solution) -> Vec<v1::NotJoined> {
    let component_of =
        |submap: &SubmapId| solution.components.iter().position(|c| c.map_from_submap.contains_key(submap));
    let mut out = Vec::new();
    let mut explained: BTreeSet<(&AgentId, &AgentId)> = BTreeSet::new();
    for pair in &solution.pairs {
        let Err(reason) = &pair.outcome else { continue };
        if component_of(&pair.s) == component_of(&pair.t) {
            continue;
        }
        explained.insert((&pair.s.agent, &pair.t.agent));
        out.push(not_joined(&pair.s, &pair.t, reason));
    }
    let agents = graph.agents();
    let pairs = agents.iter().enumerate().flat_map(|(i, a)| agents[i + 1..].iter().map(move |b| (a, b)));
    let apart = pairs.filter(|(a, b)| {
        let together = solution.components.iter().any(|c| c.agents.contains(a) && c.agents.contains(b));
        !together && !explained.contains(&(*a, *b))
    });
    let unseen = |(a, b): (&AgentId, &AgentId)| v1::NotJoined {
        agent_a: a.to_wire(),
        agent_b: b.to_wire(),
        message: "no loop between them was accepted".into(),
    };
    let room = MOST_NAMED.saturating_sub(out.len());
    out.extend(apart.map(unseen).take(room));
    out.truncate(MOST_NAMED);
    out
}
