//! For orchestrators and Prometheus. Health is open: it says nothing else.

use super::Gateway;
use axum::Json;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use std::sync::Arc;
use utoipa::ToSchema;

/// The process answers.
#[utoipa::path(get, path = "/healthz", tag = "health", responses((status = 200, description = "It lives", body = String)))]
pub async fn healthz() -> &'static str {
    "ok\n"
}

/// Whether requests are worth sending here.
#[derive(Debug, Serialize, ToSchema)]
pub struct Readiness {
    /// Every agent that is known was asked at least once.
    pub ready: bool,
    /// Agents known.
    pub agents: usize,
    /// Of these, how many answer.
    pub reachable: usize,
}

/// Ready once it is known who there is. That agents are gone does not make a gateway unready: it says so itself.
#[utoipa::path(get, path = "/readyz", tag = "health",
    responses((status = 200, description = "Ready", body = Readiness), (status = 503, description = "Not yet", body = Readiness)))]
pub async fn readyz(State(gateway): State<Arc<Gateway>>) -> Response {
    let agents = gateway.directory.agents();
    let reachable = agents.iter().filter(|link| link.state().reachable).count();
    let ready = gateway.directory.settled() && !gateway.stop.is_cancelled();
    let status = if ready { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE };
    (status, Json(Readiness { ready, agents: agents.len(), reachable })).into_response()
}

/// Prometheus' text format: this process, and each agent with its bytes by class and message type.
#[utoipa::path(get, path = "/metrics", tag = "health", security(("token" = [])),
    responses((status = 200, description = "Metrics", body = String, content_type = "text/plain")))]
pub async fn metrics(State(gateway): State<Arc<Gateway>>) -> impl IntoResponse {
    let agents = crate::metrics::of_agents(&gateway.directory.agents(), gateway.cache.bytes());
    let text = coma_runtime::metrics::render() + &agents;
    ([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], text)
}
