//! The words of the JSON answers. Metres, radians, pixels; transforms name both ends. Numbers that need all 64
//! bits (stamps, revisions) are texts, because browsers read numbers as `f64`.

use coma_geometry::{AgentId, Epoch, MapId, SubmapId};
use coma_wire::{At, FieldError, Wire, v1};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use utoipa::ToSchema;

/// A rigid motion: rotate by the unit quaternion, then translate. `a_from_b` maps points of b to points of a.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Pose {
    /// Metres.
    pub tx_m: f64,
    /// Metres.
    pub ty_m: f64,
    /// Metres.
    pub tz_m: f64,
    /// Quaternion.
    pub qx: f64,
    /// Quaternion.
    pub qy: f64,
    /// Quaternion.
    pub qz: f64,
    /// Quaternion, the scalar.
    pub qw: f64,
}

impl Pose {
    /// Checked: finite, and of unit length within 1e-4.
    pub fn read(&self, at: &At<'_>) -> Result<coma_geometry::Pose, FieldError> {
        let Pose { tx_m, ty_m, tz_m, qx, qy, qz, qw } = *self;
        coma_geometry::Pose::from_wire(v1::Pose { tx_m, ty_m, tz_m, qx, qy, qz, qw }, at)
    }
}

impl From<&coma_geometry::Pose> for Pose {
    fn from(pose: &coma_geometry::Pose) -> Self {
        let v1::Pose { tx_m, ty_m, tz_m, qx, qy, qz, qw } = pose.to_wire();
        Pose { tx_m, ty_m, tz_m, qx, qy, qz, qw }
    }
}

/// An agent that has no part in an answer, and why.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct Unreachable {
    /// Its name, if it ever answered.
    pub id: Option<String>,
    /// Where it was looked for.
    pub endpoint: String,
    /// Why it has no part.
    pub error: String,
}

/// How well the camera is tracked.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum TrackingState {
    /// The agent did not say.
    Unknown,
    /// Well.
    Tracking,
    /// With reasons for doubt.
    Degraded,
    /// Not at all.
    Lost,
}

impl From<i32> for TrackingState {
    fn from(state: i32) -> Self {
        match v1::TrackingState::try_from(state) {
            Ok(v1::TrackingState::Tracking) => TrackingState::Tracking,
            Ok(v1::TrackingState::Degraded) => TrackingState::Degraded,
            Ok(v1::TrackingState::Lost) => TrackingState::Lost,
            Ok(v1::TrackingState::Unspecified) | Err(_) => TrackingState::Unknown,
        }
    }
}

/// Where the camera was when one frame was taken.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct FramePose {
    /// The frame's own sensor stamp in nanoseconds, as text.
    #[schema(value_type = String)]
    #[serde(serialize_with = "text")]
    pub stamp_ns: i64,
    /// Its number in the session.
    pub sequence: u64,
    /// The submap that it belongs to, `agent/epoch/s0`.
    pub submap: String,
    /// Does not change when the map is corrected.
    pub submap_from_camera: Pose,
    /// By odometry alone: never jumps within one tracking chain.
    pub agent_from_camera: Pose,
    /// Jumps when the map is corrected.
    pub map_from_camera: Option<Pose>,
    /// The map, `agent/epoch`, once a result of the graph says so.
    pub map: Option<String>,
    /// How well the camera is tracked.
    pub state: TrackingState,
    /// Why the state is not `tracking`.
    pub reasons: Vec<String>,
}

impl FramePose {
    /// Checked.
    pub fn read(m: v1::PoseEstimate, at: &At<'_>) -> Result<Self, FieldError> {
        let submap: SubmapId = at.field("submap_id").required(m.submap_id)?;
        let submap_from_camera: coma_geometry::Pose =
            at.field("submap_from_camera").required(m.submap_from_camera)?;
        let agent_from_camera: coma_geometry::Pose =
            at.field("agent_from_camera").required(m.agent_from_camera)?;
        let map_from_camera: Option<coma_geometry::Pose> =
            at.field("map_from_camera").optional(m.map_from_camera)?;
        let map = m.generation.and_then(|g| g.map_id);
        let map: Option<MapId> = at.field("generation.map_id").optional(map)?;
        Ok(FramePose {
            stamp_ns: m.stamp_ns,
            sequence: m.sequence,
            submap: submap.to_string(),
            submap_from_camera: (&submap_from_camera).into(),
            agent_from_camera: (&agent_from_camera).into(),
            map_from_camera: map_from_camera.as_ref().map(Pose::from),
            map: map.map(|map| map.to_string()),
            state: m.state.into(),
            reasons: m.reasons,
        })
    }
}

/// A submap and where it lies.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct Submap {
    /// `agent/epoch/s0`; its surfels are at `/api/v1/submaps/{id}/surfels`.
    pub id: String,
    /// Whose.
    pub agent: String,
    /// Number of surfels.
    pub surfels: u64,
    /// No more frames come to it.
    pub closed: bool,
    /// Grows whenever its surfels change. As text.
    #[schema(value_type = String)]
    #[serde(serialize_with = "text")]
    pub revision: u64,
    /// By odometry alone.
    pub agent_from_submap: Pose,
    /// Changes when the map is corrected; the surfels do not.
    pub map_from_submap: Pose,
    /// Which map, `agent/epoch`. Submaps with equal maps stand in one frame of reference.
    pub map: String,
}

/// A result of the graph: whose gauge, from which entries, and the digest of its poses.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct Generation {
    /// The map, `agent/epoch`.
    pub map: String,
    /// How many entries of each log, `agent/epoch`, went in.
    pub cut: BTreeMap<String, u64>,
    /// Hexadecimal.
    pub digest: String,
}

impl Generation {
    /// Checked.
    pub fn read(m: v1::Generation, at: &At<'_>) -> Result<Self, FieldError> {
        let map: MapId = at.field("map_id").required(m.map_id)?;
        let cut = coma_wire::version_vector(m.cut, &at.field("cut"))?;
        let digest = coma_wire::hash(&m.digest, &at.field("digest"))?;
        Ok(Generation {
            map: map.to_string(),
            cut: cut.iter().map(|(log, length)| (log_text(&log.0, log.1), *length)).collect(),
            digest: digest.iter().map(|byte| format!("{byte:02x}")).collect(),
        })
    }

    /// Entries that went in.
    pub fn entries(&self) -> u64 {
        self.cut.values().fold(0, |sum, length| sum.saturating_add(*length))
    }
}

/// A submap's place in a component.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct SubmapPose {
    /// `agent/epoch/s0`.
    pub id: String,
    /// Where it lies.
    pub map_from_submap: Pose,
}

/// Submaps that share a frame of reference, as the newest solve has them.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct Component {
    /// Which result.
    pub generation: Generation,
    /// Every submap.
    pub submaps: Vec<SubmapPose>,
    /// Half the weighted sum of squared Mahalanobis errors.
    pub cost: f64,
    /// Linear solves.
    pub iterations: u32,
}

impl Component {
    /// Checked.
    pub fn read(
        m: v1::Component,
        at: &At<'_>,
    ) -> Result<(Self, Vec<(SubmapId, coma_geometry::Pose)>), FieldError> {
        let at_generation = at.field("generation");
        let generation = m.generation.ok_or_else(|| at_generation.refuse("is missing"))?;
        let generation = Generation::read(generation, &at_generation)?;
        let at_poses = at.field("poses");
        let mut poses: Vec<(SubmapId, coma_geometry::Pose)> = Vec::with_capacity(m.poses.len());
        for (i, pose) in m.poses.into_iter().enumerate() {
            let at = at_poses.index(i);
            let id: SubmapId = at.field("submap_id").required(pose.submap_id)?;
            poses.push((id, at.field("map_from_submap").required(pose.map_from_submap)?));
        }
        let submaps =
            poses.iter().map(|(id, pose)| SubmapPose { id: id.to_string(), map_from_submap: pose.into() });
        let component =
            Component { generation, submaps: submaps.collect(), cost: m.cost, iterations: m.iterations };
        Ok((component, poses))
    }
}

/// The text of a log's name.
pub fn log_text(agent: &AgentId, epoch: Epoch) -> String {
    format!("{agent}/{}", epoch.0)
}

/// Numbers that need all 64 bits.
pub fn text<T: ToString, S: serde::Serializer>(value: &T, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(&value.to_string())
}
