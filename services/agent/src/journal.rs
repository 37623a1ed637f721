//! What must survive kill -9: entries before they are served, and closed submaps with the poses of their
//! frames before they are acknowledged as durable.

use anyhow::Context;
use coma_geometry::{SubmapId, nalgebra::Matrix6};
use coma_slam::agent::FramePose;
use coma_slam::log::Entry;
use coma_slam::tracking::align::Brightness;
use coma_store::{AppendLog, BlobName, BlobSettings, Blobs, LogLimits};
use coma_surfel::SurfelCloud;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Surfels that a submap may hold when it is read back.
const MAX_SURFELS: usize = 20_000_000;

/// One pose as it is kept.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct KeptPose {
    sequence: u64,
    stamp: coma_geometry::StampNs,
    submap: SubmapId,
    submap_from_camera: coma_geometry::Pose,
    agent_from_camera: coma_geometry::Pose,
    covariance: Matrix6<f64>,
    gain: f64,
}

/// A closed submap and everything since the one before.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct KeptCheckpoint {
    session: String,
    through: u64,
    frames: u64,
    submap: Option<(SubmapId, [u8; 32], u64)>,
    poses: Vec<KeptPose>,
}

/// What a checkpoint says.
#[derive(Clone, Debug)]
pub struct Checkpoint {
    /// Session of the frames.
    pub session: String,
    /// Frames up to here are in it.
    pub through: u64,
    /// Frames taken over all sessions.
    pub frames: u64,
    /// The submap that closed: its name, its blob and its number of surfels.
    pub submap: Option<(SubmapId, BlobName, u64)>,
    /// Poses since the checkpoint before.
    pub poses: Vec<FramePose>,
}

/// The agent's disk.
pub struct Journal {
    entries: AppendLog,
    checkpoints: AppendLog,
    blobs: Blobs,
}

/// What was on the disk.
pub struct Restored {
    /// All entries, own and others', in the order they were taken.
    pub entries: Vec<Entry>,
    /// All checkpoints.
    pub checkpoints: Vec<Checkpoint>,
    /// What was cut or odd, one sentence each.
    pub notes: Vec<String>,
}

impl Journal {
    /// Opens an agent's data folder and reads what it holds.
    pub fn open(folder: &Path) -> anyhow::Result<(Journal, Restored)> {
        let entries = AppendLog::open(folder.join("log"), LogLimits::default())?;
        let checkpoints = AppendLog::open(folder.join("checkpoints"), LogLimits::default())?;
        let blobs = Blobs::open(folder.join("blobs"), BlobSettings::default())?;
        let mut notes = Vec::new();
        for (name, log) in [("log", &entries), ("checkpoints", &checkpoints)] {
            let cut = log.recovery().torn_bytes;
            if cut > 0 {
                notes.push(format!("{name}: {cut} bytes of an unfinished last record were cut off"));
            }
        }
        let mut restored = Restored { entries: Vec::new(), checkpoints: Vec::new(), notes };
        for record in entries.iter() {
            let bytes = record?.bytes;
            restored
                .entries
                .push(coma_wire::entry_from_bytes(&bytes).context("an entry of the log on disk")?);
        }
        for record in checkpoints.iter() {
            let kept: KeptCheckpoint =
                serde_json::from_slice(&record?.bytes).context("a checkpoint on disk")?;
            restored.checkpoints.push(kept.into());
        }
        Ok((Journal { entries, checkpoints, blobs }, restored))
    }

    /// Makes entries durable, all or none.
    pub fn append_entries(&mut self, entries: &[Entry]) -> anyhow::Result<()> {
        let records: Vec<Vec<u8>> = entries.iter().map(coma_wire::entry_to_bytes).collect();
        self.entries.append_batch(&records)?;
        Ok(())
    }

    /// Makes a closed submap and its frames durable.
    pub fn checkpoint(&mut self, checkpoint: &Checkpoint) -> anyhow::Result<()> {
        let record = serde_json::to_vec(&KeptCheckpoint::from(checkpoint))?;
        self.checkpoints.append(&record)?;
        Ok(())
    }

    /// Keeps a submap's surfels, packed.
    pub fn put_surfels(&mut self, surfels: &SurfelCloud) -> anyhow::Result<BlobName> {
        let name = self.blobs.put(&coma_surfel::pack::pack(surfels))?;
        self.blobs.pin(name);
        Ok(name)
    }

    /// A submap's packed surfels.
    pub fn packed_surfels(&mut self, name: &BlobName) -> anyhow::Result<Vec<u8>> {
        self.blobs.get(name)?.with_context(|| format!("submap blob {name} is missing"))
    }

    /// A submap's surfels.
    pub fn surfels(&mut self, name: &BlobName) -> anyhow::Result<SurfelCloud> {
        Ok(coma_surfel::pack::unpack(&self.packed_surfels(name)?, MAX_SURFELS)?)
    }

    /// Keeps evidence, own or fetched.
    pub fn put_evidence(&mut self, blob: &[u8], own: bool) -> anyhow::Result<()> {
        let name = self.blobs.put(blob)?;
        if own {
            self.blobs.pin(name);
        }
        Ok(())
    }

    /// Evidence by its hash, if it is here.
    pub fn evidence(&mut self, hash: &[u8; 32]) -> anyhow::Result<Option<Vec<u8>>> {
        Ok(self.blobs.get(&BlobName::from_bytes(*hash))?)
    }
}

impl From<&Checkpoint> for KeptCheckpoint {
    fn from(c: &Checkpoint) -> Self {
        let poses = c.poses.iter().map(|p| KeptPose {
            sequence: p.sequence,
            stamp: p.stamp,
            submap: p.submap.clone(),
            submap_from_camera: p.submap_from_camera,
            agent_from_camera: p.agent_from_camera,
            covariance: p.covariance,
            gain: p.brightness.gain,
        });
        KeptCheckpoint {
            session: c.session.clone(),
            through: c.through,
            frames: c.frames,
            submap: c.submap.as_ref().map(|(id, name, n)| (id.clone(), *name.as_bytes(), *n)),
            poses: poses.collect(),
        }
    }
}

impl From<KeptCheckpoint> for Checkpoint {
    fn from(k: KeptCheckpoint) -> Self {
        let poses = k.poses.into_iter().map(|p| FramePose {
            sequence: p.sequence,
            stamp: p.stamp,
            submap: p.submap,
            submap_from_camera: p.submap_from_camera,
            agent_from_camera: p.agent_from_camera,
            covariance: p.covariance,
            brightness: Brightness { gain: p.gain },
        });
        Checkpoint {
            session: k.session,
            through: k.through,
            frames: k.frames,
            submap: k.submap.map(|(id, hash, n)| (id, BlobName::from_bytes(hash), n)),
            poses: poses.collect(),
        }
    }
}
