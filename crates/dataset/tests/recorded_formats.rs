//! Reading what lies on disk, whole and damaged.

use coma_dataset::sequence::rgbd_frame;
use coma_dataset::world::{World, WorldSettings};
use coma_dataset::{Sequence, Spec, open, open_all, write_tum};
use coma_geometry::se3;
use std::fs;
use std::path::{Path, PathBuf};

fn spec(text: &str) -> Spec {
    text.parse().unwrap()
}

fn small_film() -> impl Sequence {
    let settings = WorldSettings { agents: 1, frames: 4, width: 64, height: 48, ..Default::default() };
    World::new(settings).unwrap().sequence(0).unwrap()
}

fn written() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    write_tum(&small_film(), folder.path(), &mut |_| {}).unwrap();
    folder
}

fn message(text: &str) -> String {
    match open(&spec(text)) {
        Ok(sequence) => match sequence.frame(0) {
            Ok(_) => "no error".into(),
            Err(e) => e.to_string(),
        },
        Err(e) => e.to_string(),
    }
}

#[test]
fn a_written_sequence_reads_back_the_same() {
    let film = small_film();
    let folder = tempfile::tempdir().unwrap();
    let mut seen = Vec::new();
    write_tum(&film, folder.path(), &mut |n| seen.push(n)).unwrap();
    assert_eq!(seen, [1, 2, 3, 4]);
    for matched_by_stamp in [false, true] {
        if matched_by_stamp {
            fs::remove_file(folder.path().join("associations.txt")).unwrap();
        }
        let read = open(&spec(&format!("tum:{}", folder.path().display()))).unwrap();
        assert_eq!(read.len(), 4);
        assert_eq!(read.calibration().color, film.calibration().color);
        for i in 0..4 {
            assert_eq!(read.stamp_text(i), film.stamp_text(i));
            let (a, b) = (rgbd_frame(&*read, i).unwrap(), rgbd_frame(&film, i).unwrap());
            assert_eq!((a.color, a.depth_m), (b.color, b.depth_m));
            let (metres, radians) = se3::distance(&read.truth(i).unwrap(), &film.truth(i).unwrap());
            assert!(metres < 1e-8 && radians < 1e-7);
        }
    }
}

#[test]
fn ranges_pick_and_join_frames() {
    let folder = written();
    let at = folder.path().display();
    let stamps = |ranges: &str| -> Vec<String> {
        let s = open(&spec(&format!("tum:{at}{ranges}"))).unwrap();
        (0..s.len()).map(|i| s.stamp_text(i).to_owned()).collect()
    };
    let all = stamps("");
    assert_eq!(stamps("[1:3]"), all[1..3]);
    assert_eq!(stamps("[::2]"), [all[0].clone(), all[2].clone()]);
    assert_eq!(stamps("[3:,0:1]"), [all[3].clone(), all[0].clone()]);
    let text = message(&format!("tum:{at}[2:9]"));
    assert!(text.contains("2:9") && text.contains("4 frames"), "{text}");
}

#[test]
fn missing_and_damaged_files_are_named() {
    let folder = written();
    let at = folder.path();
    let tum = format!("tum:{}", at.display());
    let color = at.join("rgb/0.000000.png");
    let whole = fs::read(&color).unwrap();
    fs::write(&color, &whole[..whole.len() / 2]).unwrap();
    assert!(message(&tum).contains("rgb/0.000000.png"), "{}", message(&tum));
    fs::write(&color, b"hello").unwrap();
    assert!(message(&tum).contains("neither PNG nor JPEG"));
    fs::remove_file(&color).unwrap();
    assert!(message(&tum).contains("rgb/0.000000.png"));
    // Depth that is a colour picture.
    fs::write(&color, &whole).unwrap();
    fs::write(at.join("depth/0.000000.png"), &whole).unwrap();
    let text = message(&tum);
    assert!(text.contains("depth/0.000000.png") && text.contains("16-bit"), "{text}");
    for (file, content, needed) in [
        ("calibration.txt", "64 48 nan 52 31 23 5000", "fx"),
        ("calibration.txt", "64 48 52 52", "7"),
        ("calibration.txt", "64 48 52 52 31 23 0", "depth_units_per_metre"),
        ("associations.txt", "0 ../../secret 0 depth/0.png", "line 1"),
        ("associations.txt", "0 a", "line 1"),
        ("groundtruth.txt", "0 0 0 0", "line 1"),
        ("calibration.txt", "32 48 52 52 15 23 5000", "64x48"),
        ("associations.txt", "# nothing", "no frames"),
    ] {
        let folder = written();
        fs::write(folder.path().join(file), content).unwrap();
        let text = message(&format!("tum:{}", folder.path().display()));
        assert!(text.contains(needed), "{file} {content:?}: {text}");
    }
    assert!(message("tum:/nowhere/at/all").contains("/nowhere/at/all"));
}

fn replica_agent(folder: &Path, frames: usize) {
    let film = small_film();
    let tum = written();
    fs::create_dir_all(folder.join("results")).unwrap();
    let mut rows = String::new();
    for i in 0..frames {
        let stamp = film.stamp_text(i);
        fs::copy(
            tum.path().join(format!("rgb/{stamp}.png")),
            folder.join(format!("results/frame{i:06}.png")),
        )
        .unwrap();
        let depth = tum.path().join(format!("depth/{stamp}.png"));
        fs::copy(depth, folder.join(format!("results/depth{i:06}.png"))).unwrap();
        let matrix = film.truth(i).unwrap().to_homogeneous().transpose();
        let row: Vec<String> = matrix.iter().map(|v| format!("{v:.9e}")).collect();
        rows.push_str(&row.join(" "));
        rows.push('\n');
    }
    fs::write(folder.join("traj.txt"), rows).unwrap();
}

fn camera_file(folder: &Path) {
    let text =
        r#"{"camera": {"w": 64, "h": 48, "fx": 52.0, "fy": 52.0, "cx": 31.5, "cy": 23.5, "scale": 5000}}"#;
    fs::write(folder.join("cam_params.json"), text).unwrap();
}

#[test]
fn a_multi_agent_folder_gives_one_sequence_per_agent() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["agent_0", "agent_1", "agent_10"] {
        replica_agent(&folder.path().join(name), 2);
    }
    fs::create_dir(folder.path().join("notes")).unwrap();
    camera_file(folder.path());
    let at = folder.path().display();
    let agents = open_all(&spec(&format!("replica-multiagent:{at}[0:1]"))).unwrap();
    let names: Vec<&str> = agents.iter().map(|a| a.0.as_str()).collect();
    assert_eq!(names, ["agent-0", "agent-1", "agent-10"]);
    assert!(agents.iter().all(|a| a.1.len() == 1));
    let film = small_film();
    let read = rgbd_frame(&*agents[1].1, 0).unwrap();
    assert_eq!(read.depth_m, rgbd_frame(&film, 0).unwrap().depth_m);
    let (metres, radians) = se3::distance(&agents[1].1.truth(0).unwrap(), &film.truth(0).unwrap());
    assert!(metres < 1e-6 && radians < 1e-6);
    let empty = tempfile::tempdir().unwrap();
    let text = open_all(&spec(&format!("aria-multiagent:{}", empty.path().display()))).err().unwrap();
    assert!(text.to_string().contains("agent folders"));
}

#[test]
fn replica_needs_a_pose_for_every_frame_and_a_depth_for_every_color() {
    let folder = tempfile::tempdir().unwrap();
    let agent = folder.path().join("a");
    replica_agent(&agent, 3);
    camera_file(folder.path());
    let text = format!("replica:{}", agent.display());
    assert_eq!(open(&spec(&text)).unwrap().len(), 3);
    let rows = fs::read_to_string(agent.join("traj.txt")).unwrap();
    fs::write(agent.join("traj.txt"), rows.lines().next().unwrap()).unwrap();
    assert!(message(&text).contains("1 poses for 3 frames"));
    fs::write(agent.join("traj.txt"), "1 2 3").unwrap();
    assert!(message(&text).contains("line 1"));
    fs::remove_file(agent.join("results/depth000001.png")).unwrap();
    assert!(message(&text).contains("2 depth frames"));
}

#[test]
fn seven_scenes_frames_are_found_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let at = folder.path();
    let (color, depth) = (
        image::RgbImage::new(640, 480),
        image::ImageBuffer::from_fn(640, 480, |x, _| image::Luma([if x == 0 { 65535u16 } else { 1500 }])),
    );
    color.save(at.join("frame-000007.color.png")).unwrap();
    depth.save(at.join("frame-000007.depth.png")).unwrap();
    fs::write(at.join("frame-000007.pose.txt"), "1 0 0 1\n0 1 0 2\n0 0 1 3\n0 0 0 1\n").unwrap();
    let read = open(&spec(&format!("7scenes:{}", at.display()))).unwrap();
    assert_eq!(read.truth(0).unwrap().translation.vector.as_slice(), [1.0, 2.0, 3.0]);
    let frame = rgbd_frame(&*read, 0).unwrap();
    assert_eq!((frame.depth_m[(0, 5)], frame.depth_m[(1, 5)]), (0.0, 1.5));
    fs::write(at.join("frame-000007.pose.txt"), "1 0 0 1\n").unwrap();
    assert!(message(&format!("7scenes:{}", at.display())).contains("frame-000007.pose.txt"));
}

#[test]
fn specs_are_parsed_and_their_errors_name_the_text_at_fault() {
    let parsed = spec("left=tum:some/where[0:100,160:240:2]");
    assert_eq!(parsed.name.as_deref(), Some("left"));
    assert_eq!(parsed.path, PathBuf::from("some/where"));
    assert_eq!(parsed.to_string(), "left=tum:some/where[0:100,160:240:2]");
    for (text, at) in [
        ("some/where", "some/where"),
        ("tumm:x", "tumm"),
        ("tum:", ""),
        ("tum:x[3:1]", "3:1"),
        ("tum:x[0:4,a:b]", "a:b"),
        ("tum:x[0:4:0]", "0:4:0"),
        ("tum:x[0:4", "x[0:4"),
        ("tum:x0:4]", "x0:4]"),
        ("Bad Name=tum:x", "Bad Name"),
    ] {
        let error = text.parse::<Spec>().unwrap_err();
        assert_eq!(error.at, at, "{text}: {error}");
        assert!(error.to_string().contains(text));
    }
}

#[test]
fn the_built_in_world_is_opened_by_name() {
    let read = open(&spec("world:rooms/agent-1[0:3]")).unwrap();
    assert_eq!((read.len(), read.stamp_text(1)), (3, "0.033333"));
    assert!(message("world:cellar/agent-0").contains("cellar"));
    assert!(message("world:rooms/agent-8").contains("agent-7"));
}

fn shared() -> PathBuf {
    let walked = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().map(|a| a.join("shared"));
    let stated = std::env::var_os("COMA_SHARED").map(PathBuf::from);
    stated.into_iter().chain(walked).find(|s| s.join("data").is_dir()).expect("the shared data folder")
}

#[test]
#[ignore = "needs the shared data folder"]
fn recorded_sequences_open_with_their_own_calibration() {
    let kitchen = open(&spec(&format!("tum:{}[250:500]", shared().join("data/kitchen").display()))).unwrap();
    assert_eq!(kitchen.len(), 250);
    assert_eq!(kitchen.stamp_text(0), "16.666667");
    assert!((kitchen.calibration().frames_per_second - 15.0).abs() < 0.1);
    let frame = rgbd_frame(&*kitchen, 10).unwrap();
    assert!((0.4..0.95).contains(&frame.depth_coverage()) && kitchen.truth(10).is_some());
    let room = open(&spec(&format!("tum:{}", shared().join("data/living-room/agent-1").display()))).unwrap();
    assert_eq!((room.len(), room.calibration().color.width), (240, 600));
    assert!(rgbd_frame(&*room, 239).unwrap().depth_coverage() > 0.99);
}
