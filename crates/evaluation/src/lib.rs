//! What a run was worth: trajectories and pictures against the truth, and the report that says so.
//!
//! * [`evaluate`] scores trajectories under two protocols. H, the headline: ONE rigid alignment for all agents of a
//!   component together. P, the paper's: one for each agent. No scale anywhere.
//! * [`score_frame`] compares a rendered view with the recorded one; [`PictureScores`] is the mean over views.
//! * [`NormalisedErrors`] says whether edges of the pose graph are as certain as they claim.
//! * [`graph_svg`] draws a pose graph before and after a solve; [`growth_svg`] draws figures that grow.
//! * [`bars_svg`] draws figures of several variants beside each other.
//! * [`Report`] holds these beside settings, bytes and times: `report.json`, [`Report::to_markdown`],
//!   [`Report::to_html`].
//!
//! This crate knows the truth and no agent; values come in, values and text go out. A figure that was not measured
//! is `None`: `null` in JSON, "not measured" in tables, never replaced by another.

mod association;
mod bars_picture;
mod curve;
mod edges;
mod graph_picture;
mod growth;
mod pictures;
mod report;
mod ssim;
mod stats;
mod trajectory;

pub use association::{Association, associate};
pub use bars_picture::{BarPanel, bars_svg};
pub use curve::{Curve, CurvePoint};
pub use edges::{Edge, NormalisedErrors};
pub use graph_picture::{GraphPicture, graph_svg};
pub use growth::{Growth, Line, growth_svg};
pub use pictures::{
    DepthL1, EQUAL_PICTURES_DB, FrameScore, PictureError, PictureScores, View, depth_l1, psnr_db,
    psnr_where_db, score_frame,
};
pub use report::*;
pub use ssim::ssim;
pub use stats::{Spread, percentile};
pub use trajectory::{
    AteUnscored, ComponentScore, Coverage, Evaluation, LEAST_COVERAGE, Rpe, RpeDelta, RunTrajectories,
    ScoreError, Track, TrackScore, TrajectoryScores, evaluate, rpe,
};
