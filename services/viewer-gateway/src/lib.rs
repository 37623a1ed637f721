//! The viewer gateway: the HTTP side of a cluster.
//!
//! ```text
//! agents (gRPC: GetStatus, Viewer) -> agents::Directory -> api (HTTP under /api/v1) -> people, programs, the page
//!                                         |  status once a second, events as they come
//!                                         `- listed, or found by DNS again and again
//! ```
//!
//! It keeps no state but a bounded cache of closed submaps, so that any number of gateways may run. An agent that
//! does not answer is named as unreachable and never waited for: every call to one has a deadline.

mod agents;
mod api;
mod ask;
mod cache;
mod config;
mod error;
mod json;
mod metrics;
mod page;
mod render;
mod scene;

pub use config::{ConfigError, GatewayConfig};

use agents::Directory;
use anyhow::Context;
use api::Gateway;
use coma_runtime::CancellationToken;
use std::net::SocketAddr;
use std::time::Duration;
use tokio::net::TcpListener;
use tokio::task::JoinHandle;

/// How long answers may go on after the gateway was asked to end.
const GRACE: Duration = Duration::from_secs(5);

/// A gateway.
pub struct Server;

/// A running gateway. Dropping it asks it to end.
pub struct Handle {
    /// Where it listens.
    pub local_addr: SocketAddr,
    /// `http://` and the address, for callers on this machine.
    pub url: String,
    stop: CancellationToken,
    task: JoinHandle<()>,
}

impl Server {
    /// Checks the settings, takes the port and starts to serve.
    pub async fn start(config: GatewayConfig) -> anyhow::Result<Handle> {
        let config = config.checked()?;
        coma_runtime::metrics::install();
        let stop = CancellationToken::new();
        // Whatever fails below ends what was started.
        let guard = stop.clone().drop_guard();
        let listen = config.listen;
        let listener =
            TcpListener::bind(listen).await.with_context(|| format!("cannot listen on {listen}"))?;
        let local_addr = listener.local_addr()?;
        if config.token.is_none() && !local_addr.ip().is_loopback() {
            tracing::warn!(%local_addr, "open to everyone who can reach it (insecure = true)");
        }
        let directory = Directory::start(&config, stop.clone())?;
        let router = api::router(Gateway::new(config, directory, stop.clone()));
        let asked = stop.clone();
        let task = tokio::spawn(async move {
            let serving =
                axum::serve(listener, router).with_graceful_shutdown(asked.clone().cancelled_owned());
            let serving = std::pin::pin!(serving.into_future());
            let late = async {
                asked.cancelled().await;
                tokio::time::sleep(GRACE).await;
            };
            tokio::select! {
                ended = serving => {
                    if let Err(error) = ended {
                        tracing::error!(%local_addr, %error, "the gateway ended");
                    }
                }
                () = late => {}
            }
        });
        tracing::info!(%local_addr, "serving");
        let reachable = if local_addr.ip().is_unspecified() {
            SocketAddr::from(([127, 0, 0, 1], local_addr.port()))
        } else {
            local_addr
        };
        guard.disarm();
        Ok(Handle { local_addr, url: format!("http://{reachable}"), stop, task })
    }
}

impl Handle {
    /// Asks it to end and waits, a few seconds at most.
    pub async fn shutdown(mut self) {
        self.stop.cancel();
        if let Err(error) = (&mut self.task).await
            && error.is_panic()
        {
            tracing::error!(%error, "the gateway's task panicked");
        }
    }
}

impl Drop for Handle {
    fn drop(&mut self) {
        self.stop.cancel();
    }
}

/// The description of everything under `/api/v1`, as OpenAPI in JSON.
pub fn openapi_json() -> String {
    // A description is made of texts and numbers, which always have a JSON form.
    serde_json::to_string_pretty(&api::description()).unwrap_or_default()
}
