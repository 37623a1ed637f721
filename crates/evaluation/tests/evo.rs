//! Agreement with `evo` (Michael Grupp), the field's tool for trajectories: what `evo_ape tum -a` and `evo_rpe tum`
//! compute, through the functions that these programs call.

mod common;

use coma_evaluation::{Association, RpeDelta, RunTrajectories, Spread, Track, evaluate};
use coma_geometry::{StampNs, tum};
use common::{Posed, agent, elsewhere, estimated, walk};
use std::path::Path;
use std::process::Command;

/// Prints `count rmse mean median max` of the absolute error, then of relative translation and rotation for each delta.
const PYTHON: &str = r#"
import copy, sys
from evo.core import metrics, sync
from evo.core.units import Unit
from evo.main_ape import ape
from evo.main_rpe import rpe
from evo.tools import file_interface
ref, est = [file_interface.read_tum_trajectory_file(f) for f in sys.argv[1:3]]
ref, est = sync.associate_trajectories(ref, est, max_diff=float(sys.argv[3]))
def show(result):
    s = result.stats
    print(len(result.np_arrays["error_array"]), *(repr(float(s[k])) for k in ("rmse", "mean", "median", "max")))
show(ape(ref, est, metrics.PoseRelation.translation_part, align=True))
for delta, every in [(1, False), (10, False), (10, True)]:
    for part in (metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg):
        # It cuts its arguments down to the pairs.
        show(rpe(copy.deepcopy(ref), copy.deepcopy(est), part, delta=delta, delta_unit=Unit.frames, all_pairs=every))
"#;

fn written(path: &Path, poses: &[Posed]) -> Vec<Posed> {
    let text = |stamp: StampNs| format!("{}.{:09}", stamp.0 / 1_000_000_000, stamp.0 % 1_000_000_000);
    let lines: Vec<(String, _)> = poses.iter().map(|(stamp, pose)| (text(*stamp), *pose)).collect();
    let file = tum::format(lines.iter().map(|(stamp, pose)| (stamp.as_str(), pose)));
    std::fs::write(path, &file).unwrap();
    // What the other side reads, digits cut and all.
    tum::parse(&file).unwrap().into_iter().map(|line| (line.stamp, line.pose)).collect()
}

fn evo(truth: &Path, estimate: &Path, tolerance_s: f64) -> Vec<Spread> {
    let output = Command::new("python3")
        .args(["-c", PYTHON])
        .args([truth, estimate])
        .arg(tolerance_s.to_string())
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let line = |line: &str| {
        let values: Vec<f64> = line.split(' ').map(|word| word.parse().unwrap()).collect();
        let [count, rmse, mean, median, max] = values[..] else { panic!("{line}") };
        Spread { count: count as usize, rmse, mean, median, max }
    };
    String::from_utf8(output.stdout).unwrap().lines().map(line).collect()
}

fn agree(what: &str, ours: Spread, theirs: Spread) {
    println!("{what}: {ours:?}");
    assert_eq!(ours.count, theirs.count, "{what}");
    for (name, ours, theirs) in [
        ("rmse", ours.rmse, theirs.rmse),
        ("mean", ours.mean, theirs.mean),
        ("median", ours.median, theirs.median),
        ("max", ours.max, theirs.max),
    ] {
        assert!((ours - theirs).abs() <= 1e-4 * theirs, "{what}, {name}: {ours} is not evo's {theirs}");
    }
}

/// Scores both ways and compares every figure.
fn compare(truth: &[Posed], estimate: &[Posed], tolerance_ns: u64) {
    let folder = tempfile::tempdir().unwrap();
    let (truth_file, estimate_file) = (folder.path().join("truth.tum"), folder.path().join("estimate.tum"));
    let (truth, estimate) = (written(&truth_file, truth), written(&estimate_file, estimate));
    let frames_seen = estimate.len();
    let track = Track { agent: agent("agent-00"), component: "map-0".into(), frames_seen, estimate, truth };
    let mut run = RunTrajectories::new(vec![track]);
    run.association = Association::Nearest { tolerance_ns };
    run.rpe_deltas = vec![RpeDelta::consecutive(1), RpeDelta::consecutive(10), RpeDelta::all_pairs(10)];
    let scores = evaluate(&run).unwrap().scores;
    let theirs = evo(&truth_file, &estimate_file, tolerance_ns as f64 * 1e-9);
    let track = &scores.tracks[0];
    agree("absolute", track.ate_p_m.unwrap(), theirs[0]);
    assert_eq!(scores.joint().unwrap().ate_m, track.ate_p_m);
    for (rpe, theirs) in track.rpe.iter().zip(theirs[1..].chunks(2)) {
        agree(&format!("translation over {:?}", rpe.delta), rpe.translation_m, theirs[0]);
        agree(&format!("rotation over {:?}", rpe.delta), rpe.rotation_deg, theirs[1]);
    }
    assert_eq!(theirs.len(), 1 + 2 * track.rpe.len());
}

#[test]
#[ignore = "needs the Python packages evo and scikit-image"]
fn a_drifting_path_with_lost_frames_has_evos_errors() {
    let truth = walk(1, 500, 33_333_333);
    let mut estimate = estimated(&truth, elsewhere(), 0.02, 1);
    estimate.drain(200..231);
    compare(&truth, &estimate, 1_000_000);
}

#[test]
#[ignore = "needs the Python packages evo and scikit-image"]
fn truth_of_another_rate_is_matched_as_evo_matches_it() {
    // The truth comes every 10 ms; every third is kept, 3 ms late, as one frame of the camera.
    let truth = walk(1, 1500, 10_000_000);
    let late = |(stamp, pose): Posed| (StampNs(stamp.0 + 3_000_000), pose);
    let estimate: Vec<Posed> =
        estimated(&truth, elsewhere(), 0.03, 2).into_iter().step_by(3).map(late).collect();
    compare(&truth, &estimate, 5_000_000);
    // And the other way round: then every pose of the truth looks for its estimate.
    compare(&estimate, &truth, 5_000_000);
}

#[test]
#[ignore = "needs the Python packages evo and scikit-image"]
fn two_agents_together_have_the_error_that_evo_gives_their_joined_paths() {
    let folder = tempfile::tempdir().unwrap();
    let files = ["truth.tum", "estimate.tum"].map(|name| folder.path().join(name));
    let truths = [walk(1, 300, 33_333_333), walk(2, 200, 33_333_333)];
    let estimates = [0, 1].map(|i| estimated(&truths[i], elsewhere(), 0.02, 5 + i as u64));
    let (truth, estimate) = (written(&files[0], &truths.concat()), written(&files[1], &estimates.concat()));
    let part = |name: &str, range: std::ops::Range<usize>| {
        common::track(name, truth[range.clone()].to_vec(), estimate[range].to_vec())
    };
    let run = RunTrajectories::new(vec![part("agent-00", 0..300), part("agent-01", 300..500)]);
    let scores = evaluate(&run).unwrap().scores;
    agree("joint", scores.joint().unwrap().ate_m.unwrap(), evo(&files[0], &files[1], 1e-3)[0]);
}
