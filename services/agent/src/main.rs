//! `coma-agent`: one agent, with its place-recognition and dpgo elsewhere.

use clap::Parser;
use coma_agent::{AgentConfig, Server};
use std::net::SocketAddr;
use std::path::PathBuf;

/// One SLAM agent: takes RGB-D frames over gRPC, tracks, maps, and agrees with its peers on one map.
///
/// Needs a place-recognition and a dpgo service (settings `place_recognition` and `dpgo`); `coma agent` runs
/// both beside the agent. Settings come from --config (TOML) and from the environment:
/// COMA_AGENT__CLUSTER_ID=lab sets `cluster_id`, COMA_AGENT__SERVER__TOKEN=... sets `server.token`.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    /// Settings file (TOML).
    #[arg(long)]
    config: Option<PathBuf>,
    /// Address and port to serve on; overrides `server.listen`.
    #[arg(long)]
    listen: Option<SocketAddr>,
    /// Data folder; overrides `data`.
    #[arg(long)]
    data: Option<PathBuf>,
}

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let arguments = Arguments::parse();
    coma_runtime::logging::init(&Default::default())?;
    let mut config: AgentConfig = coma_runtime::load(arguments.config.as_deref(), "COMA_AGENT")?;
    if let Some(listen) = arguments.listen {
        config.server.listen = listen;
    }
    if let Some(data) = arguments.data {
        config.data = data;
    }
    let handle = Server::start(config).await?;
    println!("agent {} serves on {}", handle.agent_id, handle.url);
    coma_runtime::shutdown::requested().await;
    handle.shutdown().await;
    Ok(())
}
