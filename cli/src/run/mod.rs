//! `coma run` and what it shares with `coma demo`: agents in this process, one sequence each, and a folder with
//! everything that came of it.

pub mod facts;
mod folder;
mod g2o;
pub mod gather;

pub use folder::{trajectory_name, write as write_folder, write_atomically, write_in_pieces};

use crate::cluster::Cluster;
use crate::collect::{self, AgentCalls};
use crate::fault::{self, Fault};
use crate::source::{self, Source};
use crate::stream::{StreamOptions, Streamed, stream};
use crate::{eval, progress};
use anyhow::{Context, bail};
use clap::Args;
use coma_agent::AgentConfig;
use coma_geometry::StampNs;
use coma_place_recognition::PlaceRecognitionConfig;
use coma_runtime::{ByteLedger, Class, channel};
use facts::{AgentFacts, Facts};
use std::path::{Path, PathBuf};
use std::time::{Instant, SystemTime};
use tokio::task::JoinSet;

/// Runs one agent for each spec, in this process, until all agree on one map; writes a folder with everything.
///
/// A spec is [NAME=]FORMAT:DIR[first:last:stride,...] with the formats tum, replica, 7scenes, replica-multiagent,
/// aria-multiagent and world; ranges are half-open, several are joined:
///
///   coma run 'tum:kitchen[0:250]' 'tum:kitchen[250:500]' --out runs/kitchen
///   coma run replica-multiagent:Apart-0 --out runs/apart
///   coma run left=world:rooms/agent-0 right=world:rooms/agent-1 --out runs/rooms
#[derive(Args, Clone)]
pub struct Arguments {
    /// What the agents see, one spec for each agent.
    #[arg(required = true)]
    pub specs: Vec<String>,
    /// Folder for the results; made if it is missing, and must be empty.
    #[arg(long)]
    pub out: PathBuf,
    #[command(flatten)]
    pub options: Options,
}

/// What `run` and `demo` share.
#[derive(Args, Clone, Default)]
pub struct Options {
    /// Settings of the agents (TOML), as `coma agent --config` takes them.
    #[arg(long)]
    pub config: Option<PathBuf>,
    /// Settings of place recognition (TOML): models, thresholds.
    #[arg(long)]
    pub place_config: Option<PathBuf>,
    /// Places are described and shared, but no loop is looked for.
    #[arg(long)]
    pub no_loops: bool,
    /// Every K-th frame is tracked, never mapped: its view scores the map.
    #[arg(long, value_name = "K", default_value_t = 0)]
    pub hold_out: u32,
    /// Threads of each agent's tracking and mapping; default: one per core.
    #[arg(long)]
    pub threads: Option<usize>,
    /// Spoils frames on purpose: blackout:100-129 or nodepth:100-129 (both ends included), in every sequence, or
    /// in one agent's (agent-01=blackout:100-129).
    #[arg(long, value_name = "FAULT")]
    pub fault: Vec<String>,
    /// A perceptual model (ONNX) for LPIPS; without one it is not measured.
    #[arg(long, value_name = "FILE.onnx")]
    pub lpips_model: Option<PathBuf>,
}

/// Runs it.
pub async fn run(arguments: Arguments) -> anyhow::Result<()> {
    make_empty(&arguments.out)?;
    let mut run = Run::start(arguments.specs, &arguments.options, &arguments.out).await?;
    run.finish(&arguments.options, &arguments.out).await?;
    run.cluster.shutdown().await;
    score(&arguments.options, &arguments.out).await
}

/// Scores the finished run in `out`.
pub async fn score(options: &Options, out: &Path) -> anyhow::Result<()> {
    let lpips_model = options.lpips_model.clone();
    eval::score(out, &eval::Options { lpips_model, ..eval::Options::default() }).await
}

/// Agents that are about to be fed.
pub struct Run {
    /// The agents.
    pub cluster: Cluster,
    sources: Vec<Source>,
    faults: Vec<Vec<Fault>>,
    facts: Facts,
}

impl Run {
    /// Starts the agents; nothing is streamed yet.
    pub async fn start(specs: Vec<String>, options: &Options, out: &Path) -> anyhow::Result<Self> {
        let sources = source::open(&specs)?;
        let mut config: AgentConfig = coma_runtime::load(options.config.as_deref(), "COMA_AGENT")?;
        let places: PlaceRecognitionConfig =
            coma_runtime::load(options.place_config.as_deref(), "COMA_PLACE_RECOGNITION")?;
        if options.no_loops {
            config.loops.enabled = false;
        }
        if options.threads.is_some() {
            config.threads = options.threads;
        }
        let names: Vec<String> = sources.iter().map(|s| s.agent.clone()).collect();
        let faults = faults(&options.fault, &names)?;
        let mut facts = Facts {
            version: env!("CARGO_PKG_VERSION").into(),
            commit: option_env!("COMA_COMMIT").map(Into::into),
            settings: serde_json::json!({
                "slam": config.slam, "loops": config.loops, "registration": config.registration,
                "hold_out": options.hold_out, "threads": config.threads, "faults": options.fault,
            }),
            backend: "cpu".into(),
            machine: machine(),
            specs,
            ..Facts::default()
        };
        for source in &sources {
            facts.agents.push(AgentFacts {
                name: source.agent.clone(),
                spec: source.spec.clone(),
                faults: options.fault.clone(),
                hold_out_every: options.hold_out,
                frames: source.sequence.len(),
                ..AgentFacts::default()
            });
        }
        let cluster = Cluster::start(&names, &config, &places, &out.join("agents")).await?;
        Ok(Run { cluster, sources, faults, facts })
    }

    /// Streams everything, waits until the agents agree, and writes the folder but for its scores. The agents go on.
    pub async fn finish(&mut self, options: &Options, out: &Path) -> anyhow::Result<()> {
        let (begin, cpu) = (Instant::now(), cpu_seconds());
        self.facts.started = rfc3339(SystemTime::now());
        let stamps: Vec<Vec<StampNs>> = self
            .sources
            .iter()
            .map(|s| (0..s.sequence.len()).map(|i| s.sequence.stamp(i)).collect())
            .collect();
        let texts: Vec<Vec<String>> = self
            .sources
            .iter()
            .map(|s| (0..s.sequence.len()).map(|i| s.sequence.stamp_text(i).to_owned()).collect())
            .collect();
        let streamed = self.stream_all(options).await?;
        for (facts, streamed) in self.facts.agents.iter_mut().zip(&streamed) {
            facts.refused = streamed.refused.clone();
            facts.frame_seconds = streamed.frame_seconds.clone();
        }
        let settings = coma_runtime::ClientSettings::default();
        let urls = self.cluster.urls();
        let mut calls =
            urls.iter().map(|url| AgentCalls::new(url, &settings)).collect::<anyhow::Result<Vec<_>>>()?;
        let spinner = progress::spinner("verifying");
        collect::drain(&mut calls, |text| spinner.set_message(text.to_owned())).await?;
        spinner.finish_and_clear();
        self.facts.wall_s = begin.elapsed().as_secs_f64();
        self.facts.cpu_s = cpu.zip(cpu_seconds()).map(|(before, after)| after - before);
        self.facts.finished = rfc3339(SystemTime::now());

        self.write(&mut calls, &stamps, &texts, out).await
    }

    /// Fetches what the agents know and writes it; none of it stays in memory.
    async fn write(
        &mut self,
        calls: &mut [AgentCalls],
        stamps: &[Vec<StampNs>],
        texts: &[Vec<String>],
        out: &Path,
    ) -> anyhow::Result<()> {
        let spinner = progress::spinner("writing");
        spinner.set_message("poses and the merged map");
        let mut from_agents = Vec::new();
        for call in &mut *calls {
            from_agents.push(gather::ask(call).await?);
        }
        let graph = calls.first_mut().context("no agents")?.graph().await?;
        let results = gather::gather(&mut self.facts, &from_agents, &graph, stamps)?;
        folder::write(out, &self.facts, &results, texts)?;
        spinner.finish_and_clear();
        Ok(())
    }

    async fn stream_all(&mut self, options: &Options) -> anyhow::Result<Vec<Streamed>> {
        let bars = indicatif::MultiProgress::new();
        let mut tasks = JoinSet::new();
        for (i, mut source) in std::mem::take(&mut self.sources).into_iter().enumerate() {
            let bar = bars.add(progress::frames(&source.agent, source.sequence.len() as u64));
            source.sequence = fault::spoil(source.sequence, &self.faults[i]);
            let url = self.cluster.agents[i].agent.url.clone();
            let channel = channel(
                &url,
                &coma_runtime::ClientSettings::default(),
                &ByteLedger::default(),
                Class::Client,
            )?;
            let stream_options =
                StreamOptions { hold_out_every: options.hold_out, ..StreamOptions::default() };
            tasks.spawn(async move {
                let agent = source.agent.clone();
                let streamed = stream(source, channel, &stream_options, &bar).await;
                bar.finish();
                streamed.map(|s| (i, s)).with_context(|| format!("agent {agent}"))
            });
        }
        let mut out = Vec::new();
        while let Some(done) = tasks.join_next().await {
            out.push(done??);
        }
        out.sort_by_key(|(i, _)| *i);
        for (i, streamed) in &out {
            for refused in streamed.refused.iter().take(3) {
                tracing::warn!(agent = %self.facts.agents[*i].name, "{refused}");
            }
        }
        Ok(out.into_iter().map(|(_, streamed)| streamed).collect())
    }
}

/// Each agent's faults: `FAULT` for all, `AGENT=FAULT` for one.
pub fn faults(texts: &[String], names: &[String]) -> anyhow::Result<Vec<Vec<Fault>>> {
    let mut out = vec![Vec::new(); names.len()];
    for text in texts {
        let (only, fault) = match text.split_once('=') {
            Some((name, fault)) => (Some(name), fault),
            None => (None, text.as_str()),
        };
        let fault: Fault = fault.parse()?;
        if let Some(name) = only
            && !names.iter().any(|n| n == name)
        {
            bail!("--fault {text}: no agent is named {name}; there are {}", names.join(", "));
        }
        for (name, faults) in names.iter().zip(&mut out) {
            if only.is_none_or(|only| only == name) {
                faults.push(fault);
            }
        }
    }
    Ok(out)
}

/// A folder for results: nothing that lies there already is overwritten.
pub fn make_empty(folder: &Path) -> anyhow::Result<()> {
    let shown = folder.display();
    std::fs::create_dir_all(folder).with_context(|| format!("--out {shown}"))?;
    let mut inside = std::fs::read_dir(folder).with_context(|| format!("--out {shown}"))?;
    if inside.next().is_some() {
        bail!("--out {shown} is not empty: results of another run are not overwritten");
    }
    Ok(())
}

fn machine() -> String {
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let model = std::fs::read_to_string("/proc/cpuinfo").ok().and_then(|text| {
        let line = text.lines().find(|l| l.starts_with("model name"))?;
        Some(line.split_once(':')?.1.trim().to_owned())
    });
    format!("{}, {threads} threads", model.unwrap_or_else(|| std::env::consts::ARCH.into()))
}

/// User and system time of this process, where the system tells.
fn cpu_seconds() -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    // Fields 14 and 15 of proc(5), in clock ticks of 1/100 s.
    let ticks: u64 = fields.get(11)?.parse::<u64>().ok()? + fields.get(12)?.parse::<u64>().ok()?;
    Some(ticks as f64 / 100.0)
}

/// A time as RFC 3339 writes it, UTC, to the second.
fn rfc3339(time: SystemTime) -> String {
    let seconds = time.duration_since(SystemTime::UNIX_EPOCH).map_or(0, |d| d.as_secs());
    let (days, rest) = (seconds / 86_400, seconds % 86_400);
    // Howard Hinnant's civil_from_days, for days since 1970.
    let z = days + 719_468;
    let (era, day_of_era) = (z / 146_097, z % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let shifted = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * shifted + 2) / 5 + 1;
    let month = if shifted < 10 { shifted + 3 } else { shifted - 9 };
    let year = year_of_era + era * 400 + u64::from(month <= 2);
    format!("{year:04}-{month:02}-{day:02}T{:02}:{:02}:{:02}Z", rest / 3600, rest / 60 % 60, rest % 60)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn times_are_written_as_rfc_3339_writes_them() {
        let at = |s: u64| rfc3339(SystemTime::UNIX_EPOCH + Duration::from_secs(s));
        assert_eq!(at(0), "1970-01-01T00:00:00Z");
        assert_eq!(at(951_782_400), "2000-02-29T00:00:00Z");
        assert_eq!(at(1_700_000_000), "2023-11-14T22:13:20Z");
    }

    #[test]
    fn a_fault_may_be_one_agent_s() {
        let names = ["a".to_owned(), "b".to_owned()];
        let found = faults(&["b=nodepth:1-2".into(), "blackout:5-6".into()], &names).unwrap();
        assert_eq!((found[0].len(), found[1].len()), (1, 2));
        assert!(
            faults(&["c=nodepth:1-2".into()], &names).unwrap_err().to_string().contains("there are a, b")
        );
    }
}
