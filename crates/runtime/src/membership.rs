//! Who else is there: gossip over UDP, started from seeds (addresses, or DNS names whose records are
//! looked up again and again).
//!
//! Membership is a hint. Gossip is plain and a forged member causes no more than a dial that the
//! other side, or TLS, refuses.

use crate::ledger::{ByteLedger, Class, Tally};
use async_trait::async_trait;
use chitchat::transport::{RecvOutcome, SendOutcome, Socket, Transport, UdpTransport};
use chitchat::{
    ChitchatConfig, ChitchatHandle, ChitchatId, FailureDetectorConfig, ProtocolVersion, spawn_chitchat,
};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::time::Duration;
use tokio::sync::watch;
use tokio::task::JoinHandle;

/// How an agent finds the others.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MembershipSettings {
    /// Agents of other clusters are not heard. Default: `coma`.
    pub cluster_id: String,
    /// UDP address for gossip; port 0 takes a free one. Default: a free port on loopback.
    pub listen: SocketAddr,
    /// What others send gossip to, where it is not `listen` (0.0.0.0 is nobody's address).
    pub advertise: Option<SocketAddr>,
    /// `host:port` of agents to begin with: addresses or names; a name may stand for many.
    pub seeds: Vec<String>,
    /// Time between rounds, seconds. Default: 0.25: a dead agent is noticed in about two seconds.
    pub interval_s: f64,
}

impl Default for MembershipSettings {
    fn default() -> Self {
        MembershipSettings {
            cluster_id: "coma".into(),
            listen: SocketAddr::from(([127, 0, 0, 1], 0)),
            advertise: None,
            seeds: Vec::new(),
            interval_s: 0.25,
        }
    }
}

/// Who this agent is.
#[derive(Clone, Debug)]
pub struct Myself {
    /// Its id.
    pub agent_id: String,
    /// In which life.
    pub epoch: u64,
    /// Grows with every start of the process, or others take what they knew for newer: the epoch where
    /// every start takes a new one, else a count of starts that is kept on disk.
    pub generation: u64,
    /// Where it serves gRPC.
    pub endpoint: String,
}

/// Another agent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Member {
    /// Its id, as it says.
    pub agent_id: String,
    /// In which life.
    pub epoch: u64,
    /// Where it serves gRPC.
    pub endpoint: String,
    /// Heard of lately.
    pub alive: bool,
    /// How long its log is, as last heard.
    pub log_length: u64,
}

/// Why membership did not start.
#[derive(Debug, thiserror::Error)]
pub enum MembershipError {
    /// The UDP port cannot be had, or a setting is wrong.
    #[error("membership on {listen}: {reason}")]
    Start {
        /// The address.
        listen: SocketAddr,
        /// Why.
        reason: String,
    },
}

const ENDPOINT: &str = "endpoint";
const EPOCH: &str = "epoch";
const LOG_LENGTH: &str = "log";
/// Members beyond are not listed: gossip is open to forgery and must not grow without limit here.
const MAX_MEMBERS: usize = 1024;

/// A running membership. Dropping it leaves without goodbye: others notice.
pub struct Membership {
    /// Where gossip is heard.
    pub gossip_addr: SocketAddr,
    members: watch::Receiver<Vec<Member>>,
    chitchat: Option<ChitchatHandle>,
    watcher: JoinHandle<()>,
}

impl Membership {
    /// Starts gossiping. Datagrams are booked as [`Class::Gossip`].
    pub async fn start(
        settings: &MembershipSettings,
        myself: &Myself,
        ledger: &ByteLedger,
    ) -> Result<Membership, MembershipError> {
        let failed = |reason: String| MembershipError::Start { listen: settings.listen, reason };
        if !(settings.interval_s >= 0.01 && settings.interval_s <= 60.0) {
            return Err(failed(format!("interval_s = {} is not within 0.01 and 60", settings.interval_s)));
        }
        // The port must be known before the identity that names it.
        let listen = match settings.listen.port() {
            0 => {
                let probe = std::net::UdpSocket::bind(settings.listen).and_then(|socket| socket.local_addr());
                probe.map_err(|e| failed(e.to_string()))?
            }
            _ => settings.listen,
        };
        let advertise = settings.advertise.unwrap_or(listen);
        if advertise.ip().is_unspecified() {
            return Err(failed(format!("others cannot send to {advertise}; set membership.advertise")));
        }
        let interval = Duration::from_secs_f64(settings.interval_s);
        let config = ChitchatConfig {
            chitchat_id: ChitchatId::new(myself.agent_id.clone(), myself.generation, advertise),
            cluster_id: settings.cluster_id.clone(),
            gossip_interval: interval,
            listen_addr: listen,
            seed_nodes: settings.seeds.clone(),
            failure_detector_config: FailureDetectorConfig {
                initial_interval: interval,
                dead_node_grace_period: Duration::from_secs(600),
                ..FailureDetectorConfig::default()
            },
            marked_for_deletion_grace_period: Duration::from_secs(600),
            catchup_callback: None,
            extra_liveness_predicate: None,
            protocol_version: ProtocolVersion::V1,
        };
        let own = [
            (ENDPOINT.to_owned(), myself.endpoint.clone()),
            (EPOCH.to_owned(), myself.epoch.to_string()),
            (LOG_LENGTH.to_owned(), "0".to_owned()),
        ];
        let transport = Counted { tally: ledger.open(Class::Gossip) };
        let chitchat = spawn_chitchat(config, own.to_vec(), &transport);
        let chitchat = chitchat.await.map_err(|e| failed(format!("{e:#}")))?;

        let (sender, members) = watch::channel(Vec::new());
        let state = chitchat.chitchat();
        let me = myself.agent_id.clone();
        let watcher = tokio::spawn(async move {
            let mut tick = tokio::time::interval(interval);
            loop {
                tick.tick().await;
                let listed = {
                    let chitchat = state.lock().await;
                    let live: std::collections::HashSet<_> = chitchat.live_nodes().collect();
                    list(chitchat.node_states().iter().filter(|(id, _)| *id.node_id != *me).map(
                        |(id, node)| {
                            (id, live.contains(id), node.get(ENDPOINT), node.get(EPOCH), node.get(LOG_LENGTH))
                        },
                    ))
                };
                sender.send_if_modified(|known| {
                    let changed = *known != listed;
                    *known = listed;
                    changed
                });
                if sender.is_closed() {
                    return;
                }
            }
        });
        Ok(Membership { gossip_addr: listen, members, chitchat: Some(chitchat), watcher })
    }

    /// The other agents, by id; changes wake the receiver.
    pub fn members(&self) -> watch::Receiver<Vec<Member>> {
        self.members.clone()
    }

    /// Tells the others how long this agent's log is, so that they pull when there is something to pull.
    pub async fn set_log_length(&self, length: u64) {
        if let Some(chitchat) = &self.chitchat {
            let set = |c: &mut chitchat::Chitchat| c.self_node_state().set(LOG_LENGTH, length);
            chitchat.with_chitchat(set).await;
        }
    }

    /// Stops.
    pub async fn shutdown(mut self) {
        if let Some(chitchat) = self.chitchat.take()
            && let Err(error) = chitchat.shutdown().await
        {
            tracing::warn!(%error, "membership ended");
        }
    }
}

impl Drop for Membership {
    fn drop(&mut self) {
        self.watcher.abort();
        if let Some(chitchat) = &self.chitchat {
            chitchat.abort();
        }
    }
}

/// One line per agent: the live one where an agent is known under several generations, else the newest.
fn list<'a>(
    nodes: impl Iterator<Item = (&'a ChitchatId, bool, Option<&'a str>, Option<&'a str>, Option<&'a str>)>,
) -> Vec<Member> {
    let mut out: BTreeMap<String, ((bool, u64), Member)> = BTreeMap::new();
    for (id, alive, endpoint, epoch, log_length) in nodes {
        let (Some(endpoint), Some(Ok(epoch))) = (endpoint, epoch.map(str::parse)) else { continue };
        let log_length = log_length.and_then(|text| text.parse().ok()).unwrap_or(0);
        let agent_id = id.node_id.to_string();
        if out.len() >= MAX_MEMBERS && !out.contains_key(&agent_id) {
            continue;
        }
        let rank = (alive, id.generation_id);
        let member =
            Member { agent_id: agent_id.clone(), epoch, endpoint: endpoint.into(), alive, log_length };
        match out.get(&agent_id) {
            Some((known, _)) if *known >= rank => {}
            _ => drop(out.insert(agent_id, (rank, member))),
        }
    }
    out.into_values().map(|(_, member)| member).collect()
}

/// UDP whose datagrams are counted.
struct Counted {
    tally: Tally,
}

struct CountedSocket {
    socket: Box<dyn Socket>,
    tally: Tally,
}

#[async_trait]
impl Transport for Counted {
    async fn open(&self, listen: SocketAddr) -> anyhow::Result<Box<dyn Socket>> {
        let socket = UdpTransport.open(listen).await?;
        Ok(Box::new(CountedSocket { socket, tally: self.tally.clone() }))
    }
}

#[async_trait]
impl Socket for CountedSocket {
    fn local_addr(&self) -> anyhow::Result<SocketAddr> {
        self.socket.local_addr()
    }

    async fn send(
        &mut self,
        to: SocketAddr,
        envelope: chitchat::ChitchatEnvelope,
    ) -> anyhow::Result<SendOutcome> {
        let outcome = self.socket.send(to, envelope).await?;
        self.tally.add_socket(outcome.num_bytes_sent as u64);
        self.tally.add_message("Datagram", outcome.num_bytes_sent as u64, 1);
        Ok(outcome)
    }

    async fn recv(&mut self) -> anyhow::Result<RecvOutcome> {
        self.socket.recv().await
    }
}
