//! `coma demo`: the whole cluster on the built-in world.

use crate::run::{self, Options, Run};
use anyhow::Context;
use clap::Args;
use coma_viewer_gateway::GatewayConfig;
use std::net::SocketAddr;
use std::path::PathBuf;

/// Several agents walk through a built-in furnished flat, recognise each other's places and build one map; watch them
/// in the browser. Nothing is downloaded.
#[derive(Args)]
pub struct Arguments {
    /// Number of agents, 1 to 8.
    #[arg(long, default_value_t = 2, value_parser = clap::value_parser!(u8).range(1..=8))]
    agents: u8,
    /// Frames of each agent.
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u32).range(10..=100_000))]
    frames: u32,
    /// Films with a noisy sensor instead of an ideal one.
    #[arg(long)]
    noise: bool,
    /// Ends when the map is done and scored, instead of serving it until ctrl-c.
    #[arg(long)]
    exit: bool,
    /// Folder for the results; default: a new one below the system's folder for temporary files.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Where the page is served.
    #[arg(long, default_value = "127.0.0.1:8080")]
    listen: SocketAddr,
    #[command(flatten)]
    options: Options,
}

/// Runs it.
pub async fn run(arguments: Arguments) -> anyhow::Result<()> {
    let out = match arguments.out {
        Some(out) => out,
        None => std::env::temp_dir().join(format!("coma-demo-{}", std::process::id())),
    };
    run::make_empty(&out)?;
    let world = if arguments.noise { "noisy-rooms" } else { "rooms" };
    let specs =
        (0..arguments.agents).map(|i| format!("world:{world}/agent-{i}[0:{}]", arguments.frames)).collect();
    let mut run = Run::start(specs, &arguments.options, &out).await?;
    let gateway =
        GatewayConfig { listen: arguments.listen, agents: run.cluster.urls(), ..GatewayConfig::default() };
    let gateway = coma_viewer_gateway::Server::start(gateway).await.with_context(|| {
        format!("the page can't be served on {} (--listen takes another address)", arguments.listen)
    })?;
    println!("watch the map grow: {}", gateway.url);
    run.finish(&arguments.options, &out).await?;
    run::score(&arguments.options, &out).await?;
    if !arguments.exit {
        println!("the map stays at {} until ctrl-c", gateway.url);
        coma_runtime::shutdown::requested().await;
    }
    gateway.shutdown().await;
    run.cluster.shutdown().await;
    Ok(())
}
