//! The running agent: what its tasks, its mapping thread and its services share.

use crate::config::AgentConfig;
use crate::knowledge::Knowledge;
use crate::queue::FrameQueue;
use crate::session::{Processed, Session};
use coma_frame::RgbdFrame;
use coma_geometry::{AgentId, SubmapId};
use coma_runtime::ledger::ByteLedger;
use coma_wire::v1;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;
use tokio::sync::{Notify, broadcast, mpsc};

/// An anchor on its way to place recognition.
pub struct AnchorJob {
    /// Whose.
    pub submap: SubmapId,
    /// Its frame.
    pub frame: Arc<RgbdFrame>,
}

/// Shared by everything that runs in one agent.
pub struct Node {
    /// Settings.
    pub config: AgentConfig,
    /// Where others reach this agent.
    pub endpoint: String,
    /// Bytes written, by class and message type.
    pub ledger: ByteLedger,
    /// Frames on their way to the mapping thread.
    pub queue: FrameQueue,
    /// Something changed for the loop of place recognition.
    pub places_wake: Notify,
    /// Something changed for the loop of verification.
    pub verify_wake: Notify,
    /// Something changed for the loop of solving.
    pub solve_wake: Notify,
    /// Anchors, candidates and solves that are in work or wait.
    pub unfinished: AtomicUsize,
    knowledge: Mutex<Knowledge>,
    session: Mutex<Option<Session>>,
    acks: broadcast::Sender<v1::FrameAck>,
    events: broadcast::Sender<v1::watch_response::Event>,
    anchors: mpsc::Sender<AnchorJob>,
    found: mpsc::Sender<String>,
    begin: Instant,
}

/// What a node hands to its tasks.
pub struct Inbox {
    /// Anchors on their way to place recognition.
    pub anchors: mpsc::Receiver<AnchorJob>,
    /// Endpoints of agents that called.
    pub found: mpsc::Receiver<String>,
}

/// Anchors that wait to be described; then mapping waits too, as each holds a whole frame.
const ANCHORS: usize = 64;
/// Callers' endpoints that wait to be followed; more are forgotten, as they call again.
const FOUND: usize = 64;

impl Node {
    /// An agent that is about to run, and what its tasks are to take.
    pub fn new(
        config: AgentConfig,
        endpoint: String,
        ledger: ByteLedger,
        knowledge: Knowledge,
    ) -> (Arc<Self>, Inbox) {
        let (anchors, described) = mpsc::channel(ANCHORS);
        let (found, followed) = mpsc::channel(FOUND);
        let node = Node {
            queue: FrameQueue::new(config.queue_frames),
            config,
            endpoint,
            ledger,
            places_wake: Notify::new(),
            verify_wake: Notify::new(),
            solve_wake: Notify::new(),
            unfinished: AtomicUsize::new(0),
            knowledge: Mutex::new(knowledge),
            session: Mutex::new(None),
            acks: broadcast::channel(4096).0,
            events: broadcast::channel(1024).0,
            anchors,
            found,
            begin: Instant::now(),
        };
        (Arc::new(node), Inbox { anchors: described, found: followed })
    }

    /// What the agent knows. Never held across an await.
    pub fn lock(&self) -> MutexGuard<'_, Knowledge> {
        self.knowledge.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The open session. Never held across an await.
    pub fn session(&self) -> MutexGuard<'_, Option<Session>> {
        self.session.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Id of the open session, or empty.
    pub fn session_id(&self) -> String {
        self.session().as_ref().map(|s| s.id.clone()).unwrap_or_default()
    }

    /// Seconds since the start.
    pub fn now_s(&self) -> f64 {
        self.begin.elapsed().as_secs_f64()
    }

    /// Tells viewers.
    pub fn publish(&self, event: v1::watch_response::Event) {
        // Nobody may be watching.
        let _ = self.events.send(event);
    }

    /// Events from now on.
    pub fn watch(&self) -> broadcast::Receiver<v1::watch_response::Event> {
        self.events.subscribe()
    }

    /// Acks from now on.
    pub fn acks(&self) -> broadcast::Receiver<v1::FrameAck> {
        self.acks.subscribe()
    }

    /// Hands an anchor to place recognition. For the mapping thread: it waits while too many are under way.
    pub fn describe(&self, submap: SubmapId, frame: Arc<RgbdFrame>) {
        self.unfinished.fetch_add(1, Ordering::SeqCst);
        if self.anchors.blocking_send(AnchorJob { submap, frame }).is_err() {
            self.unfinished.fetch_sub(1, Ordering::SeqCst);
        }
    }

    /// An agent of this cluster called and says where it serves: it is followed too.
    pub fn found_peer(&self, endpoint: &str) {
        if !endpoint.is_empty() && endpoint.len() <= 256 {
            // Full: it is found when it calls again.
            let _ = self.found.try_send(endpoint.to_owned());
        }
    }

    /// Wakes everything that follows the logs.
    pub fn entries_changed(&self) {
        self.places_wake.notify_one();
        self.verify_wake.notify_one();
        self.solve_wake.notify_one();
    }

    /// Agents that answer now, this one included.
    pub fn live_agents(&self) -> Vec<AgentId> {
        let knowledge = self.lock();
        let peers = knowledge.peers.values().filter(|p| p.alive).filter_map(|p| p.agent.clone());
        peers.chain([knowledge.agent.clone()]).collect()
    }

    /// A frame was processed: the session's acks go on.
    pub fn session_progress(&self, processed: Processed) {
        let mut session = self.session();
        let Some(session) = session.as_mut() else { return };
        session.processed = Some(processed.sequence);
        session.durable = processed.durable_through.or(session.durable);
        // No stream may be open just now.
        let _ = self.acks.send(session.ack(&processed));
    }
}

/// Counts a piece of unfinished work for as long as it lives.
pub struct Unfinished<'a>(&'a Node);

impl<'a> Unfinished<'a> {
    /// Begins a piece of work.
    pub fn begin(node: &'a Node) -> Self {
        node.unfinished.fetch_add(1, Ordering::SeqCst);
        Unfinished(node)
    }
}

impl Drop for Unfinished<'_> {
    fn drop(&mut self) {
        self.0.unfinished.fetch_sub(1, Ordering::SeqCst);
    }
}
