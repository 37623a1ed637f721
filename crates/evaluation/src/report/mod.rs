//! The report of a run: `report.json` as types, and the same for readers.

mod figures;
mod html;
mod loops;
mod plots;
mod sections;
mod table;
mod times;
mod traffic;

pub use html::{LoopLine, Picture, Plots};
pub use loops::LoopCounts;
pub use times::{MAPPING, StageTime, TRACKING, Times};
pub use traffic::{SentBytes, Traffic, TrafficClass};

use crate::{NormalisedErrors, PictureScores, TrajectoryScores};
use coma_geometry::AgentId;
use serde::{Deserialize, Serialize};

/// Everything that `report.json` says. What was not measured is `None`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Report {
    /// What ran, and how.
    pub run: RunInfo,
    /// The agents, sorted.
    pub agents: Vec<AgentSummary>,
    /// Against the truth.
    pub trajectories: Option<TrajectoryScores>,
    /// Rendered against recorded.
    pub pictures: Pictures,
    /// The merged map.
    pub map: Option<MapSize>,
    /// Bytes by class and message type.
    pub traffic: Option<Traffic>,
    /// Times by stage.
    pub times: Option<Times>,
    /// Candidates by verdict.
    pub loops: Option<LoopCounts>,
    /// How certain the graph's edges are, against how certain they claim to be.
    pub edges: EdgeErrors,
}

/// What ran, and how: enough to run it again.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct RunInfo {
    /// All settings, as the program took them.
    pub settings: serde_json::Value,
    /// Of the program's source.
    pub commit: Option<String>,
    /// Of everything random.
    pub seed: Option<u64>,
    /// Which rasteriser rendered.
    pub backend: Option<String>,
    /// Processor and number of threads, in words.
    pub machine: Option<String>,
    /// As RFC 3339 writes a time.
    pub started: Option<String>,
    /// As RFC 3339 writes a time.
    pub finished: Option<String>,
}

/// One agent's input.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AgentSummary {
    /// Its name.
    pub agent: AgentId,
    /// Where its frames came from (`tum:kitchen[0:250]`).
    pub source: String,
    /// Frames that it was given.
    pub frames_seen: usize,
    /// Frames that have a pose.
    pub frames_posed: usize,
    /// Submaps that it made.
    pub submaps: Option<usize>,
}

/// Rendered views against recorded ones.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Pictures {
    /// Protocol H: views that were tracked and never mapped.
    pub held_out: Option<PictureScores>,
    /// Protocol P: views that the map was made from.
    pub training: Option<PictureScores>,
    /// As `held_out`, of the refined map.
    pub refined_held_out: Option<PictureScores>,
    /// As `training`, of the refined map.
    pub refined_training: Option<PictureScores>,
}

/// The size of a map.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct MapSize {
    /// Submaps.
    pub submaps: usize,
    /// Surfels after merging.
    pub surfels: usize,
    /// Bytes that they take.
    pub bytes: u64,
}

/// Normalised squared errors by kind of edge.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct EdgeErrors {
    /// Between submaps of one agent that follow each other.
    pub odometry: Option<NormalisedErrors>,
    /// Accepted loops.
    pub loops: Option<NormalisedErrors>,
}

impl Report {
    /// Frames of all agents.
    pub fn frames_seen(&self) -> usize {
        self.agents.iter().map(|agent| agent.frames_seen).sum()
    }

    /// Everything written between agents, divided by the frames of all agents.
    pub fn bytes_per_frame(&self) -> Option<f64> {
        let frames = self.frames_seen();
        self.traffic
            .as_ref()
            .filter(|_| frames > 0)
            .map(|traffic| traffic.between_agents() as f64 / frames as f64)
    }

    /// A stage's time over all frames of all agents, seconds; `None` if the stage or frames are missing.
    pub fn per_frame_s(&self, stage: &str) -> Option<f64> {
        let frames = self.frames_seen();
        let stage = self.times.as_ref()?.stage(stage)?;
        (frames > 0).then(|| stage.total_s / frames as f64)
    }

    /// The text of `report.json`. Numbers are read back to the last bit.
    pub fn to_json(&self) -> String {
        let figures = figures::Figures::of(self);
        let whole = WithFigures { report: self, figures };
        // Keys are texts and numbers are finite: there is nothing in a report that JSON cannot hold.
        serde_json::to_string_pretty(&whole).expect("a report is plain data") + "\n"
    }

    /// Reads `report.json`.
    ///
    /// # Errors
    /// A text that is no report; names line and column.
    pub fn from_json(text: &str) -> Result<Self, serde_json::Error> {
        serde_json::from_str(text)
    }

    /// Tables as Markdown, aligned so that a terminal shows them well.
    pub fn to_markdown(&self) -> String {
        sections::markdown(self)
    }

    /// One file without outside parts, but for the pictures that `plots` names.
    pub fn to_html(&self, plots: &Plots) -> String {
        html::page(self, plots)
    }
}

/// `report.json` repeats the paper's figures in one place; they follow from the rest and are not read back.
#[derive(Serialize)]
struct WithFigures<'a> {
    figures: figures::Figures,
    #[serde(flatten)]
    report: &'a Report,
}
