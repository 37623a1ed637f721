//! What is to be scored.

use super::RpeDelta;
use crate::Association;
use coma_geometry::{AgentId, Pose, StampNs};
use std::collections::BTreeSet;

/// The poses of one agent in one map.
#[derive(Clone, Debug)]
pub struct Track {
    /// Whose.
    pub agent: AgentId,
    /// Which map the poses are in: agents that merged share it. An agent that got lost and never found back has
    /// a track in each of its maps.
    pub component: String,
    /// Frames that the agent was given, in this map or not; a camera that a test blinds doesn't see.
    pub frames_seen: usize,
    /// `map_from_camera`, in the order of time. A lost frame has none.
    pub estimate: Vec<(StampNs, Pose)>,
    /// `world_from_camera`, in the order of time; the same world for all agents. Empty if it isn't known.
    pub truth: Vec<(StampNs, Pose)>,
}

/// All trajectories of a run, and how they are scored.
#[derive(Clone, Debug)]
pub struct RunTrajectories {
    /// In any order.
    pub tracks: Vec<Track>,
    /// How poses find their truth.
    pub association: Association,
    /// Over which distances the relative error is taken.
    pub rpe_deltas: Vec<RpeDelta>,
}

impl RunTrajectories {
    /// With exact stamps, and the relative error from frame to frame and over ten frames.
    pub fn new(tracks: Vec<Track>) -> Self {
        let rpe_deltas = vec![RpeDelta::consecutive(1), RpeDelta::consecutive(10)];
        RunTrajectories { tracks, association: Association::Exact, rpe_deltas }
    }
}

/// Why a run cannot be scored; names the agent.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ScoreError {
    /// Stamps must grow from pose to pose.
    #[error("{agent}: the stamp of {field} pose {index} is not after the one before it")]
    StampsDoNotGrow {
        /// Whose.
        agent: AgentId,
        /// `estimate` or `truth`.
        field: &'static str,
        /// Counted from 0.
        index: usize,
    },
    /// A pose is NaN or infinite.
    #[error("{agent}: {field} pose {index} is not finite")]
    NotFinite {
        /// Whose.
        agent: AgentId,
        /// `estimate` or `truth`.
        field: &'static str,
        /// Counted from 0.
        index: usize,
    },
    /// Coverage would be over 100 %.
    #[error("{agent}: {posed} poses for {seen} frames")]
    MorePosesThanFrames {
        /// Whose.
        agent: AgentId,
        /// Poses in all its tracks.
        posed: usize,
        /// Frames that it saw.
        seen: usize,
    },
    /// The tracks of one agent in one map are one track.
    #[error("{agent} has two tracks in component {component:?}")]
    TwoTracks {
        /// Whose.
        agent: AgentId,
        /// Where.
        component: String,
    },
}

impl RunTrajectories {
    pub(super) fn check(&self) -> Result<(), ScoreError> {
        let mut known = BTreeSet::new();
        for track in &self.tracks {
            let agent = || track.agent.clone();
            if !known.insert((&track.agent, &track.component)) {
                return Err(ScoreError::TwoTracks { agent: agent(), component: track.component.clone() });
            }
            for (field, poses) in [("estimate", &track.estimate), ("truth", &track.truth)] {
                if let Some(index) = poses.windows(2).position(|pair| pair[1].0 <= pair[0].0) {
                    return Err(ScoreError::StampsDoNotGrow { agent: agent(), field, index: index + 1 });
                }
                if let Some(index) = poses.iter().position(|(_, pose)| !is_finite(pose)) {
                    return Err(ScoreError::NotFinite { agent: agent(), field, index });
                }
            }
            let of_agent = self.tracks.iter().filter(|other| other.agent == track.agent);
            let posed = of_agent.map(|other| other.estimate.len()).sum();
            if posed > track.frames_seen {
                return Err(ScoreError::MorePosesThanFrames {
                    agent: agent(),
                    posed,
                    seen: track.frames_seen,
                });
            }
        }
        Ok(())
    }
}

fn is_finite(pose: &Pose) -> bool {
    pose.translation.vector.iter().chain(pose.rotation.coords.iter()).all(|value| value.is_finite())
}
