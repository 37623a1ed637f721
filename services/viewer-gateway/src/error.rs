//! What callers are told when a request is refused or fails: JSON that names the field.

use axum::Json;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use coma_wire::FieldError;
use serde::Serialize;
use utoipa::ToSchema;

/// The body of every answer that is no success.
#[derive(Debug, Serialize, ToSchema)]
pub struct Problem {
    /// What went wrong.
    pub error: ProblemDetail,
}

/// What went wrong.
#[derive(Debug, Serialize, ToSchema)]
pub struct ProblemDetail {
    /// Path of the field at fault (`camera.fx`), of the parameter, or of the header. Absent where none is.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub field: Option<String>,
    /// What is wrong with it, with its numbers.
    pub message: String,
}

/// A refusal or a failure.
#[derive(Debug)]
pub struct ApiError {
    status: StatusCode,
    field: Option<String>,
    message: String,
}

impl ApiError {
    fn new(status: StatusCode, field: Option<&str>, message: impl Into<String>) -> Self {
        ApiError { status, field: field.map(str::to_owned), message: message.into() }
    }

    /// 400: a field or parameter that can't be used.
    pub fn bad(field: &str, message: impl Into<String>) -> Self {
        let field = Some(field).filter(|field| !field.is_empty());
        Self::new(StatusCode::BAD_REQUEST, field, message)
    }

    /// 401.
    pub fn unauthorized(message: impl Into<String>) -> Self {
        Self::new(StatusCode::UNAUTHORIZED, Some("authorization"), message)
    }

    /// 404: what `field` names is not here.
    pub fn not_found(field: &str, message: impl Into<String>) -> Self {
        Self::new(StatusCode::NOT_FOUND, Some(field), message)
    }

    /// 413: more than the gateway takes or makes.
    pub fn too_large(field: &str, message: impl Into<String>) -> Self {
        Self::new(StatusCode::PAYLOAD_TOO_LARGE, Some(field), message)
    }

    /// 415, 405 and their like, as the framework found them.
    pub fn plain(status: StatusCode, message: impl Into<String>) -> Self {
        Self::new(status, None, message)
    }

    /// 502: an agent did not answer, or not as the contract has it.
    pub fn agent(message: impl Into<String>) -> Self {
        Self::new(StatusCode::BAD_GATEWAY, None, message)
    }

    /// 503: try again later.
    pub fn busy(message: impl Into<String>) -> Self {
        Self::new(StatusCode::SERVICE_UNAVAILABLE, None, message)
    }

    /// 500: a bug of the gateway.
    pub fn internal(message: impl Into<String>) -> Self {
        Self::new(StatusCode::INTERNAL_SERVER_ERROR, None, message)
    }
}

impl From<FieldError> for ApiError {
    fn from(error: FieldError) -> Self {
        ApiError::bad(&error.field, error.message)
    }
}

impl IntoResponse for ApiError {
    fn into_response(self) -> Response {
        let ApiError { status, field, message } = self;
        if status.is_server_error() {
            tracing::warn!(%status, field, message, "a request failed");
        }
        let mut response =
            (status, Json(Problem { error: ProblemDetail { field, message } })).into_response();
        if status == StatusCode::SERVICE_UNAVAILABLE {
            response.headers_mut().insert(header::RETRY_AFTER, HeaderValue::from_static("1"));
        }
        if status == StatusCode::UNAUTHORIZED {
            response.headers_mut().insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
        }
        response
    }
}
