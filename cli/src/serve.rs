//! `coma agent`, `place-recognition`, `dpgo` and `gateway`: services that run until they are asked to end.

use crate::cluster::LocalAgent;
use clap::Args;
use coma_agent::AgentConfig;
use coma_dpgo::DpgoConfig;
use coma_place_recognition::PlaceRecognitionConfig;
use coma_viewer_gateway::GatewayConfig;
use std::net::SocketAddr;
use std::path::PathBuf;

/// One agent: robots stream frames to it, peers exchange logs with it. Place recognition and pose-graph solving run
/// in the same process unless the settings `place_recognition` and `dpgo` say where they run.
///
/// Settings come from --config (TOML) and from the environment: COMA_AGENT__CLUSTER_ID=lab sets `cluster_id`,
/// COMA_AGENT__SERVER__TOKEN=... sets `server.token`. Place recognition beside the agent reads
/// COMA_PLACE_RECOGNITION__..., dpgo COMA_DPGO__....
///
///   coma agent --listen 127.0.0.1:7001 --data robot-1
///   coma agent --listen 127.0.0.1:7003 --data robot-2 --peer http://127.0.0.1:7001
#[derive(Args)]
pub struct AgentArguments {
    /// Settings file (TOML).
    #[arg(long)]
    config: Option<PathBuf>,
    /// Address and port to serve on; overrides `server.listen`.
    #[arg(long)]
    listen: Option<SocketAddr>,
    /// Data folder: log, evidence, submaps, identity; overrides `data`.
    #[arg(long)]
    data: Option<PathBuf>,
    /// A peer to greet at the start (`http://host:port`); may be given several times; added to `peers`.
    #[arg(long)]
    peer: Vec<String>,
}

/// Runs an agent.
pub async fn agent(arguments: AgentArguments) -> anyhow::Result<()> {
    let mut config: AgentConfig = coma_runtime::load(arguments.config.as_deref(), "COMA_AGENT")?;
    let places: PlaceRecognitionConfig = coma_runtime::load(None, "COMA_PLACE_RECOGNITION")?;
    let dpgo: DpgoConfig = coma_runtime::load(None, "COMA_DPGO")?;
    if let Some(listen) = arguments.listen {
        config.server.listen = listen;
    }
    if let Some(data) = arguments.data {
        config.data = data;
    }
    config.peers.extend(arguments.peer);
    let running = LocalAgent::start(config, places, dpgo).await?;
    println!("agent {} serves on {}", running.agent.agent_id, running.agent.url);
    coma_runtime::shutdown::requested().await;
    running.shutdown().await;
    Ok(())
}

/// Flags that the other services share.
#[derive(Args)]
pub struct ServiceArguments {
    /// Settings file (TOML).
    #[arg(long)]
    config: Option<PathBuf>,
    /// Address and port to serve on; overrides the settings.
    #[arg(long)]
    listen: Option<SocketAddr>,
}

/// Runs a place-recognition service.
pub async fn place_recognition(arguments: ServiceArguments) -> anyhow::Result<()> {
    let mut config: PlaceRecognitionConfig =
        coma_runtime::load(arguments.config.as_deref(), "COMA_PLACE_RECOGNITION")?;
    if let Some(listen) = arguments.listen {
        config.server.listen = listen;
    }
    let handle = coma_place_recognition::Server::start(config).await?;
    println!("place-recognition serves on {}", handle.url);
    coma_runtime::shutdown::requested().await;
    handle.shutdown().await;
    Ok(())
}

/// Runs a dpgo service.
pub async fn dpgo(arguments: ServiceArguments) -> anyhow::Result<()> {
    let mut config: DpgoConfig = coma_runtime::load(arguments.config.as_deref(), "COMA_DPGO")?;
    if let Some(listen) = arguments.listen {
        config.server.listen = listen;
    }
    let handle = coma_dpgo::Server::start(config).await?;
    println!("dpgo serves on {}", handle.url);
    coma_runtime::shutdown::requested().await;
    handle.shutdown().await;
    Ok(())
}

/// The gateway: trajectories, maps, renderings and a page over HTTP.
///
/// Settings come from --config (TOML) and from the environment: COMA_GATEWAY__TOKEN=... sets `token`.
///
///   coma gateway --agent http://127.0.0.1:7001 --agent http://127.0.0.1:7003
#[derive(Args)]
pub struct GatewayArguments {
    /// Settings file (TOML).
    #[arg(long)]
    config: Option<PathBuf>,
    /// Address and port to serve on; overrides `listen`.
    #[arg(long)]
    listen: Option<SocketAddr>,
    /// An agent to show (`http://host:port`); may be given several times; added to `agents`.
    #[arg(long)]
    agent: Vec<String>,
}

/// Runs a gateway.
pub async fn gateway(arguments: GatewayArguments) -> anyhow::Result<()> {
    let mut config: GatewayConfig = coma_runtime::load(arguments.config.as_deref(), "COMA_GATEWAY")?;
    if let Some(listen) = arguments.listen {
        config.listen = listen;
    }
    config.agents.extend(arguments.agent);
    let handle = coma_viewer_gateway::Server::start(config).await?;
    println!("the page: {}", handle.url);
    coma_runtime::shutdown::requested().await;
    handle.shutdown().await;
    Ok(())
}
