//! `coma synth`: the built-in world as files.

pub mod graph;

use crate::progress;
use anyhow::Context;
use clap::{Args, Subcommand};
use coma_dataset::world::{SensorNoise, World, WorldSettings};
use std::path::PathBuf;

/// What to make.
#[derive(Subcommand)]
pub enum Synth {
    /// RGB-D sequences of the built-in flat in the TUM layout, with exact poses: one folder for each agent.
    Rooms(RoomsArguments),
    Graph(graph::Arguments),
}

/// Films the built-in flat.
#[derive(Args)]
pub struct RoomsArguments {
    /// Folder; agent-0, agent-1, ... are made in it.
    #[arg(long)]
    out: PathBuf,
    /// Number of agents, 1 to 8.
    #[arg(long, default_value_t = 2)]
    agents: usize,
    /// Frames of each agent.
    #[arg(long, default_value_t = 200)]
    frames: usize,
    /// Image width, pixels.
    #[arg(long, default_value_t = 320)]
    width: u32,
    /// Image height, pixels.
    #[arg(long, default_value_t = 240)]
    height: u32,
    /// Textures, small things, hand shake, noise.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Films with a noisy sensor instead of an ideal one.
    #[arg(long)]
    noise: bool,
}

/// Runs it.
pub fn run(synth: &Synth) -> anyhow::Result<()> {
    match synth {
        Synth::Rooms(arguments) => rooms(arguments),
        Synth::Graph(arguments) => graph::run(arguments),
    }
}

fn rooms(arguments: &RoomsArguments) -> anyhow::Result<()> {
    let settings = WorldSettings {
        seed: arguments.seed,
        agents: arguments.agents,
        frames: arguments.frames,
        width: arguments.width,
        height: arguments.height,
        noise: arguments.noise.then(SensorNoise::default),
        ..WorldSettings::default()
    };
    let world = World::new(settings)?;
    for agent in 0..arguments.agents {
        let sequence = world.sequence(agent).context("the world has fewer agents")?;
        let name = format!("agent-{agent}");
        let bar = progress::frames(&name, arguments.frames as u64);
        let folder = arguments.out.join(&name);
        coma_dataset::write_tum(&sequence, &folder, &mut |done| bar.set_position(done as u64))?;
        bar.finish_and_clear();
        println!("tum:{}", folder.display());
    }
    Ok(())
}
