//! The report: what is read back, what is said of what was not measured, and the page.

mod common;

use coma_evaluation::*;
use coma_geometry::StampNs;
use common::{agent, elsewhere, estimated, track, walk};
use serde_json::{Value, json};

const FRAMES: usize = 500;

fn evaluation(merged: bool) -> Evaluation {
    let tracks = (0..2u32)
        .map(|number| {
            let truth = walk(number, FRAMES, 33_333_333);
            let mut estimate = estimated(&truth, elsewhere(), 0.02, u64::from(number));
            if number == 1 {
                estimate.drain(300..306);
            }
            let mut track = track(&format!("agent-0{number}"), truth, estimate);
            if number == 1 && !merged {
                track.component = "map-1".into();
            }
            track
        })
        .collect();
    evaluate(&RunTrajectories::new(tracks)).unwrap()
}

fn sent(class: TrafficClass, message_type: &str, bytes: u64, messages: u64) -> SentBytes {
    SentBytes { class, message_type: message_type.into(), bytes, messages }
}

fn full(merged: bool) -> Report {
    let evaluation = evaluation(merged);
    let summary = |number: usize, frames_posed| AgentSummary {
        agent: agent(&format!("agent-0{number}")),
        source: format!("tum:kitchen[{}:{}]", number * FRAMES, (number + 1) * FRAMES),
        frames_seen: FRAMES,
        frames_posed,
        submaps: Some(21 + number),
    };
    let view = |noise: f64| FrameScore {
        psnr_db: 24.0 - noise,
        psnr_where_depth_db: Some(25.5 - noise),
        ssim: 0.81,
        lpips: None,
        depth_l1: Some(DepthL1 { mean_m: 0.021 + noise * 1e-3, pixels: 250_000 }),
    };
    let times = |mean_s: f64| {
        (0..FRAMES * 2).map(|i| mean_s * (0.8 + 0.4 * ((i * 7) % 10) as f64 / 9.0)).collect::<Vec<_>>()
    };
    let mut loops = LoopCounts {
        accepted_within: 3,
        accepted_between: 9,
        pending: 0,
        withdrawn: 1,
        ..Default::default()
    };
    for reason in ["low_overlap", "low_overlap", "photometric_mismatch", "too_few_inliers"] {
        loops.add_rejected(reason);
    }
    Report {
        run: RunInfo {
            settings: json!({"tracking": {"levels": 3, "huber_m": 0.01}, "hold_out": 8, "note": "<b>&"}),
            commit: Some("0123456789abcdef".into()),
            seed: Some(u64::MAX),
            backend: Some("cpu".into()),
            machine: None,
            started: Some("2026-01-02T03:04:05Z".into()),
            finished: Some("2026-01-02T03:14:05Z".into()),
        },
        agents: vec![summary(0, FRAMES), summary(1, FRAMES - 6)],
        trajectories: Some(evaluation.scores),
        pictures: Pictures {
            held_out: PictureScores::of(&[view(0.7), view(0.1)]),
            training: PictureScores::of(&[view(-3.3)]),
            ..Pictures::default()
        },
        map: Some(MapSize { submaps: 43, surfels: 412_345, bytes: 9_896_280 }),
        traffic: Some(Traffic::of([
            sent(TrafficClass::Peer, "FetchEvidenceResponse", 1_450_321, 31),
            sent(TrafficClass::Peer, "PullEntriesResponse", 212_876, 140),
            sent(TrafficClass::Peer, "HelloRequest", 812, 2),
            sent(TrafficClass::Peer, "framing", 98_311, 0),
            sent(TrafficClass::Gossip, "framing", 44_910, 0),
            sent(TrafficClass::Local, "DescribeRequest", 8_123_456, 43),
            sent(TrafficClass::Client, "FrameAck", 31_234, 1000),
        ])),
        times: Some(Times {
            wall_s: Some(612.3),
            cpu_s: Some(1103.9),
            stages: [
                ("decoding", 0.006),
                (TRACKING, 0.082),
                (MAPPING, 0.21),
                ("places", 0.012),
                ("registration", 0.034),
            ]
            .into_iter()
            .filter_map(|(stage, mean_s)| StageTime::of(stage, &times(mean_s)))
            .collect(),
        }),
        loops: Some(loops),
        edges: EdgeErrors {
            odometry: Some(NormalisedErrors { edges: 41, unusable: 0, mean: 5.2, median: 4.1, max: 19.4 }),
            loops: Some(NormalisedErrors { edges: 12, unusable: 1, mean: 14.8, median: 9.0, max: 61.0 }),
        },
    }
}

fn plots(merged: bool) -> Plots {
    let evaluation = evaluation(merged);
    let stamp = |curve: usize, index: usize| {
        let curve = &evaluation.curves[curve];
        (curve.agent.clone(), curve.points[index].stamp)
    };
    let mut plots = Plots::of(&evaluation);
    plots.loops = [(40, 90, true), (220, 10, true), (120, 330, true), (300, 200, false)]
        .map(|(from, to, accepted)| LoopLine { from: stamp(0, from), to: stamp(1, to), accepted })
        .to_vec();
    plots.pictures = ["agent-00-000040", "agent-01-000360"]
        .map(|name| Picture {
            path: format!("renders/{name}.png"),
            caption: format!("{name}: rendered, recorded"),
        })
        .to_vec();
    plots
}

#[test]
fn a_report_is_read_back_to_the_last_bit() {
    for report in [full(true), full(false), Report::default()] {
        assert_eq!(Report::from_json(&report.to_json()).unwrap(), report);
    }
}

#[test]
fn what_was_not_measured_is_null_and_said_to_be_so() {
    let json: Value = serde_json::from_str(&Report::default().to_json()).unwrap();
    for path in [
        "/trajectories",
        "/pictures/held_out",
        "/map",
        "/traffic",
        "/times",
        "/loops",
        "/edges/loops",
        "/run/seed",
        "/figures/protocol_h/lpips",
        "/figures/bytes_per_frame",
    ] {
        assert_eq!(json.pointer(path), Some(&Value::Null), "{path}");
    }
    let text = Report::default().to_markdown();
    for figure in [
        "ATE RMSE, cm",
        "PSNR, dB",
        "SSIM",
        "LPIPS",
        "depth L1, cm",
        "mapping per frame, s",
        "tracking per frame, s",
        "map memory, MB",
        "bytes per frame between agents",
    ] {
        let row = text.lines().find(|line| line.contains(figure)).unwrap_or_else(|| panic!("no {figure}"));
        assert_eq!(row.matches("not measured").count(), 2, "{row}");
    }
    let row = |text: &str| text.lines().find(|line| line.contains("LPIPS")).unwrap().to_owned();
    assert_eq!(row(&full(true).to_markdown()).matches("not measured").count(), 2);
}

#[test]
fn the_figures_of_the_paper_are_in_one_place() {
    let report = full(true);
    let json: Value = serde_json::from_str(&report.to_json()).unwrap();
    let figure = |path: &str| json.pointer(&format!("/figures/{path}")).unwrap().as_f64().unwrap();
    let scores = report.trajectories.as_ref().unwrap();
    assert_eq!(figure("protocol_h/ate_rmse_m"), scores.joint().unwrap().ate_m.unwrap().rmse);
    assert_eq!(figure("protocol_p/ate_rmse_m"), scores.mean_ate_p_m().unwrap());
    let between = 1_450_321.0 + 212_876.0 + 812.0 + 98_311.0 + 44_910.0;
    assert_eq!(figure("bytes_per_frame"), between / (2 * FRAMES) as f64);
    assert!((figure("tracking_per_frame_s") - 0.082).abs() < 1e-6);
}

#[test]
fn components_that_did_not_merge_have_no_joint_figure_and_are_printed_so() {
    let report = full(false);
    let json: Value = serde_json::from_str(&report.to_json()).unwrap();
    assert_eq!(json.pointer("/figures/protocol_h/ate_rmse_m"), Some(&Value::Null));
    for text in [report.to_markdown(), report.to_html(&plots(false))] {
        assert!(text.contains("not joint: 2 components"), "{text}");
        assert!(text.contains("this component alone") && !text.contains("all agents jointly"));
        assert!(text.contains("none of these errors is joint"));
    }
    assert!(full(true).to_markdown().contains("all agents jointly"));
}

#[test]
fn an_error_over_too_few_frames_is_shown_and_does_not_count() {
    let truth = walk(0, 100, 33_333_333);
    let short = track("agent-00", truth.clone(), estimated(&truth, elsewhere(), 0.02, 0)[..97].to_vec());
    let scores = evaluate(&RunTrajectories::new(vec![short])).unwrap().scores;
    let report = Report { trajectories: Some(scores), ..Report::default() };
    let text = report.to_markdown();
    assert!(text.contains("(does not count: 97.0 % of frames)"), "{text}");
    assert!(text.contains("no: coverage 97.0 %") && text.contains("0 of 1 tracks count"), "{text}");
    let json: Value = serde_json::from_str(&report.to_json()).unwrap();
    assert_eq!(json.pointer("/figures/protocol_h/ate_rmse_m"), Some(&Value::Null));
    assert_eq!(json.pointer("/figures/protocol_p/ate_rmse_m"), Some(&Value::Null));
}

#[test]
fn the_page_is_one_file_with_its_plots_inside() {
    let page = full(true).to_html(&plots(true));
    // To look at.
    let folder = std::path::Path::new(env!("CARGO_TARGET_TMPDIR")).join("report");
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("report.html"), &page).unwrap();
    std::fs::write(folder.join("report.md"), full(true).to_markdown()).unwrap();
    std::fs::write(folder.join("report.json"), full(true).to_json()).unwrap();

    assert_eq!(page.matches("<svg").count(), 4);
    assert_eq!(page.matches("</svg>").count(), 4);
    for outside in ["http://", "https://", "url(", "<script", "<link"] {
        let found = page.matches(outside).count();
        // The name of SVG's namespace is no address that is looked up.
        let namespaces = page.matches("http://www.w3.org/2000/svg").count();
        assert_eq!(found, if outside == "http://" { namespaces } else { 0 }, "{outside}");
    }
    assert!(page.contains("<img src=\"renders/agent-00-000040.png\""));
    assert!(!page.contains("NaN") && !page.contains("inf,"), "a plot has a point that is no number");
    assert!(!page.contains("#0100") && !page.contains("#0200"), "a colour was not taken from the page");
    assert!(page.contains("&lt;b&gt;&amp;"), "settings are shown as they are");
    // Two agents in two pieces each or one, and the truth under them.
    for color in ["var(--agent-0)", "var(--agent-1)", "var(--truth)", "var(--good)", "var(--bad)"] {
        assert!(page.contains(&format!("stroke=\"{color}\"")), "{color}");
    }
}

#[test]
fn a_page_of_nothing_has_no_plots_and_says_what_is_missing() {
    let page = Report::default().to_html(&Plots::default());
    assert!(!page.contains("<svg") && page.contains("not measured"));
    // A curve of a single frame, and loops to nowhere.
    let mut plots = plots(true);
    plots.curves.truncate(1);
    plots.curves[0].points.truncate(1);
    plots.loops[0].to = (agent("agent-09"), StampNs(0));
    let page = full(true).to_html(&plots);
    assert!(!page.contains("NaN") && page.contains("<svg"));
}
