//! What the agents know at the end, as facts: poses by component, maps, the graph, every candidate.

use super::facts::{AgentFacts, ComponentFacts, EdgeFacts, End, Facts, LoopFacts, PoseFacts, SubmapFacts};
use crate::collect::{AgentCalls, FramePose, Submap};
use coma_evaluation::{SentBytes, TrafficClass};
use coma_geometry::{Pose, StampNs, SubmapId};
use coma_slam::log::{EntryKey, LoopOutcome, Payload};
use coma_surfel::{Keepers, MergeSettings, SurfelCloud, ply};
use coma_wire::{At, Wire, v1};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::Write;

/// What one agent gave.
pub struct FromAgent {
    /// How it fares.
    pub status: v1::GetStatusResponse,
    /// Every pose.
    pub poses: Vec<FramePose>,
    /// Every submap.
    pub submaps: Vec<Submap>,
}

/// A run's results that are not facts but files.
#[derive(Default)]
pub struct Results<'a> {
    /// By agent, then component: frame and `map_from_camera`.
    pub trajectories: BTreeMap<(usize, usize), Vec<(usize, Pose)>>,
    /// By component.
    pub maps: Vec<Map<'a>>,
    /// Every candidate.
    pub loops: Vec<LoopFacts>,
    /// The graph of the largest component, for other programs.
    pub g2o: String,
}

/// A component's map, to be written submap by submap.
pub struct Map<'a> {
    submaps: Vec<&'a Submap>,
    keepers: Keepers,
}

impl<'a> Map<'a> {
    fn of(submaps: Vec<&'a Submap>) -> anyhow::Result<Self> {
        let part = |i: usize| anyhow::Ok((Cow::Owned(submaps[i].surfels()?), submaps[i].map_from_submap));
        let keepers = Keepers::among(submaps.len(), part, &MergeSettings::default())?;
        Ok(Map { submaps, keepers })
    }

    /// Writes it as PLY.
    pub fn write(&self, out: &mut dyn Write) -> anyhow::Result<()> {
        let mut writer = ply::Writer::new(out, self.keepers.counts().iter().sum())?;
        for (i, submap) in self.submaps.iter().enumerate() {
            let surfels: SurfelCloud = submap.surfels()?;
            for surfel in self.keepers.kept(i, &surfels, &submap.map_from_submap) {
                writer.push(&surfel)?;
            }
        }
        Ok(writer.finish()?)
    }
}

/// Asks an agent for everything.
pub async fn ask(calls: &mut AgentCalls) -> anyhow::Result<FromAgent> {
    Ok(FromAgent {
        status: calls.status().await?,
        poses: calls.trajectory().await?,
        submaps: calls.submaps().await?,
    })
}

/// Puts it together. `stamps` are those of each agent's frames, in the order of `facts.agents`.
pub fn gather<'a>(
    facts: &mut Facts,
    from_agents: &'a [FromAgent],
    graph: &v1::GetGraphResponse,
    stamps: &[Vec<StampNs>],
) -> anyhow::Result<Results<'a>> {
    let mut results = Results::default();
    let entries = entries(graph)?;
    let mut component_of = components(facts, graph, from_agents)?;
    let anchors = anchors(facts, &entries, stamps);
    for (i, from) in from_agents.iter().enumerate() {
        poses(facts, &mut results, i, &from.poses, &stamps[i], &mut component_of);
        agent(&mut facts.agents[i], from, &component_of, &anchors)?;
    }
    let mut submaps: Vec<&Submap> = from_agents.iter().flat_map(|f| &f.submaps).collect();
    submaps.sort_by(|a, b| a.id.cmp(&b.id));
    for (index, component) in facts.components.iter_mut().enumerate() {
        let mine = submaps.iter().copied().filter(|s| component_of.get(&s.id) == Some(&index));
        let map = Map::of(mine.collect())?;
        let ids = map.submaps.iter().map(|s| &s.id);
        let kept: BTreeMap<&SubmapId, usize> = ids.zip(map.keepers.counts().iter().copied()).collect();
        for submap in facts.agents.iter_mut().flat_map(|a| &mut a.submaps) {
            if let Some(kept) = kept.get(&submap.id) {
                submap.merged_surfels = Some(*kept);
            }
        }
        component.surfels = kept.values().sum();
        component.map = if index == 0 { "map.ply".into() } else { format!("map-{index}.ply") };
        results.maps.push(map);
    }
    let end = |id: &SubmapId| End { submap: id.clone(), frame: anchors.get(id).copied() };
    let weights = weights(graph)?;
    let withdrawn: BTreeMap<&EntryKey, &str> = entries
        .iter()
        .filter_map(|(_, payload)| match payload {
            Payload::LoopWithdrawn(w) => Some((&w.verdict, w.message.as_str())),
            _ => None,
        })
        .collect();
    for (key, payload) in &entries {
        match payload {
            Payload::OdometryEdge(e) => facts.odometry.push(EdgeFacts {
                from: end(&e.from),
                to: end(&e.to),
                from_from_to: e.from_from_to,
                information: e.information,
            }),
            Payload::LoopVerdict(v) => {
                let (from, to) = (end(&v.from), end(&v.to));
                let weight = weights.get(key);
                let mut line = LoopFacts {
                    from: from.clone(),
                    to: to.clone(),
                    verdict: String::new(),
                    reason: None,
                    message: None,
                    numbers: BTreeMap::new(),
                    by: key.agent.to_string(),
                    similarity: v.similarity,
                    space: v.space.clone(),
                    weight: weight.map(|(w, _)| *w),
                    solver: weight.map(|(_, said)| said.clone()).filter(|said| !said.is_empty()),
                    edge: None,
                };
                match &v.outcome {
                    LoopOutcome::Accepted { from_from_to, information, numbers } => {
                        line.verdict = "accepted".into();
                        line.numbers = numbers.clone();
                        line.edge = Some(EdgeFacts {
                            from,
                            to,
                            from_from_to: *from_from_to,
                            information: *information,
                        });
                        if let Some(message) = withdrawn.get(key) {
                            line.verdict = "withdrawn".into();
                            line.message = Some((*message).to_owned());
                        }
                    }
                    LoopOutcome::Rejected { reason, message, numbers } => {
                        line.verdict = "rejected".into();
                        line.reason = Some(reason.clone());
                        line.message = Some(message.clone());
                        line.numbers = numbers.clone();
                    }
                }
                results.loops.push(line);
            }
            _ => {}
        }
    }
    results.g2o = super::g2o::text(graph, &entries)?;
    Ok(results)
}

fn entries(graph: &v1::GetGraphResponse) -> anyhow::Result<Vec<(EntryKey, Payload)>> {
    let at = At::Root("entries");
    let mut out = Vec::new();
    for (i, entry) in graph.entries.iter().enumerate() {
        // Entries without payload are those that viewers do not get.
        if entry.payload.is_empty() {
            continue;
        }
        let key: EntryKey = at.index(i).field("key").required(entry.key.clone())?;
        // A kind that only newer agents know has no part in the files.
        if let Ok(payload) = coma_wire::decode_payload(&entry.payload) {
            out.push((key, payload));
        }
    }
    Ok(out)
}

/// Lists the components, the one with most frames first, and tells which holds a submap.
fn components(
    facts: &mut Facts,
    graph: &v1::GetGraphResponse,
    from_agents: &[FromAgent],
) -> anyhow::Result<BTreeMap<SubmapId, usize>> {
    let mut frames: BTreeMap<SubmapId, usize> = BTreeMap::new();
    for pose in from_agents.iter().flat_map(|f| &f.poses) {
        *frames.entry(pose.submap.clone()).or_default() += 1;
    }
    let mut found = Vec::new();
    for (i, component) in graph.components.iter().enumerate() {
        let at = At::Root("components");
        let at = at.index(i);
        let mut ids = Vec::new();
        for pose in &component.poses {
            ids.push(at.field("submap_id").required::<SubmapId>(pose.submap_id.clone())?);
        }
        ids.sort();
        let seen: usize = ids.iter().filter_map(|id| frames.get(id)).sum();
        found.push((seen, component, ids));
    }
    found.sort_by(|a, b| b.0.cmp(&a.0).then_with(|| a.2.cmp(&b.2)));
    let mut component_of = BTreeMap::new();
    for (index, (_, component, ids)) in found.into_iter().enumerate() {
        let generation = component.generation.clone().unwrap_or_default();
        let map_id = generation.map_id.unwrap_or_default();
        facts.components.push(ComponentFacts {
            name: format!(
                "{}/{} from {}",
                map_id.agent_id,
                map_id.epoch,
                ids.first().map_or(String::new(), |id| id.to_string())
            ),
            digest: generation.digest.iter().map(|b| format!("{b:02x}")).collect(),
            submaps: ids.len(),
            cost: component.cost,
            ..ComponentFacts::default()
        });
        component_of.extend(ids.into_iter().map(|id| (id, index)));
    }
    facts.not_joined =
        graph.not_joined.iter().map(|n| format!("{} and {}: {}", n.agent_a, n.agent_b, n.message)).collect();
    Ok(component_of)
}

/// Frame of every submap's anchor, by its stamp.
fn anchors(
    facts: &Facts,
    entries: &[(EntryKey, Payload)],
    stamps: &[Vec<StampNs>],
) -> BTreeMap<SubmapId, usize> {
    let mut out = BTreeMap::new();
    for (_, payload) in entries {
        let Payload::SubmapOpened(opened) = payload else { continue };
        let Some(i) = facts.agents.iter().position(|a| a.name == opened.id.agent.as_str()) else { continue };
        if let Ok(frame) = stamps[i].binary_search(&opened.anchor_stamp) {
            out.insert(opened.id.clone(), frame);
        }
    }
    out
}

fn poses(
    facts: &mut Facts,
    results: &mut Results<'_>,
    agent: usize,
    poses: &[FramePose],
    stamps: &[StampNs],
    component_of: &mut BTreeMap<SubmapId, usize>,
) {
    for pose in poses {
        let Ok(frame) = stamps.binary_search(&pose.stamp) else { continue };
        // A submap that no solve has placed yet is a component of its agent's own.
        let next = facts.components.len();
        let component = *component_of.entry(pose.submap.clone()).or_insert(next);
        if component == next {
            let name = format!("{} alone", pose.submap);
            facts.components.push(ComponentFacts { name, submaps: 1, ..ComponentFacts::default() });
        }
        facts.agents[agent].poses.push(PoseFacts { frame, component, degraded: pose.degraded });
        results.trajectories.entry((agent, component)).or_default().push((frame, pose.map_from_camera));
    }
}

fn agent(
    facts: &mut AgentFacts,
    from: &FromAgent,
    component_of: &BTreeMap<SubmapId, usize>,
    anchors: &BTreeMap<SubmapId, usize>,
) -> anyhow::Result<()> {
    facts.dropped = from.status.frames_dropped;
    facts.encoder = from.status.encoder.clone();
    facts.warnings = from.status.warnings.clone();
    facts.stage_seconds = from.status.stage_seconds.iter().map(|(k, v)| (k.clone(), *v)).collect();
    facts.sent = from
        .status
        .bytes_sent
        .iter()
        .filter_map(|line| {
            Some(SentBytes {
                class: TrafficClass::from_name(&line.class)?,
                message_type: line.message_type.clone(),
                bytes: line.bytes,
                messages: line.messages,
            })
        })
        .collect();
    facts.submaps = from
        .submaps
        .iter()
        .map(|s| {
            Ok(SubmapFacts {
                id: s.id.clone(),
                anchor_frame: anchors.get(&s.id).copied(),
                component: component_of.get(&s.id).copied(),
                surfels: s.count,
                packed_bytes: s.packed_bytes(),
                merged_surfels: None,
            })
        })
        .collect::<anyhow::Result<_>>()?;
    Ok(())
}

/// What the solver made of each accepted loop: weight, and a sentence where it is not used.
fn weights(graph: &v1::GetGraphResponse) -> anyhow::Result<BTreeMap<EntryKey, (f64, String)>> {
    let mut out = BTreeMap::new();
    for line in graph.components.iter().flat_map(|c| &c.loops) {
        if let Some(key) = line.verdict.clone() {
            let key = EntryKey::from_wire(key, &At::Root("verdict"))?;
            out.insert(key, (line.weight, line.message.clone()));
        }
    }
    Ok(out)
}
