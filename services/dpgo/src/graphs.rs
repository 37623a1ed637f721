//! The graphs of every caller, in bounded number; each is solved once for every state that it was in.

use crate::answer::answer;
use crate::logs::{Lacking, Logs};
use coma_pose_graph::GlobalSettings;
use coma_runtime::CancellationToken;
use coma_wire::entries::VersionVector;
use coma_wire::v1;
use futures::FutureExt;
use futures::future::{BoxFuture, Shared};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Instant;
use tokio::sync::{Semaphore, watch};
use tracing::{info, warn};

/// A solve that runs or has run: whoever waits for it gets the same answer.
type Solving = Shared<BoxFuture<'static, Result<Arc<v1::SolveResponse>, String>>>;

#[derive(Default)]
struct State {
    logs: Logs,
    /// The newest solve, and of which version of the logs.
    solving: Option<(u64, Solving)>,
}

/// One caller's graph.
pub struct Graph {
    state: Mutex<State>,
    /// The version of the logs.
    changed: watch::Sender<u64>,
    /// Room for those who watch it.
    pub watchers: Arc<Semaphore>,
    /// Cancelled when it made room for another graph.
    pub dropped: CancellationToken,
}

/// Why there is no answer.
#[derive(Debug)]
pub enum NoAnswer {
    /// The graph does not hold enough.
    Lacking(Lacking),
    /// The solver ended badly.
    Failed(String),
}

/// How graphs are solved.
#[derive(Clone)]
pub struct Solver {
    /// Everything that shapes a result.
    pub settings: GlobalSettings,
    /// One permit for each solve that may run at once.
    pub work: Arc<Semaphore>,
}

impl Graph {
    fn new(max_watchers: usize) -> Self {
        Graph {
            state: Mutex::default(),
            changed: watch::Sender::new(0),
            watchers: Arc::new(Semaphore::new(max_watchers)),
            dropped: CancellationToken::new(),
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Does something with the logs. Never held across an await.
    pub fn with_logs<T>(&self, f: impl FnOnce(&mut Logs) -> T) -> T {
        let logs = &mut self.lock().logs;
        let out = f(logs);
        let version = logs.version();
        self.changed.send_if_modified(|known| std::mem::replace(known, version) != version);
        out
    }

    /// Tells when something that a solve takes has changed.
    pub fn changes(&self) -> watch::Receiver<u64> {
        self.changed.subscribe()
    }

    /// The cold solve of what the graph holds, which is at least `at_least`. A graph that was solved as it is gives
    /// the answer that it gave. One solve of a graph runs at a time, and goes on if its callers leave: who comes
    /// back finds it.
    pub async fn solve(
        &self,
        at_least: &VersionVector,
        solver: &Solver,
    ) -> Result<Arc<v1::SolveResponse>, NoAnswer> {
        loop {
            let (current, solving) = {
                let mut state = self.lock();
                if let Some(lacking) = state.logs.lacking(at_least) {
                    return Err(NoAnswer::Lacking(lacking));
                }
                let version = state.logs.version();
                match &state.solving {
                    Some((solved, solving))
                        if *solved == version && !matches!(solving.peek(), Some(Err(_))) =>
                    {
                        (true, solving.clone())
                    }
                    // Of an older state, and still running: its turn first.
                    Some((_, solving)) if solving.peek().is_none() => (false, solving.clone()),
                    _ => {
                        let before = state.solving.as_ref().and_then(|(_, s)| s.peek()?.clone().ok());
                        let solving = begin(state.logs.graph(), before, solver.clone());
                        state.solving = Some((version, solving.clone()));
                        (true, solving)
                    }
                }
            };
            let answer = solving.await;
            if current {
                return answer.map_err(NoAnswer::Failed);
            }
        }
    }
}

/// Starts a solve on a thread of its own; `before` is the graph's answer before this one.
fn begin(graph: crate::facts::Graph, before: Option<Arc<v1::SolveResponse>>, solver: Solver) -> Solving {
    let task = tokio::spawn(async move {
        let permit = solver.work.acquire_owned().await.map_err(|_| "the service is ending".to_owned())?;
        let solve = move || {
            let _permit = permit;
            let begin = Instant::now();
            let solution = coma_pose_graph::solve(&graph.entries, &solver.settings);
            let seconds = begin.elapsed().as_secs_f64();
            report(&graph, &solution, seconds);
            let answer = answer(&graph, &solution);
            let is_new = |c: &&v1::Component| {
                let mut known = before.iter().flat_map(|b| &b.components);
                !known.any(|b| b.generation == c.generation)
            };
            let generations = answer.components.iter().filter(is_new).count();
            metrics::counter!("coma_dpgo_generations_total").increment(generations as u64);
            Arc::new(answer)
        };
        tokio::task::spawn_blocking(solve).await.map_err(|e| format!("the solver ended badly: {e}"))
    });
    async move { task.await.map_err(|e| format!("the solver ended badly: {e}"))? }.boxed().shared()
}

fn report(graph: &crate::facts::Graph, solution: &coma_pose_graph::Solution, seconds: f64) {
    let (submaps, edges) = (graph.entries.nodes.len(), graph.entries.edges.len());
    let components = solution.components.len();
    metrics::counter!("coma_dpgo_solves_total").increment(1);
    metrics::histogram!("coma_dpgo_solve_seconds").record(seconds);
    metrics::gauge!("coma_dpgo_graph_submaps").set(submaps as f64);
    metrics::gauge!("coma_dpgo_graph_edges").set(edges as f64);
    metrics::gauge!("coma_dpgo_graph_components").set(components as f64);
    let cost: f64 = solution.components.iter().map(|c| c.cost).sum();
    metrics::gauge!("coma_dpgo_graph_cost").set(cost);
    info!(submaps, edges, components, cost, seconds, "graph solved");
    for component in &solution.components {
        if let Some(failure) = &component.failure {
            warn!(map = %component.map_id, failure, "a component keeps the poses that the solve started from");
        }
    }
}

#[derive(Default)]
struct Shelf {
    /// By name: when a graph was last used, and the graph.
    graphs: BTreeMap<String, (u64, Arc<Graph>)>,
    /// Counts uses.
    clock: u64,
}

/// The graphs of all callers, by name; the least recently used one makes room for a new one.
pub struct Graphs {
    max_graphs: usize,
    max_watchers_per_graph: usize,
    shelf: Mutex<Shelf>,
}

impl Graphs {
    /// None yet.
    pub fn new(max_graphs: usize, max_watchers_per_graph: usize) -> Self {
        Graphs { max_graphs, max_watchers_per_graph, shelf: Mutex::default() }
    }

    fn lock(&self) -> MutexGuard<'_, Shelf> {
        self.shelf.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A graph that is here.
    pub fn get(&self, name: &str) -> Option<Arc<Graph>> {
        let Shelf { graphs, clock } = &mut *self.lock();
        *clock += 1;
        let (last_used, graph) = graphs.get_mut(name)?;
        *last_used = *clock;
        Some(graph.clone())
    }

    /// A graph, made where it is not here.
    pub fn get_or_make(&self, name: &str) -> Arc<Graph> {
        let Shelf { graphs, clock } = &mut *self.lock();
        *clock += 1;
        if let Some((last_used, graph)) = graphs.get_mut(name) {
            *last_used = *clock;
            return graph.clone();
        }
        if graphs.len() >= self.max_graphs
            && let Some(oldest) =
                graphs.iter().min_by_key(|(_, (used, _))| *used).map(|(name, _)| name.clone())
        {
            warn!(dropped = oldest, max_graphs = self.max_graphs, "the least recently used graph made room");
            if let Some((_, graph)) = graphs.remove(&oldest) {
                graph.dropped.cancel();
            }
        }
        let graph = Arc::new(Graph::new(self.max_watchers_per_graph));
        graphs.insert(name.to_owned(), (*clock, graph.clone()));
        graph
    }
}
