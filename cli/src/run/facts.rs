//! What a run left: `run.json` and `loops.json` in its folder. Scores are made from these, the trajectories, the
//! map and the truth, and can be made again at any time.

use anyhow::Context;
use coma_evaluation::SentBytes;
use coma_geometry::{Matrix6, Pose, SubmapId};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// `run.json`.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Facts {
    /// Version of the program.
    pub version: String,
    /// Of the program's source.
    pub commit: Option<String>,
    /// All settings, as the program took them.
    pub settings: serde_json::Value,
    /// Which rasteriser.
    pub backend: String,
    /// Processor and number of threads.
    pub machine: String,
    /// RFC 3339.
    pub started: String,
    /// RFC 3339.
    pub finished: String,
    /// From the first frame to the end of the drain, seconds.
    pub wall_s: f64,
    /// Processor time of the whole program in that time, seconds, where the system tells.
    pub cpu_s: Option<f64>,
    /// What was asked for, as it was given.
    pub specs: Vec<String>,
    /// The agents, in the order of their specs.
    pub agents: Vec<AgentFacts>,
    /// Maps that did not merge, the one with most frames first.
    pub components: Vec<ComponentFacts>,
    /// Pairs of agents that share no map, and why.
    pub not_joined: Vec<String>,
    /// Motions between submaps that follow each other.
    pub odometry: Vec<EdgeFacts>,
}

impl Facts {
    /// Reads `run.json` of a run's folder.
    pub fn read(out: &Path) -> anyhow::Result<Self> {
        let path = out.join("run.json");
        let text = std::fs::read_to_string(&path)
            .with_context(|| format!("{} is no run's folder: run.json can't be read", out.display()))?;
        serde_json::from_str(&text).with_context(|| path.display().to_string())
    }

    /// The rhythm of sessions: every k-th frame, never the first.
    pub fn is_held_out(&self, agent: usize, frame: usize) -> bool {
        let every = self.agents[agent].hold_out_every as usize;
        every > 0 && frame > 0 && frame.is_multiple_of(every)
    }
}

/// One agent's part of a run.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct AgentFacts {
    /// Its name.
    pub name: String,
    /// What it saw.
    pub spec: String,
    /// What was spoilt on purpose.
    pub faults: Vec<String>,
    /// Every k-th frame was never mapped; 0: none.
    pub hold_out_every: u32,
    /// Frames of its sequence.
    pub frames: usize,
    /// Frames dropped by policy `latest`.
    pub dropped: u64,
    /// Frames that it refused, and why.
    pub refused: Vec<String>,
    /// What describes its places.
    pub encoder: String,
    /// What it warned of.
    pub warnings: Vec<String>,
    /// Every frame with a pose.
    pub poses: Vec<PoseFacts>,
    /// Its submaps.
    pub submaps: Vec<SubmapFacts>,
    /// Wall seconds of each processed frame, by stage.
    pub frame_seconds: BTreeMap<String, Vec<f64>>,
    /// Wall seconds in all, by stage.
    pub stage_seconds: BTreeMap<String, f64>,
    /// What it wrote.
    pub sent: Vec<SentBytes>,
}

/// One frame that has a pose; the pose is in the trajectory file of its component.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct PoseFacts {
    /// Index in the sequence.
    pub frame: usize,
    /// Index in [`Facts::components`].
    pub component: usize,
    /// True where the pose rests on little.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub degraded: bool,
}

/// One submap.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SubmapFacts {
    /// Its name.
    pub id: SubmapId,
    /// Index of its anchor in the sequence.
    pub anchor_frame: Option<usize>,
    /// Index in [`Facts::components`].
    pub component: Option<usize>,
    /// Number of surfels.
    pub surfels: usize,
    /// Packed, bytes.
    pub packed_bytes: u64,
    /// Of its surfels in the merged map, which holds submap by submap in the order of their names; absent in runs of
    /// older versions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub merged_surfels: Option<usize>,
}

/// One connected map.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct ComponentFacts {
    /// Its gauge: agent, epoch and first submap.
    pub name: String,
    /// Of the poses, in hexadecimal.
    pub digest: String,
    /// Submaps in it.
    pub submaps: usize,
    /// Surfels of its merged map.
    pub surfels: usize,
    /// Its map in the run's folder.
    pub map: String,
    /// 0.5 times the sum of squared, weighted errors.
    pub cost: f64,
}

/// A motion between two anchors.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct EdgeFacts {
    /// One end.
    pub from: End,
    /// The other.
    pub to: End,
    /// Measured.
    pub from_from_to: Pose,
    /// Of the motion, perturbed on the right.
    pub information: Matrix6,
}

/// A submap and its anchor's frame.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct End {
    /// The submap.
    pub submap: SubmapId,
    /// Index of its anchor in its agent's sequence.
    pub frame: Option<usize>,
}

/// One line of `loops.json`: a candidate and what became of it.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct LoopFacts {
    /// Target of the registration.
    pub from: End,
    /// Source of the registration.
    pub to: End,
    /// `accepted`, `rejected` or `withdrawn`.
    pub verdict: String,
    /// A stable name where it was not accepted.
    pub reason: Option<String>,
    /// A plain sentence where it was not accepted.
    pub message: Option<String>,
    /// What the verdict rests on.
    pub numbers: BTreeMap<String, f64>,
    /// Who decided.
    pub by: String,
    /// Similarity of the places, by the space named.
    pub similarity: f32,
    /// Descriptor space.
    pub space: String,
    /// In the solved graph, 0 (an outlier) to 1; absent where it was not accepted.
    pub weight: Option<f64>,
    /// What the solver says of it.
    pub solver: Option<String>,
    /// The motion, where it was accepted.
    pub edge: Option<EdgeFacts>,
}
