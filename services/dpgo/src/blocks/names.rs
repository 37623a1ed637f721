//! Names and numbers: agents, submaps and loops have names on the wire and numbers in a block.

use coma_geometry::{AgentId, Matrix6, Pose, SubmapId, Tangent};
use coma_pose_graph::blocks::coarse::{Link, Summary};
use coma_pose_graph::blocks::{BlockId, Boundary, NodeId, OwnBlock, Standing};
use coma_pose_graph::{EdgeKey, EdgeKind};
use coma_wire::entries::EntryKey;
use coma_wire::{At, FieldError, Wire, finite, v1};
use std::collections::BTreeMap;

/// Poses and weights in one boundary.
const MAX_BOUNDARY: usize = 65_536;
/// Largest gradient and squared error.
const MOST: f64 = 1e30;

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

    fn read(&self, name: String, at: &At<'_>) -> Result<BlockId, FieldError> {
        let agent = AgentId::from_wire(name, at)?;
        self.number(&agent).ok_or_else(|| at.refuse(format!("{agent} takes no part in this solve")))
    }

    fn read_all(&self, names: Vec<String>, at: &At<'_>) -> Result<Vec<BlockId>, FieldError> {
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

    fn summary(&self, s: &Summary) -> v1::BlockSummary {
        let link = |l: &Link| v1::BlockLink {
            other: self.name(l.other),
            gradient: l.gradient.iter().copied().collect(),
            hessian: Some(l.hessian.to_wire()),
        };
        v1::BlockSummary {
            agent_id: self.name(s.block),
            held: s.held,
            neighbours: s.neighbours.iter().map(|n| self.name(*n)).collect(),
            links: s.links.iter().map(link).collect(),
            largest_squared_error: s.largest_squared,
        }
    }

    fn read_summary(&self, m: v1::BlockSummary, at: &At<'_>) -> Result<Summary, FieldError> {
        let links_at = at.field("links");
        links_at.at_most(m.links.len(), self.agents.len(), "links")?;
        let read_link = |(k, l): (usize, v1::BlockLink)| {
            let at = links_at.index(k);
            let gradient_at = at.field("gradient");
            if l.gradient.len() != 6 {
                return Err(gradient_at.refuse(format!("{} numbers, 6 are needed", l.gradient.len())));
            }
            for (k, value) in l.gradient.iter().enumerate() {
                within(*value, &gradient_at.index(k))?;
            }
            let hessian: Matrix6 = at.field("hessian").required(l.hessian)?;
            let gradient = Tangent::from_column_slice(&l.gradient);
            Ok(Link { other: self.read(l.other, &at.field("other"))?, gradient, hessian })
        };
        Ok(Summary {
            block: self.read(m.agent_id, &at.field("agent_id"))?,
            held: m.held,
            neighbours: self.read_all(m.neighbours, &at.field("neighbours"))?,
            links: m.links.into_iter().enumerate().map(read_link).collect::<Result<_, _>>()?,
            largest_squared: within(m.largest_squared_error, &at.field("largest_squared_error"))?,
        })
    }
}

fn within(value: f64, at: &At<'_>) -> Result<f64, FieldError> {
    if value.abs() <= MOST {
        Ok(value)
    } else {
        Err(at.refuse(format!("{value} is not finite or over 1e30")))
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
            round: b.round,
            have: b.have.iter().map(|block| team.name(*block)).collect(),
            towards: b.towards,
            summaries: b.summaries.iter().map(|s| team.summary(s)).collect(),
        }
    }

    /// Reads a boundary. Submaps and loops that this block does not know are left out: the sender may know more.
    pub fn read_boundary(
        &self,
        from: BlockId,
        m: v1::Boundary,
        team: &Team,
        at: &At<'_>,
    ) -> Result<Boundary, FieldError> {
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
        let summaries_at = at.field("summaries");
        summaries_at.at_most(m.summaries.len(), team.agents.len(), "summaries")?;
        let summaries = m.summaries.into_iter().enumerate();
        Ok(Boundary {
            from,
            sequence: m.sequence,
            heard: m.heard,
            poses,
            weights,
            round: m.round,
            have: team.read_all(m.have, &at.field("have"))?,
            towards: m.towards,
            summaries: summaries
                .map(|(k, s)| team.read_summary(s, &summaries_at.index(k)))
                .collect::<Result<_, _>>()?,
        })
    }
}
