//! What an entry says of the graph, and how all that is said becomes the entries of a solve.

use coma_geometry::{AgentId, Epoch, SubmapId};
use coma_pose_graph::{Edge, EdgeKey, EdgeKind, GraphEntries, NodeInfo};
use coma_wire::entries::{Entry, EntryKey, LoopOutcome, Payload};
use std::collections::BTreeMap;

/// What one entry says of the graph.
#[derive(Clone, Debug)]
pub enum Fact {
    /// An agent began a life, and wants so much to hold the gauge.
    Started {
        /// The smallest (priority, id) holds it.
        anchor_priority: u32,
    },
    /// A submap began.
    Submap(SubmapId, NodeInfo),
    /// Odometry.
    Odometry(Box<Edge>),
    /// A pair was decided: with its loop, or turned down.
    Verdict {
        /// Both submaps, the smaller one first.
        pair: (SubmapId, SubmapId),
        /// The loop; none if the pair was turned down.
        accepted: Option<Box<Edge>>,
    },
    /// A verdict is taken back.
    Withdrawn(EdgeKey),
    /// It cannot be used.
    Unusable(String),
}

/// The pose graph's name for an entry.
pub fn edge_key(key: &EntryKey) -> EdgeKey {
    EdgeKey { agent: key.agent.clone(), epoch: key.epoch, sequence: key.sequence }
}

impl Fact {
    /// What an entry says; `None` for entries that are not about the graph.
    pub fn of(entry: &Entry) -> Option<Fact> {
        let key = &entry.key;
        let own = |submap: &SubmapId| submap.agent == key.agent && submap.epoch == key.epoch;
        let foreign = |submap: &SubmapId| {
            Fact::Unusable(format!("submap {submap} is not one of the life that wrote this entry"))
        };
        let payload = match coma_wire::decode_payload(&entry.payload) {
            Ok(payload) => payload,
            // Also a kind that only newer programs know.
            Err(error) => return Some(Fact::Unusable(error.to_string())),
        };
        Some(match payload {
            Payload::AgentStarted(started) => Fact::Started { anchor_priority: started.anchor_priority },
            Payload::SubmapOpened(opened) if !own(&opened.id) => foreign(&opened.id),
            Payload::SubmapOpened(opened) => {
                let first_frame = opened.anchor_frame;
                Fact::Submap(opened.id, NodeInfo { first_frame, agent_from_submap: opened.agent_from_submap })
            }
            Payload::OdometryEdge(edge) if !own(&edge.from) => foreign(&edge.from),
            Payload::OdometryEdge(edge) if !own(&edge.to) => foreign(&edge.to),
            Payload::OdometryEdge(edge) => Fact::Odometry(Box::new(Edge {
                key: edge_key(key),
                kind: EdgeKind::Odometry,
                from: edge.from,
                to: edge.to,
                from_from_to: edge.from_from_to,
                information: edge.information,
            })),
            Payload::LoopVerdict(verdict) => {
                let (from, to) = (verdict.from, verdict.to);
                let pair = if from <= to { (from.clone(), to.clone()) } else { (to.clone(), from.clone()) };
                let accepted = match verdict.outcome {
                    LoopOutcome::Rejected { .. } => None,
                    LoopOutcome::Accepted { from_from_to, information, .. } => Some(Box::new(Edge {
                        key: edge_key(key),
                        kind: EdgeKind::Loop,
                        from,
                        to,
                        from_from_to,
                        information,
                    })),
                };
                Fact::Verdict { pair, accepted }
            }
            Payload::LoopWithdrawn(withdrawn) => Fact::Withdrawn(edge_key(&withdrawn.verdict)),
            Payload::AnchorDescribed(_) | Payload::SolveDigest(_) => return None,
        })
    }
}

/// All that is said, ready to be solved.
#[derive(Clone, Debug, Default)]
pub struct Graph {
    /// What the solver takes.
    pub entries: GraphEntries,
    /// The entry of each submap.
    pub submap_keys: BTreeMap<SubmapId, EdgeKey>,
    /// What was left out here, and why.
    pub rejected: Vec<(EdgeKey, String)>,
    /// Entries that decided which loops there are: the cut of a result holds them too.
    pub deciding: Vec<EdgeKey>,
}

type Verdicts<'a> = BTreeMap<&'a (SubmapId, SubmapId), Vec<(EdgeKey, &'a Option<Box<Edge>>)>>;

impl Graph {
    /// Gathers facts that come sorted by agent, epoch and sequence.
    pub fn of<'a>(facts: impl Iterator<Item = (EdgeKey, &'a Fact)>) -> Graph {
        let mut graph = Graph::default();
        let mut verdicts = Verdicts::new();
        for (key, fact) in facts {
            match fact {
                // An agent's priority is that of its first life: the gauge does not move when it starts anew.
                Fact::Started { anchor_priority } => {
                    graph.entries.anchor_priority.entry(key.agent).or_insert(*anchor_priority);
                }
                Fact::Submap(id, node) => match graph.submap_keys.get(id) {
                    Some(_) => graph.rejected.push((key, format!("submap {id} was opened before"))),
                    None => {
                        graph.submap_keys.insert(id.clone(), key);
                        graph.entries.nodes.insert(id.clone(), node.clone());
                    }
                },
                Fact::Odometry(edge) => graph.entries.edges.push((**edge).clone()),
                Fact::Verdict { pair, accepted } => verdicts.entry(pair).or_default().push((key, accepted)),
                Fact::Withdrawn(verdict) => {
                    let by = graph.entries.withdrawn.entry(verdict.clone()).or_insert_with(|| key.clone());
                    // The author's word is the one that counts.
                    if by.agent != verdict.agent {
                        *by = key;
                    }
                }
                Fact::Unusable(reason) => graph.rejected.push((key, reason.clone())),
            }
        }
        for verdicts in verdicts.into_values() {
            graph.decide(&verdicts);
        }
        graph
    }

    /// Of a pair's verdicts the one with the smallest key counts, unless its author took it back.
    fn decide(&mut self, verdicts: &[(EdgeKey, &Option<Box<Edge>>)]) {
        if verdicts.iter().all(|(_, accepted)| accepted.is_none()) {
            return;
        }
        let withdrawn =
            |key: &EdgeKey| self.entries.withdrawn.get(key).filter(|by| by.agent == key.agent).cloned();
        let counts = verdicts.iter().find(|(key, _)| withdrawn(key).is_none());
        let refused_by = counts.and_then(|(key, accepted)| accepted.is_none().then_some(key));
        for (key, accepted) in verdicts {
            let withdrawn = withdrawn(key);
            self.deciding.push(key.clone());
            self.deciding.extend(withdrawn.clone());
            let Some(edge) = accepted else { continue };
            match refused_by {
                Some(by) if withdrawn.is_none() => {
                    let by = format!("{}/{}/{}", by.agent, by.epoch.0, by.sequence);
                    self.rejected
                        .push((key.clone(), format!("entry {by}, which counts, turned this pair down")));
                }
                _ => self.entries.edges.push((**edge).clone()),
            }
        }
    }

    /// Agents with a submap.
    pub fn agents(&self) -> Vec<AgentId> {
        let mut agents: Vec<AgentId> = self.entries.nodes.keys().map(|id| id.agent.clone()).collect();
        agents.dedup();
        agents
    }
}

/// One life of one agent: its log.
pub type Life = (AgentId, Epoch);
