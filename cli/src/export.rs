//! `coma export`: what running agents have, as files.

use crate::collect::AgentCalls;
use crate::run::facts::{AgentFacts, Facts};
use crate::run::{gather, make_empty, write_folder};
use clap::Args;
use coma_geometry::{StampNs, tum};
use coma_runtime::{ClientSettings, Secret};
use std::path::PathBuf;

/// Fetches trajectories (TUM), the merged map (PLY), the graph (g2o) and every loop's verdict from running agents.
///
///   coma export --from http://127.0.0.1:7001 --from http://127.0.0.1:7003 --out files
#[derive(Args)]
pub struct Arguments {
    /// An agent, `http://host:port`; may be given several times.
    #[arg(long, required = true)]
    from: Vec<String>,
    /// Folder for the files; made if it is missing, and must be empty.
    #[arg(long)]
    out: PathBuf,
    /// Bearer token of the agents.
    #[arg(long, env = "COMA_TOKEN", hide_env_values = true)]
    token: Option<String>,
}

/// Runs it.
pub async fn run(arguments: Arguments) -> anyhow::Result<()> {
    make_empty(&arguments.out)?;
    let settings = ClientSettings { token: arguments.token.map(Secret::new), ..ClientSettings::default() };
    let mut facts = Facts { version: env!("CARGO_PKG_VERSION").into(), ..Facts::default() };
    let (mut from_agents, mut graph) = (Vec::new(), None);
    for url in &arguments.from {
        let mut calls = AgentCalls::new(url, &settings)?;
        let from = gather::ask(&mut calls).await.map_err(|e| e.context(url.clone()))?;
        if graph.is_none() {
            graph = Some(calls.graph().await?);
        }
        facts.agents.push(AgentFacts { name: from.status.agent_id.clone(), ..AgentFacts::default() });
        from_agents.push(from);
    }
    let stamps: Vec<Vec<StampNs>> = from_agents
        .iter()
        .map(|from| {
            let mut stamps: Vec<StampNs> = from.poses.iter().map(|p| p.stamp).collect();
            stamps.sort();
            stamps
        })
        .collect();
    let texts: Vec<Vec<String>> =
        stamps.iter().map(|s| s.iter().map(|s| tum::stamp_text(*s)).collect()).collect();
    let results = gather::gather(&mut facts, &from_agents, &graph.unwrap_or_default(), &stamps)?;
    write_folder(&arguments.out, &facts, &results, &texts)?;
    for component in &facts.components {
        println!(
            "map {}: {} submaps, {} surfels, {}",
            component.name, component.submaps, component.surfels, component.map
        );
    }
    Ok(())
}
