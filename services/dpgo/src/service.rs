//! The gRPC side: requests are checked, work goes to threads of its own, answers come back.

use crate::blocks::{BlockRequest, Runs};
use crate::graphs::{Graph, Graphs, NoAnswer, Solver};
use crate::logs::{Full, Lacking, Room};
use crate::watch::Watcher;
use coma_runtime::{CancellationToken, Class, Connection};
use coma_wire::entries::Entry;
use coma_wire::v1::dpgo_server::Dpgo;
use coma_wire::{At, FieldError, Wire, limits, v1};
use futures::Stream;
use std::pin::Pin;
use std::sync::Arc;
use tonic::{Request, Response, Status};

/// Entries in one PutEntries.
pub const MAX_ENTRIES_PER_CALL: usize = 4096;

/// Answers the calls of `coma.v1.Dpgo`.
#[derive(Clone)]
pub struct DpgoService {
    /// What callers have put.
    pub graphs: Arc<Graphs>,
    /// How it is solved.
    pub solver: Solver,
    /// How much one graph may hold.
    pub room: Room,
    /// Blocks that are solved with others.
    pub runs: Runs,
    /// Cancelled when the service is asked to end.
    pub stopping: CancellationToken,
}

type Answers<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

/// A caller's graph: named, and not too long.
fn graph_name(name: String) -> Result<String, FieldError> {
    let at = At::Root("graph");
    if name.is_empty() {
        return Err(at.refuse("is empty: name the graph, for example by the agent's id"));
    }
    at.text(name, limits::NAME)
}

fn full(graph: &str, Full { what, limit }: Full) -> Status {
    let graph = format!("graph {graph:?}");
    coma_wire::full(&graph, &format!("{graph} is full: {what} = {limit}"))
}

fn lacking(graph: &str, Lacking { life: (agent, epoch), have, needed, forked_at }: Lacking) -> Status {
    let epoch = epoch.0;
    let why = match forked_at {
        Some(at) => format!("it forked at {at}, see rejected_entries; ask for less"),
        None => "put the entries that are missing".to_owned(),
    };
    Status::failed_precondition(format!(
        "graph {graph:?} holds {have} entries of {agent}/{epoch}, at_least asks for {needed}: {why}"
    ))
}

impl DpgoService {
    fn graph(&self, name: &str) -> Result<Arc<Graph>, Status> {
        let not_here = || Status::not_found(format!("graph {name:?} is not here: put the entries"));
        self.graphs.get(name).ok_or_else(not_here)
    }
}

#[tonic::async_trait]
impl Dpgo for DpgoService {
    async fn put_entries(
        &self,
        request: Request<v1::PutEntriesRequest>,
    ) -> Result<Response<v1::PutEntriesResponse>, Status> {
        let request = request.into_inner();
        let name = graph_name(request.graph)?;
        let at = At::Root("entries");
        at.at_most(request.entries.len(), MAX_ENTRIES_PER_CALL, "entries in one call")?;
        let (graphs, room) = (self.graphs.clone(), self.room);
        let put = move || {
            let mut entries: Vec<Entry> =
                At::Root("entries").repeated(request.entries, MAX_ENTRIES_PER_CALL)?;
            // Within a call any order will do.
            entries.sort_by(|a, b| a.key.cmp(&b.key));
            let graph = graphs.get_or_make(&name);
            let have = graph.with_logs(|logs| {
                entries.iter().try_for_each(|entry| logs.offer(entry, room))?;
                Ok(logs.have())
            });
            metrics::counter!("coma_dpgo_entries_total").increment(entries.len() as u64);
            have.map_err(|e| full(&name, e))
        };
        let have = tokio::task::spawn_blocking(put).await;
        let have =
            have.map_err(|e| Status::internal(format!("the work on this call ended badly: {e}")))??;
        Ok(Response::new(v1::PutEntriesResponse { have: Some(have.to_wire()) }))
    }

    async fn solve(&self, request: Request<v1::SolveRequest>) -> Result<Response<v1::SolveResponse>, Status> {
        let request = request.into_inner();
        let name = graph_name(request.graph)?;
        let at_least = coma_wire::version_vector(request.at_least, &At::Root("at_least"))?;
        let graph = self.graph(&name)?;
        match graph.solve(&at_least, &self.solver).await {
            Ok(answer) => Ok(Response::new(answer.as_ref().clone())),
            Err(NoAnswer::Lacking(what)) => Err(lacking(&name, what)),
            Err(NoAnswer::Failed(message)) => Err(Status::internal(message)),
        }
    }

    type WatchCorrectionsStream = Answers<v1::WatchCorrectionsResponse>;

    async fn watch_corrections(
        &self,
        request: Request<v1::WatchCorrectionsRequest>,
    ) -> Result<Response<Self::WatchCorrectionsStream>, Status> {
        let name = graph_name(request.into_inner().graph)?;
        let graph = self.graph(&name)?;
        let watcher = Watcher::new(name, graph, self.solver.clone(), self.stopping.clone())?;
        Ok(Response::new(Box::pin(watcher.answers())))
    }

    type SolveBlockStream = Answers<v1::SolveBlockResponse>;

    async fn solve_block(
        &self,
        request: Request<v1::SolveBlockRequest>,
    ) -> Result<Response<Self::SolveBlockStream>, Status> {
        let max_team = self.runs.max_team()?;
        let mut request = request.into_inner();
        let name = graph_name(std::mem::take(&mut request.graph))?;
        let at_least = coma_wire::version_vector(request.at_least.take(), &At::Root("at_least"))?;
        let request = BlockRequest::read(request, max_team)?;
        let held = self.graph(&name)?.with_logs(|logs| match logs.lacking(&at_least) {
            Some(what) => Err(what),
            None => Ok(logs.graph()),
        });
        let held = held.map_err(|what| lacking(&name, what))?;
        let progress = self.runs.begin(request, held.entries).await?;
        Ok(Response::new(Box::pin(progress.answers())))
    }

    async fn put_boundary(
        &self,
        request: Request<v1::PutBoundaryRequest>,
    ) -> Result<Response<v1::PutBoundaryResponse>, Status> {
        if let Some(connection) = Connection::of(&request) {
            connection.set_class(Class::Peer);
        }
        let attempt = self.runs.put(request.into_inner())?;
        Ok(Response::new(v1::PutBoundaryResponse { attempt }))
    }
}
