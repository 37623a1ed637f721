//! `coma refine`: a finished run's map, made better by its own pictures; a job that can be cut off and goes on.

pub mod folder;
mod views;

use crate::progress;
use crate::run::facts::Facts;
use crate::run::write_atomically;
use anyhow::{Context, bail};
use clap::Args;
use coma_frame::RgbdFrame;
use coma_slam::mapping::refine::{RefineSettings, Refiner, Step};
use coma_surfel::SurfelCloud;
use folder::{Files, Progress, RefinedFacts, RefinedPose};
use std::path::{Path, PathBuf};
use std::time::Instant;
use views::Views;

/// Refines the map of a finished run by the frames that it was made from: surfels are moved, coloured, split and
/// dropped until renderings fit the pictures; `coma eval` then scores the map before and after.
///
/// The run's own map stays as it is; the refined one is written beside it, below refined/. A job that is cut off goes on
/// from its last checkpoint when the same command is given again, and ends with the same bits. Frames that the run held
/// out are never read.
///
///   coma refine runs/rooms
///   coma refine runs/rooms --agent agent-01     # only what this agent owns, by its own pictures
#[derive(Args)]
pub struct Arguments {
    /// Folder of the run, as `coma run --out` wrote it.
    dir: PathBuf,
    /// Refines only the surfels of this agent, by its frames alone; those of others are rendered and stay as they are.
    /// `coma eval` puts shares together.
    #[arg(long, value_name = "NAME")]
    agent: Option<String>,
    /// Optimiser steps, one frame each; default: 3000, or what --config says.
    #[arg(long)]
    steps: Option<u32>,
    /// Cameras choose their exposure: each picture is first brought to the map's brightness.
    #[arg(long)]
    exposure: bool,
    /// Aligns each view with the map when it is visited, for cameras that were tracked worse than the map shows detail.
    /// Held-out views take the corrections of their neighbours.
    #[arg(long)]
    poses: bool,
    /// Which of the run's maps, where agents did not all merge; the first has most frames.
    #[arg(long, default_value_t = 0)]
    component: usize,
    /// Settings of refinement (TOML); COMA_REFINE_... in the environment overrides them.
    #[arg(long)]
    config: Option<PathBuf>,
    /// A checkpoint is written after so many steps.
    #[arg(long, default_value_t = 250, value_parser = clap::value_parser!(u32).range(1..))]
    checkpoint_every: u32,
    /// Threads; default: one per core. The result does not depend on it.
    #[arg(long)]
    threads: Option<usize>,
}

/// Runs it.
pub async fn run(arguments: Arguments) -> anyhow::Result<()> {
    let mut settings: RefineSettings = coma_runtime::load(arguments.config.as_deref(), "COMA_REFINE")?;
    settings.steps = arguments.steps.unwrap_or(settings.steps);
    settings.exposure |= arguments.exposure;
    settings.poses |= arguments.poses;
    tokio::task::spawn_blocking(move || {
        let mut pool = rayon::ThreadPoolBuilder::new();
        if let Some(threads) = arguments.threads {
            pool = pool.num_threads(threads.max(1));
        }
        pool.build()?.install(|| refine(&arguments, settings))
    })
    .await?
}

fn refine(arguments: &Arguments, settings: RefineSettings) -> anyhow::Result<()> {
    let (dir, component) = (&arguments.dir, arguments.component);
    let facts = Facts::read(dir)?;
    let Some(of) = facts.components.get(component).filter(|c| !c.map.is_empty()) else {
        bail!("--component {component}: the run has {} maps, counted from 0", facts.components.len());
    };
    if let Some(name) = &arguments.agent
        && !facts.agents.iter().any(|a| a.name == *name)
    {
        let names: Vec<&str> = facts.agents.iter().map(|a| a.name.as_str()).collect();
        bail!("--agent {name}: no agent has this name; there are {}", names.join(", "));
    }
    let files = Files::new(dir, component, arguments.agent.as_deref());
    if files.facts().exists() {
        bail!("{}: is there already; remove it to refine again", files.facts().display());
    }
    let views = Views::open(dir, &facts, component, arguments.agent.as_deref())?;
    let map = folder::read_map(&dir.join(&of.map))?;
    if map.len() != of.surfels {
        bail!("{}: {} surfels, run.json speaks of {}", of.map, map.len(), of.surfels);
    }
    let (own, fixed) = match &arguments.agent {
        Some(agent) => share(&folder::owners(&facts, component, &map)?, agent, &map),
        None => (map, SurfelCloud::default()),
    };
    let job = Refiner::new(settings.clone(), own, fixed, views.poses());
    let mut job = Job { job, files, progress: Vec::new(), seconds: 0.0 };
    job.take_up()?;
    std::fs::create_dir_all(dir.join("refined")).with_context(|| dir.display().to_string())?;
    job.go(&views, arguments.checkpoint_every)?;
    let poses = views.of.iter().zip(job.job.poses()).map(|(view, pose)| RefinedPose {
        agent: views.agent(view).to_owned(),
        frame: view.frame,
        map_from_camera: *pose,
    });
    let done = RefinedFacts {
        component: of.name.clone(),
        digest: of.digest.clone(),
        base_surfels: of.surfels,
        agent: arguments.agent.clone(),
        settings,
        surfels: job.job.surfels().len(),
        seconds: job.seconds,
        progress: job.progress.clone(),
        poses: poses.collect(),
    };
    job.finish(&done)
}

/// One agent's surfels, and those of all others.
fn share(
    owners: &[(String, std::ops::Range<usize>)],
    agent: &str,
    map: &SurfelCloud,
) -> (SurfelCloud, SurfelCloud) {
    let of = |own: bool| -> SurfelCloud {
        let ranges = owners.iter().filter(|(name, _)| (name == agent) == own);
        ranges.flat_map(|(_, range)| range.clone()).map(|i| map.get(i)).collect()
    };
    (of(true), of(false))
}

/// Steps between two lines of progress.
const LINE_STEPS: u32 = 100;

struct Job {
    job: Refiner,
    files: Files,
    progress: Vec<Progress>,
    /// Of earlier parts too.
    seconds: f64,
}

/// What a checkpoint's file holds before the job's own bytes, as one line of JSON.
#[derive(serde::Serialize, serde::Deserialize)]
struct Head {
    progress: Vec<Progress>,
    seconds: f64,
}

impl Job {
    /// Goes on where a job that was cut off left its checkpoint.
    fn take_up(&mut self) -> anyhow::Result<()> {
        let path = self.files.checkpoint();
        if !path.exists() {
            return Ok(());
        }
        let bytes = folder::read_bounded(&path)?;
        let refuse = || format!("{}: can't go on from it; remove it to begin anew", path.display());
        let line = bytes.iter().position(|b| *b == b'\n').unwrap_or(bytes.len());
        let head: Head = serde_json::from_slice(&bytes[..line]).with_context(refuse)?;
        let state = bytes.get(line + 1..).unwrap_or_default();
        self.job.resume(state).with_context(refuse)?;
        (self.progress, self.seconds) = (head.progress, head.seconds);
        println!("goes on after step {}", self.job.steps());
        Ok(())
    }

    fn write_checkpoint(&self) -> anyhow::Result<()> {
        let head = Head { progress: self.progress.clone(), seconds: self.seconds };
        let mut bytes = serde_json::to_vec(&head)?;
        bytes.push(b'\n');
        bytes.extend_from_slice(&self.job.checkpoint());
        write_atomically(&self.files.checkpoint(), &bytes)
    }

    fn go(&mut self, views: &Views, checkpoint_every: u32) -> anyhow::Result<()> {
        let total = self.job.steps() + self.job.steps_left();
        let bar = progress::steps("refining", u64::from(total));
        bar.set_position(u64::from(self.job.steps()));
        let reader = views.reader(self.job.wants())?;
        let mut line = Line::default();
        while self.job.wants().is_some() {
            let begin = Instant::now();
            let frame: RgbdFrame = reader.next(self.job.wants_then())?;
            let step = self.job.step(&frame);
            let seconds = begin.elapsed().as_secs_f64();
            self.seconds += seconds;
            line.add(&step, seconds);
            bar.set_position(u64::from(self.job.steps()));
            if self.job.steps().is_multiple_of(LINE_STEPS) || self.job.wants().is_none() {
                let mean = line.mean(self.job.steps());
                bar.set_message(format!("{:.2} dB, {} surfels", mean.psnr_db, mean.surfels));
                println!("{mean}");
                self.progress.push(mean);
                line = Line::default();
            }
            if self.job.steps().is_multiple_of(checkpoint_every) && self.job.wants().is_some() {
                let begin = Instant::now();
                self.write_checkpoint()?;
                self.seconds += begin.elapsed().as_secs_f64();
            }
        }
        bar.finish_and_clear();
        Ok(())
    }

    fn finish(&self, facts: &RefinedFacts) -> anyhow::Result<()> {
        self.files.write(self.job.surfels(), facts)?;
        let checkpoint = self.files.checkpoint();
        if checkpoint.exists() {
            std::fs::remove_file(&checkpoint).with_context(|| checkpoint.display().to_string())?;
        }
        println!(
            "refined map: {}, {} surfels, {:.0} s; `coma eval` scores it",
            shown(&self.files.map()),
            facts.surfels,
            facts.seconds
        );
        Ok(())
    }
}

fn shown(path: &Path) -> String {
    path.display().to_string()
}

/// Sums since the last line of progress.
#[derive(Default)]
struct Line {
    steps: u32,
    psnr_db: f64,
    ssim: f64,
    depth_l1_m: f64,
    seconds: f64,
    surfels: usize,
}

impl Line {
    fn add(&mut self, step: &Step, seconds: f64) {
        self.steps += 1;
        self.psnr_db += step.psnr_db;
        self.ssim += step.ssim;
        self.depth_l1_m += step.depth_l1_m;
        self.seconds += seconds;
        self.surfels = step.surfels;
    }

    fn mean(&self, step: u32) -> Progress {
        let steps = f64::from(self.steps.max(1));
        Progress {
            step,
            psnr_db: self.psnr_db / steps,
            ssim: self.ssim / steps,
            depth_l1_m: self.depth_l1_m / steps,
            surfels: self.surfels,
            step_s: self.seconds / steps,
        }
    }
}

impl std::fmt::Display for Progress {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "step {:5}: PSNR {:.2} dB, SSIM {:.4}, depth L1 {:.3} cm, {} surfels, {:.0} ms per step",
            self.step,
            self.psnr_db,
            self.ssim,
            self.depth_l1_m * 100.0,
            self.surfels,
            self.step_s * 1e3
        )
    }
}
