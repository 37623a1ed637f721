//! What every request passes.

use super::Gateway;
use crate::error::ApiError;
use axum::extract::{MatchedPath, Request, State};
use axum::http::{StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Longest time until an answer begins. Calls to agents have shorter limits of their own.
const LONGEST: Duration = Duration::from_secs(120);

/// `authorization: Bearer <token>`, where a token is set.
pub async fn authorized(State(gateway): State<Arc<Gateway>>, request: Request, next: Next) -> Response {
    let Some(token) = &gateway.config.token else { return next.run(request).await };
    let entry = request.headers().get(header::AUTHORIZATION).map(|entry| entry.as_bytes());
    let offered = entry.and_then(|entry| {
        let (scheme, token) = entry.split_at_checked(7)?;
        scheme.eq_ignore_ascii_case(b"bearer ").then_some(token)
    });
    match (entry, offered) {
        (_, Some(offered)) if token.matches(offered) => next.run(request).await,
        (None, _) => ApiError::unauthorized("missing; `Bearer <token>` is needed").into_response(),
        (_, None) => ApiError::unauthorized("`Bearer <token>` is needed").into_response(),
        (_, Some(_)) => ApiError::unauthorized("the token is not the gateway's").into_response(),
    }
}

/// At most so many requests at once; more are refused, health checks aside.
pub async fn admitted(State(gateway): State<Arc<Gateway>>, request: Request, next: Next) -> Response {
    if matches!(request.uri().path(), "/healthz" | "/readyz") {
        return next.run(request).await;
    }
    match gateway.requests.try_acquire() {
        Ok(_place) => next.run(request).await,
        Err(_) => {
            let limit = gateway.config.max_requests;
            ApiError::busy(format!("{limit} requests are under work, the limit of this gateway"))
                .into_response()
        }
    }
}

/// No request hangs.
pub async fn in_time(request: Request, next: Next) -> Response {
    match tokio::time::timeout(LONGEST, next.run(request)).await {
        Ok(response) => response,
        Err(_) => ApiError::plain(StatusCode::GATEWAY_TIMEOUT, format!("no answer within {LONGEST:?}"))
            .into_response(),
    }
}

/// Counts requests by route, method and status.
pub async fn counted(request: Request, next: Next) -> Response {
    let begin = Instant::now();
    let route = request.extensions().get::<MatchedPath>().map_or("page", |path| path.as_str()).to_owned();
    let method = request.method().as_str().to_owned();
    let response = next.run(request).await;
    let status = response.status().as_u16().to_string();
    metrics::counter!("coma_gateway_requests_total", "route" => route.clone(), "method" => method, "status" => status)
        .increment(1);
    metrics::histogram!("coma_gateway_request_seconds", "route" => route)
        .record(begin.elapsed().as_secs_f64());
    response
}
