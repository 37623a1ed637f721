//! What an agent knows, in one place: its own poses and submaps, everybody's logs, and where the newest solve
//! puts every submap. Services read it, tasks change it, nobody holds it across an await.

use crate::journal::{Checkpoint, Journal};
use coma_geometry::{AgentId, Epoch, SubmapId};
use coma_slam::agent::FramePose;
use coma_slam::log::{Entry, EntryKey, Offered, Payload, Replica, SubmapOpened, VersionVector};
use coma_slam::loop_closure::LoopCloser;
use coma_slam::loop_closure::corrections::{Corrections, Placed};
use coma_slam::tracking::State;
use coma_store::BlobName;
use coma_surfel::SurfelCloud;
use coma_wire::v1;
use std::collections::BTreeMap;
use std::sync::Arc;
use tracing::{error, warn};

/// One of this agent's submaps.
#[derive(Clone, Debug)]
pub struct OwnSubmap {
    /// Grows whenever surfels change.
    pub revision: u64,
    /// Number of surfels.
    pub surfels: u64,
    /// Where the finished surfels are kept; none while frames are still added.
    pub blob: Option<BlobName>,
}

/// One frame's place in the trajectory.
#[derive(Clone, Debug)]
pub struct TrajectoryPose {
    /// The pose.
    pub pose: FramePose,
    /// How well it is known.
    pub state: State,
}

/// A peer as it was last heard of.
#[derive(Clone, Debug, Default)]
pub struct PeerState {
    /// Its name, once it said Hello.
    pub agent: Option<AgentId>,
    /// The last call succeeded.
    pub alive: bool,
    /// Why not.
    pub last_error: String,
    /// What it had.
    pub heads: VersionVector,
}

/// See the module.
pub struct Knowledge {
    /// This agent.
    pub agent: AgentId,
    /// Its life.
    pub epoch: Epoch,
    /// Its disk.
    pub journal: Journal,
    /// Everybody's logs.
    pub replica: Replica,
    /// What the logs say of places and loops.
    pub closer: LoopCloser,
    /// Where submaps lie.
    pub corrections: Corrections,
    /// The last solve's components and what did not join, as they came.
    pub solved: v1::SolveResponse,
    /// The components that this agent's own solver made, for peers; served are those in `solved`, which may be adopted.
    pub own_results: Vec<v1::Component>,
    /// Own poses in order.
    pub trajectory: Vec<TrajectoryPose>,
    /// Own submaps.
    pub submaps: BTreeMap<SubmapId, OwnSubmap>,
    /// The submap under work, for viewers.
    pub active: Option<(SubmapId, Arc<SurfelCloud>)>,
    /// Of the newest frame.
    pub state: State,
    /// Frames taken, over all sessions.
    pub frames: u64,
    /// Frames dropped by policy `latest`.
    pub dropped: u64,
    /// Wall seconds by stage.
    pub stage_seconds: BTreeMap<String, f64>,
    /// By endpoint.
    pub peers: BTreeMap<String, PeerState>,
    /// What users should know.
    pub warnings: Vec<String>,
    /// Which encoders describe places.
    pub encoder: String,
    /// By session: frames up to here survive kill -9.
    durable: BTreeMap<String, u64>,
    /// Entries whose payload this build can't read.
    unreadable: u64,
}

impl Knowledge {
    /// What is known when the agent starts; entries and checkpoints are given by [`Knowledge::restore`].
    pub fn new(agent: AgentId, epoch: Epoch, journal: Journal, closer: LoopCloser) -> Self {
        Knowledge {
            agent,
            epoch,
            journal,
            replica: Replica::default(),
            closer,
            corrections: Corrections::default(),
            solved: v1::SolveResponse::default(),
            own_results: Vec::new(),
            trajectory: Vec::new(),
            submaps: BTreeMap::new(),
            active: None,
            state: State::Tracking,
            frames: 0,
            dropped: 0,
            stage_seconds: BTreeMap::new(),
            peers: BTreeMap::new(),
            warnings: Vec::new(),
            encoder: String::new(),
            durable: BTreeMap::new(),
            unreadable: 0,
        }
    }

    /// Takes what an earlier life left on the disk.
    pub fn restore(&mut self, entries: Vec<Entry>, checkpoints: &[Checkpoint]) {
        for entry in entries {
            self.learn(entry);
        }
        for checkpoint in checkpoints {
            self.frames = checkpoint.frames;
            self.durable.insert(checkpoint.session.clone(), checkpoint.through);
            let poses = checkpoint.poses.iter().cloned();
            self.trajectory.extend(poses.map(|pose| TrajectoryPose { pose, state: State::Tracking }));
            if let Some((id, blob, surfels)) = &checkpoint.submap {
                let submap = OwnSubmap { revision: u64::MAX, surfels: *surfels, blob: Some(*blob) };
                self.submaps.insert(id.clone(), submap);
            }
        }
    }

    /// Writes an entry of this agent: to disk first, then to the replica.
    pub fn write(&mut self, payload: &Payload) -> anyhow::Result<EntryKey> {
        let sequence = self.replica.heads().get(&(self.agent.clone(), self.epoch)).copied().unwrap_or(0);
        let entry = Entry {
            key: EntryKey { agent: self.agent.clone(), epoch: self.epoch, sequence },
            previous_hash: self.replica.head_hash(&self.agent, self.epoch),
            payload: coma_wire::encode_payload(payload),
            signature: Vec::new(),
        };
        self.journal.append_entries(std::slice::from_ref(&entry))?;
        let key = entry.key.clone();
        self.learn(entry);
        Ok(key)
    }

    /// Takes entries that a peer sent; those that are new go to disk first. Returns how many were new.
    pub fn take(&mut self, entries: Vec<Entry>) -> anyhow::Result<usize> {
        let mut trial = self.replica.heads();
        let mut new = Vec::new();
        for entry in entries {
            let length = trial.entry((entry.key.agent.clone(), entry.key.epoch)).or_insert(0);
            if entry.key.sequence == *length {
                *length += 1;
                new.push(entry);
            } else if entry.key.sequence < *length {
                // Known, or another entry under a known key: the replica tells.
                self.learn(entry);
            }
        }
        self.journal.append_entries(&new)?;
        let count = new.len();
        new.into_iter().for_each(|entry| self.learn(entry));
        Ok(count)
    }

    fn learn(&mut self, entry: Entry) {
        let key = entry.key.clone();
        let payload = entry.payload.clone();
        match self.replica.offer(entry) {
            Offered::Taken => match coma_wire::decode_payload(&payload) {
                Ok(payload) => self.closer.on_entry(&key, &payload),
                Err(e) => {
                    self.unreadable += 1;
                    warn!(agent = %key.agent, sequence = key.sequence, error = %e, "an entry was kept but can't be read by this build");
                }
            },
            Offered::Known => {}
            Offered::Gap { have } => {
                warn!(agent = %key.agent, sequence = key.sequence, have, "an entry came before its time")
            }
            Offered::Conflict { key } => {
                let text = format!(
                    "two different entries under {}/{}/{}: neither is used, nor what follows",
                    key.agent, key.epoch.0, key.sequence
                );
                error!("{text}");
                self.warn_once(text);
            }
        }
    }

    /// Users are told something, once.
    pub fn warn_once(&mut self, text: String) {
        if !self.warnings.contains(&text) {
            self.warnings.push(text);
        }
    }

    /// Up to where a session's frames survive kill -9.
    pub fn durable_of(&self, session: &str) -> Option<u64> {
        self.durable.get(session).copied()
    }

    /// A session's frames up to here survive kill -9.
    pub fn set_durable(&mut self, session: String, through: u64) {
        self.durable.insert(session, through);
    }

    /// The newest result that places this agent's submaps.
    pub fn own_generation(&self) -> Option<&coma_slam::loop_closure::corrections::Generation> {
        let own = |c: &&coma_slam::loop_closure::corrections::Correction| {
            c.map_from_submap.keys().any(|id| id.agent == self.agent && id.epoch == self.epoch)
        };
        self.corrections
            .components()
            .iter()
            .filter(own)
            .max_by_key(|c| c.map_from_submap.len())
            .map(|c| &c.generation)
    }

    /// Where a submap lies in the map.
    pub fn place(&self, opened: &SubmapOpened) -> Placed<'_> {
        self.corrections.place(opened, |id| self.closer.submap(id).map(|facts| facts.opened.clone()))
    }
}
