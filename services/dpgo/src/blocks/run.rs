//! A block that is being solved: what its calls and its driver share.

use super::names::{Names, Team};
use super::part::Heard;
use coma_pose_graph::blocks::BlockId;
use coma_runtime::CancellationToken;
use coma_wire::{At, v1};
use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use tokio::sync::Notify;
use tonic::Status;

/// Messages that wait from one neighbour; of more the oldest is left out, which its sender says again.
const WAITING: usize = 8;

/// The name of a run: that of the solve, and whose block.
pub type RunName = (String, coma_geometry::AgentId);

/// One block that is being solved here.
pub struct Run {
    /// Its name.
    pub name: RunName,
    /// Who takes part.
    pub team: Team,
    /// The block's names.
    pub names: Names,
    /// Tells this run from one that was here before.
    pub life: u64,
    /// Cancelled when a newer call takes over.
    pub replaced: CancellationToken,
    /// Notified when something was heard.
    pub wake: Notify,
    /// Of the driver.
    pub attempt: AtomicU64,
    shared: Mutex<Shared>,
}

#[derive(Default)]
struct Shared {
    inbox: BTreeMap<BlockId, VecDeque<Heard>>,
    /// Attempt and version of standings that neighbours have.
    delivered: BTreeMap<BlockId, (u64, u64)>,
    /// Neighbours that have not answered last time.
    unheard: BTreeMap<BlockId, String>,
    /// Those of them that know nothing of this run.
    gone: BTreeMap<BlockId, bool>,
}

impl Run {
    /// Nothing was heard yet.
    pub fn new(name: RunName, team: Team, names: Names, life: u64) -> Self {
        Run {
            name,
            team,
            names,
            life,
            replaced: CancellationToken::new(),
            wake: Notify::new(),
            attempt: AtomicU64::new(0),
            shared: Mutex::default(),
        }
    }

    fn lock(&self) -> MutexGuard<'_, Shared> {
        self.shared.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes a message from a neighbour, or refuses it; gives the own attempt.
    pub fn put(&self, request: v1::PutBoundaryRequest) -> Result<u64, Status> {
        let at = At::Root("from_agent_id");
        let from: coma_geometry::AgentId = coma_wire::Wire::from_wire(request.from_agent_id, &at)?;
        let number = self.team.number(&from).filter(|_| from != self.name.1);
        let number = number.ok_or_else(|| at.refuse(format!("{from} takes no part in this solve")))?;
        let team = coma_wire::hash(&request.team, &At::Root("team"))?;
        if team != self.team.digest {
            let message = format!("{from} was told another team or gauge than {}", self.name.1);
            return Err(Status::failed_precondition(message));
        }
        if request.attempt > super::MAX_ATTEMPT {
            let message = format!("{} is more than {}", request.attempt, super::MAX_ATTEMPT);
            return Err(At::Root("attempt").refuse(message).into());
        }
        let at = At::Root("boundary");
        let read = |b: v1::Boundary| self.names.read_boundary(number, b, &self.team, &at);
        let boundary = request.boundary.map(read).transpose()?;
        let standings = self.team.read_standings(request.standings, &At::Root("standings"))?;
        let heard = Heard { life: Some(request.life), attempt: request.attempt, boundary, standings };
        self.heard(number, heard);
        Ok(self.attempt.load(Ordering::Relaxed))
    }

    /// Something was heard from a neighbour.
    pub fn heard(&self, from: BlockId, heard: Heard) {
        let mut shared = self.lock();
        let waiting = shared.inbox.entry(from).or_default();
        if waiting.len() >= WAITING {
            waiting.pop_front();
        }
        waiting.push_back(heard);
        drop(shared);
        self.wake.notify_one();
    }

    /// All that was heard since the last time.
    pub fn take_heard(&self) -> Vec<(BlockId, Heard)> {
        let inbox = std::mem::take(&mut self.lock().inbox);
        inbox.into_iter().flat_map(|(from, heard)| heard.into_iter().map(move |h| (from, h))).collect()
    }

    /// A neighbour has these standings.
    pub fn answered(&self, by: BlockId, delivered: (u64, u64)) {
        let mut shared = self.lock();
        shared.unheard.remove(&by);
        shared.gone.remove(&by);
        shared.delivered.insert(by, delivered);
        drop(shared);
        self.wake.notify_one();
    }

    /// A neighbour did not answer, or does not know this run.
    pub fn unanswered(&self, by: BlockId, reason: &str, gone: bool) {
        let mut shared = self.lock();
        shared.unheard.insert(by, reason.to_owned());
        shared.gone.insert(by, gone);
    }

    /// True if a neighbour has these standings.
    pub fn has(&self, neighbour: BlockId, standings: (u64, u64)) -> bool {
        self.lock().delivered.get(&neighbour) == Some(&standings)
    }

    /// True if a neighbour knows nothing of this run, or no more.
    pub fn is_gone(&self, neighbour: BlockId) -> bool {
        self.lock().gone.get(&neighbour).copied().unwrap_or(false)
    }

    /// Neighbours that have not answered last time, with the reason.
    pub fn unheard(&self) -> Vec<v1::UnheardPeer> {
        let shared = self.lock();
        let unheard = shared.unheard.iter();
        unheard
            .map(|(block, message)| v1::UnheardPeer {
                agent_id: self.team.name(*block),
                message: message.clone(),
            })
            .collect()
    }
}
