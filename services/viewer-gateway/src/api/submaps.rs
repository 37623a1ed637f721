//! Submaps and their surfels.

use super::Gateway;
use crate::agents::{PlacedSubmap, failed};
use crate::ask::{Asked, submap_id};
use crate::error::{ApiError, Problem};
use crate::json::{Submap, Unreachable};
use crate::scene;
use axum::Json;
use axum::body::Bytes;
use axum::extract::{Path, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use utoipa::{IntoParams, ToSchema};

/// Which submaps.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
pub struct SubmapsQuery {
    /// Only those that frames still come to.
    pub open: bool,
}

/// Submaps of all agents that answer.
#[derive(Debug, Serialize, ToSchema)]
pub struct Submaps {
    /// By agent, epoch and number.
    pub submaps: Vec<Submap>,
    /// Agents that have no part in this.
    pub unreachable: Vec<Unreachable>,
}

/// Every submap with where it lies, without surfels. A correction of the map changes this and no surfels.
#[utoipa::path(get, path = "/api/v1/submaps", tag = "maps", params(SubmapsQuery), security(("token" = [])),
    responses((status = 200, description = "The submaps", body = Submaps),
              (status = 400, description = "A bad parameter", body = Problem)))]
pub async fn submaps(
    State(gateway): State<Arc<Gateway>>,
    Asked(query): Asked<SubmapsQuery>,
) -> Result<Json<Submaps>, ApiError> {
    let (mut submaps, unreachable) = scene::submaps(&gateway.directory).await;
    submaps.retain(|submap| !(query.open && submap.closed));
    Ok(Json(Submaps { submaps: submaps.iter().map(PlacedSubmap::json).collect(), unreachable }))
}

/// How surfels come.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum SurfelFormat {
    /// 23 bytes a surfel; the layout is in `crates/surfel/src/pack.rs`.
    #[default]
    Packed,
    /// Binary PLY in the layout of 3D Gaussian Splatting, in the submap's own frame.
    Ply,
}

/// How surfels come.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
pub struct SurfelsQuery {
    /// Packed bytes or PLY.
    #[param(inline)]
    pub format: SurfelFormat,
    /// The revision that the caller knows of: a closed submap in that revision is answered without asking its
    /// agent, and may be kept by the caller for good.
    pub revision: Option<u64>,
}

/// One submap's surfels, in the submap's own frame. The header `etag` has the revision.
#[utoipa::path(get, path = "/api/v1/submaps/{agent}/{epoch}/{number}/surfels", tag = "maps", security(("token" = [])),
    params(SurfelsQuery,
        ("agent" = String, Path, description = "Whose submap"),
        ("epoch" = u64, Path, description = "In which of its lives"),
        ("number" = String, Path, description = "`s` and its number")),
    responses((status = 200, description = "The surfels", body = Vec<u8>, content_type = "application/octet-stream"),
              (status = 304, description = "The caller has this revision (`if-none-match`)"),
              (status = 400, description = "A bad parameter", body = Problem),
              (status = 404, description = "No such submap", body = Problem),
              (status = 502, description = "The agent does not answer", body = Problem)))]
pub async fn surfels(
    State(gateway): State<Arc<Gateway>>,
    Path(parts): Path<(String, String, String)>,
    Asked(query): Asked<SurfelsQuery>,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    let id = submap_id(parts)?;
    let max_surfels = gateway.config.max_surfels;
    // Only closed submaps are in the cache.
    let known = query.revision.and_then(|revision| gateway.cache.get(&id, revision));
    let (surfels, closed) = match known {
        Some(surfels) => (surfels, true),
        None => {
            let link = gateway.directory.agent("agent", &id.agent)?;
            let listed = link.submaps().await.map_err(|e| failed(&id.agent, &e))?;
            let not_here = || ApiError::not_found("number", format!("agent {} has no submap {id}", id.agent));
            let submap = listed.into_iter().find(|submap| submap.id == id).ok_or_else(not_here)?;
            let surfels = scene::fetch(&gateway.directory, &gateway.cache, &submap, max_surfels).await?;
            (surfels, submap.closed)
        }
    };
    let lasting = closed && query.revision == Some(surfels.revision);
    let cache = if lasting { "private, max-age=86400, immutable" } else { "private, no-cache" };
    let etag = format!("\"{}\"", surfels.revision);
    let mut out = HeaderMap::new();
    out.insert(header::CACHE_CONTROL, HeaderValue::from_static(cache));
    out.insert(header::ETAG, HeaderValue::from_str(&etag).map_err(|e| ApiError::internal(e.to_string()))?);
    if headers.get(header::IF_NONE_MATCH).is_some_and(|known| known.as_bytes() == etag.as_bytes()) {
        return Ok((StatusCode::NOT_MODIFIED, out).into_response());
    }
    let bytes = match query.format {
        SurfelFormat::Packed => surfels.packed.clone(),
        SurfelFormat::Ply => {
            let write = move || {
                let unpacked =
                    surfels.surfels(max_surfels).map_err(|e| ApiError::agent(format!("surfels: {e}")))?;
                Ok(Bytes::from(coma_surfel::ply::to_bytes(&unpacked)))
            };
            out.insert(
                header::CONTENT_DISPOSITION,
                HeaderValue::from_static("attachment; filename=\"submap.ply\""),
            );
            gateway.heavy(write).await?
        }
    };
    out.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/octet-stream"));
    Ok((out, bytes).into_response())
}
