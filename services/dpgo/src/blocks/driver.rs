//! Drives one part: the clock, the threads and the letters around the state machine.

use super::part::{Heard, Part};
use super::post::{Letter, Slot};
use super::run::Run;
use crate::answer::{loop_weight, not_joined};
use coma_pose_graph::SolveError;
use coma_pose_graph::blocks::{BlockId, Boundary, OwnBlock};
use coma_runtime::CancellationToken;
use coma_wire::{Wire, v1};
use futures::{Stream, stream};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;
use tokio::sync::{Semaphore, watch};
use tokio::time::{Instant, sleep, timeout};
use tonic::Status;
use tracing::{info, warn};

/// How often a caller is told at most.
const TELL: Duration = Duration::from_millis(100);
/// How long a block that is finished goes on telling its neighbours so.
const LINGER: Duration = Duration::from_secs(10);

type Told = Result<v1::SolveBlockResponse, Status>;

/// How far a block is, for its caller: the newest, whenever the caller has room for it.
pub struct Progress {
    seen: watch::Receiver<Option<Told>>,
    /// The caller left.
    left: CancellationToken,
}

impl Progress {
    pub(super) fn new(seen: watch::Receiver<Option<Told>>, left: CancellationToken) -> Self {
        Progress { seen, left }
    }

    /// Until the run ends.
    pub fn answers(self) -> impl Stream<Item = Told> {
        let Progress { seen, left } = self;
        stream::unfold((seen, left.drop_guard()), |(mut seen, guard)| async {
            loop {
                // Ends when the driver has, and the last that it said was seen.
                seen.changed().await.ok()?;
                let told = seen.borrow_and_update().clone();
                if let Some(told) = told {
                    return Some((told, (seen, guard)));
                }
            }
        })
    }
}

/// A part and what is around it.
pub struct Driver {
    pub(super) own: Arc<OwnBlock>,
    /// Away while it steps.
    pub(super) part: Option<Part>,
    pub(super) run: Arc<Run>,
    /// One for each neighbour.
    pub(super) slots: BTreeMap<BlockId, Arc<Slot>>,
    pub(super) progress: watch::Sender<Option<Told>>,
    pub(super) left: CancellationToken,
    pub(super) stopping: CancellationToken,
    pub(super) work: Arc<Semaphore>,
    /// Shortest time between two steps.
    pub(super) step: Duration,
    /// How long to wait before what was not acknowledged is said again.
    pub(super) repeat: Duration,
    pub(super) longest: Duration,
    /// When standings were last told without a boundary.
    pub(super) standings_told: Instant,
}

/// Why a run ends.
enum End {
    /// The caller left.
    Left,
    /// All blocks are still.
    Finished(v1::SolveBlockResponse),
    /// With this status.
    Status(Status),
}

impl Driver {
    /// Until all blocks are still, the caller leaves, a newer call takes over, time is up, or the service ends.
    pub async fn drive(mut self) {
        let (run, left, stopping) = (self.run.clone(), self.left.clone(), self.stopping.clone());
        let longest = self.longest;
        let end = tokio::select! {
            biased;
            () = stopping.cancelled() => End::Status(Status::unavailable("the service is ending")),
            () = left.cancelled() => End::Left,
            () = run.replaced.cancelled() => End::Status(Status::aborted("a newer call took over this block")),
            () = sleep(longest) => {
                let message = format!("not all blocks were still after {longest:?}: blocks.max_run_s");
                End::Status(Status::deadline_exceeded(message))
            }
            end = self.solve() => end,
        };
        let (solve, agent) = &run.name;
        match end {
            End::Left => info!(solve, %agent, "the caller of a block left"),
            End::Status(status) => {
                warn!(solve, %agent, reason = status.message(), "a block was not finished");
                self.progress.send_replace(Some(Err(status)));
            }
            End::Finished(last) => {
                info!(solve, %agent, steps = last.steps, cost = last.cost, "all blocks are still");
                self.progress.send_replace(Some(Ok(last)));
                let progress = std::mem::replace(&mut self.progress, watch::Sender::new(None));
                drop(progress);
                tokio::select! {
                    () = stopping.cancelled() => {}
                    () = run.replaced.cancelled() => {}
                    () = self.linger() => {}
                }
            }
        }
    }

    async fn solve(&mut self) -> End {
        let mut told = Instant::now();
        let mut was_still = false;
        loop {
            let out = match self.advance().await {
                Ok(out) => out,
                Err(status) => return End::Status(status),
            };
            self.post(out);
            let Some(part) = &self.part else { return End::Left };
            if part.stillness.all_still() {
                return End::Finished(self.told(part, true));
            }
            let still = part.agent.is_still();
            if told.elapsed() >= TELL || still && !was_still {
                told = Instant::now();
                self.progress.send_replace(Some(Ok(self.told(part, false))));
            }
            was_still = still;
            let busy = part.agent.is_busy();
            sleep(self.step).await;
            if !busy {
                // Until something is heard, or what was said has to be said again.
                let _ = timeout(self.repeat, self.run.wake.notified()).await;
            }
        }
    }

    /// One step, on a thread for work.
    async fn advance(&mut self) -> Result<Vec<(BlockId, Boundary)>, Status> {
        let heard: Vec<(BlockId, Heard)> = self.run.take_heard();
        let permit = self.work.clone().acquire_owned().await;
        let permit = permit.map_err(|_| Status::unavailable("the service is ending"))?;
        let Some(mut part) = self.part.take() else { return Err(Status::internal("the block is gone")) };
        let step = move || {
            let _permit = permit;
            let out = part.advance(heard);
            (part, out)
        };
        let stepped = tokio::task::spawn_blocking(step).await;
        let (part, out) = stepped.map_err(|e| Status::internal(format!("a step ended badly: {e}")))?;
        self.run.attempt.store(part.attempt, Ordering::Relaxed);
        self.part = Some(part);
        metrics::counter!("coma_dpgo_block_steps_total").increment(1);
        out.map_err(|e: SolveError| Status::internal(format!("the block cannot be solved: {e}")))
    }

    /// Leaves letters for the neighbours: boundaries, and what is known of all. The latter is for the end: a block that
    /// moves does not tell it, and one that is still tells it by itself only now and then until all seem to be still.
    fn post(&mut self, out: Vec<(BlockId, Boundary)>) {
        let Some(part) = &self.part else { return };
        let version = part.stillness.version();
        let told = part.stillness.told().filter(|_| part.agent.is_still());
        let standings: Vec<v1::Standing> = told.map(|s| self.run.team.standing(s)).collect();
        let due = part.stillness.seems_over() || self.standings_told.elapsed() >= self.repeat;
        let by_itself = due && part.agent.is_still();
        if by_itself {
            self.standings_told = Instant::now();
        }
        let mut boundaries: BTreeMap<BlockId, Boundary> = out.into_iter().collect();
        for (to, slot) in &self.slots {
            let boundary = boundaries.remove(to);
            if boundary.is_none() && (!by_itself || self.run.has(*to, (part.attempt, version))) {
                continue;
            }
            let request = v1::PutBoundaryRequest {
                run: self.run.name.0.clone(),
                from_agent_id: self.run.name.1.to_wire(),
                to_agent_id: self.run.team.name(*to),
                team: self.run.team.digest.to_vec().into(),
                life: self.run.life,
                attempt: part.attempt,
                boundary: boundary.map(|b| self.run.names.boundary(&b, &self.run.team)),
                standings: standings.clone(),
            };
            let version = if part.agent.is_still() { version } else { 0 };
            slot.put(Letter { request, version });
        }
    }

    /// Tells neighbours that all are still, until they know or are gone themselves.
    async fn linger(&mut self) {
        let until = Instant::now() + LINGER;
        while Instant::now() < until {
            let Some(part) = &self.part else { return };
            let newest = (part.attempt, part.stillness.version());
            if self.slots.keys().all(|to| self.run.has(*to, newest) || self.run.is_gone(*to)) {
                return;
            }
            self.post(Vec::new());
            let _ = timeout(self.repeat, self.run.wake.notified()).await;
            self.run.take_heard();
        }
    }

    fn told(&self, part: &Part, finished: bool) -> v1::SolveBlockResponse {
        let poses = self.own.poses(part.agent.poses());
        let loops = part.agent.weights().filter_map(|(index, weight)| {
            let squared = part.agent.squared_error_of(index).unwrap_or(f64::NAN);
            Some(loop_weight(&self.own.loop_weight(index, weight, squared)?))
        });
        v1::SolveBlockResponse {
            steps: part.steps,
            cost: part.agent.cost(),
            still: part.agent.is_still(),
            finished,
            unplaced: self.own.own.len().saturating_sub(poses.len()) as u32,
            loops: loops.collect(),
            unheard: self.run.unheard(),
            not_joined: self.own.not_joined.iter().map(|(s, t, why)| not_joined(s, t, why)).collect(),
            provisional_poses: poses
                .iter()
                .map(|(submap, pose)| v1::SubmapPose {
                    submap_id: Some(submap.to_wire()),
                    map_from_submap: Some(pose.to_wire()),
                })
                .collect(),
        }
    }
}
