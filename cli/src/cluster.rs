//! Agents in this process, each with its place-recognition and dpgo beside it: the same services and the same
//! gRPC calls as when every one runs as a process of its own.

use anyhow::Context;
use coma_agent::AgentConfig;
use coma_dpgo::DpgoConfig;
use coma_place_recognition::PlaceRecognitionConfig;
use coma_runtime::ServerSettings;
use std::path::Path;

/// An agent and what runs beside it.
pub struct LocalAgent {
    /// The agent.
    pub agent: coma_agent::Handle,
    place_recognition: Option<coma_place_recognition::Handle>,
    dpgo: Option<coma_dpgo::Handle>,
}

impl LocalAgent {
    /// Starts an agent, and beside it the services that its settings do not place elsewhere.
    pub async fn start(
        mut config: AgentConfig,
        mut places: PlaceRecognitionConfig,
        mut dpgo: DpgoConfig,
    ) -> anyhow::Result<Self> {
        let place_recognition = match config.place_recognition {
            Some(_) => None,
            None => {
                places.server = beside(places.server);
                let handle =
                    coma_place_recognition::Server::start(places).await.context("place-recognition")?;
                config.place_recognition = Some(handle.url.clone());
                Some(handle)
            }
        };
        let dpgo = match config.dpgo {
            Some(_) => None,
            None => {
                dpgo.server = beside(dpgo.server);
                let handle = coma_dpgo::Server::start(dpgo).await.context("dpgo")?;
                config.dpgo = Some(handle.url.clone());
                Some(handle)
            }
        };
        let agent = coma_agent::Server::start(config).await.context("agent")?;
        Ok(LocalAgent { agent, place_recognition, dpgo })
    }

    /// Ends all three in order.
    pub async fn shutdown(self) {
        self.agent.shutdown().await;
        if let Some(handle) = self.place_recognition {
            handle.shutdown().await;
        }
        if let Some(handle) = self.dpgo {
            handle.shutdown().await;
        }
    }
}

/// A service for the agent in the same process: a free port on loopback, whatever the settings say of ports.
fn beside(settings: ServerSettings) -> ServerSettings {
    ServerSettings {
        listen: std::net::SocketAddr::from(([127, 0, 0, 1], 0)),
        token: None,
        tls: None,
        ..settings
    }
}

/// Several agents that know one another.
pub struct Cluster {
    /// In the order of their names as given.
    pub agents: Vec<LocalAgent>,
}

impl Cluster {
    /// Starts one agent for each name; their data lies in a folder each below `data`.
    pub async fn start(
        names: &[String],
        template: &AgentConfig,
        places: &PlaceRecognitionConfig,
        data: &Path,
    ) -> anyhow::Result<Self> {
        let mut cluster = Cluster { agents: Vec::new() };
        for name in names {
            let mut config = template.clone();
            config.agent_id = Some(coma_geometry::AgentId::new(name)?);
            config.data = data.join(name);
            // Each greets those before it, and is followed back by them.
            config.peers = cluster.urls();
            config.gossip = false;
            let started = LocalAgent::start(config, places.clone(), DpgoConfig::default()).await;
            cluster.agents.push(started.with_context(|| format!("agent {name} did not start"))?);
        }
        Ok(cluster)
    }

    /// Where the agents serve.
    pub fn urls(&self) -> Vec<String> {
        self.agents.iter().map(|a| a.agent.url.clone()).collect()
    }

    /// Ends all.
    pub async fn shutdown(self) {
        for agent in self.agents {
            agent.shutdown().await;
        }
    }
}
