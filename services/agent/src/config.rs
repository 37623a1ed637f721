//! Settings of an agent.

use coma_geometry::AgentId;
use coma_runtime::{ClientSettings, MembershipSettings, ServerSettings};
use coma_slam::agent::SlamSettings;
use coma_slam::loop_closure::LoopSettings;
use serde::Deserialize;
use std::path::PathBuf;

/// Settings of an agent; every one has a default, and `COMA_AGENT__NAME=value` overrides the file.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AgentConfig {
    /// Its name in the cluster. Without one the agent makes one and keeps it in its data folder.
    pub agent_id: Option<AgentId>,
    /// Agents of another cluster are refused.
    pub cluster_id: String,
    /// Where the log, evidence and submaps are kept.
    pub data: PathBuf,
    /// Where it serves.
    pub server: ServerSettings,
    /// How others reach it; by default the address that it is bound to.
    pub advertise: Option<String>,
    /// How it reaches others.
    pub client: ClientSettings,
    /// How it finds its peers.
    pub membership: MembershipSettings,
    /// Endpoints of peers that are always tried, e.g. `http://robot-2:7001`.
    pub peers: Vec<String>,
    /// The place-recognition service that it uses, e.g. `http://127.0.0.1:7011`.
    pub place_recognition: Option<String>,
    /// The dpgo service that it uses, e.g. `http://127.0.0.1:7021`.
    pub dpgo: Option<String>,
    /// Those two services run on another machine, perhaps another agent's: bytes to them count as between agents.
    pub shared_sidecars: bool,
    /// Finds peers by gossip; off where `peers` says all.
    pub gossip: bool,
    /// The agent with the smallest (anchor_priority, id) holds the map's gauge.
    pub anchor_priority: u32,
    /// Frames that wait at most; then `block` waits and `latest` drops.
    pub queue_frames: usize,
    /// Threads for tracking, mapping and registration; none: one per core.
    pub threads: Option<usize>,
    /// Seconds between pulls from each peer.
    pub pull_every_s: f64,
    /// Tracking and mapping.
    pub slam: SlamSettings,
    /// Loops.
    pub loops: LoopSettings,
    /// Geometric verification.
    pub registration: coma_registration::Settings,
}

impl Default for AgentConfig {
    fn default() -> Self {
        AgentConfig {
            agent_id: None,
            cluster_id: "coma".into(),
            data: PathBuf::from("coma-data"),
            server: ServerSettings { class: coma_runtime::Class::Client, ..ServerSettings::default() },
            advertise: None,
            client: ClientSettings::default(),
            membership: MembershipSettings::default(),
            peers: Vec::new(),
            place_recognition: None,
            dpgo: None,
            shared_sidecars: false,
            gossip: true,
            anchor_priority: 100,
            queue_frames: 8,
            threads: None,
            pull_every_s: 0.5,
            slam: SlamSettings::default(),
            loops: LoopSettings::default(),
            registration: coma_registration::Settings::default(),
        }
    }
}
