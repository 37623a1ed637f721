//! Peers are found, greeted, and asked for what is missing here; evidence is fetched from whoever holds it.

use crate::node::Node;
use coma_geometry::AgentId;
use coma_runtime::Channel;
use coma_runtime::{Class, channel};
use coma_slam::log::{Entry, Evidence};
use coma_wire::Message;
use coma_wire::v1::peer_client::PeerClient;
use coma_wire::{At, FieldError, Limited, PROTOCOL_MAJOR, PROTOCOL_MINOR, Wire, v1};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tracing::{debug, info, warn};

/// What this build can do, told in Hello.
pub const FEATURES: [&str; 3] = ["log/1", "evidence/1", "depth-codec/1"];
/// Program version, told in Hello.
pub const BUILD: &str = env!("CARGO_PKG_VERSION");

/// Clients to every peer that was greeted.
#[derive(Default)]
pub struct Peers {
    clients: Mutex<BTreeMap<AgentId, PeerClient<Channel>>>,
}

impl Peers {
    /// Fetches a blob: from its author first, then from anyone. `None` if nobody has it now.
    pub async fn fetch_evidence(
        &self,
        node: &Node,
        author: &AgentId,
        name: &Evidence,
    ) -> Option<bytes::Bytes> {
        let own = node.lock().agent.clone();
        let mut holders: Vec<(AgentId, PeerClient<Channel>)> = {
            let clients = self.clients.lock().unwrap_or_else(PoisonError::into_inner);
            clients.iter().filter(|(id, _)| **id != own).map(|(id, c)| (id.clone(), c.clone())).collect()
        };
        holders.sort_by_key(|(id, _)| (id != author, id.clone()));
        for (holder, mut client) in holders {
            let request = v1::FetchEvidenceRequest { hash: name.hash.to_vec().into() };
            match client.fetch_evidence(request).await {
                Ok(response) => {
                    let blob = response.into_inner().blob;
                    if blob.len() as u64 == name.size_bytes && *blake3::hash(&blob).as_bytes() == name.hash {
                        return Some(blob);
                    }
                    warn!(%holder, "a peer served evidence that is not what its name says");
                }
                Err(status) => debug!(%holder, %status, "a peer did not serve evidence"),
            }
        }
        None
    }

    /// Fetches a result of another agent's solver, if it still has it.
    pub async fn fetch_result(&self, author: &AgentId, generation: v1::Generation) -> Option<v1::Component> {
        let mut client = self.clients.lock().unwrap_or_else(PoisonError::into_inner).get(author)?.clone();
        let request = v1::FetchResultRequest { generation: Some(generation) };
        match client.fetch_result(request).await {
            Ok(response) => v1::Component::decode(response.into_inner().component).ok(),
            Err(status) => {
                debug!(%author, %status, "a peer did not serve its result");
                None
            }
        }
    }

    fn put(&self, agent: AgentId, client: PeerClient<Channel>) {
        self.clients.lock().unwrap_or_else(PoisonError::into_inner).insert(agent, client);
    }
}

/// Follows one peer for as long as it is wanted: greets it, then pulls what is missing, again and again.
pub async fn follow(node: Arc<Node>, peers: Arc<Peers>, endpoint: String) {
    let mut wait = Duration::from_millis(100);
    loop {
        match session(&node, &peers, &endpoint, &mut wait).await {
            Ok(()) => return,
            Err(e) => {
                let message = format!("{e:#}");
                let mut knowledge = node.lock();
                let state = knowledge.peers.entry(endpoint.clone()).or_default();
                if state.alive || state.last_error != message {
                    info!(%endpoint, error = %message, "peer can't be reached");
                }
                state.alive = false;
                state.last_error = message;
            }
        }
        tokio::time::sleep(wait).await;
        wait = (wait * 2).min(Duration::from_secs(5));
    }
}

/// Ends with an error when the peer fails, or with nothing when it is this agent itself.
async fn session(node: &Arc<Node>, peers: &Peers, endpoint: &str, wait: &mut Duration) -> anyhow::Result<()> {
    let channel = channel(endpoint, &node.config.client, &node.ledger, Class::Peer)?;
    let mut client = PeerClient::new(channel).limited(node.config.client.max_message_bytes);
    let hello = client.hello(hello(node)).await.map_err(plain)?.into_inner();
    let agent = AgentId::from_wire(hello.agent_id, &At::Root("agent_id"))?;
    if agent == node.lock().agent {
        if hello.epoch == node.lock().epoch.0 {
            node.lock().peers.remove(endpoint);
            return Ok(());
        }
        anyhow::bail!("{endpoint} also calls itself {agent}: ids must be unique");
    }
    if hello.protocol_major != PROTOCOL_MAJOR {
        anyhow::bail!(
            "{agent} speaks protocol {}.{}, this build {PROTOCOL_MAJOR}",
            hello.protocol_major,
            hello.protocol_minor
        );
    }
    info!(%agent, endpoint, build = %hello.build, "peer greeted");
    *wait = Duration::from_millis(100);
    peers.put(agent.clone(), client.clone());
    loop {
        let more = pull(node, &mut client, endpoint, &agent).await?;
        if !more {
            tokio::time::sleep(Duration::from_secs_f64(node.config.pull_every_s.clamp(0.01, 60.0))).await;
        }
    }
}

/// What this agent says first.
pub fn hello(node: &Node) -> v1::HelloRequest {
    let knowledge = node.lock();
    v1::HelloRequest {
        protocol_major: PROTOCOL_MAJOR,
        protocol_minor: PROTOCOL_MINOR,
        build: BUILD.into(),
        features: FEATURES.iter().map(|f| f.to_string()).collect(),
        agent_id: knowledge.agent.to_string(),
        epoch: knowledge.epoch.0,
        cluster_id: node.config.cluster_id.clone(),
        endpoint: node.endpoint.clone(),
    }
}

/// One pull; true if more may be waiting.
async fn pull(
    node: &Node,
    client: &mut PeerClient<Channel>,
    endpoint: &str,
    agent: &AgentId,
) -> anyhow::Result<bool> {
    let have = node.lock().replica.heads();
    let request = v1::PullEntriesRequest { have: Some(have.to_wire()), limit: 0 };
    let mut stream = client.pull_entries(request).await.map_err(plain)?.into_inner();
    let mut entries: Vec<Entry> = Vec::new();
    let mut heads = None;
    while let Some(message) = stream.message().await.map_err(plain)? {
        if let Some(entry) = message.entry {
            entries.push(Entry::from_wire(entry, &At::Root("entry"))?);
        }
        if let Some(h) = message.heads {
            heads = Some(coma_wire::version_vector(Some(h), &At::Root("heads"))?);
        }
        if entries.len() > 10_000 {
            return Err(FieldError::new("entries", "more than 10000 in one pull").into());
        }
    }
    let mut knowledge = node.lock();
    let new = knowledge.take(entries)?;
    let state = knowledge.peers.entry(endpoint.to_owned()).or_default();
    state.alive = true;
    state.agent = Some(agent.clone());
    state.last_error.clear();
    if let Some(heads) = heads {
        state.heads = heads;
    }
    drop(knowledge);
    if new > 0 {
        node.entries_changed();
    }
    Ok(new > 0)
}

/// A status without its metadata.
fn plain(status: tonic::Status) -> anyhow::Error {
    anyhow::anyhow!("{:?}: {}", status.code(), status.message())
}
