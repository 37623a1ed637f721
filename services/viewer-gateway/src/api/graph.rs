//! The graph: submaps, odometry, and every loop with its verdict.

use super::Gateway;
use crate::agents::{Directory, Link, Whole};
use crate::json::{Component, Pose, Unreachable, log_text, text};
use axum::Json;
use axum::extract::State;
use coma_geometry::{AgentId, SubmapId};
use coma_wire::entries::{EntryKey, LoopOutcome, LoopVerdict, Payload};
use coma_wire::{At, FieldError, v1};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use tonic::Status;
use utoipa::ToSchema;

/// The graph, from the logs of all agents that answer.
#[derive(Debug, Default, Serialize, ToSchema)]
pub struct Graph {
    /// Its nodes, by id.
    pub submaps: Vec<Node>,
    /// Edges between submaps that followed one another.
    pub odometry: Vec<Odometry>,
    /// Every verdict on two places, accepted and rejected, by the entry that says so.
    pub loops: Vec<Loop>,
    /// The newest result: submaps that share a frame of reference.
    pub components: Vec<Component>,
    /// Pairs of agents that have loops and no common map, with the reason.
    pub not_joined: Vec<NotJoined>,
    /// Agents that have no part in this; others may still know their logs.
    pub unreachable: Vec<Unreachable>,
}

/// A submap as its agent logged it.
#[derive(Debug, Serialize, ToSchema)]
pub struct Node {
    /// `agent/epoch/s0`.
    pub id: String,
    /// Submaps of one chain are tied by odometry; a lost camera starts a new chain.
    pub chain: u32,
    /// Position of its first frame in the agent's stream.
    pub anchor_frame: u64,
    /// Stamp of its first frame in nanoseconds, as text.
    #[schema(value_type = String)]
    #[serde(serialize_with = "text")]
    pub anchor_stamp_ns: i64,
    /// By odometry alone.
    pub agent_from_submap: Pose,
}

/// An edge of odometry.
#[derive(Debug, Serialize, ToSchema)]
pub struct Odometry {
    /// `agent/epoch/s0`.
    pub from: String,
    /// `agent/epoch/s1`.
    pub to: String,
    /// As measured.
    pub from_from_to: Pose,
}

/// Two places that were compared.
#[derive(Debug, Serialize, ToSchema)]
pub struct Loop {
    /// The entry that says so, `agent/epoch/sequence`.
    pub entry: String,
    /// `agent/epoch/s0`.
    pub from: String,
    /// `agent/epoch/s0`.
    pub to: String,
    /// Of the places, 0 to 1.
    pub similarity: f32,
    /// Of the descriptors.
    pub space: String,
    /// They are the same place, and how they stand to each other is known.
    pub accepted: bool,
    /// Of several verdicts on one pair, the one with the smallest key counts; a withdrawn one does not.
    pub counts: bool,
    /// Where accepted.
    pub from_from_to: Option<Pose>,
    /// A stable name, where rejected.
    pub reason: Option<String>,
    /// Why it was rejected, as a sentence.
    pub message: Option<String>,
    /// What was measured.
    pub numbers: BTreeMap<String, f64>,
    /// Why its author took it back.
    pub withdrawn: Option<String>,
    /// What the newest result made of it.
    pub solution: Option<LoopInSolution>,
}

/// A loop's part in a result.
#[derive(Debug, Serialize, ToSchema)]
pub struct LoopInSolution {
    /// 0 (an outlier) to 1.
    pub weight: f64,
    /// Squared Mahalanobis error, 6 degrees of freedom; absent where there is none.
    pub squared_error: Option<f64>,
    /// What became of it.
    pub message: String,
}

/// Two agents without a common map.
#[derive(Debug, Serialize, ToSchema)]
pub struct NotJoined {
    /// The one.
    pub agent_a: String,
    /// The other.
    pub agent_b: String,
    /// Why.
    pub message: String,
}

/// One agent's view of the graph, checked.
pub struct View {
    entries: Vec<(EntryKey, Payload)>,
    components: Vec<(Component, BTreeMap<SubmapId, coma_geometry::Pose>)>,
    weights: Vec<(EntryKey, LoopInSolution)>,
    not_joined: Vec<v1::NotJoined>,
}

/// The views of all agents that answer.
pub struct Views(Whole<View>);

impl Views {
    /// Asks all agents.
    pub async fn ask(directory: &Directory) -> Views {
        let ask = async |link: Arc<Link>| {
            let unreadable = |e: FieldError| Status::internal(format!("its graph can't be read: {e}"));
            View::read(link.graph().await?).map_err(unreadable)
        };
        Views(directory.ask(ask).await)
    }
}

/// The place of the view whose results are made of most entries; of equals, of the agent with the smallest name.
fn newest(answers: &[(AgentId, View)]) -> Option<usize> {
    let entries =
        |view: &View| view.components.iter().map(|(c, _)| c.generation.entries()).max().unwrap_or(0);
    (0..answers.len()).rev().max_by_key(|i| entries(&answers[*i].1))
}

/// Where the newest result puts submaps, component by component.
pub fn newest_components(views: &Views) -> Vec<BTreeMap<SubmapId, coma_geometry::Pose>> {
    let Some(newest) = newest(&views.0.answers) else { return Vec::new() };
    views.0.answers[newest].1.components.iter().map(|(_, poses)| poses.clone()).collect()
}

impl View {
    fn read(m: v1::GetGraphResponse) -> Result<View, FieldError> {
        let mut entries = Vec::new();
        let at_entries = At::Root("entries");
        for (i, entry) in m.entries.into_iter().enumerate() {
            let key: EntryKey = at_entries.index(i).field("key").required(entry.key)?;
            // Descriptors come empty; others may be of kinds that only newer gateways know.
            if let Ok(payload) = coma_wire::decode_payload(&entry.payload) {
                entries.push((key, payload));
            }
        }
        let (mut components, mut weights) = (Vec::new(), Vec::new());
        let at_components = At::Root("components");
        for (i, mut component) in m.components.into_iter().enumerate() {
            let at = at_components.index(i);
            let at_loops = at.field("loops");
            for (k, weight) in std::mem::take(&mut component.loops).into_iter().enumerate() {
                let key: EntryKey = at_loops.index(k).field("verdict").required(weight.verdict)?;
                let v1::LoopWeight { weight, squared_error, message, .. } = weight;
                let squared_error = Some(squared_error).filter(|e| e.is_finite());
                weights.push((key, LoopInSolution { weight, squared_error, message }));
            }
            let (component, poses) = Component::read(component, &at)?;
            components.push((component, poses.into_iter().collect()));
        }
        Ok(View { entries, components, weights, not_joined: m.not_joined })
    }
}

/// Everything that the agents know of the graph: submaps, odometry, loops with verdicts and reasons, components.
#[utoipa::path(get, path = "/api/v1/graph", tag = "graph", security(("token" = [])),
    responses((status = 200, description = "The graph", body = Graph)))]
pub async fn graph(State(gateway): State<Arc<Gateway>>) -> Json<Graph> {
    Json(assemble(Views::ask(&gateway.directory).await))
}

fn assemble(Views(whole): Views) -> Graph {
    let newest = newest(&whole.answers);
    let mut entries: BTreeMap<EntryKey, Payload> = BTreeMap::new();
    let mut graph = Graph { unreachable: whole.unreachable, ..Graph::default() };
    let mut solutions = BTreeMap::new();
    for (i, (_, view)) in whole.answers.into_iter().enumerate() {
        entries.extend(view.entries);
        if Some(i) == newest {
            graph.components = view.components.into_iter().map(|(component, _)| component).collect();
            solutions = view.weights.into_iter().collect();
            let not_joined =
                |n: v1::NotJoined| NotJoined { agent_a: n.agent_a, agent_b: n.agent_b, message: n.message };
            graph.not_joined = view.not_joined.into_iter().map(not_joined).collect();
        }
    }
    for payload in entries.values() {
        match payload {
            Payload::SubmapOpened(opened) => graph.submaps.push(Node {
                id: opened.id.to_string(),
                chain: opened.chain,
                anchor_frame: opened.anchor_frame,
                anchor_stamp_ns: opened.anchor_stamp.0,
                agent_from_submap: (&opened.agent_from_submap).into(),
            }),
            Payload::OdometryEdge(edge) => graph.odometry.push(Odometry {
                from: edge.from.to_string(),
                to: edge.to.to_string(),
                from_from_to: (&edge.from_from_to).into(),
            }),
            _ => {}
        }
    }
    graph.loops = loops(&entries, solutions);
    graph
}

/// Verdicts in the order of their keys.
fn loops(
    entries: &BTreeMap<EntryKey, Payload>,
    mut solutions: BTreeMap<EntryKey, LoopInSolution>,
) -> Vec<Loop> {
    let withdrawn: BTreeMap<&EntryKey, &str> = entries
        .iter()
        .filter_map(|(by, payload)| match payload {
            // Only its author can take a verdict back.
            Payload::LoopWithdrawn(w) if w.verdict.agent == by.agent => {
                Some((&w.verdict, w.message.as_str()))
            }
            _ => None,
        })
        .collect();
    let mut judged = BTreeSet::new();
    let verdicts = entries.iter().filter_map(|(key, payload)| match payload {
        Payload::LoopVerdict(verdict) => Some((key, verdict)),
        _ => None,
    });
    verdicts
        .map(|(key, verdict)| {
            let LoopVerdict { from, to, similarity, space, outcome } = verdict;
            let withdrawn = withdrawn.get(key).map(|why| (*why).to_owned());
            let pair = if from <= to { (from, to) } else { (to, from) };
            let counts = withdrawn.is_none() && judged.insert(pair);
            let (accepted, pose, reason, message, numbers) = match outcome {
                LoopOutcome::Accepted { from_from_to, numbers, .. } => {
                    (true, Some(from_from_to.into()), None, None, numbers)
                }
                LoopOutcome::Rejected { reason, message, numbers } => {
                    (false, None, Some(reason.clone()), Some(message.clone()), numbers)
                }
            };
            Loop {
                entry: format!("{}/{}", log_text(&key.agent, key.epoch), key.sequence),
                from: from.to_string(),
                to: to.to_string(),
                similarity: *similarity,
                space: space.clone(),
                accepted,
                counts,
                from_from_to: pose,
                reason,
                message,
                numbers: numbers.clone(),
                withdrawn,
                solution: solutions.remove(key),
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_geometry::{Epoch, Matrix6};
    use coma_wire::entries::LoopWithdrawn;

    fn key(agent: &str, sequence: u64) -> EntryKey {
        EntryKey { agent: AgentId::new(agent).unwrap(), epoch: Epoch(1), sequence }
    }

    fn submap(agent: &str, number: u32) -> SubmapId {
        SubmapId { agent: AgentId::new(agent).unwrap(), epoch: Epoch(1), number }
    }

    fn verdict(from: SubmapId, to: SubmapId, accepted: bool) -> Payload {
        let numbers = BTreeMap::from([("inliers".to_owned(), 11.0)]);
        let outcome = if accepted {
            LoopOutcome::Accepted {
                from_from_to: coma_geometry::Pose::identity(),
                information: Matrix6::identity(),
                numbers,
            }
        } else {
            LoopOutcome::Rejected { reason: "low_overlap".into(), message: "Too little.".into(), numbers }
        };
        Payload::LoopVerdict(LoopVerdict { from, to, similarity: 0.5, space: "builtin/1".into(), outcome })
    }

    #[test]
    fn of_two_verdicts_the_smaller_key_counts_unless_its_author_took_it_back() {
        let entries = BTreeMap::from([
            (key("a", 0), verdict(submap("a", 0), submap("b", 0), true)),
            (key("b", 0), verdict(submap("b", 0), submap("a", 0), false)),
            (key("b", 1), verdict(submap("b", 1), submap("a", 1), false)),
        ]);
        let solution = || LoopInSolution { weight: 0.5, squared_error: None, message: "used".into() };
        let found = loops(&entries, BTreeMap::from([(key("a", 0), solution())]));
        let counts = |loops: &[Loop]| loops.iter().map(|l| l.counts).collect::<Vec<_>>();
        assert_eq!(counts(&found), [true, false, true]);
        assert!(found[0].accepted && found[0].solution.is_some() && found[0].from_from_to.is_some());
        assert_eq!((found[1].entry.as_str(), found[1].reason.as_deref()), ("b/1/0", Some("low_overlap")));
        assert_eq!(found[1].numbers["inliers"], 11.0);

        let withdrawn = |by| {
            let mut entries = entries.clone();
            let why = LoopWithdrawn { verdict: key("a", 0), message: "wrong".into() };
            entries.insert(key(by, 7), Payload::LoopWithdrawn(why));
            loops(&entries, BTreeMap::new())
        };
        assert_eq!(counts(&withdrawn("a")), [false, true, true]);
        assert_eq!(withdrawn("a")[0].withdrawn.as_deref(), Some("wrong"));
        assert_eq!(counts(&withdrawn("b")), [true, false, true], "another agent can't take it back");
    }
}
