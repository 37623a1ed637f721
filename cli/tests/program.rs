//! The program as its users meet it.

use std::path::Path;
use std::process::{Command, Output};

fn coma(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_coma")).args(arguments).output().expect("the program starts")
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Runs what must succeed; gives its standard output.
fn succeeds(arguments: &[&str]) -> String {
    let output = coma(arguments);
    assert!(output.status.success(), "coma {arguments:?}: {}", text(&output.stderr));
    text(&output.stdout)
}

/// Runs what must fail; gives its message.
fn fails(arguments: &[&str]) -> String {
    let output = coma(arguments);
    assert!(!output.status.success(), "coma {arguments:?} succeeded: {}", text(&output.stdout));
    text(&output.stderr)
}

fn json(path: &Path) -> serde_json::Value {
    serde_json::from_slice(&std::fs::read(path).expect("the file is there")).expect("it is JSON")
}

#[test]
fn help_names_every_command_and_shows_how_to_begin() {
    let help = succeeds(&["--help"]);
    for command in [
        "demo",
        "run",
        "agent",
        "place-recognition",
        "dpgo",
        "gateway",
        "stream",
        "refine",
        "eval",
        "export",
        "synth",
        "bench",
    ] {
        assert!(help.lines().any(|l| l.trim_start().starts_with(command)), "{command} is missing in\n{help}");
        assert!(succeeds(&[command, "--help"]).len() > 100, "{command} --help says too little");
    }
}

#[test]
fn a_run_leaves_a_folder_that_can_be_scored_again() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("run");
    let shown = out.to_str().unwrap();
    let table = succeeds(&[
        "run",
        "left=world:rooms/agent-0[0:26]",
        "world:rooms/agent-0[10:40:2]",
        "--out",
        shown,
        "--hold-out",
        "5",
        "--fault",
        "left=nodepth:12-13",
    ]);
    assert!(table.contains("ATE RMSE") && table.contains("bytes per frame"), "{table}");

    for file in ["report.json", "report.html", "map.ply", "graph.g2o", "loops.json", "run.json"] {
        assert!(out.join(file).is_file(), "{file}");
    }
    assert!(out.join("renders").read_dir().unwrap().count() >= 4);
    // Stamps are the input's, digit for digit; frames without depth have no pose, or are found again.
    let left = std::fs::read_to_string(out.join("trajectories/left.tum")).unwrap();
    let stamps: Vec<&str> =
        left.lines().filter(|l| !l.starts_with('#')).map(|l| l.split(' ').next().unwrap()).collect();
    assert_eq!(stamps[..3], ["0.000000", "0.033333", "0.066667"]);
    assert!((20..=24).contains(&stamps.len()), "{} poses", stamps.len());
    let other = std::fs::read_to_string(out.join("trajectories/agent-01.tum")).unwrap();
    assert_eq!(other.lines().filter(|l| !l.starts_with('#')).count(), 15);

    let first = json(&out.join("report.json"));
    assert!(first["figures"]["protocol_p"]["ate_rmse_m"].as_f64().unwrap() < 0.02, "{}", first["figures"]);
    assert!(
        first["figures"]["protocol_h"]["psnr_db"].as_f64().is_some(),
        "held-out views: {}",
        first["figures"]
    );
    assert!(first["figures"]["bytes_per_frame"].as_f64().unwrap() > 0.0);
    succeeds(&["eval", shown]);
    assert_eq!(json(&out.join("report.json")), first, "scores come from the folder alone");

    let refused = fails(&["run", "world:rooms/agent-0[0:5]", "--out", shown]);
    assert!(refused.contains("not empty"), "{refused}");
}

#[test]
fn a_finished_map_is_refined_even_if_cut_off_and_each_agent_refines_its_share() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let run = path("run");
    let size = ["--frames", "60", "--width", "160", "--height", "120", "--agents", "1"];
    for side in ["left", "right"] {
        succeeds(&[&["synth", "rooms", "--out", &path(side)][..], &size[..]].concat());
    }
    let left = format!("left=tum:{}/agent-0[0:50]", path("left"));
    let right = format!("right=tum:{}/agent-0[10:60]", path("right"));
    succeeds(&["run", &left, &right, "--hold-out", "4", "--out", &run]);
    let base = std::fs::read(folder.path().join("run/map.ply")).unwrap();
    let steps = ["--steps", "60", "--checkpoint-every", "5", "--poses"];
    let (refine, of_right) = ([&["refine", &run][..], &steps[..]].concat(), ["--agent", "right"]);
    let refined = |name: &str| folder.path().join("run/refined").join(name);

    // Killed once a checkpoint is there.
    let mut child = Command::new(env!("CARGO_BIN_EXE_coma")).args(&refine).spawn().expect("it starts");
    while !refined("map.checkpoint").exists() {
        assert!(child.try_wait().unwrap().is_none(), "it ended without a checkpoint");
        std::thread::yield_now();
    }
    child.kill().unwrap();
    child.wait().unwrap();
    let whole = std::fs::read(refined("map.checkpoint")).unwrap();
    std::fs::write(refined("map.checkpoint"), &whole[..whole.len() - 7]).unwrap();
    let torn = fails(&refine);
    assert!(torn.contains("map.checkpoint") && torn.contains("torn"), "{torn}");
    std::fs::write(refined("map.checkpoint"), &whole).unwrap();
    assert!(succeeds(&refine).contains("goes on after step"));
    let cut_off = std::fs::read(refined("map.ply")).unwrap();
    assert!(!refined("map.checkpoint").exists());
    let again = fails(&refine);
    assert!(again.contains("map.json"), "a refined map is not overwritten: {again}");
    std::fs::remove_dir_all(folder.path().join("run/refined")).unwrap();
    succeeds(&refine);
    assert!(std::fs::read(refined("map.ply")).unwrap() == cut_off, "the same bits");
    assert!(std::fs::read(folder.path().join("run/map.ply")).unwrap() == base, "the run's own map stays");

    succeeds(&["eval", &run]);
    let report = json(&folder.path().join("run/report.json"));
    let score = |kind: &str| report["pictures"][kind]["psnr_db"].as_f64().unwrap();
    assert!(score("refined_training") > score("training") + 1.0, "{}", report["pictures"]);
    assert!(score("refined_held_out") > score("held_out"), "{}", report["pictures"]);
    assert!(report["figures"]["protocol_p"]["psnr_db"] == report["pictures"]["refined_training"]["psnr_db"]);

    // One agent's share: nothing of the other's sequence is read, it need not even be there.
    std::fs::remove_dir_all(folder.path().join("run/refined")).unwrap();
    std::fs::rename(path("left"), path("away")).unwrap();
    succeeds(&[&refine[..], &of_right[..]].concat());
    std::fs::rename(path("away"), path("left")).unwrap();
    let share = json(&refined("share-right.json"));
    let agents: Vec<&str> =
        share["poses"].as_array().unwrap().iter().map(|p| p["agent"].as_str().unwrap()).collect();
    assert!(agents.len() == 38 && agents.iter().all(|a| *a == "right"), "{agents:?}");
    succeeds(&["eval", &run]);
    let report = json(&folder.path().join("run/report.json"));
    assert!(report["pictures"]["refined_training"]["psnr_db"].as_f64().is_some(), "{}", report["pictures"]);
    let unknown = fails(&[&refine[..], &["--agent", "middle"]].concat());
    assert!(unknown.contains("middle") && unknown.contains("left, right"), "{unknown}");
}

#[test]
fn what_is_wrong_is_said_with_the_name_of_the_file_or_argument() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let out = path("out");
    for (arguments, named) in [
        (vec!["run", "tum:does-not-exist", "--out", &out], "does-not-exist"),
        (vec!["run", "movie:x", "--out", &out], "movie"),
        (vec!["run", "world:rooms/agent-0[9:3]", "--out", &out], "9:3"),
        (
            vec!["run", "a=world:rooms/agent-0", "a=world:rooms/agent-1", "--out", &out],
            "two agents are named a",
        ),
        (vec!["run", "world:rooms/agent-0[0:5]", "--out", &out, "--fault", "fog:1-2"], "fog"),
        (vec!["eval", &out], "run.json"),
        (vec!["refine", &out], "run.json"),
        (vec!["stream", "world:rooms/agent-0[0:5]", "--to", "nowhere"], "nowhere"),
        (vec!["demo", "--agents", "0"], "--agents"),
    ] {
        let message = fails(&arguments);
        assert!(message.contains(named), "coma {arguments:?}: {message}");
        assert!(!message.contains("panicked"), "{message}");
    }
    let settings = path("settings.toml");
    std::fs::write(&settings, "queue_frames = 'many'\n").unwrap();
    let message = fails(&["run", "world:rooms/agent-0[0:5]", "--out", &out, "--config", &settings]);
    assert!(message.contains("queue_frames") && message.contains("settings.toml"), "{message}");
}

#[test]
fn a_synthetic_sequence_can_be_written_and_read_back() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("flat");
    let size = ["--frames", "3", "--width", "160", "--height", "120", "--agents", "2"];
    let specs = succeeds(&[&["synth", "rooms", "--out", out.to_str().unwrap()][..], &size[..]].concat());
    let specs: Vec<&str> = specs.lines().collect();
    assert_eq!(specs.len(), 2, "{specs:?}");
    let table = succeeds(&["bench", "tracking", specs[1]]);
    assert!(table.contains("| 3 | 3 | 0 |"), "three frames, three poses: {table}");
}

#[test]
fn an_ablation_leaves_a_table_and_a_picture() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("ablation");
    let table = succeeds(&[
        "bench",
        "ablation",
        "--frames",
        "4",
        "--views",
        "2",
        "--rows",
        "unfitted,gaussians",
        "world:rooms/agent-0",
        "--out",
        out.to_str().unwrap(),
    ]);
    let rows =
        ["| ours |", "| without surfels (3D Gaussians) |", "| without surface-fitting initialisation |"];
    assert!(rows.iter().all(|row| table.contains(row)), "{table}");
    assert!(!table.contains("Adam"), "only what was asked for: {table}");
    let page = std::fs::read_to_string(out.join("ablation.md")).unwrap();
    assert!(page.contains("world:rooms/agent-0[0:4]") && page.contains("ablation.svg"), "{page}");
    assert!(std::fs::read_to_string(out.join("ablation.svg")).unwrap().starts_with("<svg"));
    assert!(fails(&["bench", "ablation", "--frames", "4", "world:rooms/agent-0[0:9]"]).contains("[0:9]"));
}
