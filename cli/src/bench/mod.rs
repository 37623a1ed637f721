//! Figures as tables: each bench measures one part.

mod blocks;
mod clock;
pub mod graph;
pub mod robust;
pub mod sets;
pub mod tracking;

use clap::Subcommand;

/// What to measure.
#[derive(Subcommand)]
pub enum Bench {
    /// One agent alone: accuracy and time per frame.
    Tracking(tracking::Arguments),
    Graph(graph::Arguments),
    Robust(robust::Arguments),
}

/// Runs it.
pub fn run(bench: &Bench) -> anyhow::Result<()> {
    match bench {
        Bench::Tracking(arguments) => tracking::run(arguments),
        Bench::Graph(arguments) => graph::run(arguments),
        Bench::Robust(arguments) => robust::run(arguments),
    }
}
