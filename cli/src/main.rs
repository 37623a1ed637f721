//! `coma`: the whole cluster in one program.

mod bench;
mod fault;
mod progress;
mod source;

use clap::{Parser, Subcommand};

/// CoMA: several RGB-D cameras build one map together.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Measures one part and prints its figures.
    #[command(subcommand)]
    Bench(bench::Bench),
}

fn main() -> anyhow::Result<()> {
    match Arguments::parse().command {
        Command::Bench(bench) => bench::run(&bench),
    }
}
