//! `coma`: the whole cluster in one program.

mod bench;
mod cluster;
mod collect;
mod eval;
mod fault;
mod progress;
mod run;
mod source;
mod stream;

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
    Run(run::Arguments),
    Eval(eval::Arguments),
    /// Measures one part and prints its figures.
    #[command(subcommand)]
    Bench(bench::Bench),
}

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let arguments = Arguments::parse();
    coma_runtime::logging::init(&Default::default())?;
    match arguments.command {
        Command::Run(arguments) => run::run(arguments).await,
        Command::Eval(arguments) => eval::run(arguments).await,
        Command::Bench(bench) => bench::run(&bench),
    }
}
