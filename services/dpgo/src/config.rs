//! Settings of a dpgo service.

use anyhow::ensure;
use coma_pose_graph::GlobalSettings;
use coma_runtime::{Class, LogSettings, ServerSettings};
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
    /// Graphs that are solved at once; none: one per core. Others wait.
    pub threads: Option<usize>,
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
        within("threads", self.threads.unwrap_or(1), 1, 256)
    }
}
