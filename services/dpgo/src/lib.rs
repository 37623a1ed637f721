//! The dpgo service: entries of agents' logs in, where every submap lies out.
//!
//! ```text
//! PutEntries       -> logs (contiguous, hash-chained) -> facts: submaps, odometry, verdicts, withdrawals
//! Solve            -> facts -> coma_pose_graph::solve (cold, canonical) -> answer: components, weights, reasons
//! WatchCorrections -> the answer of Solve, and again whenever its generations change
//! SolveBlock       -> facts -> one agent's block, solved with other dpgo services over PutBoundary (blocks)
//! ```
//!
//! It owns no truth: a service that was restarted has no graphs, answers `Solve` with NOT_FOUND, and its callers put
//! their entries again. Equal entries and settings give equal bits, in whatever order they came.

mod answer;
mod blocks;
mod config;
mod facts;
mod graphs;
mod logs;
mod service;
mod watch;

pub use config::{BlockConfig, DpgoConfig};

use blocks::Runs;
use coma_runtime::{Bound, ByteLedger, Services};
use coma_wire::v1::dpgo_server::DpgoServer;
use coma_wire::{FILE_DESCRIPTOR_SET, Limited};
use graphs::{Graphs, Solver};
use logs::Room;
use service::DpgoService;
use std::net::SocketAddr;
use std::sync::Arc;
use tokio::sync::Semaphore;

/// A dpgo service.
pub struct Server;

/// A running service. Dropping it ends it without waiting; [`Handle::shutdown`] waits.
pub struct Handle {
    /// Where it serves.
    pub local_addr: SocketAddr,
    /// `http://` or `https://` and the address, for callers on this machine.
    pub url: String,
    /// What it wrote, by class and message type.
    pub ledger: ByteLedger,
    server: coma_runtime::Handle,
}

impl Server {
    /// Takes the port and serves.
    ///
    /// # Errors
    /// Settings out of range, and a port that cannot be had.
    pub async fn start(config: DpgoConfig) -> anyhow::Result<Handle> {
        config.check()?;
        let bound = Bound::bind(&config.server).await?;
        let (local_addr, url) = (bound.local_addr, bound.url());
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let work = Arc::new(Semaphore::new(config.threads.unwrap_or(cores)));
        let ledger = ByteLedger::default();
        let largest = config.server.max_message_bytes;
        let service = DpgoService {
            graphs: Arc::new(Graphs::new(config.max_graphs, config.max_watchers_per_graph)),
            solver: Solver { settings: config.solve, work: work.clone() },
            runs: Runs::new(config.blocks, config.solve, largest, ledger.clone(), work, bound.stopping()),
            room: Room { entries: config.max_entries_per_graph, facts: config.max_facts_per_graph },
            stopping: bound.stopping(),
        };
        let limited = DpgoServer::new(service).limited(largest);
        let server = bound.serve(Services::new().with(limited), FILE_DESCRIPTOR_SET, &ledger).await?;
        Ok(Handle { local_addr, url, ledger, server })
    }
}

impl Handle {
    /// Ends in order: no more calls, those under work are finished up to the grace time.
    pub async fn shutdown(self) {
        self.server.shutdown().await;
    }
}
