//! Where cameras were.

use super::Gateway;
use crate::agents::{Link, failed};
use crate::ask::{Asked, agent_id};
use crate::error::{ApiError, Problem};
use crate::json::{FramePose, TrackingState, Unreachable};
use axum::Json;
use axum::extract::{Path, State};
use axum::http::header;
use axum::response::{IntoResponse, Response};
use coma_geometry::{StampNs, tum};
use coma_wire::At;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::sync::Arc;
use utoipa::{IntoParams, ToSchema};

/// Which poses.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
pub struct TrajectoriesQuery {
    /// Only this agent's.
    pub agent: Option<String>,
    /// Only poses from this sequence on.
    pub first_sequence: u64,
}

/// Trajectories of all agents that answer.
#[derive(Debug, Serialize, ToSchema)]
pub struct Trajectories {
    /// By agent.
    pub trajectories: Vec<Trajectory>,
    /// Agents that have no part in this.
    pub unreachable: Vec<Unreachable>,
}

/// One agent's trajectory.
#[derive(Debug, Serialize, ToSchema)]
pub struct Trajectory {
    /// Whose.
    pub agent: String,
    /// In the order of the frames.
    pub poses: Vec<FramePose>,
}

/// Every pose of every agent, or of one.
#[utoipa::path(get, path = "/api/v1/trajectories", tag = "trajectories", params(TrajectoriesQuery), security(("token" = [])),
    responses((status = 200, description = "The trajectories", body = Trajectories),
              (status = 400, description = "A bad parameter", body = Problem),
              (status = 404, description = "No such agent", body = Problem)))]
pub async fn trajectories(
    State(gateway): State<Arc<Gateway>>,
    Asked(query): Asked<TrajectoriesQuery>,
) -> Result<Json<Trajectories>, ApiError> {
    let (first, limit) = (query.first_sequence, gateway.config.max_poses);
    if let Some(agent) = query.agent {
        let agent = agent_id("agent", &agent)?;
        let link = gateway.directory.agent("agent", &agent)?;
        let poses = link.trajectory(first, limit).await.map_err(|e| failed(&agent, &e))?;
        let trajectories = vec![Trajectory { agent: agent.to_string(), poses }];
        return Ok(Json(Trajectories { trajectories, unreachable: Vec::new() }));
    }
    let whole = gateway.directory.ask(async |link: Arc<Link>| link.trajectory(first, limit).await).await;
    let trajectories =
        whole.answers.into_iter().map(|(agent, poses)| Trajectory { agent: agent.to_string(), poses });
    Ok(Json(Trajectories { trajectories: trajectories.collect(), unreachable: whole.unreachable }))
}

/// One agent's trajectory in the TUM format: `stamp tx ty tz qx qy qz qw` a line, `map_from_camera`, stamps exact to
/// the nanosecond. A lost frame has no line. Lines are of one map, the one with most of the frames; a comment
/// names it and says how many frames lie in others.
#[utoipa::path(get, path = "/api/v1/agents/{agent}/trajectory.tum", tag = "trajectories", security(("token" = [])),
    params(("agent" = String, Path, description = "The agent's name")),
    responses((status = 200, description = "The trajectory", body = String, content_type = "text/plain"),
              (status = 404, description = "No such agent", body = Problem),
              (status = 502, description = "The agent does not answer", body = Problem)))]
pub async fn tum(
    State(gateway): State<Arc<Gateway>>,
    Path(agent): Path<String>,
) -> Result<Response, ApiError> {
    let agent = agent_id("agent", &agent)?;
    let link = gateway.directory.agent("agent", &agent)?;
    let poses = link.trajectory(0, gateway.config.max_poses).await.map_err(|e| failed(&agent, &e))?;
    let text = tum_text(agent.as_str(), &poses)?;
    Ok(([(header::CONTENT_TYPE, "text/plain; charset=utf-8")], text).into_response())
}

fn tum_text(agent: &str, poses: &[FramePose]) -> Result<String, ApiError> {
    let tracked = || poses.iter().filter(|p| p.state != TrackingState::Lost && p.map_from_camera.is_some());
    let mut by_map: BTreeMap<Option<&str>, usize> = BTreeMap::new();
    tracked().for_each(|pose| *by_map.entry(pose.map.as_deref()).or_default() += 1);
    let all: usize = by_map.values().sum();
    let (map, lines) = by_map.into_iter().max_by_key(|(_, frames)| *frames).unwrap_or((None, 0));
    let mut text = String::new();
    // Writing to a string can't fail.
    let _ = match map {
        Some(map) => writeln!(text, "# agent {agent}, map {map}"),
        None => writeln!(text, "# agent {agent}, in its own frame: no result of the graph places it yet"),
    };
    if lines < all {
        let _ = writeln!(text, "# {} more frames lie in other maps", all - lines);
    }
    let stamped = tracked().filter(|pose| pose.map.as_deref() == map).filter_map(|pose| {
        let map_from_camera = pose.map_from_camera?.read(&At::Root("map_from_camera"));
        Some(map_from_camera.map(|pose_in_map| (tum::stamp_text(StampNs(pose.stamp_ns)), pose_in_map)))
    });
    let stamped: Vec<(String, coma_geometry::Pose)> =
        stamped.collect::<Result<_, _>>().map_err(|e| ApiError::agent(e.to_string()))?;
    text.push_str(&tum::format(stamped.iter().map(|(stamp, pose)| (stamp.as_str(), pose))));
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::json::Pose;

    fn pose(stamp_ns: i64, map: Option<&str>, state: TrackingState) -> FramePose {
        let at: Pose = (&coma_geometry::Pose::translation(1.0, 2.0, 3.0)).into();
        FramePose {
            stamp_ns,
            sequence: 0,
            submap: "a/1/s0".into(),
            submap_from_camera: at,
            agent_from_camera: at,
            map_from_camera: Some(at),
            map: map.map(str::to_owned),
            state,
            reasons: Vec::new(),
        }
    }

    #[test]
    fn stamps_are_exact_lost_frames_have_no_line_and_maps_are_not_mixed() {
        use TrackingState::{Degraded, Lost, Tracking};
        let poses = [
            pose(1_305_031_102_175_304_000, Some("a/1"), Tracking),
            pose(1_305_031_102_275_304_001, Some("a/1"), Degraded),
            pose(1_305_031_102_375_304_001, Some("a/1"), Lost),
            pose(1_305_031_102_475_304_001, Some("b/1"), Tracking),
        ];
        let text = tum_text("a", &poses).unwrap();
        let lines: Vec<&str> = text.lines().collect();
        assert!(lines[0].contains("map a/1") && lines[1].contains("1 more"), "{text}");
        let read = tum::parse(&text).unwrap();
        let stamps: Vec<&str> = read.iter().map(|p| p.stamp_text.as_str()).collect();
        assert_eq!(stamps, ["1305031102.175304000", "1305031102.275304001"]);
        assert_eq!(read[0].pose.translation.vector.z, 3.0);
        assert!(tum_text("a", &[]).unwrap().starts_with("# agent a, in its own frame"));
    }
}
