//! `coma bench registration`: pairs of views with a wide baseline, and pairs that share nothing.

use super::cpu::{median, timed};
use super::overlap::Sight;
use crate::source;
use anyhow::{Context, ensure};
use clap::Args;
use coma_dataset::Sequence;
use coma_geometry::{Pose, Tangent, se3};
use coma_registration::{
    Alignment, Outcome, Prepared, Reason, Settings, Side, View, align_prepared, coarse, decide,
};
use serde::{Deserialize, Serialize};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Registers pairs of frames from no initial guess, and prints success, errors, processor time and verdicts.
///
/// A pair succeeds under 3 degrees and 5 cm; an accepted one is wrong over 5 degrees or 10 cm, and always if its
/// frames share less than 1 % of what they see. For example, pairs with a wide baseline, then all pairs of every
/// 10th frame, and each of these with every 10th frame of another room:
///
///   coma bench registration tum:kitchen --pairs kitchen_pairs.json
///   coma bench registration tum:kitchen --sweep 10 --other tum:living-room/agent-0
#[derive(Args)]
pub struct Arguments {
    /// The sequence whose frames are registered, as for `coma run`; its true poses must be known.
    spec: String,
    /// Pairs to register: a JSON list of {"src": FRAME, "dst": FRAME}.
    #[arg(long)]
    pairs: Option<PathBuf>,
    /// Registers all pairs of every K-th frame.
    #[arg(long, value_name = "K")]
    sweep: Option<usize>,
    /// A sequence of another place, for the sweep: no pair with one of its frames may be accepted.
    #[arg(long, value_name = "SPEC", requires = "sweep")]
    other: Vec<String>,
    /// Settings of registration (TOML).
    #[arg(long)]
    settings: Option<PathBuf>,
    /// Seed of the samples.
    #[arg(long, default_value_t = 7)]
    seed: u64,
    /// Threads; default: one per core.
    #[arg(long)]
    threads: Option<usize>,
    /// Prints JSON instead of tables.
    #[arg(long)]
    json: bool,
}

#[derive(Deserialize)]
struct Asked {
    src: usize,
    dst: usize,
}

/// One pair with a wide baseline.
#[derive(Debug, Serialize)]
struct Pair {
    src: usize,
    dst: usize,
    true_overlap: f64,
    accepted: bool,
    error_deg: Option<f64>,
    error_cm: Option<f64>,
    /// By the claimed information; 6 on average if it is right.
    squared_error: Option<f64>,
    verdict: String,
    prepare_ms: f64,
    coarse_ms: f64,
    refine_ms: f64,
}

#[derive(Debug, Serialize)]
struct PairsReport {
    pairs: usize,
    success: usize,
    accepted: usize,
    wrong: usize,
    median_deg: f64,
    median_cm: f64,
    mean_squared_error: f64,
    /// Processor time per pair, median: both views' clouds and features.
    prepare_ms: f64,
    /// Matches and RANSAC.
    coarse_ms: f64,
    /// Refinement and verification.
    refine_ms: f64,
    /// All of it, median and largest.
    total_ms: f64,
    total_max_ms: f64,
    rows: Vec<Pair>,
}

/// Pairs of a sweep that truly share so much.
#[derive(Debug, Serialize)]
struct Class {
    truly_shared: String,
    tried: usize,
    accepted: usize,
    success: usize,
    wrong: usize,
    wrong_pairs: Vec<String>,
    /// By the claimed information; 6 on average if it is right.
    mean_squared_error: Option<f64>,
    median_squared_error: Option<f64>,
    /// Root mean squares.
    rms_cm: Option<f64>,
    rms_deg: Option<f64>,
    /// All accepted ones; the figures above leave out those that are wrong.
    edges: Vec<EdgeError>,
}

/// An accepted motion: how wrong it is and how sure it claims to be.
#[derive(Debug, Serialize)]
struct EdgeError {
    source: String,
    target: String,
    true_overlap: f64,
    wrong: bool,
    /// `log(truth^-1 * found)`: metres, then radians.
    error: Tangent,
    /// What registration said of it.
    found: Box<Alignment>,
}

impl EdgeError {
    /// By the claimed information.
    fn squared(&self) -> f64 {
        (self.error.transpose() * self.found.information * self.error)[0]
    }
}

#[derive(Serialize)]
struct Report {
    seed: u64,
    pairs: Option<PairsReport>,
    sweep: Option<Vec<Class>>,
}

/// Runs it.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    ensure!(arguments.pairs.is_some() || arguments.sweep.is_some(), "nothing to do: give --pairs or --sweep");
    let settings: Settings = coma_runtime::load(arguments.settings.as_deref(), "COMA_REGISTRATION")?;
    let mut pool = rayon::ThreadPoolBuilder::new();
    if let Some(threads) = arguments.threads {
        pool = pool.num_threads(threads.max(1));
    }
    let report = pool.build()?.install(|| {
        let sequence = one(&arguments.spec)?;
        let pairs = match &arguments.pairs {
            Some(file) => Some(pairs(&*sequence, file, &settings, arguments.seed)?),
            None => None,
        };
        let sweep = match arguments.sweep {
            Some(every) => Some(sweep(&*sequence, every, &arguments.other, &settings, arguments.seed)?),
            None => None,
        };
        anyhow::Ok(Report { seed: arguments.seed, pairs, sweep })
    })?;
    if arguments.json {
        println!("{}", serde_json::to_string_pretty(&report)?);
        return Ok(());
    }
    if let Some(pairs) = &report.pairs {
        print!("{}", pairs_table(pairs));
    }
    if let Some(classes) = &report.sweep {
        print!("{}", sweep_table(classes));
    }
    Ok(())
}

fn one(spec: &str) -> anyhow::Result<Box<dyn Sequence>> {
    let mut sources = source::open(&[spec.to_owned()])?;
    ensure!(sources.len() == 1, "{spec} names {} sequences, one is needed", sources.len());
    Ok(sources.remove(0).sequence)
}

/// Metres and degrees, and whether an acceptance is wrong.
fn error(truth: &Pose, found: &Pose) -> (f64, f64, bool) {
    let (m, rad) = se3::distance(truth, found);
    let deg = rad.to_degrees();
    (m, deg, !(m <= 0.10 && deg <= 5.0))
}

/// By the claimed information.
fn squared_error(truth: &Pose, found: &Alignment) -> f64 {
    let xi = se3::log(&truth.inv_mul(&found.target_from_source));
    (xi.transpose() * found.information * xi)[0]
}

fn succeeds(m: f64, deg: f64) -> bool {
    m < 0.05 && deg < 3.0
}

fn pairs(
    sequence: &dyn Sequence,
    file: &Path,
    settings: &Settings,
    seed: u64,
) -> anyhow::Result<PairsReport> {
    let text = std::fs::read_to_string(file).with_context(|| file.display().to_string())?;
    let asked: Vec<Asked> = serde_json::from_str(&text).with_context(|| file.display().to_string())?;
    let mut rows = Vec::new();
    for Asked { src, dst } in asked {
        let frames = sequence.len();
        ensure!(src < frames && dst < frames, "pair {src} and {dst}: the sequence has {frames} frames");
        rows.push(pair(sequence, src, dst, settings, seed)?);
    }
    let wrong = |r: &&Pair| r.accepted && !(r.error_cm <= Some(10.0) && r.error_deg <= Some(5.0));
    let success =
        |r: &&Pair| r.accepted && succeeds(r.error_cm.unwrap_or(1e9) / 100.0, r.error_deg.unwrap_or(1e9));
    let of = |value: fn(&Pair) -> Option<f64>| median(rows.iter().filter_map(value).collect());
    let squared: Vec<f64> = rows.iter().filter_map(|r| r.squared_error).collect();
    let total = |r: &Pair| r.prepare_ms + r.coarse_ms + r.refine_ms;
    Ok(PairsReport {
        pairs: rows.len(),
        success: rows.iter().filter(success).count(),
        accepted: rows.iter().filter(|r| r.accepted).count(),
        wrong: rows.iter().filter(wrong).count(),
        median_deg: of(|r| r.error_deg),
        median_cm: of(|r| r.error_cm),
        mean_squared_error: squared.iter().sum::<f64>() / squared.len().max(1) as f64,
        prepare_ms: of(|r| Some(r.prepare_ms)),
        coarse_ms: of(|r| Some(r.coarse_ms)),
        refine_ms: of(|r| Some(r.refine_ms)),
        total_ms: median(rows.iter().map(total).collect()),
        total_max_ms: rows.iter().map(total).fold(0.0, f64::max),
        rows,
    })
}

/// The steps of [`coma_registration::align()`], each timed.
fn pair(
    sequence: &dyn Sequence,
    src: usize,
    dst: usize,
    settings: &Settings,
    seed: u64,
) -> anyhow::Result<Pair> {
    let (seen_source, source) = Sight::of(sequence, src)?;
    let (seen_target, target) = Sight::of(sequence, dst)?;
    let (source, target) = (View::from_frame(&source), View::from_frame(&target));
    let (prepared, prepare_ms) = timed(|| {
        let source = Prepared::new(&source, settings, Side::Source)?;
        Ok::<_, Reason>((source, Prepared::new(&target, settings, Side::Target)?))
    });
    let (mut coarse_ms, mut refine_ms) = (0.0, 0.0);
    let outcome = match prepared {
        Err(reason) => Outcome::Rejected(reason),
        Ok((source, target)) => {
            let (hypotheses, ms) = timed(|| coarse(&source, &target, settings, seed));
            coarse_ms = ms;
            match hypotheses {
                Err(reason) => Outcome::Rejected(reason),
                Ok(hypotheses) => {
                    let (outcome, ms) = timed(|| decide(&source, &target, hypotheses, settings));
                    refine_ms = ms;
                    outcome
                }
            }
        }
    };
    let truth = seen_source.motion_to(&seen_target);
    let true_overlap = seen_source.mutual(&seen_target);
    let mut row = Pair {
        src,
        dst,
        true_overlap,
        accepted: false,
        error_deg: None,
        error_cm: None,
        squared_error: None,
        verdict: String::new(),
        prepare_ms,
        coarse_ms,
        refine_ms,
    };
    match outcome {
        Outcome::Accepted(a) => {
            let (m, deg, _) = error(&truth, &a.target_from_source);
            row.accepted = true;
            row.error_deg = Some(deg);
            row.error_cm = Some(m * 100.0);
            row.squared_error = Some(squared_error(&truth, &a));
            row.verdict = format!(
                "overlap {:.2}, conflicts {:.3}, correlation {}",
                a.overlap,
                a.conflicts,
                a.photometric_correlation.map_or("none".into(), |c| format!("{c:.2}"))
            );
        }
        Outcome::Rejected(reason) => row.verdict = reason.to_string(),
    }
    Ok(row)
}

/// A frame of a sweep.
struct Frame {
    name: String,
    place: usize,
    sight: Sight,
    prepared: Result<Prepared, Reason>,
}

fn frames(
    sequence: &dyn Sequence,
    every: usize,
    place: usize,
    name: &str,
    settings: &Settings,
) -> anyhow::Result<Vec<Frame>> {
    let frame = |index| {
        let (sight, frame) = Sight::of(sequence, index)?;
        let prepared = Prepared::new(&View::from_frame(&frame), settings, Side::Source);
        Ok(Frame { name: format!("{name}{index}"), place, sight, prepared })
    };
    (0..sequence.len()).step_by(every.max(1)).map(frame).collect()
}

fn sweep(
    sequence: &dyn Sequence,
    every: usize,
    others: &[String],
    settings: &Settings,
    seed: u64,
) -> anyhow::Result<Vec<Class>> {
    let own = frames(sequence, every, 0, "", settings)?;
    let mut all: Vec<&Frame> = own.iter().collect();
    let mut strangers = Vec::new();
    for (place, spec) in others.iter().enumerate() {
        strangers.extend(frames(&*one(spec)?, every, place + 1, &format!("{spec} "), settings)?);
    }
    all.extend(&strangers);
    let names = ["another place", "under 1 %", "1 to 10 %", "10 to 35 %", "35 % and more"];
    let mut classes = names.map(|name| Class {
        truly_shared: name.into(),
        tried: 0,
        accepted: 0,
        success: 0,
        wrong: 0,
        wrong_pairs: Vec::new(),
        mean_squared_error: None,
        median_squared_error: None,
        rms_cm: None,
        rms_deg: None,
        edges: Vec::new(),
    });
    let progress = crate::progress::steps(
        "pairs",
        (own.len() * (own.len() - 1) / 2 + own.len() * strangers.len()) as u64,
    );
    for (i, source) in own.iter().enumerate() {
        for target in &all[i + 1..] {
            progress.inc(1);
            let shared = if source.place == target.place { source.sight.mutual(&target.sight) } else { 0.0 };
            let class = match shared {
                _ if source.place != target.place => 0,
                s if s < 0.01 => 1,
                s if s < 0.10 => 2,
                s if s < 0.35 => 3,
                _ => 4,
            };
            let class = &mut classes[class];
            class.tried += 1;
            let (Ok(from), Ok(into)) = (&source.prepared, &target.prepared) else { continue };
            let Outcome::Accepted(found) = align_prepared(from, into, settings, seed) else { continue };
            class.accepted += 1;
            let truth = source.sight.motion_to(&target.sight);
            let (m, deg, is_far) = error(&truth, &found.target_from_source);
            let wrong = shared < 0.01 || is_far;
            if wrong {
                class.wrong += 1;
                class.wrong_pairs.push(format!(
                    "{} and {}: {deg:.1} degrees, {:.1} cm",
                    source.name,
                    target.name,
                    m * 100.0
                ));
            } else {
                class.success += succeeds(m, deg) as usize;
            }
            class.edges.push(EdgeError {
                source: source.name.clone(),
                target: target.name.clone(),
                true_overlap: shared,
                wrong,
                error: se3::log(&truth.inv_mul(&found.target_from_source)),
                found,
            });
        }
    }
    progress.finish_and_clear();
    for class in &mut classes {
        let right: Vec<&EdgeError> = class.edges.iter().filter(|e| !e.wrong).collect();
        if right.is_empty() {
            continue;
        }
        let squared: Vec<f64> = right.iter().map(|e| e.squared()).collect();
        let mean =
            |of: &dyn Fn(&EdgeError) -> f64| right.iter().map(|e| of(e)).sum::<f64>() / right.len() as f64;
        class.rms_cm = Some(100.0 * mean(&|e| e.error.fixed_rows::<3>(0).norm_squared()).sqrt());
        class.rms_deg = Some(mean(&|e| e.error.fixed_rows::<3>(3).norm_squared()).sqrt().to_degrees());
        class.mean_squared_error = Some(mean(&EdgeError::squared));
        class.median_squared_error = Some(median(squared));
    }
    Ok(classes.into_iter().filter(|c| c.tried > 0).collect())
}

fn pairs_table(report: &PairsReport) -> String {
    let mut out = String::from(
        "| frames | truly shared | degrees | cm | squared error | CPU ms: prepare | coarse | refine | verdict |\n\
         |---|---|---|---|---|---|---|---|---|\n",
    );
    let number = |v: Option<f64>| v.map_or("-".to_owned(), |v| format!("{v:.2}"));
    for r in &report.rows {
        let _ = writeln!(
            out,
            "| {} {} | {:.2} | {} | {} | {} | {:.0} | {:.0} | {:.0} | {}: {} |",
            r.src,
            r.dst,
            r.true_overlap,
            number(r.error_deg),
            number(r.error_cm),
            number(r.squared_error),
            r.prepare_ms,
            r.coarse_ms,
            r.refine_ms,
            if r.accepted { "accepted" } else { "rejected" },
            r.verdict
        );
    }
    let _ = writeln!(
        out,
        "\n{} of {} pairs within 3 degrees and 5 cm; {} accepted, {} of them wrong; median error {:.2} degrees, {:.2} cm; \
         mean squared normalised error {:.2}\n\
         CPU ms per pair, median: prepare {:.0}, coarse {:.0}, refine {:.0}, all {:.0} (at most {:.0})",
        report.success,
        report.pairs,
        report.accepted,
        report.wrong,
        report.median_deg,
        report.median_cm,
        report.mean_squared_error,
        report.prepare_ms,
        report.coarse_ms,
        report.refine_ms,
        report.total_ms,
        report.total_max_ms
    );
    out
}

fn sweep_table(classes: &[Class]) -> String {
    let mut out = String::from(
        "| truly shared | tried | accepted | within 3 degrees and 5 cm | wrong | RMS degrees | RMS cm | \
         squared error: mean | median |\n|---|---|---|---|---|---|---|---|---|\n",
    );
    for c in classes {
        let number = |v: Option<f64>| v.map_or("-".to_owned(), |v| format!("{v:.2}"));
        let _ = writeln!(
            out,
            "| {} | {} | {} | {} | {} | {} | {} | {} | {} |",
            c.truly_shared,
            c.tried,
            c.accepted,
            c.success,
            c.wrong,
            number(c.rms_deg),
            number(c.rms_cm),
            number(c.mean_squared_error),
            number(c.median_squared_error)
        );
    }
    for pair in classes.iter().flat_map(|c| &c.wrong_pairs) {
        let _ = writeln!(out, "wrong: {pair}");
    }
    out
}
