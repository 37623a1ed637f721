//! Laws of the trajectory scores.

mod common;

use coma_evaluation::{
    Association, AteUnscored, Coverage, RpeDelta, RunTrajectories, ScoreError, Track, evaluate,
};
use coma_geometry::nalgebra::Vector3;
use coma_geometry::{Pose, StampNs, se3};
use common::{Posed, agent, elsewhere, estimated, track, walk};

const PERIOD_NS: i64 = 33_333_333;

fn moved(poses: &[Posed], new_from_old: Pose) -> Vec<Posed> {
    poses.iter().map(|(stamp, pose)| (*stamp, new_from_old * pose)).collect()
}

fn shifted(poses: &[Posed], x_m: f64) -> Vec<Posed> {
    moved(poses, Pose::translation(x_m, 0.0, 0.0))
}

fn two_agents() -> Vec<Track> {
    [(0, "agent-00"), (1, "agent-01")]
        .map(|(number, name)| {
            let truth = walk(number, 200, PERIOD_NS);
            let estimate = estimated(&truth, elsewhere(), 0.02, u64::from(number));
            track(name, truth, estimate)
        })
        .to_vec()
}

fn close(a: f64, b: f64, tolerance: f64) {
    assert!((a - b).abs() <= tolerance, "{a} is not {b}");
}

#[test]
fn equal_paths_have_no_error() {
    let truth = walk(0, 100, PERIOD_NS);
    let result = evaluate(&RunTrajectories::new(vec![track("a", truth.clone(), truth)])).unwrap();
    let joint = result.scores.joint().unwrap();
    assert!(joint.counts && joint.ate_m.unwrap().max < 1e-9);
    let track = &result.scores.tracks[0];
    assert!(track.ate_p_m.unwrap().max < 1e-9);
    assert_eq!(track.rpe.len(), 2);
    assert!(track.rpe.iter().all(|rpe| rpe.translation_m.max < 1e-9 && rpe.rotation_deg.max < 1e-6));
}

#[test]
fn another_frame_of_reference_changes_no_error() {
    let here = evaluate(&RunTrajectories::new(two_agents())).unwrap().scores;
    let mut tracks = two_agents();
    for track in &mut tracks {
        track.estimate = moved(&track.estimate, elsewhere() * Pose::translation(100.0, 0.0, 0.0));
    }
    let there = evaluate(&RunTrajectories::new(tracks)).unwrap().scores;
    close(here.joint().unwrap().ate_m.unwrap().rmse, there.joint().unwrap().ate_m.unwrap().rmse, 1e-9);
    for (here, there) in here.tracks.iter().zip(&there.tracks) {
        close(here.ate_p_m.unwrap().max, there.ate_p_m.unwrap().max, 1e-9);
        close(here.rpe[0].rotation_deg.rmse, there.rpe[0].rotation_deg.rmse, 1e-6);
    }
}

#[test]
fn scale_is_not_forgiven() {
    let truth = walk(0, 100, PERIOD_NS);
    let larger = |(stamp, pose): &Posed| {
        (*stamp, Pose::from_parts((pose.translation.vector * 1.1).into(), pose.rotation))
    };
    let estimate = truth.iter().map(larger).collect();
    let places = truth.iter().map(|(_, pose)| pose.translation.vector);
    let middle = places.clone().sum::<Vector3<f64>>() / 100.0;
    // What is left of a tenth too much is a tenth of the distance from the middle.
    let spread_m = (places.map(|place| (place - middle).norm_squared()).sum::<f64>() / 100.0).sqrt();
    let result = evaluate(&RunTrajectories::new(vec![track("a", truth, estimate)])).unwrap();
    close(result.scores.tracks[0].ate_p_m.unwrap().rmse, 0.1 * spread_m, 1e-9);
}

#[test]
fn agents_that_are_right_alone_and_wrong_together_are_told_apart() {
    let truths = [walk(0, 200, PERIOD_NS), walk(1, 200, PERIOD_NS)];
    // Both paths are perfect, but the second is put 10 cm beside its place in the shared map.
    let tracks = vec![
        track("agent-00", truths[0].clone(), moved(&truths[0], elsewhere())),
        track("agent-01", truths[1].clone(), moved(&shifted(&truths[1], 0.1), elsewhere())),
    ];
    let result = evaluate(&RunTrajectories::new(tracks)).unwrap();
    let joint = result.scores.joint().unwrap();
    assert_eq!(joint.agents, [agent("agent-00"), agent("agent-01")]);
    let rmse_m = joint.ate_m.unwrap().rmse;
    // The alignment splits a shift between equally many poses; turning a little takes up some of it.
    assert!(rmse_m > 0.03 && rmse_m <= 0.05 + 1e-9, "{rmse_m}");
    for track in &result.scores.tracks {
        assert!(track.ate_p_m.unwrap().max < 1e-9 && track.ate_h_m.unwrap().rmse > 0.02);
    }
    assert!(result.scores.mean_ate_p_m().unwrap() < 1e-9);
}

#[test]
fn the_joint_error_is_that_of_both_shares() {
    let scores = evaluate(&RunTrajectories::new(two_agents())).unwrap().scores;
    let shares = scores.tracks.iter().map(|track| track.ate_h_m.unwrap());
    let squares: f64 = shares.clone().map(|share| share.rmse.powi(2) * share.count as f64).sum();
    let count: usize = shares.map(|share| share.count).sum();
    let joint = scores.joint().unwrap().ate_m.unwrap();
    assert_eq!(joint.count, count);
    close(joint.rmse, (squares / count as f64).sqrt(), 1e-12);
    for track in &scores.tracks {
        assert!(track.ate_p_m.unwrap().rmse <= track.ate_h_m.unwrap().rmse + 1e-12);
    }
}

#[test]
fn components_that_did_not_merge_are_never_joint() {
    let mut tracks = two_agents();
    tracks[1].component = "map-1".into();
    tracks[1].estimate = moved(&tracks[1].estimate, Pose::translation(9.0, 9.0, 9.0));
    let scores = evaluate(&RunTrajectories::new(tracks)).unwrap().scores;
    assert!(scores.joint().is_none());
    assert_eq!(scores.components.len(), 2);
    for component in &scores.components {
        assert!(!component.joint && component.counts && component.agents.len() == 1);
    }
    // Each is aligned as if it were alone.
    for (component, track) in scores.components.iter().zip(&scores.tracks) {
        close(component.ate_m.unwrap().rmse, track.ate_p_m.unwrap().rmse, 1e-12);
    }
}

#[test]
fn an_agent_that_lost_itself_for_good_has_a_track_in_each_map() {
    let truth = walk(0, 200, PERIOD_NS);
    let estimate = estimated(&truth, elsewhere(), 0.01, 3);
    let first = track("agent-00", truth.clone(), estimate[..120].to_vec());
    let second = Track { component: "map-1".into(), estimate: estimate[130..].to_vec(), ..first.clone() };
    let other = track("agent-01", walk(1, 50, PERIOD_NS), walk(1, 50, PERIOD_NS));
    let scores = evaluate(&RunTrajectories::new(vec![second, other, first])).unwrap().scores;
    assert_eq!(scores.tracks.len(), 3);
    // The first map holds every agent, but 80 of 250 frames are not in it.
    let joint = scores.joint().unwrap();
    assert_eq!((joint.component.as_str(), joint.counts), ("map-0", false));
    assert_eq!(joint.coverage, Coverage { frames_posed: 170, frames_seen: 250 });
    assert_eq!(scores.mean_ate_p_m(), None);
}

#[test]
fn under_98_percent_of_the_frames_an_error_does_not_count() {
    for (posed, counts) in [(98, true), (97, false), (0, false)] {
        let truth = walk(0, 100, PERIOD_NS);
        let estimate = truth[..posed].to_vec();
        let scores = evaluate(&RunTrajectories::new(vec![track("a", truth, estimate)])).unwrap().scores;
        assert_eq!((scores.tracks[0].counts, scores.components[0].counts), (counts, counts), "{posed} %");
        assert_eq!(scores.tracks[0].ate_p_m.is_some(), posed > 0, "the error is there all the same");
    }
    assert!(!Coverage { frames_posed: 0, frames_seen: 0 }.suffices());
}

#[test]
fn what_cannot_be_scored_says_why() {
    let truth = walk(0, 100, PERIOD_NS);
    let unknown = Track { truth: Vec::new(), ..track("a", truth.clone(), truth.clone()) };
    let result = evaluate(&RunTrajectories::new(vec![unknown])).unwrap();
    assert_eq!(result.scores.tracks[0].unscored, Some(AteUnscored::NoTruth));
    assert!(!result.curves[0].aligned && result.curves[0].points.len() == 100);

    let later = truth.iter().map(|(stamp, pose)| (StampNs(stamp.0 + 1), *pose)).collect();
    let scores = evaluate(&RunTrajectories::new(vec![track("a", truth, later)])).unwrap().scores;
    let why = AteUnscored::TooFewPairs { found: 0, needed: 3 };
    assert_eq!((scores.components[0].unscored, scores.tracks[0].unscored), (Some(why), Some(why)));
    assert!(scores.tracks[0].rpe.is_empty());
}

#[test]
fn stamps_that_are_near_are_matched_if_asked_for() {
    let truth = walk(0, 400, 10_000_000);
    // Every third, 2 ms late.
    let estimate =
        truth.iter().step_by(3).map(|(stamp, pose)| (StampNs(stamp.0 + 2_000_000), *pose)).collect();
    let mut run = RunTrajectories::new(vec![track("a", truth, estimate)]);
    run.association = Association::Nearest { tolerance_ns: 10_000_000 };
    let scores = evaluate(&run).unwrap().scores;
    assert_eq!(scores.tracks[0].ate_p_m.unwrap().count, 134);
    assert!(scores.tracks[0].ate_p_m.unwrap().max < 1e-9);
}

#[test]
fn curves_hold_each_frame_in_the_frame_of_the_truth() {
    let mut tracks = two_agents();
    tracks[0].truth.remove(7);
    let result = evaluate(&RunTrajectories::new(tracks.clone())).unwrap();
    let curve = &result.curves[0];
    assert_eq!((curve.points.len(), curve.aligned), (200, true));
    assert_eq!((curve.points[7].truth_m, curve.points[7].error_h_m), (None, None));
    let point = curve.at(tracks[0].estimate[12].0).unwrap();
    let (estimate, truth) = (point.estimate_m, point.truth_m.unwrap());
    let distance_m = (0..3).map(|i| (estimate[i] - truth[i]).powi(2)).sum::<f64>().sqrt();
    close(point.error_h_m.unwrap(), distance_m, 1e-12);
    let worst_m = curve.points.iter().filter_map(|point| point.error_h_m).fold(0.0, f64::max);
    close(worst_m, result.scores.tracks[0].ate_h_m.unwrap().max, 1e-12);
    // The cameras are about level in a world whose z points up.
    assert!(result.up[2] > 0.99, "{:?}", result.up);
}

#[test]
fn tracks_may_come_in_any_order() {
    let mut tracks = two_agents();
    let forwards = evaluate(&RunTrajectories::new(tracks.clone())).unwrap();
    tracks.reverse();
    assert_eq!(forwards, evaluate(&RunTrajectories::new(tracks)).unwrap());
}

#[test]
fn what_is_no_trajectory_is_refused_by_name() {
    let refused = |change: &dyn Fn(&mut Track)| {
        let truth = walk(0, 10, PERIOD_NS);
        let mut track = track("agent-07", truth.clone(), truth);
        change(&mut track);
        evaluate(&RunTrajectories::new(vec![track])).unwrap_err()
    };
    let a = || agent("agent-07");
    assert_eq!(
        refused(&|track| track.estimate.swap(4, 5)),
        ScoreError::StampsDoNotGrow { agent: a(), field: "estimate", index: 5 }
    );
    assert_eq!(
        refused(&|track| track.truth[3].1.translation.vector.x = f64::NAN),
        ScoreError::NotFinite { agent: a(), field: "truth", index: 3 }
    );
    let error = refused(&|track| track.frames_seen = 9);
    assert_eq!(error.to_string(), "agent-07: 10 poses for 9 frames");
    let twice = track("agent-07", Vec::new(), Vec::new());
    let error = evaluate(&RunTrajectories::new(vec![twice.clone(), twice])).unwrap_err();
    assert_eq!(error, ScoreError::TwoTracks { agent: a(), component: "map-0".into() });
}

#[test]
fn a_lost_stretch_makes_one_long_step() {
    let truth = walk(0, 100, PERIOD_NS);
    let mut estimate = estimated(&truth, elsewhere(), 0.0, 0);
    estimate.drain(40..60);
    // After the stretch it is 0.3 m beside, in its own frame.
    for (_, pose) in &mut estimate[40..] {
        *pose = se3::exp(&coma_geometry::Tangent::new(0.3, 0.0, 0.0, 0.0, 0.0, 0.0)) * *pose;
    }
    let mut run = RunTrajectories::new(vec![track("a", truth, estimate)]);
    run.rpe_deltas = vec![RpeDelta::consecutive(1)];
    let rpe = evaluate(&run).unwrap().scores.tracks[0].rpe[0];
    assert_eq!(rpe.translation_m.count, 79);
    close(rpe.translation_m.max, 0.3, 1e-9);
    close(rpe.translation_m.median, 0.0, 1e-9);
}
