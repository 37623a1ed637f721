//! The place-recognition service: pictures become descriptors, and anchors that may show one place are found.
//!
//! ```text
//! Describe -> picture (decode) -> encoders (builtin, models) -> descriptors
//! Insert   -> indices: the anchors of one caller
//! Query    -> indices: similar, far enough apart in time, in similar surroundings -> candidates
//! ```
//!
//! Everything here is derived: a service that was restarted has empty indices, answers `Query` with NOT_FOUND,
//! and its callers insert their anchors again.

mod config;
mod encoders;
mod indices;
mod picture;
mod service;

pub use config::{MAX_MODELS, OnnxSettings, PlaceRecognitionConfig};
pub use encoders::{Encoders, Named};

use anyhow::Context;
use coma_runtime::{Bound, ByteLedger, Services};
use coma_wire::v1::place_recognition_server::PlaceRecognitionServer;
use coma_wire::{FILE_DESCRIPTOR_SET, Limited};
use indices::Indices;
use service::PlaceService;
use std::net::SocketAddr;
use std::sync::Arc;
use tokio::sync::Semaphore;

/// A place-recognition service.
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
    /// Loads the models, takes the port and serves.
    ///
    /// # Errors
    /// Settings out of range, and a port that cannot be had. A model that cannot be loaded is no error.
    pub async fn start(config: PlaceRecognitionConfig) -> anyhow::Result<Handle> {
        config.check()?;
        let bound = Bound::bind(&config.server).await?;
        let (local_addr, url) = (bound.local_addr, bound.url());
        let limit = config.server.max_message_bytes;
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let work = Arc::new(Semaphore::new(config.threads.unwrap_or(cores)));
        let loading = {
            let config = config.clone();
            tokio::task::spawn_blocking(move || Encoders::load(&config))
        };
        let encoders = Arc::new(loading.await.context("models could not be loaded")?);
        let indices = Arc::new(Indices::new(
            config.candidates,
            encoders.thresholds(),
            config.max_indices,
            config.max_anchors_per_index,
        ));
        let service = PlaceService { encoders, indices, work, max_pixels: config.max_pixels };
        let services = Services::new().with(PlaceRecognitionServer::new(service).limited(limit));
        let ledger = ByteLedger::default();
        let server = bound.serve(services, FILE_DESCRIPTOR_SET, &ledger).await?;
        Ok(Handle { local_addr, url, ledger, server })
    }
}

impl Handle {
    /// Ends in order: no more calls, those under work are finished up to the grace time.
    pub async fn shutdown(self) {
        self.server.shutdown().await;
    }
}
