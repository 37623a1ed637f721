//! Trajectories against the truth.

mod rpe;
mod score;
mod track;

pub use rpe::{Rpe, RpeDelta, rpe};
pub use score::{
    AteUnscored, ComponentScore, Coverage, Evaluation, LEAST_COVERAGE, TrackScore, TrajectoryScores, evaluate,
};
pub use track::{RunTrajectories, ScoreError, Track};
