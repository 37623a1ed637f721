//! `coma`: the whole cluster in one program.

mod bench;
mod cluster;
mod collect;
mod demo;
mod eval;
mod export;
mod fault;
mod inspect;
mod inspect_loops;
mod play;
mod progress;
mod run;
mod serve;
mod source;
mod stream;
mod synth;

use clap::{Parser, Subcommand};

/// CoMA: several RGB-D cameras build one map together, peer to peer.
///
/// Begin with `coma demo`: a cluster on a built-in world, in the browser. `coma run` does the same with recorded
/// sequences and scores the result; `coma agent`, `coma gateway` and `coma stream` are the parts of a real cluster.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Demo(demo::Arguments),
    Run(run::Arguments),
    Eval(eval::Arguments),
    Agent(serve::AgentArguments),
    /// Describes pictures and finds places that agents have seen before, for one agent or several.
    PlaceRecognition(serve::ServiceArguments),
    /// Solves pose graphs, for one agent or several.
    Dpgo(serve::ServiceArguments),
    Gateway(serve::GatewayArguments),
    Stream(play::Arguments),
    Export(export::Arguments),
    /// Shows what came of a run, and why.
    #[command(subcommand)]
    Inspect(Inspect),
    /// Writes synthetic data to disk.
    #[command(subcommand)]
    Synth(synth::Synth),
    /// Measures one part and prints its figures.
    #[command(subcommand)]
    Bench(bench::Bench),
}

/// What to show.
#[derive(Subcommand)]
enum Inspect {
    Loops(inspect_loops::Arguments),
    /// A pose graph (g2o): cost, residuals, weights, and whether its minimum is the global one.
    Graph(inspect::GraphArguments),
}

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let arguments = Arguments::parse();
    init_logging(&arguments.command)?;
    match arguments.command {
        Command::Demo(arguments) => demo::run(arguments).await,
        Command::Run(arguments) => run::run(arguments).await,
        Command::Eval(arguments) => eval::run(arguments).await,
        Command::Agent(arguments) => serve::agent(arguments).await,
        Command::PlaceRecognition(arguments) => serve::place_recognition(arguments).await,
        Command::Dpgo(arguments) => serve::dpgo(arguments).await,
        Command::Gateway(arguments) => serve::gateway(arguments).await,
        Command::Stream(arguments) => play::run(arguments).await,
        Command::Export(arguments) => export::run(arguments).await,
        Command::Inspect(Inspect::Loops(arguments)) => inspect_loops::run(&arguments),
        Command::Inspect(Inspect::Graph(arguments)) => inspect::graph(&arguments),
        Command::Synth(synth) => synth::run(&synth),
        Command::Bench(bench) => bench::run(&bench),
    }
}

/// Services log what they do; the other commands speak for themselves, and show warnings. RUST_LOG overrides both.
fn init_logging(command: &Command) -> anyhow::Result<()> {
    let serves = matches!(
        command,
        Command::Agent(_) | Command::PlaceRecognition(_) | Command::Dpgo(_) | Command::Gateway(_)
    );
    let filter =
        std::env::var("RUST_LOG").unwrap_or_else(|_| if serves { "info".into() } else { "warn".into() });
    Ok(coma_runtime::logging::init(&coma_runtime::LogSettings { filter, ..Default::default() })?)
}
