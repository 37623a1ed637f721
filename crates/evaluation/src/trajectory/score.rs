//! Absolute errors after rigid alignment: one alignment for a whole component (protocol H), and one for each track
//! (protocol P).

use super::{Rpe, RunTrajectories, ScoreError, Track, rpe};
use crate::{Association, Curve, CurvePoint, Spread, associate};
use coma_geometry::alignment::rigid_alignment;
use coma_geometry::nalgebra::{Point3, Vector3};
use coma_geometry::{AgentId, Pose, StampNs};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::fmt;

/// Share of frames with a pose under which an absolute error does not count: who drops the hard frames
/// has a small error.
pub const LEAST_COVERAGE: f64 = 0.98;

/// Pairs under which nothing is aligned.
const LEAST_PAIRS: usize = 3;

/// How many of the frames have a pose.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Coverage {
    /// Frames with a pose.
    pub frames_posed: usize,
    /// Frames seen.
    pub frames_seen: usize,
}

impl Coverage {
    /// 0 to 1; `None` if nothing was seen.
    pub fn fraction(&self) -> Option<f64> {
        (self.frames_seen > 0).then(|| self.frames_posed as f64 / self.frames_seen as f64)
    }

    /// True if errors over these frames count.
    pub fn suffices(&self) -> bool {
        self.fraction().is_some_and(|fraction| fraction >= LEAST_COVERAGE)
    }
}

/// Why there is no absolute error.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(tag = "reason", rename_all = "snake_case")]
pub enum AteUnscored {
    /// The truth isn't known.
    NoTruth,
    /// Too few poses have a truth for an alignment.
    TooFewPairs {
        /// Pairs found.
        found: usize,
        /// Least number.
        needed: usize,
    },
}

impl fmt::Display for AteUnscored {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            AteUnscored::NoTruth => f.write_str("the truth is not known"),
            AteUnscored::TooFewPairs { found, needed } => {
                write!(f, "{found} poses have a truth, {needed} are needed")
            }
        }
    }
}

/// Protocol H: all agents that share a map, aligned together.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ComponentScore {
    /// Its name.
    pub component: String,
    /// Whose tracks it holds, sorted.
    pub agents: Vec<AgentId>,
    /// True if it holds every agent of the run. Otherwise this is no joint score.
    pub joint: bool,
    /// Over the frames of its agents.
    pub coverage: Coverage,
    /// True if there is an error and coverage suffices.
    pub counts: bool,
    /// Absolute error, metres.
    pub ate_m: Option<Spread>,
    /// Why there is none.
    pub unscored: Option<AteUnscored>,
    /// The one alignment of all agents.
    pub truth_from_map: Option<Pose>,
}

/// Protocol P, and a track's share of protocol H.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrackScore {
    /// Whose.
    pub agent: AgentId,
    /// In which map.
    pub component: String,
    /// Over the agent's frames.
    pub coverage: Coverage,
    /// True if there is an error and coverage suffices.
    pub counts: bool,
    /// Absolute error under the component's alignment, metres.
    pub ate_h_m: Option<Spread>,
    /// Absolute error under an alignment of this track alone, metres.
    pub ate_p_m: Option<Spread>,
    /// Why there is none.
    pub unscored: Option<AteUnscored>,
    /// Relative errors, in the order of the deltas asked for; those with at least one pair.
    pub rpe: Vec<Rpe>,
}

/// What a run's trajectories are worth.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrajectoryScores {
    /// How poses found their truth.
    pub association: Association,
    /// Protocol H, sorted by name.
    pub components: Vec<ComponentScore>,
    /// Protocol P, sorted by agent, then component.
    pub tracks: Vec<TrackScore>,
}

impl TrajectoryScores {
    /// The score of all agents together, if all are in one map.
    pub fn joint(&self) -> Option<&ComponentScore> {
        self.components.iter().find(|component| component.joint)
    }

    /// The paper's figure: the mean of the tracks' errors (RMSE, metres), if all of them count.
    pub fn mean_ate_p_m(&self) -> Option<f64> {
        let rmse = |track: &TrackScore| track.ate_p_m.filter(|_| track.counts).map(|ate| ate.rmse);
        let all: Vec<f64> = self.tracks.iter().map(rmse).collect::<Option<_>>()?;
        crate::stats::mean(&all)
    }
}

/// Scores, and the frames behind them.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Evaluation {
    /// For the report.
    pub scores: TrajectoryScores,
    /// For its plots, in the order of `scores.tracks`.
    pub curves: Vec<Curve>,
    /// Which way the cameras' tops pointed on average: what "from above" means. Unit length.
    pub up: [f64; 3],
}

/// A track with its pairs.
struct Matched<'a> {
    track: &'a Track,
    /// Index into the estimate, index into the truth.
    pairs: Vec<(usize, usize)>,
    truth_from_map: Option<Pose>,
}

impl Matched<'_> {
    /// `(estimate, truth)`
    fn poses(&self) -> Vec<(Pose, Pose)> {
        self.pairs.iter().map(|(e, t)| (self.track.estimate[*e].1, self.track.truth[*t].1)).collect()
    }
}

/// Scores all trajectories of a run.
///
/// # Errors
/// Stamps that don't grow, poses that aren't finite, more poses than frames, two tracks of one agent in one map.
pub fn evaluate(run: &RunTrajectories) -> Result<Evaluation, ScoreError> {
    run.check()?;
    let mut tracks: Vec<&Track> = run.tracks.iter().collect();
    tracks.sort_by_key(|track| (&track.agent, &track.component));
    let mut matched: Vec<Matched> = tracks
        .into_iter()
        .map(|track| {
            let stamps =
                |poses: &[(StampNs, Pose)]| poses.iter().map(|(stamp, _)| *stamp).collect::<Vec<_>>();
            let pairs = associate(&stamps(&track.estimate), &stamps(&track.truth), run.association);
            Matched { track, pairs, truth_from_map: None }
        })
        .collect();

    let agents: BTreeSet<&AgentId> = run.tracks.iter().map(|track| &track.agent).collect();
    let names: BTreeSet<&String> = run.tracks.iter().map(|track| &track.component).collect();
    let components = names
        .into_iter()
        .map(|name| {
            let mut members: Vec<&mut Matched> =
                matched.iter_mut().filter(|member| member.track.component == *name).collect();
            let score = component_score(name, &members, agents.len());
            members.iter_mut().for_each(|member| member.truth_from_map = score.truth_from_map);
            score
        })
        .collect();

    let (tracks, curves) = matched.iter().map(|member| track_score(member, &run.rpe_deltas)).unzip();
    let scores = TrajectoryScores { association: run.association, components, tracks };
    Ok(Evaluation { scores, curves, up: up(&matched) })
}

fn component_score(name: &str, members: &[&mut Matched], agents_of_run: usize) -> ComponentScore {
    let poses: Vec<(Pose, Pose)> = members.iter().flat_map(|member| member.poses()).collect();
    let knows_truth = members.iter().any(|member| !member.track.truth.is_empty());
    let (truth_from_map, ate_m, unscored) = aligned(&poses, knows_truth);
    let coverage = members.iter().fold(Coverage::default(), |sum, member| Coverage {
        frames_posed: sum.frames_posed + member.track.estimate.len(),
        frames_seen: sum.frames_seen + member.track.frames_seen,
    });
    ComponentScore {
        component: name.to_owned(),
        agents: members.iter().map(|member| member.track.agent.clone()).collect(),
        // One track for an agent and component: their number is that of the agents.
        joint: members.len() == agents_of_run,
        coverage,
        counts: ate_m.is_some() && coverage.suffices(),
        ate_m,
        unscored,
        truth_from_map,
    }
}

fn track_score(member: &Matched, deltas: &[super::RpeDelta]) -> (TrackScore, Curve) {
    let track = member.track;
    let poses = member.poses();
    let (own_alignment, ate_p_m, unscored) = aligned(&poses, !track.truth.is_empty());
    let coverage = Coverage { frames_posed: track.estimate.len(), frames_seen: track.frames_seen };
    let score = TrackScore {
        agent: track.agent.clone(),
        component: track.component.clone(),
        coverage,
        counts: ate_p_m.is_some() && coverage.suffices(),
        ate_h_m: member.truth_from_map.and_then(|truth_from_map| ate(&poses, &truth_from_map)),
        ate_p_m,
        unscored,
        rpe: deltas.iter().filter_map(|delta| rpe(&poses, *delta)).collect(),
    };
    (score, curve(member, own_alignment))
}

/// The least-squares alignment of matched poses, the error that is left, or why there is none.
fn aligned(poses: &[(Pose, Pose)], knows_truth: bool) -> (Option<Pose>, Option<Spread>, Option<AteUnscored>) {
    let point = |pose: &Pose| Point3::from(pose.translation.vector);
    let (estimate, truth): (Vec<_>, Vec<_>) = poses.iter().map(|(e, t)| (point(e), point(t))).unzip();
    match rigid_alignment(&estimate, &truth) {
        Some(truth_from_map) => (Some(truth_from_map), ate(poses, &truth_from_map), None),
        None if !knows_truth => (None, None, Some(AteUnscored::NoTruth)),
        None => (None, None, Some(AteUnscored::TooFewPairs { found: poses.len(), needed: LEAST_PAIRS })),
    }
}

fn ate(poses: &[(Pose, Pose)], truth_from_map: &Pose) -> Option<Spread> {
    let errors: Vec<f64> =
        poses.iter().map(|(estimate, truth)| distance_m(&(truth_from_map * estimate), truth)).collect();
    Spread::of(&errors)
}

fn distance_m(a: &Pose, b: &Pose) -> f64 {
    (a.translation.vector - b.translation.vector).norm()
}

fn curve(member: &Matched, own_alignment: Option<Pose>) -> Curve {
    let track = member.track;
    let mut truth_of = vec![None; track.estimate.len()];
    for (estimate, truth) in &member.pairs {
        truth_of[*estimate] = Some(&track.truth[*truth].1);
    }
    let shown = member.truth_from_map.unwrap_or_else(Pose::identity);
    let points = track.estimate.iter().zip(truth_of).map(|((stamp, estimate), truth)| {
        let error_m = |alignment: Option<Pose>| Some(distance_m(&(alignment? * estimate), truth?));
        CurvePoint {
            stamp: *stamp,
            estimate_m: (shown * estimate).translation.vector.into(),
            truth_m: truth.map(|truth| truth.translation.vector.into()),
            error_h_m: error_m(member.truth_from_map),
            error_p_m: error_m(own_alignment),
        }
    });
    Curve {
        agent: track.agent.clone(),
        component: track.component.clone(),
        aligned: member.truth_from_map.is_some(),
        points: points.collect(),
    }
}

/// Cameras look about level on average, and y points down in them.
fn up(matched: &[Matched]) -> [f64; 3] {
    let tops = matched.iter().flat_map(|member| {
        let shown = member.truth_from_map.unwrap_or_else(Pose::identity);
        member.track.estimate.iter().map(move |(_, estimate)| (shown * estimate).rotation * -Vector3::y())
    });
    let sum: Vector3<f64> = tops.sum();
    sum.try_normalize(1e-9).unwrap_or_else(Vector3::z).into()
}
