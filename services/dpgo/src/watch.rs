//! A watcher of one graph: its answer now, and whenever its generations change.

use crate::graphs::{Graph, NoAnswer, Solver};
use coma_runtime::CancellationToken;
use coma_wire::entries::VersionVector;
use coma_wire::v1;
use futures::{Stream, stream};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::{OwnedSemaphorePermit, watch};
use tonic::Status;

/// Entries that come together are answered together.
const GATHER: Duration = Duration::from_millis(20);

/// One watcher. Nothing is kept for it: it asks for the newest answer when its reader has room for one, so that a slow
/// reader skips and holds nobody up.
pub struct Watcher {
    /// For messages.
    name: String,
    graph: Arc<Graph>,
    solver: Solver,
    changes: watch::Receiver<u64>,
    /// Generations of the last answer that was sent.
    sent: Option<Generations>,
    stopping: CancellationToken,
    _place: OwnedSemaphorePermit,
    _counted: Counted,
}

type Generations = Vec<Option<v1::Generation>>;

/// Counts as long as it lives.
struct Counted;

impl Counted {
    fn one() -> Self {
        metrics::gauge!("coma_dpgo_watchers").increment(1.0);
        Counted
    }
}

impl Drop for Counted {
    fn drop(&mut self) {
        metrics::gauge!("coma_dpgo_watchers").decrement(1.0);
    }
}

impl Watcher {
    /// Begins to watch; refuses where too many do.
    pub fn new(
        name: String,
        graph: Arc<Graph>,
        solver: Solver,
        stopping: CancellationToken,
    ) -> Result<Self, Status> {
        let place = graph.watchers.clone().try_acquire_owned().map_err(|_| {
            let message = format!("graph {name:?} has as many watchers as max_watchers_per_graph allows");
            Status::resource_exhausted(message)
        })?;
        let changes = graph.changes();
        Ok(Watcher {
            name,
            graph,
            solver,
            changes,
            sent: None,
            stopping,
            _place: place,
            _counted: Counted::one(),
        })
    }

    /// Answers until the graph or the service ends.
    pub fn answers(self) -> impl Stream<Item = Result<v1::WatchCorrectionsResponse, Status>> {
        stream::unfold(Some(self), |watcher| async {
            let mut watcher = watcher?;
            match watcher.next().await {
                Ok(answer) => Some((Ok(answer), Some(watcher))),
                Err(end) => Some((Err(end), None)),
            }
        })
    }

    async fn next(&mut self) -> Result<v1::WatchCorrectionsResponse, Status> {
        let (stopping, dropped) = (self.stopping.clone(), self.graph.dropped.clone());
        tokio::select! {
            biased;
            () = stopping.cancelled() => Err(Status::unavailable("the service is ending; watch again later")),
            () = dropped.cancelled() => {
                let message = format!("graph {:?} made room for another: put the entries again", self.name);
                Err(Status::not_found(message))
            }
            answer = self.newest() => answer,
        }
    }

    /// The next answer whose generations differ from those sent last.
    async fn newest(&mut self) -> Result<v1::WatchCorrectionsResponse, Status> {
        loop {
            if self.sent.is_some() {
                self.changes.changed().await.map_err(|e| Status::internal(e.to_string()))?;
                tokio::time::sleep(GATHER).await;
            }
            self.changes.mark_unchanged();
            let answer = match self.graph.solve(&VersionVector::new(), &self.solver).await {
                Ok(answer) => answer,
                Err(NoAnswer::Failed(message)) => return Err(Status::internal(message)),
                Err(NoAnswer::Lacking(what)) => return Err(Status::internal(format!("{what:?}"))),
            };
            let generations: Generations = answer.components.iter().map(|c| c.generation.clone()).collect();
            if self.sent.as_ref() != Some(&generations) {
                self.sent = Some(generations);
                metrics::counter!("coma_dpgo_corrections_sent_total").increment(1);
                return Ok(v1::WatchCorrectionsResponse { answer: Some(answer.as_ref().clone()) });
            }
        }
    }
}
