//! Figures as tables: each bench measures one part.

pub mod tracking;

use clap::Subcommand;

/// What to measure.
#[derive(Subcommand)]
pub enum Bench {
    /// One agent alone: accuracy and time per frame.
    Tracking(tracking::Arguments),
}

/// Runs it.
pub fn run(bench: &Bench) -> anyhow::Result<()> {
    match bench {
        Bench::Tracking(arguments) => tracking::run(arguments),
    }
}
