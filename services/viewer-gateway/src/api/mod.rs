//! The HTTP side: routes, and the layers around them.
//!
//! From outside in: counts, admission with load shedding, deadline, compression of JSON and the page,
//! authorization of everything under `/api` and `/metrics`.

mod agents;
mod around;
mod events;
mod graph;
mod health;
mod maps;
mod render;
mod submaps;
mod trajectories;

use crate::agents::Directory;
use crate::cache::SurfelCache;
use crate::config::GatewayConfig;
use crate::error::{ApiError, Problem};
use crate::page;
use axum::Router;
use axum::extract::Request;
use axum::http::{Method, StatusCode};
use axum::middleware::{from_fn, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use coma_runtime::CancellationToken;
use std::sync::Arc;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tower_http::compression::CompressionLayer;
use utoipa::OpenApi;
use utoipa::openapi::security::{HttpAuthScheme, HttpBuilder, SecurityScheme};

/// What requests work with.
pub struct Gateway {
    config: GatewayConfig,
    directory: Arc<Directory>,
    cache: SurfelCache,
    /// Heavy work under way.
    heavy: Arc<Semaphore>,
    /// Heavy work under way or waiting.
    heavy_or_waiting: Arc<Semaphore>,
    listeners: Arc<Semaphore>,
    requests: Semaphore,
    stop: CancellationToken,
}

impl Gateway {
    /// With settings that were checked.
    pub fn new(config: GatewayConfig, directory: Arc<Directory>, stop: CancellationToken) -> Arc<Self> {
        Arc::new(Gateway {
            directory,
            cache: SurfelCache::new(config.cache_bytes),
            heavy: Arc::new(Semaphore::new(config.max_heavy)),
            heavy_or_waiting: Arc::new(Semaphore::new(2 * config.max_heavy)),
            listeners: Arc::new(Semaphore::new(config.max_listeners)),
            requests: Semaphore::new(config.max_requests),
            config,
            stop,
        })
    }

    /// Runs heavy work on a thread of its own, when it is its turn. It counts until it is done, even if the
    /// caller has gone.
    async fn heavy<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> Result<T, ApiError> + Send + 'static,
    ) -> Result<T, ApiError> {
        let places: [OwnedSemaphorePermit; 2] = [
            self.heavy_or_waiting.clone().try_acquire_owned().map_err(|_| {
                ApiError::busy(format!(
                    "{} renderings and maps are under work or wait",
                    2 * self.config.max_heavy
                ))
            })?,
            self.heavy.clone().acquire_owned().await.map_err(|e| ApiError::internal(e.to_string()))?,
        ];
        let work = move || {
            let _places = places;
            work()
        };
        tokio::task::spawn_blocking(work).await.map_err(|e| ApiError::internal(e.to_string()))?
    }
}

/// The description of all this, as OpenAPI.
#[derive(OpenApi)]
#[openapi(
    info(
        title = "CoMA viewer gateway",
        description = "Trajectories, maps, renderings, loops and live events of a cluster of SLAM agents. Metres, \
                       radians, pixels; transforms name both ends. Agents that do not answer are named in \
                       `unreachable`, never waited for."
    ),
    paths(
        agents::agents,
        trajectories::trajectories,
        trajectories::tum,
        submaps::submaps,
        submaps::surfels,
        maps::maps,
        maps::ply,
        maps::relation,
        render::render_get,
        render::render_post,
        graph::graph,
        events::events,
        health::metrics,
        health::healthz,
        health::readyz,
    ),
    components(schemas(Problem, crate::agents::LiveEvent))
)]
struct Description;

/// The description with the token's scheme.
pub fn description() -> utoipa::openapi::OpenApi {
    let mut description = Description::openapi();
    let bearer = SecurityScheme::Http(HttpBuilder::new().scheme(HttpAuthScheme::Bearer).build());
    if let Some(components) = &mut description.components {
        components.add_security_scheme("token", bearer);
    }
    description
}

async fn openapi() -> axum::Json<utoipa::openapi::OpenApi> {
    axum::Json(description())
}

/// Everything that the gateway serves.
pub fn router(gateway: Arc<Gateway>) -> Router {
    let protected = Router::new()
        .route("/api/v1/agents", get(agents::agents))
        .route("/api/v1/trajectories", get(trajectories::trajectories))
        .route("/api/v1/agents/{agent}/trajectory.tum", get(trajectories::tum))
        .route("/api/v1/submaps", get(submaps::submaps))
        .route("/api/v1/maps", get(maps::maps))
        .route("/api/v1/maps/relation", get(maps::relation))
        .route("/api/v1/graph", get(graph::graph))
        .route("/api/v1/openapi.json", get(openapi))
        .route("/metrics", get(health::metrics))
        .layer(CompressionLayer::new())
        // Surfels and pictures are dense already, and events must not wait in a compressor.
        .route("/api/v1/submaps/{agent}/{epoch}/{number}/surfels", get(submaps::surfels))
        .route("/api/v1/map.ply", get(maps::ply))
        .route("/api/v1/render", get(render::render_get).post(render::render_post))
        .route("/api/v1/events", get(events::events))
        .layer(from_fn_with_state(gateway.clone(), around::authorized));
    let open = Router::new()
        .route("/healthz", get(health::healthz))
        .route("/readyz", get(health::readyz))
        .fallback_service(
            tower::ServiceBuilder::new().layer(CompressionLayer::new()).service(get(elsewhere)),
        );
    protected
        .merge(open)
        .method_not_allowed_fallback(wrong_method)
        .layer(from_fn(around::in_time))
        .layer(from_fn_with_state(gateway.clone(), around::admitted))
        .layer(from_fn(around::counted))
        .with_state(gateway)
}

async fn elsewhere(request: Request) -> Response {
    match page::file(request.uri()) {
        Some(file) => file,
        None => {
            let path: String = request.uri().path().chars().take(100).collect();
            ApiError::not_found("path", format!("{path} is not served here; see /api/v1/openapi.json"))
                .into_response()
        }
    }
}

async fn wrong_method(method: Method) -> ApiError {
    ApiError::plain(StatusCode::METHOD_NOT_ALLOWED, format!("{method} is not for this path"))
}
