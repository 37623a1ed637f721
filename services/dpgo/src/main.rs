//! `coma-dpgo`: the pose-graph solver, for one agent or several.

use clap::Parser;
use coma_dpgo::{DpgoConfig, Server};
use std::net::SocketAddr;
use std::path::PathBuf;

/// Solves pose graphs: where every submap lies, by all odometry and loops. Agents call it over gRPC.
///
/// Settings come from --config (TOML) and from the environment: COMA_DPGO__SERVER__TOKEN=... sets `server.token`.
#[derive(Parser)]
#[command(version)]
struct Arguments {
    /// Settings file (TOML). Without it, dpgo.toml in the data folder is read if it is there.
    #[arg(long)]
    config: Option<PathBuf>,
    /// Address and port to serve on; overrides `server.listen`.
    #[arg(long)]
    listen: Option<SocketAddr>,
    /// Folder of the settings file. Nothing is written there: graphs are put again after a restart.
    #[arg(long)]
    data: Option<PathBuf>,
}

#[tokio::main]
async fn main() -> anyhow::Result<()> {
    let arguments = Arguments::parse();
    let in_data = arguments.data.map(|folder| folder.join("dpgo.toml")).filter(|file| file.is_file());
    let mut config: DpgoConfig = coma_runtime::load(arguments.config.or(in_data).as_deref(), "COMA_DPGO")?;
    coma_runtime::logging::init(&config.log)?;
    if let Some(listen) = arguments.listen {
        config.server.listen = listen;
    }
    let handle = Server::start(config).await?;
    println!("dpgo serves on {}", handle.url);
    coma_runtime::shutdown::requested().await;
    handle.shutdown().await;
    Ok(())
}
