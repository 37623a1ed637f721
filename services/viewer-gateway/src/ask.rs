//! Requests taken apart: every refusal names its field.

use crate::error::ApiError;
use axum::body::{Body, to_bytes};
use axum::extract::{FromRequest, FromRequestParts, Query, Request};
use axum::http::request::Parts;
use coma_geometry::{AgentId, Epoch, InvalidMapId, MapId, SubmapId};
use serde::de::DeserializeOwned;
use std::error::Error;

/// Bytes of a request's body.
const MAX_BODY: usize = 64 << 10;

/// The query string as a struct; unknown parameters are refused if the struct says so.
pub struct Asked<T>(pub T);

impl<T: DeserializeOwned, S: Send + Sync> FromRequestParts<S> for Asked<T> {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, ApiError> {
        match Query::try_from_uri(&parts.uri) {
            Ok(Query(asked)) => Ok(Asked(asked)),
            Err(rejection) => {
                let message = rejection.source().map_or_else(|| rejection.to_string(), |e| e.to_string());
                let (field, message) = field_of(&message);
                Err(ApiError::bad(field, message))
            }
        }
    }
}

/// A JSON body of at most 64 KiB.
pub struct Json<T>(pub T);

impl<T: DeserializeOwned, S: Send + Sync> FromRequest<S> for Json<T> {
    type Rejection = ApiError;

    async fn from_request(request: Request<Body>, _: &S) -> Result<Self, ApiError> {
        let too_large = |_| ApiError::too_large("body", format!("over {MAX_BODY} bytes, or cut off"));
        let bytes = to_bytes(request.into_body(), MAX_BODY).await.map_err(too_large)?;
        let mut json = serde_json::Deserializer::from_slice(&bytes);
        let value = serde_path_to_error::deserialize(&mut json).map_err(|e| {
            let path = e.path().to_string();
            let message = e.inner().to_string();
            match path.as_str() {
                "." | "?" => {
                    let (field, message) = field_of(&message);
                    ApiError::bad(if field.is_empty() { "body" } else { field }, message)
                }
                path => match field_of(&message) {
                    ("", message) => ApiError::bad(path, message),
                    (field, message) if path.ends_with(field) => ApiError::bad(path, message),
                    (field, message) => ApiError::bad(&format!("{path}.{field}"), message),
                },
            }
        })?;
        json.end().map_err(|e| ApiError::bad("body", e.to_string()))?;
        Ok(Json(value))
    }
}

/// The field that a message of serde names, or empty, and the rest of the message.
fn field_of(message: &str) -> (&str, &str) {
    let names_field = message.starts_with("missing field `") || message.starts_with("unknown field `");
    if names_field && let Some(name) = message.split('`').nth(1) {
        return (name, message);
    }
    match message.split_once(": ") {
        Some((field, rest))
            if !field.is_empty() && field.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_') =>
        {
            (field, rest)
        }
        _ => ("", message),
    }
}

/// `agent-00`.
pub fn agent_id(field: &str, text: &str) -> Result<AgentId, ApiError> {
    AgentId::new(text).map_err(|e| ApiError::bad(field, e.to_string()))
}

/// `agent-00/1` or `agent-00/1/s7`: a map.
pub fn map_id(field: &str, text: &str) -> Result<MapId, ApiError> {
    text.parse().map_err(|e: InvalidMapId| ApiError::bad(field, e.to_string()))
}

/// The parts of `agent-00/1/s3`.
pub fn submap_id((agent, epoch, number): (String, String, String)) -> Result<SubmapId, ApiError> {
    let refuse = |field, what| ApiError::bad(field, format!("is no {what}"));
    Ok(SubmapId {
        agent: agent_id("agent", &agent)?,
        epoch: Epoch(epoch.parse().map_err(|_| refuse("epoch", "epoch"))?),
        number: number
            .strip_prefix('s')
            .and_then(|n| n.parse().ok())
            .ok_or_else(|| refuse("number", "submap number: s and digits are needed"))?,
    })
}
