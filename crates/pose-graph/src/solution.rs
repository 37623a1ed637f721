//! What a solve gives: components, each with a frame, poses, and what became of every loop.

use crate::graph::{Cut, Edge, EdgeKey, EntryName, EntryProblem};
use crate::relative::NotJoined;
use coma_geometry::{AgentId, MapId, Pose, SubmapId};
use std::collections::{BTreeMap, BTreeSet};

/// The name of a published result.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Generation {
    /// Which map.
    pub map_id: MapId,
    /// From which entries.
    pub cut: Cut,
    /// [`Component::digest`].
    pub digest: [u8; 32],
}

/// What became of a loop.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum LoopVerdict {
    /// It has a weight of at least one half in the solution.
    #[error("used")]
    Used,
    /// It contradicts the largest set of loops between the same two chains that agree.
    #[error("contradicts the loops between the same two agents that agree with each other")]
    Inconsistent,
    /// It does not fit the solution.
    #[error("squared error {squared_error:.1} against the solution, at most {limit:.1} is believed")]
    LargeResidual {
        /// Squared Mahalanobis error.
        squared_error: f64,
        /// The most that is believed.
        limit: f64,
    },
    /// Its ends are in different components.
    #[error("waiting: {0}")]
    Waiting(NotJoined),
    /// The solve failed; nothing can be said.
    #[error("not weighed: the solve failed")]
    NotWeighed,
}

/// A loop's part in the solution.
#[derive(Clone, Debug, PartialEq)]
pub struct LoopWeight {
    /// Its log entry.
    pub key: EdgeKey,
    /// Submap i.
    pub from: SubmapId,
    /// Submap j.
    pub to: SubmapId,
    /// 0 to 1.
    pub weight: f64,
    /// Squared Mahalanobis error (6 degrees of freedom) at the solution; NaN where there is none.
    pub squared_error: f64,
    /// What became of it.
    pub verdict: LoopVerdict,
}

impl LoopWeight {
    /// Says what became of a loop; `contradicts` if it contradicts those that joined its chains; `limit` is the largest
    /// squared error that is believed.
    pub(crate) fn judged(
        edge: &Edge,
        weight: f64,
        squared_error: f64,
        contradicts: bool,
        limit: f64,
    ) -> LoopWeight {
        let verdict = if weight >= 0.5 {
            LoopVerdict::Used
        } else if contradicts {
            LoopVerdict::Inconsistent
        } else {
            LoopVerdict::LargeResidual { squared_error, limit }
        };
        LoopWeight {
            key: edge.key.clone(),
            from: edge.from.clone(),
            to: edge.to.clone(),
            weight,
            squared_error,
            verdict,
        }
    }
}

/// Submaps that share a frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Component {
    /// Its name.
    pub map_id: MapId,
    /// The submap whose frame is the map's.
    pub gauge: SubmapId,
    /// The agents with a submap in it.
    pub agents: BTreeSet<AgentId>,
    /// Every submap's pose.
    pub map_from_submap: BTreeMap<SubmapId, Pose>,
    /// Those that were appended by composing odometry rather than solved for.
    pub composed: BTreeSet<SubmapId>,
    /// Half the weighted sum of squared Mahalanobis errors.
    pub cost: f64,
    /// The same at the start, with all loops at full weight that were not known to contradict others.
    pub initial_cost: f64,
    /// Linear solves.
    pub iterations: u32,
    /// False if an iteration limit ended the solve, or it failed.
    pub converged: bool,
    /// Why the solve failed, if it did; poses are those of the start then.
    pub failure: Option<String>,
    /// The loops within, by key.
    pub loops: Vec<LoopWeight>,
    /// BLAKE3 over the solved poses rounded to 0.1 mm and 0.01 mrad, and the map id.
    pub digest: [u8; 32],
}

impl Component {
    /// `map_from_old_map` of a map that has become part of this one. `None` if it has not.
    pub fn map_from_old_map(&self, old: &MapId) -> Option<Pose> {
        self.map_from_submap.get(&old.gauge()).copied()
    }
}

/// What was found between two chains with loops between them.
#[derive(Clone, Debug, PartialEq)]
pub struct PairReport {
    /// First submap of the one chain.
    pub s: SubmapId,
    /// First submap of the other.
    pub t: SubmapId,
    /// The loops between them, by key.
    pub loops: Vec<EdgeKey>,
    /// Joined, or the reason why not.
    pub outcome: Result<PairJoin, NotJoined>,
}

/// Two chains that stand to each other well enough to share a map.
#[derive(Clone, Debug, PartialEq)]
pub struct PairJoin {
    /// T_st between the agents' own frames (eq. 12).
    pub agent_s_from_agent_t: Pose,
    /// T_st between the chains' first submaps.
    pub s_from_t: Pose,
    /// Loops that agree with each other and with it.
    pub consistent: Vec<EdgeKey>,
    /// The largest number of them that are independent of each other.
    pub independent: usize,
}

/// The result of a solve: a function of the set of entries and the settings.
#[derive(Clone, Debug, PartialEq)]
pub struct Solution {
    /// By map id.
    pub components: Vec<Component>,
    /// Every pair of chains with loops between them.
    pub pairs: Vec<PairReport>,
    /// Loops between different components, by key.
    pub waiting: Vec<LoopWeight>,
    /// Entries that were not used, with reasons.
    pub rejected: Vec<(EntryName, EntryProblem)>,
    /// From which entries.
    pub cut: Cut,
    /// BLAKE3 over the components' digests.
    pub digest: [u8; 32],
}

impl Solution {
    /// The component that holds a submap.
    pub fn component_of(&self, submap: &SubmapId) -> Option<&Component> {
        self.components.iter().find(|c| c.map_from_submap.contains_key(submap))
    }

    /// The name under which a component is published.
    pub fn generation(&self, component: &Component) -> Generation {
        Generation { map_id: component.map_id.clone(), cut: self.cut.clone(), digest: component.digest }
    }
}

/// Poses are told apart by steps of this many metres.
pub const DIGEST_STEP_M: f64 = 1e-4;
/// And of this many radians.
pub const DIGEST_STEP_RAD: f64 = 1e-5;

/// Digest of solved poses, by submap, rounded to [`DIGEST_STEP_M`] and [`DIGEST_STEP_RAD`].
pub fn pose_digest<'a>(
    map_id: &MapId,
    poses: impl IntoIterator<Item = (&'a SubmapId, &'a Pose)>,
) -> [u8; 32] {
    let mut hasher = blake3::Hasher::new();
    hash_submap(&mut hasher, &map_id.gauge());
    for (submap, pose) in poses {
        hash_submap(&mut hasher, submap);
        for metres in pose.translation.vector.iter() {
            hasher.update(&rounded(*metres, DIGEST_STEP_M).to_le_bytes());
        }
        // A rotation by d moves its quaternion by d / 2; q and -q are one rotation.
        let q = pose.rotation.quaternion();
        let mut steps = [q.w, q.i, q.j, q.k].map(|x| rounded(x, 0.5 * DIGEST_STEP_RAD));
        if steps.iter().find(|x| **x != 0).is_some_and(|x| *x < 0) {
            steps = steps.map(|x| -x);
        }
        for step in steps {
            hasher.update(&step.to_le_bytes());
        }
    }
    *hasher.finalize().as_bytes()
}

fn rounded(value: f64, step: f64) -> i64 {
    (value / step).round() as i64
}

fn hash_submap(hasher: &mut blake3::Hasher, submap: &SubmapId) {
    let name = submap.agent.as_str().as_bytes();
    hasher.update(&(name.len() as u64).to_le_bytes());
    hasher.update(name);
    hasher.update(&submap.epoch.0.to_le_bytes());
    hasher.update(&submap.number.to_le_bytes());
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_geometry::{Epoch, Tangent, se3};

    #[test]
    fn digests_ignore_rounding_and_the_quaternion_s_sign_but_see_a_millimetre() {
        let submap = SubmapId { agent: AgentId::new("a").unwrap(), epoch: Epoch(0), number: 0 };
        let map_id = MapId::of(&submap);
        let pose = se3::exp(&Tangent::new(1.00002, 2.00002, -3.00002, 0.1, 0.2, 0.3));
        let digest = |pose: &Pose| pose_digest(&map_id, [(&submap, pose)]);
        let mut flipped = pose;
        flipped.rotation = nalgebra::Unit::new_unchecked(-pose.rotation.into_inner());
        assert_eq!(digest(&pose), digest(&flipped));
        let mut nudged = pose;
        nudged.translation.vector.x += 1e-9;
        assert_eq!(digest(&pose), digest(&nudged));
        nudged.translation.vector.x += 1e-3;
        assert_ne!(digest(&pose), digest(&nudged));
    }
}
