//! A client in another language, made from the .proto files alone.

use coma_geometry::{alignment, nalgebra::Point3, tum};
use coma_tests::story::Cast;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Recorded data: the folder that COMA_SHARED names, or `shared` beside the repository.
fn kitchen() -> PathBuf {
    let beside = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared");
    std::env::var_os("COMA_SHARED").map_or_else(beside, PathBuf::from).join("data/kitchen")
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs shared/data/kitchen and the Python packages grpcio and grpcio-tools"]
async fn a_python_client_streams_recorded_frames_and_reads_poses() {
    const FRAMES: usize = 25;
    let cast = Cast::start(&["agent-00"]).await;
    let address = cast.url(0).trim_start_matches("http://").to_owned();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("clients/python/stream.py");
    let output = tokio::task::spawn_blocking(move || {
        let mut command = Command::new("python3");
        command.arg(script).arg(kitchen()).args(["--to", &address, "--frames", &FRAMES.to_string()]);
        command.output().expect("python3 starts")
    });
    let output = output.await.unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let poses = tum::parse(&String::from_utf8(output.stdout).unwrap()).unwrap();
    assert_eq!(poses.len(), FRAMES);

    let truth = tum::parse(&std::fs::read_to_string(kitchen().join("groundtruth.txt")).unwrap()).unwrap();
    let true_pose =
        |p: &tum::StampedPose| truth.iter().find(|t| t.stamp == p.stamp).expect("a truth for every stamp");
    let point = |p: &tum::StampedPose| Point3::from(p.pose.translation.vector);
    let estimated: Vec<_> = poses.iter().map(point).collect();
    let real: Vec<_> = poses.iter().map(|p| point(true_pose(p))).collect();
    let world_from_map = alignment::rigid_alignment(&estimated, &real).unwrap();
    for (e, t) in estimated.iter().zip(&real) {
        let error_m = (world_from_map * e - t).norm();
        assert!(error_m < 0.05, "{error_m} m");
    }
    cast.shutdown().await;
}
