//! Names and numbers: agents, submaps and loops have names on the wire and numbers in a block.

use super::rounds;
use coma_geometry::{AgentId, Pose, SubmapId};
use coma_pose_graph::blocks::{BlockId, Boundary, NodeId, OwnBlock, Standing};
use coma_pose_graph::{EdgeKey, EdgeKind};
use coma_wire::entries::EntryKey;
use coma_wire::{At, FieldError, Wire, finite, v1};
use std::collections::BTreeMap;

/// Poses and weights in one boundary.
const MAX_BOUNDARY: usize = 65_536;

/// Who takes part in a solve, in the order of their numbers, and whose frame is the map's.
pub struct Team {
    agents: Vec<AgentId>,
    /// Equal for all that were told the same.
    pub digest: [u8; 32],
}

impl Team {
    /// All that take part, in any order.
    pub fn new(mut agents: Vec<AgentId>, gauge: &SubmapId) -> Self {
        agents.sort();
        let mut hasher = blake3::Hasher::new();
        hasher.update(gauge.to_string().as_bytes());
        for agent in &agents {
            hasher.update(b"\n");
            hasher.update(agent.as_str().as_bytes());
        }
        Team { agents, digest: *hasher.finalize().as_bytes() }
    }

    /// By number.
    pub fn agents(&self) -> &[AgentId] {
        &self.agents
    }

    /// The number of an agent.
    pub fn number(&self, agent: &AgentId) -> Option<BlockId> {
        self.agents.binary_search(agent).ok().map(|k| k as BlockId)
    }

    /// The name of a block; empty for a number that nobody has.
    pub fn name(&self, block: BlockId) -> String {
        self.agents.get(block as usize).map_or_else(String::new, Wire::to_wire)
    }

    pub(super) fn read(&self, name: String, at: &At<'_>) -> Result<BlockId, FieldError> {
        let agent = AgentId::from_wire(name, at)?;
        self.number(&agent).ok_or_else(|| at.refuse(format!("{agent} takes no part in this solve")))
    }

    pub(super) fn read_all(&self, names: Vec<String>, at: &At<'_>) -> Result<Vec<BlockId>, FieldError> {
        at.at_most(names.len(), self.agents.len(), "agents")?;
        names.into_iter().enumerate().map(|(k, name)| self.read(name, &at.index(k))).collect()
    }

    /// Writes what a block says of itself.
    pub fn standing(&self, s: &Standing) -> v1::Standing {
        let agent_id = self.name(s.block);
        let Standing { edition, changes, still, confirmed, .. } = *s;
        v1::Standing { agent_id, edition, changes, still, confirmed }
    }

    /// Reads what blocks say of themselves.
    pub fn read_standings(
        &self,
        standings: Vec<v1::Standing>,
        at: &At<'_>,
    ) -> Result<Vec<Standing>, FieldError> {
        at.at_most(standings.len(), self.agents.len(), "standings")?;
        let read = |(k, s): (usize, v1::Standing)| {
            let block = self.read(s.agent_id, &at.index(k).field("agent_id"))?;
            Ok(Standing {
                block,
                edition: s.edition,
                changes: s.changes,
                still: s.still,
                confirmed: s.confirmed,
            })
        };
        standings.into_iter().enumerate().map(read).collect()
    }
}

/// The names of one block's nodes and loops.
pub struct Names {
    submaps: Vec<SubmapId>,
    keys: Vec<EdgeKey>,
    loops: BTreeMap<EdgeKey, u32>,
}

impl Names {
    /// Those of a block.
    pub fn new(own: &OwnBlock) -> Self {
        let loops = own.edges.iter().enumerate().filter(|(_, e)| e.kind == EdgeKind::Loop);
        Names {
            submaps: own.submaps.clone(),
            keys: own.edges.iter().map(|e| e.key.clone()).collect(),
            loops: loops.map(|(k, e)| (e.key.clone(), k as u32)).collect(),
        }
    }

    /// Writes a boundary.
    pub fn boundary(&self, b: &Boundary, team: &Team) -> v1::Boundary {
        let pose = |(node, pose): &(NodeId, Pose)| {
            Some(v1::SubmapPose {
                submap_id: Some(self.submaps.get(*node as usize)?.to_wire()),
                map_from_submap: Some(pose.to_wire()),
            })
        };
        let weight = |(index, weight): &(u32, f64)| {
            let verdict = crate::answer::entry_key(self.keys.get(*index as usize)?);
            Some(v1::BoundaryWeight { verdict: Some(verdict), weight: *weight })
        };
        v1::Boundary {
            sequence: b.sequence,
            heard: b.heard,
            poses: b.poses.iter().filter_map(pose).collect(),
            weights: b.weights.iter().filter_map(weight).collect(),
            ..rounds::written(&b.coarse, team)
        }
    }

    /// Reads a boundary. Submaps and loops that this block does not know are left out: the sender may know more.
    pub fn read_boundary(
        &self,
        from: BlockId,
        mut m: v1::Boundary,
        team: &Team,
        at: &At<'_>,
    ) -> Result<Boundary, FieldError> {
        let coarse = rounds::read(&mut m, team, at)?;
        let poses_at = at.field("poses");
        poses_at.at_most(m.poses.len(), MAX_BOUNDARY, "poses")?;
        let mut poses = Vec::new();
        for (k, p) in m.poses.into_iter().enumerate() {
            let at = poses_at.index(k);
            let submap: SubmapId = at.field("submap_id").required(p.submap_id)?;
            let pose: Pose = at.field("map_from_submap").required(p.map_from_submap)?;
            if let Ok(node) = self.submaps.binary_search(&submap) {
                poses.push((node as NodeId, pose));
            }
        }
        let weights_at = at.field("weights");
        weights_at.at_most(m.weights.len(), MAX_BOUNDARY, "weights")?;
        let mut weights = Vec::new();
        for (k, w) in m.weights.into_iter().enumerate() {
            let at = weights_at.index(k);
            let verdict: EntryKey = at.field("verdict").required(w.verdict)?;
            let weight = finite(w.weight, &at.field("weight"))?;
            if !(0.0..=1.0).contains(&weight) {
                return Err(at.field("weight").refuse(format!("{weight} is not within 0 and 1")));
            }
            weights.extend(self.loops.get(&crate::facts::edge_key(&verdict)).map(|index| (*index, weight)));
        }
        Ok(Boundary { from, sequence: m.sequence, heard: m.heard, poses, weights, coarse })
    }
}
