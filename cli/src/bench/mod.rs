//! Figures as tables: each bench measures one part.

mod ablation;
mod against;
mod blocks;
mod clock;
mod cpu;
pub mod depth;
pub mod graph;
pub mod index;
mod overlap;
pub mod places;
pub mod raster;
pub mod registration;
pub mod robust;
pub mod sets;
pub mod team;
pub mod tracking;

use clap::Subcommand;

/// What to measure.
#[derive(Subcommand)]
pub enum Bench {
    /// One agent alone: accuracy and time per frame.
    Tracking(tracking::Arguments),
    Ablation(ablation::Arguments),
    Raster(raster::Arguments),
    Registration(registration::Arguments),
    Places(places::Arguments),
    Index(index::Arguments),
    Depth(depth::Arguments),
    Graph(graph::Arguments),
    Robust(robust::Arguments),
    Team(team::Arguments),
}

/// Runs it.
pub fn run(bench: &Bench) -> anyhow::Result<()> {
    match bench {
        Bench::Tracking(arguments) => tracking::run(arguments),
        Bench::Ablation(arguments) => ablation::run(arguments),
        Bench::Raster(arguments) => raster::run(arguments),
        Bench::Registration(arguments) => registration::run(arguments),
        Bench::Places(arguments) => places::run(arguments),
        Bench::Index(arguments) => index::run(arguments),
        Bench::Depth(arguments) => depth::run(arguments),
        Bench::Graph(arguments) => graph::run(arguments),
        Bench::Robust(arguments) => robust::run(arguments),
        Bench::Team(arguments) => team::run(arguments),
    }
}
