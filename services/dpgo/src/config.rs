//! Settings of a dpgo service.

use anyhow::ensure;
use coma_pose_graph::GlobalSettings;
use coma_pose_graph::blocks::BlockSettings;
use coma_runtime::{Class, ClientSettings, LogSettings, ServerSettings};
use serde::Deserialize;

/// Settings of a dpgo service; every one has a default, and `COMA_DPGO__NAME=value` overrides the file.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DpgoConfig {
    /// Where it serves.
    pub server: ServerSettings,
    /// What the program logs.
    pub log: LogSettings,
    /// How graphs are solved. Agents that are to agree need services with equal ones.
    pub solve: GlobalSettings,
    /// Graphs that are kept; beyond, the least recently used one is dropped, and its callers put their
    /// entries again. Default: 64.
    pub max_graphs: usize,
    /// Entries of one graph, of any kind; more are refused. One takes 32 bytes. Default: 1000000.
    pub max_entries_per_graph: usize,
    /// Entries of one graph that say something of it (submaps, odometry, verdicts, withdrawals); more are
    /// refused. One takes about 600 bytes. Default: 100000.
    pub max_facts_per_graph: usize,
    /// Callers that may watch one graph; more are refused. Default: 16.
    pub max_watchers_per_graph: usize,
    /// Solving block by block with other dpgo services.
    pub blocks: BlockConfig,
    /// Graphs that are solved at once; none: one per core. Others wait.
    pub threads: Option<usize>,
}

/// How this service solves block by block with others.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BlockConfig {
    /// Take part: it then calls the dpgo services that requests name. Default: no.
    pub enabled: bool,
    /// How it calls them; its token goes to every address that a request names.
    pub client: ClientSettings,
    /// How a block descends. Services that solve together need equal ones.
    pub descent: BlockSettings,
    /// Blocks that are solved at once; more are refused. Default: 16.
    pub max_runs: usize,
    /// Agents in one solve. Default: 1024.
    pub max_team: usize,
    /// Shortest time between two steps of a block, milliseconds. Default: 5.
    pub step_ms: u64,
    /// How long before what a neighbour has not acknowledged is said again, milliseconds. Default: 200.
    pub repeat_ms: u64,
    /// Longest solve, seconds; it ends with DEADLINE_EXCEEDED. Default: 600.
    pub max_run_s: f64,
}

impl Default for BlockConfig {
    fn default() -> Self {
        BlockConfig {
            enabled: false,
            client: ClientSettings::default(),
            descent: BlockSettings::default(),
            max_runs: 16,
            max_team: 1024,
            step_ms: 5,
            repeat_ms: 200,
            max_run_s: 600.0,
        }
    }
}

impl Default for DpgoConfig {
    fn default() -> Self {
        DpgoConfig {
            // Every call may hold a message of the largest size: fewer at once than elsewhere.
            server: ServerSettings {
                class: Class::Local,
                max_concurrent_calls: 32,
                ..ServerSettings::default()
            },
            log: LogSettings::default(),
            solve: GlobalSettings::default(),
            max_graphs: 64,
            max_entries_per_graph: 1_000_000,
            max_facts_per_graph: 100_000,
            max_watchers_per_graph: 16,
            blocks: BlockConfig::default(),
            threads: None,
        }
    }
}

impl DpgoConfig {
    /// Refuses settings out of range, by name.
    pub(crate) fn check(&self) -> anyhow::Result<()> {
        let within = |name: &str, value: usize, low: usize, high: usize| {
            ensure!((low..=high).contains(&value), "{name} = {value} must be {low} to {high}");
            Ok(())
        };
        within("max_graphs", self.max_graphs, 1, 10_000)?;
        within("max_entries_per_graph", self.max_entries_per_graph, 1, 100_000_000)?;
        within("max_facts_per_graph", self.max_facts_per_graph, 1, 10_000_000)?;
        within("max_watchers_per_graph", self.max_watchers_per_graph, 1, 10_000)?;
        within("blocks.max_runs", self.blocks.max_runs, 1, 10_000)?;
        within("blocks.max_team", self.blocks.max_team, 1, 4096)?;
        within("blocks.step_ms", self.blocks.step_ms as usize, 0, 60_000)?;
        within("blocks.repeat_ms", self.blocks.repeat_ms as usize, 1, 60_000)?;
        let longest = self.blocks.max_run_s;
        ensure!(
            longest > 0.0 && longest <= 1e6,
            "blocks.max_run_s = {longest} must be over 0 and at most 1e6"
        );
        within("threads", self.threads.unwrap_or(1), 1, 256)
    }
}
