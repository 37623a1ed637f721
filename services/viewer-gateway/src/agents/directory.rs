//! Which agents there are: those listed, and those that DNS names now.

use super::calls::{Whole, ask_all};
use super::events::LiveEvent;
use super::link::Link;
use crate::config::GatewayConfig;
use crate::error::ApiError;
use anyhow::Context;
use coma_geometry::AgentId;
use coma_runtime::{ByteLedger, CancellationToken};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::broadcast;
use tonic::Status;

/// Agents that are followed at most; further addresses of DNS are left out.
const MAX_AGENTS: usize = 1024;
/// Events that a slow listener may be behind.
const EVENTS: usize = 4096;

/// See the module.
pub struct Directory {
    config: GatewayConfig,
    ledger: ByteLedger,
    events: broadcast::Sender<LiveEvent>,
    stop: CancellationToken,
    links: Mutex<BTreeMap<String, Arc<Link>>>,
    /// DNS answered once, or is not asked.
    resolved: Mutex<bool>,
}

impl Directory {
    /// Dials the listed agents and starts to ask DNS, until `stop`.
    pub fn start(config: &GatewayConfig, stop: CancellationToken) -> anyhow::Result<Arc<Directory>> {
        let directory = Arc::new(Directory {
            config: config.clone(),
            ledger: ByteLedger::default(),
            events: broadcast::channel(EVENTS).0,
            stop: stop.clone(),
            links: Mutex::default(),
            resolved: Mutex::new(config.agents_dns.is_none()),
        });
        for (i, endpoint) in config.agents.iter().enumerate() {
            directory.follow(endpoint).with_context(|| format!("agents[{i}]"))?;
        }
        if let Some(name) = &config.agents_dns {
            let (scheme, host) = match name.split_once("://") {
                Some(("https", host)) => ("https", host),
                Some(("http", host)) => ("http", host),
                Some(_) => anyhow::bail!("agents_dns = {name:?}: only http:// and https:// are known"),
                None => ("http", name.as_str()),
            };
            let port = host.rsplit_once(':').and_then(|(_, port)| port.parse::<u16>().ok());
            port.with_context(|| {
                format!("agents_dns = {name:?} must be a name and a port, like agent:7001")
            })?;
            let (directory, scheme, host) = (directory.clone(), scheme.to_owned(), host.to_owned());
            tokio::spawn(async move {
                stop.run_until_cancelled(directory.ask_dns(&scheme, &host)).await;
            });
        }
        Ok(directory)
    }

    fn links(&self) -> std::sync::MutexGuard<'_, BTreeMap<String, Arc<Link>>> {
        self.links.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn follow(&self, endpoint: &str) -> anyhow::Result<()> {
        let mut links = self.links();
        if !links.contains_key(endpoint) && links.len() < MAX_AGENTS {
            let link = Link::open(endpoint, &self.config, &self.ledger, self.events.clone(), &self.stop)?;
            links.insert(endpoint.to_owned(), link);
        }
        Ok(())
    }

    async fn ask_dns(&self, scheme: &str, host: &str) {
        let mut failed = false;
        loop {
            match tokio::net::lookup_host(host).await {
                Ok(addresses) => {
                    failed = false;
                    self.follow_only(addresses.map(|a| format!("{scheme}://{a}")).collect());
                }
                // A name without addresses fails in the same way as a server that does not answer: those who
                // are known stay, and show for themselves whether they are reachable.
                Err(error) if !failed => {
                    failed = true;
                    tracing::warn!(host, %error, "DNS does not name any agents now");
                }
                Err(_) => {}
            }
            *self.resolved.lock().unwrap_or_else(PoisonError::into_inner) = true;
            tokio::time::sleep(Duration::from_secs_f64(self.config.dns_every_s)).await;
        }
    }

    /// Agents are those listed and these.
    fn follow_only(&self, mut endpoints: BTreeSet<String>) {
        endpoints.extend(self.config.agents.iter().cloned());
        let before = self.links().len();
        for endpoint in &endpoints {
            if let Err(e) = self.follow(endpoint) {
                tracing::warn!(endpoint, error = %e, "an address of DNS can't be dialled");
            }
        }
        let mut links = self.links();
        let mut changed = links.len() != before;
        links.retain(|endpoint, link| {
            let stays = endpoints.contains(endpoint);
            if !stays {
                link.forget();
                changed = true;
            }
            stays
        });
        if changed {
            // Nobody may be listening.
            let _ = self.events.send(LiveEvent::Agents {});
        }
    }

    /// Every agent once: one that is found under several endpoints is taken where it answers.
    pub fn agents(&self) -> Vec<Arc<Link>> {
        let links: Vec<Arc<Link>> = self.links().values().cloned().collect();
        let mut by_id: BTreeMap<AgentId, Arc<Link>> = BTreeMap::new();
        let mut nameless = Vec::new();
        for link in links {
            let state = link.state();
            match state.id {
                None => nameless.push(link),
                Some(id) => {
                    let better =
                        by_id.get(&id).is_none_or(|known| state.reachable && !known.state().reachable);
                    if better {
                        by_id.insert(id, link);
                    }
                }
            }
        }
        by_id.into_values().chain(nameless).collect()
    }

    /// The agent of that name.
    pub fn agent(&self, field: &str, id: &AgentId) -> Result<Arc<Link>, ApiError> {
        let link = self.agents().into_iter().find(|link| link.state().id.as_ref() == Some(id));
        let link = link.ok_or_else(|| ApiError::not_found(field, format!("no agent {id} is known here")))?;
        let state = link.state();
        if !state.reachable {
            return Err(ApiError::agent(format!("agent {id} is unreachable: {}", state.error)));
        }
        Ok(link)
    }

    /// Asks every agent; those that do not answer are named.
    pub async fn ask<T, F: Future<Output = Result<T, Status>>>(
        &self,
        ask: impl Fn(Arc<Link>) -> F,
    ) -> Whole<T> {
        ask_all(self.agents(), ask).await
    }

    /// True once it is known who there is: every agent was asked.
    pub fn settled(&self) -> bool {
        let resolved = *self.resolved.lock().unwrap_or_else(PoisonError::into_inner);
        resolved && self.links().values().all(|link| link.state().asked)
    }

    /// Events of all agents from now on.
    pub fn events(&self) -> broadcast::Receiver<LiveEvent> {
        self.events.subscribe()
    }
}
