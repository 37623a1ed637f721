//! Who there is and how they fare.

use super::Gateway;
use crate::json::{Generation, TrackingState};
use axum::Json;
use axum::extract::State;
use coma_wire::{At, v1};
use serde::Serialize;
use std::collections::BTreeMap;
use std::sync::Arc;
use utoipa::ToSchema;

/// All agents that are known.
#[derive(Debug, Serialize, ToSchema)]
pub struct Agents {
    /// By name; those that never answered come last.
    pub agents: Vec<Agent>,
}

/// One agent.
#[derive(Debug, Serialize, ToSchema)]
pub struct Agent {
    /// Its name; absent if it never answered.
    pub id: Option<String>,
    /// Where it is called.
    pub endpoint: String,
    /// It answered the last time it was asked, at most a few seconds ago.
    pub reachable: bool,
    /// Why it is not reachable.
    pub error: Option<String>,
    /// What it last said of itself; old if it is not reachable now.
    pub status: Option<AgentStatus>,
}

/// What an agent says of itself.
#[derive(Debug, Serialize, ToSchema)]
pub struct AgentStatus {
    /// Which of its lives.
    pub epoch: u64,
    /// Its cluster.
    pub cluster: String,
    /// Its build.
    pub build: String,
    /// How well its camera is tracked.
    pub state: TrackingState,
    /// Frames tracked.
    pub frames_processed: u64,
    /// Frames that found the queue full.
    pub frames_dropped: u64,
    /// Its submaps.
    pub submaps: u32,
    /// Its surfels.
    pub surfels: u64,
    /// The result of the graph that places its submaps, once there is one.
    pub generation: Option<Generation>,
    /// Agents that it talks to.
    pub peers: Vec<Peer>,
    /// Wall seconds by stage.
    pub stage_seconds: BTreeMap<String, f64>,
    /// What it wrote to sockets.
    pub bytes_sent: Vec<BytesSent>,
    /// How it describes places.
    pub encoder: String,
    /// What users should know, one sentence each.
    pub warnings: Vec<String>,
}

/// A peer as an agent sees it.
#[derive(Debug, Serialize, ToSchema)]
pub struct Peer {
    /// Its name; absent if it never answered.
    pub id: Option<String>,
    /// Where it is called.
    pub endpoint: String,
    /// It answers.
    pub alive: bool,
    /// Why not.
    pub error: Option<String>,
}

/// Bytes of one kind.
#[derive(Debug, Serialize, ToSchema)]
pub struct BytesSent {
    /// `peer`, `local`, `client` or `gossip`.
    pub class: String,
    /// The message, or `framing`.
    pub message_type: String,
    /// Bytes.
    pub bytes: u64,
    /// Messages.
    pub messages: u64,
}

fn given(text: &str) -> Option<String> {
    (!text.is_empty()).then(|| text.to_owned())
}

impl From<&v1::GetStatusResponse> for AgentStatus {
    fn from(m: &v1::GetStatusResponse) -> Self {
        let peer = |p: &v1::PeerStatus| Peer {
            id: given(&p.agent_id),
            endpoint: p.endpoint.clone(),
            alive: p.alive,
            error: given(&p.last_error),
        };
        let sent = |b: &v1::ByteCount| BytesSent {
            class: b.class.clone(),
            message_type: b.message_type.clone(),
            bytes: b.bytes,
            messages: b.messages,
        };
        AgentStatus {
            epoch: m.epoch,
            cluster: m.cluster_id.clone(),
            build: m.build.clone(),
            state: m.state.into(),
            frames_processed: m.frames_processed,
            frames_dropped: m.frames_dropped,
            submaps: m.submaps,
            surfels: m.surfels,
            // One that can't be read is as none.
            generation: m.generation.clone().and_then(|g| Generation::read(g, &At::Root("generation")).ok()),
            peers: m.peers.iter().map(peer).collect(),
            stage_seconds: m.stage_seconds.iter().map(|(stage, s)| (stage.clone(), *s)).collect(),
            bytes_sent: m.bytes_sent.iter().map(sent).collect(),
            encoder: m.encoder.clone(),
            warnings: m.warnings.clone(),
        }
    }
}

/// All agents with what they last said. Answers at once: agents are asked in the background.
#[utoipa::path(get, path = "/api/v1/agents", tag = "agents", security(("token" = [])),
    responses((status = 200, description = "The agents", body = Agents)))]
pub async fn agents(State(gateway): State<Arc<Gateway>>) -> Json<Agents> {
    let agents = gateway.directory.agents().into_iter().map(|link| {
        let state = link.state();
        let not_asked = || (!state.asked).then(|| "not asked yet".to_owned());
        Agent {
            id: state.id.as_ref().map(ToString::to_string),
            endpoint: link.endpoint.clone(),
            reachable: state.reachable,
            error: given(&state.error).or_else(not_asked),
            status: state.status.as_deref().map(AgentStatus::from),
        }
    });
    Json(Agents { agents: agents.collect() })
}
