//! `coma bench tracking`: one agent alone, without network, loops or peers: what its poses are worth and what
//! they cost.

use crate::source::{self, Source};
use anyhow::Context;
use clap::Args;
use coma_geometry::{AgentId, Epoch, Pose, alignment, se3};
use coma_slam::agent::{Agent, Event, FrameOptions, SlamSettings};
use coma_slam::tracking::State;
use serde::Serialize;
use std::fmt::Write as _;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;

/// Tracks and maps sequences with one agent each, alone, and prints accuracy and time per frame.
#[derive(Args)]
pub struct Arguments {
    /// Sequences, as for `coma run`.
    #[arg(required = true)]
    specs: Vec<String>,
    /// Settings of tracking, mapping and rendering (TOML; the `slam` table of an agent's settings).
    #[arg(long)]
    settings: Option<PathBuf>,
    /// Writes each agent's trajectory and a table of its frames here.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Threads; default: one per core.
    #[arg(long)]
    threads: Option<usize>,
    /// Prints JSON instead of a table.
    #[arg(long)]
    json: bool,
}

/// One agent's row.
#[derive(Debug, Serialize)]
struct Row {
    agent: String,
    spec: String,
    frames: usize,
    posed: usize,
    lost: usize,
    degraded: usize,
    ate_rmse_cm: Option<f64>,
    ate_max_cm: Option<f64>,
    step_error_mm: Option<f64>,
    track_ms: f64,
    map_ms: f64,
    decode_ms: f64,
    mean_ms: f64,
    p95_ms: f64,
    submaps: usize,
    surfels: usize,
}

/// Runs it.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let settings: SlamSettings = coma_runtime::load(arguments.settings.as_deref(), "COMA_SLAM")?;
    let mut pool = rayon::ThreadPoolBuilder::new();
    if let Some(threads) = arguments.threads {
        pool = pool.num_threads(threads.max(1));
    }
    let pool = pool.build()?;
    let mut rows = Vec::new();
    for source in source::open(&arguments.specs)? {
        rows.push(pool.install(|| one(source, &settings, arguments))?);
    }
    if arguments.json {
        println!("{}", serde_json::to_string_pretty(&rows)?);
    } else {
        print!("{}", table(&rows));
    }
    Ok(())
}

fn one(source: Source, settings: &SlamSettings, arguments: &Arguments) -> anyhow::Result<Row> {
    let sequence = &*source.sequence;
    let progress = crate::progress::frames(&source.agent, sequence.len() as u64);
    let mut agent = Agent::new(AgentId::new(&source.agent)?, Epoch(1), None, settings.clone());
    let mut found: Vec<(usize, Pose)> = Vec::new();
    let (mut lost, mut degraded, mut submaps, mut surfels) = (0, 0, 0, 0);
    let (mut decode_s, mut track_s, mut map_s, mut totals_s) = (0.0, 0.0, 0.0, Vec::new());
    let mut csv = String::from(
        "frame,state,share,x,y,z,track_ms,map_ms,added,new_share,steps,hits,loss_l1,loss_ssim,loss_depth,gain,submap\n",
    );
    for index in 0..sequence.len() {
        let begin = Instant::now();
        let frame = Arc::new(coma_dataset::sequence::rgbd_frame(sequence, index)?);
        let decoded = begin.elapsed().as_secs_f64();
        let located = agent.locate(&frame);
        let tracked = begin.elapsed().as_secs_f64();
        let outcome = agent.take(frame, located, FrameOptions::default());
        let mapped = begin.elapsed().as_secs_f64();
        decode_s += decoded;
        track_s += tracked - decoded;
        map_s += mapped - tracked;
        totals_s.push(mapped);
        let state = match &outcome.state {
            State::Tracking => "tracking".to_owned(),
            State::Degraded(reasons) => {
                degraded += 1;
                format!("degraded: {}", reasons.iter().map(|r| r.to_string()).collect::<Vec<_>>().join("; "))
            }
            State::Lost(reasons) => {
                lost += 1;
                format!("lost: {}", reasons.iter().map(|r| r.to_string()).collect::<Vec<_>>().join("; "))
            }
        };
        for event in &outcome.events {
            if let Event::SubmapClosed(_, cloud) = event {
                submaps += 1;
                surfels += cloud.len();
            }
        }
        if let Some(pose) = &outcome.pose {
            found.push((index, pose.agent_from_camera));
            let t = pose.agent_from_camera.translation.vector;
            let m = &outcome.mapped;
            let loss = m.loss.unwrap_or_default();
            writeln!(
                csv,
                "{index},{state:?},{:.4},{:.5},{:.5},{:.5},{:.1},{:.1},{},{:.4},{},{},{:.5},{:.4},{:.5},{:.4},{}",
                outcome.share,
                t.x,
                t.y,
                t.z,
                (tracked - decoded) * 1e3,
                (mapped - tracked) * 1e3,
                m.added,
                m.new_share,
                m.steps,
                m.hits,
                loss.color_l1,
                loss.ssim,
                loss.depth_l1_m,
                pose.brightness.gain,
                pose.submap.number
            )?;
        } else {
            writeln!(csv, "{index},{state:?}")?;
        }
        progress.inc(1);
    }
    for event in agent.finish() {
        if let Event::SubmapClosed(_, cloud) = event {
            submaps += 1;
            surfels += cloud.len();
        }
    }
    progress.finish_and_clear();
    if let Some(out) = &arguments.out {
        std::fs::create_dir_all(out).with_context(|| out.display().to_string())?;
        let lines = found.iter().map(|(i, pose)| (sequence.stamp_text(*i), pose));
        std::fs::write(out.join(format!("{}.tum", source.agent)), coma_geometry::tum::format(lines))?;
        std::fs::write(out.join(format!("{}.csv", source.agent)), csv)?;
    }
    let score = score(&found, |i| sequence.truth(i));
    totals_s.sort_by(f64::total_cmp);
    let n = sequence.len() as f64;
    Ok(Row {
        agent: source.agent.clone(),
        spec: source.spec.clone(),
        frames: sequence.len(),
        posed: found.len(),
        lost,
        degraded,
        ate_rmse_cm: score.map(|s| s.0 * 100.0),
        ate_max_cm: score.map(|s| s.1 * 100.0),
        step_error_mm: score.map(|s| s.2 * 1e3),
        track_ms: track_s / n * 1e3,
        map_ms: map_s / n * 1e3,
        decode_ms: decode_s / n * 1e3,
        mean_ms: totals_s.iter().sum::<f64>() / n * 1e3,
        p95_ms: totals_s[((totals_s.len() - 1) as f64 * 0.95) as usize] * 1e3,
        submaps,
        surfels,
    })
}

/// RMS and largest distance after rigid alignment, and RMS of the error of one step, metres.
fn score(found: &[(usize, Pose)], truth: impl Fn(usize) -> Option<Pose>) -> Option<(f64, f64, f64)> {
    let pairs: Vec<(usize, Pose, Pose)> =
        found.iter().filter_map(|(i, p)| Some((*i, *p, truth(*i)?))).collect();
    let points = |f: fn(&(usize, Pose, Pose)) -> Pose| -> Vec<_> {
        pairs.iter().map(|p| f(p).translation.vector.into()).collect()
    };
    let (estimated, true_points) = (points(|p| p.1), points(|p| p.2));
    let world_from_agent = alignment::rigid_alignment(&estimated, &true_points)?;
    let distances: Vec<f64> =
        estimated.iter().zip(&true_points).map(|(e, t)| (world_from_agent * e - t).norm()).collect();
    let rms = (distances.iter().map(|d| d * d).sum::<f64>() / distances.len() as f64).sqrt();
    let steps: Vec<f64> = pairs
        .windows(2)
        .map(|w| {
            let (own, real) = (w[0].1.inv_mul(&w[1].1), w[0].2.inv_mul(&w[1].2));
            se3::distance(&own, &real).0
        })
        .collect();
    let step = (steps.iter().map(|d| d * d).sum::<f64>() / steps.len().max(1) as f64).sqrt();
    Some((rms, distances.iter().copied().fold(0.0, f64::max), step))
}

fn table(rows: &[Row]) -> String {
    let mut out = String::from(
        "| agent | frames | posed | lost | ATE RMSE cm | max cm | step mm | track ms | map ms | decode ms | all ms | p95 ms | submaps | surfels |\n\
         |---|---|---|---|---|---|---|---|---|---|---|---|---|---|\n",
    );
    let number = |v: Option<f64>| v.map_or("no truth".to_owned(), |v| format!("{v:.3}"));
    for r in rows {
        let _ = writeln!(
            out,
            "| {} | {} | {} | {} | {} | {} | {} | {:.1} | {:.1} | {:.1} | {:.1} | {:.1} | {} | {} |",
            r.agent,
            r.frames,
            r.posed,
            r.lost,
            number(r.ate_rmse_cm),
            number(r.ate_max_cm),
            number(r.step_error_mm),
            r.track_ms,
            r.map_ms,
            r.decode_ms,
            r.mean_ms,
            r.p95_ms,
            r.submaps,
            r.surfels
        );
    }
    out
}
