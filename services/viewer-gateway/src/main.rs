//! `coma-viewer-gateway`: HTTP for people and programs.

use clap::Parser;
use coma_viewer_gateway::{GatewayConfig, Server};
use std::net::SocketAddr;
use std::path::PathBuf;

/// The HTTP side of a cluster: trajectories, maps, renderings, loops, live events, metrics, and a page.
///
/// Settings come from --config (TOML) and from the environment: COMA_GATEWAY__TOKEN=... sets `token`,
/// COMA_GATEWAY__AGENTS=http://robot-1:7001,http://robot-2:7001 sets `agents`.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    /// Settings file (TOML).
    #[arg(long)]
    config: Option<PathBuf>,
    /// Address and port to serve on; overrides `listen`.
    #[arg(long)]
    listen: Option<SocketAddr>,
    /// Data folder, as the other services take one. The gateway keeps no state and writes nothing there.
    #[arg(long)]
    data: Option<PathBuf>,
}

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let Arguments { config, listen, data: _ } = Arguments::parse();
    coma_runtime::logging::init(&Default::default())?;
    let mut config: GatewayConfig = coma_runtime::load(config.as_deref(), "COMA_GATEWAY")?;
    if let Some(listen) = listen {
        config.listen = listen;
    }
    let handle = Server::start(config).await?;
    println!("the gateway serves on {}", handle.url);
    coma_runtime::shutdown::requested().await;
    handle.shutdown().await;
    Ok(())
}
