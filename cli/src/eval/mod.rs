//! `coma eval`: scores a run's folder against the truth, and writes `report.json`, `report.html` and `renders/`.

mod edges;
mod pictures;

use crate::fault::{self, Fault};
use crate::run::facts::{AgentFacts, Facts, LoopFacts};
use crate::run::{faults, trajectory_name, write_atomically};
use crate::source::{self, Source};
use anyhow::Context;
use clap::Args;
use coma_dataset::Sequence;
use coma_evaluation::{
    AgentSummary, EdgeErrors, LoopCounts, LoopLine, MapSize, NormalisedErrors, Plots, Report, RunInfo,
    RunTrajectories, StageTime, Times, Track, Traffic,
};
use coma_geometry::{AgentId, Pose, StampNs, tum};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Scores a finished run. Needs its folder, and the sequences for truth and pictures where they lay during the run.
///
/// Protocol H (headline): one rigid alignment for all agents of a map together, every frame, views that were never
/// mapped. Protocol P (the paper's): an alignment for each agent, views that the map was made from.
#[derive(Args)]
pub struct Arguments {
    /// Folder of the run, as `coma run --out` wrote it.
    pub dir: PathBuf,
    #[command(flatten)]
    pub options: Options,
}

/// What is measured, and how closely.
#[derive(Args, Clone)]
pub struct Options {
    /// A perceptual model (ONNX) for LPIPS; without one it is not measured.
    #[arg(long, value_name = "FILE.onnx")]
    pub lpips_model: Option<PathBuf>,
    /// Views of each agent that are rendered and compared, evenly spread over its frames; held-out views and others
    /// are counted apart. 0: none.
    #[arg(long, default_value_t = 24)]
    pub views: usize,
}

impl Default for Options {
    fn default() -> Self {
        Options { lpips_model: None, views: 24 }
    }
}

/// Runs it.
pub async fn run(arguments: Arguments) -> anyhow::Result<()> {
    score(&arguments.dir, &arguments.options).await
}

/// Scores the run in `out`, writes its reports there and prints the table.
pub async fn score(out: &Path, options: &Options) -> anyhow::Result<()> {
    let (out, options) = (out.to_owned(), options.clone());
    tokio::task::spawn_blocking(move || score_now(&out, &options)).await?
}

/// A run as it is read back.
pub struct Read {
    /// What the run did.
    pub facts: Facts,
    /// Every candidate.
    pub loops: Vec<LoopFacts>,
    /// What the agents saw, in the order of the facts.
    pub sources: Vec<Source>,
    faults: Vec<Vec<Fault>>,
    /// By agent, then component: frame and `map_from_camera`.
    pub tracks: Tracks,
}

/// By agent, then component: frame and `map_from_camera`.
pub type Tracks = BTreeMap<(usize, usize), Vec<(usize, Pose)>>;

fn score_now(out: &Path, options: &Options) -> anyhow::Result<()> {
    let read = Read::open(out)?;
    let facts = &read.facts;
    let evaluation = coma_evaluation::evaluate(&RunTrajectories::new(read.tracks()?))?;
    let (pictures, shown) = pictures::score(&read, out, options)?;
    let map = facts.components.first().map(|main| MapSize {
        submaps: main.submaps,
        surfels: main.surfels,
        bytes: (main.surfels * coma_surfel::pack::SURFEL_BYTES) as u64,
    });
    let (odometry, loops) = edges::normalised(&read);
    let report = Report {
        run: RunInfo {
            settings: facts.settings.clone(),
            commit: facts.commit.clone(),
            seed: None,
            backend: Some(facts.backend.clone()),
            machine: Some(facts.machine.clone()),
            started: Some(facts.started.clone()),
            finished: Some(facts.finished.clone()),
        },
        agents: facts
            .agents
            .iter()
            .enumerate()
            .map(|(i, a)| summary(&read, i, a))
            .collect::<anyhow::Result<_>>()?,
        trajectories: Some(evaluation.scores.clone()),
        pictures,
        map,
        traffic: Some(Traffic::of(facts.agents.iter().flat_map(|a| a.sent.iter().cloned()))),
        times: Some(times(facts)),
        loops: Some(counts(&read.loops)),
        edges: EdgeErrors { odometry: NormalisedErrors::of(&odometry), loops: NormalisedErrors::of(&loops) },
    };
    let mut plots = Plots::of(&evaluation);
    plots.loops = read.loops.iter().filter_map(|line| loop_line(&read, line)).collect();
    plots.pictures = shown;
    write_atomically(&out.join("report.json"), report.to_json().as_bytes())?;
    write_atomically(&out.join("report.html"), report.to_html(&plots).as_bytes())?;
    println!("{}", report.to_markdown());
    for reason in &facts.not_joined {
        println!("not joined: {reason}");
    }
    println!("report: {}", out.join("report.html").display());
    Ok(())
}

impl Read {
    /// Reads the folder that `coma run` wrote; the sequences must lie where they lay then.
    pub fn open(out: &Path) -> anyhow::Result<Self> {
        let facts = Facts::read(out)?;
        let path = out.join("loops.json");
        let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
        let loops: Vec<LoopFacts> =
            serde_json::from_str(&text).with_context(|| path.display().to_string())?;
        let mut opened = source::open(&facts.specs)?;
        let mut sources = Vec::new();
        for agent in &facts.agents {
            let found = opened.iter().position(|s| s.agent == agent.name);
            let found = found.with_context(|| format!("no spec of the run names agent {}", agent.name))?;
            sources.push(opened.swap_remove(found));
        }
        let names: Vec<String> = facts.agents.iter().map(|a| a.name.clone()).collect();
        let faults = match facts.agents.first() {
            Some(agent) => faults(&agent.faults, &names)?,
            None => Vec::new(),
        };
        let tracks = tracks(out, &facts, &sources)?;
        Ok(Read { facts, loops, sources, faults, tracks })
    }

    fn tracks(&self) -> anyhow::Result<Vec<Track>> {
        let stamp = |agent: usize, frame: usize| self.sources[agent].sequence.stamp(frame);
        self.tracks
            .iter()
            .map(|((agent, component), poses)| {
                let source = &self.sources[*agent];
                let truth = (0..source.sequence.len())
                    .filter_map(|i| Some((source.sequence.stamp(i), source.sequence.truth(i)?)))
                    .collect();
                Ok(Track {
                    agent: AgentId::new(&source.agent)?,
                    component: self.facts.components[*component].name.clone(),
                    frames_seen: self.seen(*agent),
                    estimate: poses.iter().map(|(frame, pose)| (stamp(*agent, *frame), *pose)).collect(),
                    truth,
                })
            })
            .collect()
    }

    /// Frames in which an agent's camera was not blinded on purpose; frames that have a pose all the same count.
    fn seen(&self, agent: usize) -> usize {
        let posed: BTreeSet<usize> = self.facts.agents[agent].poses.iter().map(|p| p.frame).collect();
        let frames = 0..self.sources[agent].sequence.len();
        frames.filter(|i| !fault::blinds(&self.faults[agent], *i) || posed.contains(i)).count()
    }
}

/// Reads the trajectory files.
fn tracks(out: &Path, facts: &Facts, sources: &[Source]) -> anyhow::Result<Tracks> {
    let mut tracks = BTreeMap::new();
    for (agent, known) in facts.agents.iter().enumerate() {
        let components: BTreeSet<usize> = known.poses.iter().map(|p| p.component).collect();
        for component in components {
            let poses = track(out, facts, agent, component, &*sources[agent].sequence)?;
            tracks.insert((agent, component), poses);
        }
    }
    Ok(tracks)
}

/// Reads one trajectory file: frame and `map_from_camera`. Every pose finds its frame by its stamp.
pub fn track(
    out: &Path,
    facts: &Facts,
    agent: usize,
    component: usize,
    sequence: &dyn Sequence,
) -> anyhow::Result<Vec<(usize, Pose)>> {
    let frames: BTreeMap<StampNs, usize> = (0..sequence.len()).map(|i| (sequence.stamp(i), i)).collect();
    let path = out.join("trajectories").join(trajectory_name(facts, agent, component));
    let shown = || path.display().to_string();
    let text = std::fs::read_to_string(&path).with_context(shown)?;
    let of_frame = |p: tum::StampedPose| {
        let frame = frames.get(&p.stamp).copied();
        let frame = frame.with_context(|| format!("{}: no frame has the stamp {}", shown(), p.stamp_text))?;
        Ok((frame, p.pose))
    };
    tum::parse(&text).with_context(shown)?.into_iter().map(of_frame).collect()
}

fn summary(read: &Read, index: usize, agent: &AgentFacts) -> anyhow::Result<AgentSummary> {
    Ok(AgentSummary {
        agent: AgentId::new(&agent.name)?,
        source: agent.spec.clone(),
        frames_seen: read.seen(index),
        frames_posed: agent.poses.len(),
        submaps: Some(agent.submaps.len()),
    })
}

/// Stages of frames have every time; those of other work have their sum, counted once for each agent.
fn times(facts: &Facts) -> Times {
    let mut stages: BTreeMap<&str, Vec<f64>> = BTreeMap::new();
    for agent in &facts.agents {
        for (stage, seconds) in &agent.frame_seconds {
            stages.entry(stage).or_default().extend(seconds);
        }
        for (stage, seconds) in
            agent.stage_seconds.iter().filter(|(s, _)| !agent.frame_seconds.contains_key(*s))
        {
            stages.entry(stage).or_default().push(*seconds);
        }
    }
    let order = |name: &str| (name != "tracking", name != "mapping", name.to_owned());
    let mut stages: Vec<StageTime> = stages.iter().filter_map(|(s, v)| StageTime::of(s, v)).collect();
    stages.sort_by_key(|s| order(&s.stage));
    Times { wall_s: Some(facts.wall_s), cpu_s: facts.cpu_s, stages }
}

fn counts(loops: &[LoopFacts]) -> LoopCounts {
    let mut out = LoopCounts::default();
    for line in loops {
        match line.verdict.as_str() {
            "accepted" if line.from.submap.agent == line.to.submap.agent => out.accepted_within += 1,
            "accepted" => out.accepted_between += 1,
            "withdrawn" => out.withdrawn += 1,
            _ => out.add_rejected(line.reason.as_deref().unwrap_or("unknown")),
        }
    }
    out
}

fn loop_line(read: &Read, line: &LoopFacts) -> Option<LoopLine> {
    let end = |end: &crate::run::facts::End| {
        let agent = read.facts.agents.iter().position(|a| a.name == end.submap.agent.as_str())?;
        Some((end.submap.agent.clone(), read.sources[agent].sequence.stamp(end.frame?)))
    };
    Some(LoopLine { from: end(&line.from)?, to: end(&line.to)?, accepted: line.verdict == "accepted" })
}
