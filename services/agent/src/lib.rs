//! The agent service: frames come in over gRPC, are tracked and mapped, and what is seen is agreed with peers.
//!
//! ```text
//! client -> service::agent -> queue -> worker (mapping thread) -> knowledge -> service::viewer -> gateway
//!                                         | anchors                 ^  ^
//!                                   task::places <-> place-recognition  | entries
//!                                   task::verify (registration)    task::peers <-> other agents
//!                                   task::solve  <-> dpgo
//! ```
//!
//! The agent owns its log, evidence, registration and verdicts; place-recognition and dpgo own nothing that
//! can't be made again.

mod config;
mod convert;
mod decode;
mod evidence;
mod journal;
mod knowledge;
mod node;
mod queue;
mod service;
mod session;
mod task;
mod worker;

pub use config::AgentConfig;

use anyhow::Context;
use coma_runtime::membership::Myself;
use coma_runtime::{Bound, ByteLedger, Class, Membership, Services, channel};
use coma_slam::log::{AgentStarted, Payload};
use coma_slam::loop_closure::LoopCloser;
use coma_store::Identity;
use coma_wire::v1::agent_server::AgentServer;
use coma_wire::v1::dpgo_client::DpgoClient;
use coma_wire::v1::peer_server::PeerServer;
use coma_wire::v1::place_recognition_client::PlaceRecognitionClient;
use coma_wire::v1::viewer_server::ViewerServer;
use coma_wire::{FILE_DESCRIPTOR_SET, Limited};
use journal::Journal;
use knowledge::Knowledge;
use node::Node;
use std::collections::BTreeSet;
use std::net::SocketAddr;
use std::sync::Arc;
use std::thread::JoinHandle;
use task::peers::Peers;
use tokio::task::JoinSet;
use tracing::{info, warn};

/// An agent.
pub struct Server;

/// A running agent. Dropping it ends it without waiting; [`Handle::shutdown`] waits.
pub struct Handle {
    /// Where it serves.
    pub local_addr: SocketAddr,
    /// `http://` or `https://` and the address, for callers on this machine.
    pub url: String,
    /// Its name.
    pub agent_id: String,
    server: coma_runtime::Handle,
    node: Arc<Node>,
    tasks: JoinSet<()>,
    worker: Option<JoinHandle<()>>,
    _identity: Identity,
}

impl Server {
    /// Opens the data folder, takes the port and starts to serve.
    pub async fn start(config: AgentConfig) -> anyhow::Result<Handle> {
        let needed = "set its endpoint, or use `coma agent`, which runs one beside the agent";
        let place_recognition =
            config.place_recognition.clone().with_context(|| format!("place_recognition: {needed}"))?;
        let dpgo = config.dpgo.clone().with_context(|| format!("dpgo: {needed}"))?;
        let identity = Identity::open(&config.data, config.agent_id.clone())?;
        let (agent_id, epoch) = (identity.agent_id().clone(), identity.epoch());
        let (journal, restored) = Journal::open(&config.data)?;
        for note in &restored.notes {
            warn!("{note}");
        }
        let closer = LoopCloser::new(agent_id.clone(), config.loops.clone());
        let mut knowledge = Knowledge::new(agent_id.clone(), epoch, journal, closer);
        knowledge.restore(restored.entries, &restored.checkpoints);
        if !knowledge.replica.heads().contains_key(&(agent_id.clone(), epoch)) {
            let started =
                AgentStarted { anchor_priority: config.anchor_priority, build: task::peers::BUILD.into() };
            knowledge.write(&Payload::AgentStarted(started))?;
        }

        let ledger = ByteLedger::default();
        let bound = Bound::bind(&config.server).await?;
        let url = bound.url();
        let endpoint = match &config.advertise {
            Some(endpoint) => endpoint.clone(),
            None => reachable(&bound),
        };
        let (node, inbox) = Node::new(config, endpoint, ledger.clone(), knowledge);
        let config = &node.config;
        let limit = config.server.max_message_bytes;
        let services = Services::new()
            .with(AgentServer::new(service::agent::AgentService(node.clone())).limited(limit))
            .with(PeerServer::new(service::peer::PeerService(node.clone())).limited(limit))
            .with(ViewerServer::new(service::viewer::ViewerService(node.clone())).limited(limit));
        let local_addr = bound.local_addr;
        let server = bound.serve(services, FILE_DESCRIPTOR_SET, &ledger).await?;

        let class = if config.shared_sidecars { Class::Peer } else { Class::Local };
        let to_place = channel(&place_recognition, &config.client, &ledger, class)?;
        let to_dpgo = channel(&dpgo, &config.client, &ledger, class)?;
        let message_limit = config.client.max_message_bytes;
        let place = PlaceRecognitionClient::new(to_place).limited(message_limit);
        let dpgo = DpgoClient::new(to_dpgo).limited(message_limit);
        let peers = Arc::new(Peers::default());
        let mut tasks = JoinSet::new();
        tasks.spawn(task::places::encoders(node.clone(), place.clone()));
        tasks.spawn(task::places::describe(node.clone(), inbox.anchors, place.clone()));
        tasks.spawn(task::places::index(node.clone(), place));
        tasks.spawn(task::verify::run(node.clone(), peers.clone()));
        tasks.spawn(task::solve::run(node.clone(), peers.clone(), dpgo));
        tasks.spawn(find_peers(node.clone(), peers, inbox.found, agent_id.to_string(), epoch.0));

        let resume = worker::resume_from(&node, &restored.checkpoints)?;
        if resume.is_some() {
            info!(agent = %agent_id, frames = node.lock().frames, "going on where the last life ended");
        }
        let agent = coma_slam::agent::Agent::new(agent_id.clone(), epoch, resume, config.slam.clone());
        let threads = config.threads;
        let worker_node = node.clone();
        let worker = std::thread::Builder::new()
            .name("mapping".into())
            .spawn(move || worker::run(worker_node, agent, threads))?;
        Ok(Handle {
            local_addr,
            url,
            agent_id: agent_id.to_string(),
            server,
            node,
            tasks,
            worker: Some(worker),
            _identity: identity,
        })
    }
}

impl Handle {
    /// Ends in order: no more calls, the frame under work is finished, the disk is closed.
    pub async fn shutdown(mut self) {
        self.server.shutdown().await;
        self.node.queue.close();
        self.tasks.shutdown().await;
        if let Some(worker) = self.worker.take() {
            let joined = tokio::task::spawn_blocking(move || worker.join()).await;
            if !matches!(joined, Ok(Ok(()))) {
                warn!("the mapping thread ended badly");
            }
        }
    }
}

/// An address that is bound to every interface is reached by this machine's own name or address.
fn reachable(bound: &Bound) -> String {
    let addr = bound.local_addr;
    if !addr.ip().is_unspecified() {
        return bound.url();
    }
    let ip = own_ip().map_or_else(|| "127.0.0.1".to_owned(), |ip| ip.to_string());
    bound.url().replace(&addr.ip().to_string(), &ip)
}

/// The address that this machine's host name stands for: a container's own address.
fn own_ip() -> Option<std::net::IpAddr> {
    use std::net::ToSocketAddrs;
    let name = std::fs::read_to_string("/etc/hostname").ok()?;
    let addresses = (name.trim(), 0).to_socket_addrs().ok()?;
    addresses.map(|a| a.ip()).find(|ip| !ip.is_loopback() && ip.is_ipv4())
}

/// Peers that are followed at once at most: callers and gossip name them, and either may be forged.
const MAX_FOLLOWED: usize = 256;

/// Follows configured peers, those that call, and those that gossip finds.
async fn find_peers(
    node: Arc<Node>,
    peers: Arc<Peers>,
    mut found: tokio::sync::mpsc::Receiver<String>,
    agent_id: String,
    epoch: u64,
) {
    let mut followed = BTreeSet::new();
    let mut following = JoinSet::new();
    let mut follow = |endpoint: String| {
        if followed.len() < MAX_FOLLOWED && followed.insert(endpoint.clone()) {
            following.spawn(task::peers::follow(node.clone(), peers.clone(), endpoint));
        }
    };
    node.config.peers.iter().cloned().for_each(&mut follow);
    let membership = if node.config.gossip { gossip(&node, &agent_id, epoch).await } else { None };
    let mut members = membership.as_ref().map(Membership::members);
    loop {
        if let Some(members) = &mut members {
            let alive = |m: &&coma_runtime::Member| m.alive && m.agent_id != agent_id;
            members
                .borrow_and_update()
                .iter()
                .filter(alive)
                .map(|m| m.endpoint.clone())
                .for_each(&mut follow);
        }
        let changed = async {
            match &mut members {
                Some(members) => members.changed().await.is_ok(),
                None => std::future::pending().await,
            }
        };
        tokio::select! {
            endpoint = found.recv() => match endpoint {
                Some(endpoint) => follow(endpoint),
                None => return,
            },
            alive = changed => if !alive { members = None },
        }
    }
}

/// Joins the gossip of the cluster; without it only configured peers and callers are followed.
async fn gossip(node: &Node, agent_id: &str, epoch: u64) -> Option<Membership> {
    let mut settings = node.config.membership.clone();
    settings.cluster_id = node.config.cluster_id.clone();
    if settings.listen.ip().is_unspecified()
        && settings.advertise.is_none()
        && let Some(ip) = own_ip()
    {
        settings.advertise = Some(SocketAddr::new(ip, settings.listen.port()));
    }
    let generation = std::time::SystemTime::now()
        .duration_since(std::time::UNIX_EPOCH)
        .map_or(epoch, |since| since.as_millis() as u64);
    let endpoint = node.endpoint.clone();
    let myself = Myself { agent_id: agent_id.to_owned(), epoch, generation, endpoint };
    match Membership::start(&settings, &myself, &node.ledger).await {
        Ok(membership) => Some(membership),
        Err(e) => {
            warn!(error = %e, "no gossip: only configured peers and callers are followed");
            node.lock().warnings.push(format!("no gossip: {e}"));
            None
        }
    }
}
