//! Solving block by block with other dpgo services: each descends on the block of one agent and tells its neighbours
//! where the boundary is.
//!
//! ```text
//! SolveBlock  -> graph -> OwnBlock -> Run --- driver: heard -> Part (BlockAgent, Stillness) -> letters
//! PutBoundary -> Run: checked, read, and left for the driver                                     |
//!                                                       neighbours' PutBoundary <- Slot, one each +
//! ```
//!
//! A neighbour that is down is called again until it answers. One that began anew has another life, and all begin
//! another attempt from where they are. What comes out is provisional: it is compared by cost, not by bits.

mod driver;
mod names;
mod part;
mod post;
mod rounds;
mod run;

use crate::config::BlockConfig;
use coma_geometry::{AgentId, Pose, SubmapId};
use coma_pose_graph::blocks::own::NoBlock;
use coma_pose_graph::blocks::{BlockAgent, OwnBlock};
use coma_pose_graph::{GlobalSettings, GraphEntries};
use coma_runtime::{ByteLedger, CancellationToken, Class, channel};
use coma_wire::v1::dpgo_client::DpgoClient;
use coma_wire::{At, FieldError, Limited, Wire, limits, v1};
use driver::{Driver, Progress};
use names::{Names, Team};
use part::Part;
use post::Slot;
use run::{Run, RunName};
use std::collections::hash_map::RandomState;
use std::collections::{BTreeMap, BTreeSet};
use std::hash::{BuildHasher, Hasher};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::sync::{Semaphore, watch};
use tonic::Status;

/// Attempts beyond are refused.
const MAX_ATTEMPT: u64 = 1 << 32;
/// Bytes of an address.
const MAX_ADDRESS: usize = 512;

/// A request, checked.
pub struct BlockRequest {
    /// Whose block, in which solve.
    name: RunName,
    team: Team,
    gauge: SubmapId,
    /// Where the others' dpgo services are.
    addresses: BTreeMap<AgentId, (usize, String)>,
}

impl BlockRequest {
    /// Checks everything but the graph.
    pub fn read(request: v1::SolveBlockRequest, max_team: usize) -> Result<Self, FieldError> {
        let at = At::Root("run");
        if request.run.is_empty() {
            return Err(at.refuse("is empty: name the solve alike for all that take part"));
        }
        let run = at.text(request.run, limits::NAME)?;
        let agent = AgentId::from_wire(request.agent_id, &At::Root("agent_id"))?;
        let gauge: SubmapId = At::Root("gauge").required(request.gauge)?;
        let peers_at = At::Root("peers");
        peers_at.at_most(request.peers.len(), max_team.saturating_sub(1), "peers")?;
        let mut addresses = BTreeMap::new();
        for (k, peer) in request.peers.into_iter().enumerate() {
            let at = peers_at.index(k);
            let id_at = at.field("agent_id");
            let id = AgentId::from_wire(peer.agent_id, &id_at)?;
            let address = at.field("dpgo_address").text(peer.dpgo_address, MAX_ADDRESS)?;
            if id == agent || addresses.insert(id, (k, address)).is_some() {
                return Err(id_at.refuse("is named twice"));
            }
        }
        let all = addresses.keys().cloned().chain([agent.clone()]).collect();
        let team = Team::new(all, &gauge);
        if team.number(&gauge.agent).is_none() {
            return Err(At::Root("gauge").refuse(format!("{} takes no part in this solve", gauge.agent)));
        }
        Ok(BlockRequest { name: (run, agent), team, gauge, addresses })
    }
}

/// All blocks that are being solved here.
#[derive(Clone)]
pub struct Runs {
    config: Arc<BlockConfig>,
    settings: GlobalSettings,
    /// Largest message.
    max_message_bytes: usize,
    ledger: ByteLedger,
    /// One permit for each solve or step that may run at once.
    work: Arc<Semaphore>,
    stopping: CancellationToken,
    shelf: Arc<Mutex<BTreeMap<RunName, Arc<Run>>>>,
}

impl Runs {
    /// None yet.
    pub fn new(
        config: BlockConfig,
        settings: GlobalSettings,
        max_message_bytes: usize,
        ledger: ByteLedger,
        work: Arc<Semaphore>,
        stopping: CancellationToken,
    ) -> Self {
        let config = Arc::new(config);
        Runs { config, settings, max_message_bytes, ledger, work, stopping, shelf: Arc::default() }
    }

    /// Largest number of agents in one solve, where this service takes part in any.
    pub fn max_team(&self) -> Result<usize, Status> {
        if !self.config.enabled {
            let message = "this service does not solve block by block: blocks.enabled = false";
            return Err(Status::failed_precondition(message));
        }
        Ok(self.config.max_team)
    }

    /// Begins to solve a block; the progress ends with the run, and dropping it ends the run.
    pub async fn begin(&self, request: BlockRequest, entries: GraphEntries) -> Result<Progress, Status> {
        let BlockRequest { name, team, gauge, addresses } = request;
        let permit = self.work.clone().acquire_owned().await;
        let permit = permit.map_err(|_| Status::unavailable("the service is ending"))?;
        let (settings, descent) = (self.settings, self.config.descent);
        let own = move || {
            let _permit = permit;
            let own = OwnBlock::new(&entries, &name.1, team.agents(), &gauge, &settings);
            own.map(|own| (name, team, own))
        };
        let own = tokio::task::spawn_blocking(own).await;
        let own = own.map_err(|e| Status::internal(format!("the block's making ended badly: {e}")))?;
        let (name, team, own) = own.map_err(|e: NoBlock| Status::failed_precondition(e.to_string()))?;
        // A pose is only asked of the gauge, whose frame is the map's.
        let agent = BlockAgent::new(own.block.clone(), |_| Pose::identity(), descent);
        let neighbours: BTreeSet<_> = agent.neighbours().collect();
        let part = Part::new(agent, team.agents().len());
        let run = Arc::new(Run::new(name, team, Names::new(&own), random()));
        let mut slots = BTreeMap::new();
        let mut carriers = tokio::task::JoinSet::new();
        for block in neighbours {
            let Some(agent) = run.team.agents().get(block as usize) else { continue };
            let Some((k, address)) = addresses.get(agent) else { continue };
            let at = At::Root("peers");
            let refuse = |e: coma_runtime::ChannelError| {
                Status::from(at.index(*k).field("dpgo_address").refuse(e.to_string()))
            };
            let to = channel(address, &self.config.client, &self.ledger, Class::Peer).map_err(refuse)?;
            let client = DpgoClient::new(to).limited(self.max_message_bytes);
            let slot = Arc::<Slot>::default();
            slots.insert(block, slot.clone());
            carriers.spawn(post::carry(run.clone(), block, slot, client));
        }
        self.shelve(&run)?;
        let (progress, seen) = watch::channel(None);
        let ended = CancellationToken::new();
        let driver = Driver {
            own: Arc::new(own),
            part: Some(part),
            run: run.clone(),
            slots,
            progress,
            left: ended.clone(),
            stopping: self.stopping.clone(),
            work: self.work.clone(),
            step: Duration::from_millis(self.config.step_ms),
            repeat: Duration::from_millis(self.config.repeat_ms),
            longest: Duration::from_secs_f64(self.config.max_run_s),
            standings_told: tokio::time::Instant::now(),
        };
        let runs = self.clone();
        tokio::spawn(async move {
            driver.drive().await;
            drop(carriers);
            runs.unshelve(&run);
        });
        Ok(Progress::new(seen, ended))
    }

    /// Takes where a neighbour's boundary is; gives the attempt of the block that it was meant for.
    pub fn put(&self, mut request: v1::PutBoundaryRequest) -> Result<u64, Status> {
        self.max_team()?;
        let run = At::Root("run").text(std::mem::take(&mut request.run), limits::NAME)?;
        let to = AgentId::from_wire(std::mem::take(&mut request.to_agent_id), &At::Root("to_agent_id"))?;
        let name = (run, to);
        let found = self.lock().get(&name).cloned();
        match found {
            Some(run) => run.put(request),
            None => Err(Status::not_found(format!(
                "the block of {} in {:?} is not being solved here",
                name.1, name.0
            ))),
        }
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<RunName, Arc<Run>>> {
        self.shelf.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn shelve(&self, run: &Arc<Run>) -> Result<(), Status> {
        let mut shelf = self.lock();
        if !shelf.contains_key(&run.name) && shelf.len() >= self.config.max_runs {
            let most = self.config.max_runs;
            return Err(Status::resource_exhausted(format!(
                "{most} blocks are being solved: blocks.max_runs"
            )));
        }
        if let Some(older) = shelf.insert(run.name.clone(), run.clone()) {
            older.replaced.cancel();
        }
        metrics::gauge!("coma_dpgo_block_runs").set(shelf.len() as f64);
        Ok(())
    }

    fn unshelve(&self, run: &Arc<Run>) {
        let mut shelf = self.lock();
        if shelf.get(&run.name).is_some_and(|here| Arc::ptr_eq(here, run)) {
            shelf.remove(&run.name);
        }
        metrics::gauge!("coma_dpgo_block_runs").set(shelf.len() as f64);
    }
}

/// A number that no other life has.
fn random() -> u64 {
    RandomState::new().build_hasher().finish()
}
