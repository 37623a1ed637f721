//! What the agent knows, as messages of the contract.

use crate::knowledge::{Knowledge, TrajectoryPose};
use coma_geometry::{MapId, SubmapId};
use coma_slam::loop_closure::corrections::{Correction, Generation};
use coma_slam::tracking::State;
use coma_wire::{At, FieldError, Wire, v1};
use std::collections::BTreeMap;

/// Name of a tracking state.
pub fn state(state: &State) -> v1::TrackingState {
    match state {
        State::Tracking => v1::TrackingState::Tracking,
        State::Degraded(_) => v1::TrackingState::Degraded,
        State::Lost(_) => v1::TrackingState::Lost,
    }
}

/// Why the state is not `Tracking`.
pub fn reasons(state: &State) -> Vec<String> {
    match state {
        State::Tracking => Vec::new(),
        State::Degraded(reasons) | State::Lost(reasons) => reasons.iter().map(|r| r.to_string()).collect(),
    }
}

/// A generation's message.
pub fn generation(g: &Generation) -> v1::Generation {
    v1::Generation {
        map_id: Some(g.map_id.to_wire()),
        cut: Some(g.cut.to_wire()),
        digest: g.digest.to_vec().into(),
    }
}

/// A pose in every frame of reference that a client may ask for.
pub fn pose_estimate(knowledge: &Knowledge, entry: &TrajectoryPose) -> v1::PoseEstimate {
    let pose = &entry.pose;
    let facts = knowledge.closer.submap(&pose.submap);
    let placed = facts.map(|facts| knowledge.place(&facts.opened));
    let map_from_camera = placed.as_ref().map(|p| p.map_from_submap * pose.submap_from_camera);
    v1::PoseEstimate {
        stamp_ns: pose.stamp.0,
        sequence: pose.sequence,
        submap_id: Some(pose.submap.to_wire()),
        submap_from_camera: Some(pose.submap_from_camera.to_wire()),
        agent_from_camera: Some(pose.agent_from_camera.to_wire()),
        map_from_camera: map_from_camera.map(|p| p.to_wire()),
        generation: placed.and_then(|p| p.generation.map(generation)),
        covariance: Some(pose.covariance.to_wire()),
        state: state(&entry.state).into(),
        reasons: reasons(&entry.state),
    }
}

/// One of this agent's submaps, without surfels.
pub fn submap_info(knowledge: &Knowledge, id: &SubmapId) -> Option<v1::SubmapInfo> {
    let own = knowledge.submaps.get(id)?;
    let facts = knowledge.closer.submap(id)?;
    let placed = knowledge.place(&facts.opened);
    let map_id = match placed.generation {
        Some(generation) => generation.map_id.clone(),
        None => MapId { agent: knowledge.agent.clone(), epoch: knowledge.epoch, first_submap: 0 },
    };
    Some(v1::SubmapInfo {
        id: Some(id.to_wire()),
        surfels: own.surfels,
        closed: own.blob.is_some(),
        revision: own.revision,
        agent_from_submap: Some(facts.opened.agent_from_submap.to_wire()),
        map_from_submap: Some(placed.map_from_submap.to_wire()),
        map_id: Some(map_id.to_wire()),
    })
}

/// Reads a component of a solve.
pub fn correction(component: v1::Component, at: &At<'_>) -> Result<Correction, FieldError> {
    let at_generation = at.field("generation");
    let g = component.generation.ok_or_else(|| at_generation.refuse("is missing"))?;
    let generation = Generation {
        map_id: at_generation.field("map_id").required(g.map_id)?,
        cut: coma_wire::version_vector(g.cut, &at_generation.field("cut"))?,
        digest: coma_wire::hash(&g.digest, &at_generation.field("digest"))?,
    };
    let at_poses = at.field("poses");
    let mut map_from_submap = BTreeMap::new();
    for (i, pose) in component.poses.into_iter().enumerate() {
        let at = at_poses.index(i);
        let id: SubmapId = at.field("submap_id").required(pose.submap_id)?;
        map_from_submap.insert(id, at.field("map_from_submap").required(pose.map_from_submap)?);
    }
    Ok(Correction { generation, map_from_submap })
}
