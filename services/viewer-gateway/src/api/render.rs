//! The map as seen from any viewpoint.

use super::Gateway;
use crate::ask::{Asked, Json, map_id};
use crate::error::{ApiError, Problem};
use crate::json::Pose;
use crate::render::{Format, Output, picture};
use crate::scene;
use axum::extract::State;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use coma_geometry::Intrinsics;
use coma_wire::At;
use serde::Deserialize;
use std::sync::Arc;
use utoipa::{IntoParams, ToSchema};

/// A pinhole camera; the first pixel's centre is (0, 0). Pixels.
#[derive(Clone, Copy, Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Camera {
    /// 8 to 8192.
    pub width: u32,
    /// 8 to 8192.
    pub height: u32,
    /// Focal length along x.
    pub fx: f64,
    /// Focal length along y.
    pub fy: f64,
    /// Principal point.
    pub cx: f64,
    /// Principal point.
    pub cy: f64,
}

/// A viewpoint, and what is wanted of it.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct RenderRequest {
    /// `agent/epoch`; by default the map with most surfels.
    #[serde(default)]
    pub map: Option<String>,
    /// Where the camera is: x right, y down, z forward.
    pub map_from_camera: Pose,
    /// The camera.
    pub camera: Camera,
    /// What the picture shows.
    #[serde(default)]
    pub output: Output,
    /// How it is written.
    #[serde(default)]
    pub format: Format,
}

/// [`RenderRequest`] as parameters.
#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
pub struct RenderQuery {
    /// `agent/epoch`; by default the map with most surfels.
    pub map: Option<String>,
    /// Of map_from_camera, metres.
    pub tx_m: f64,
    /// Of map_from_camera, metres.
    pub ty_m: f64,
    /// Of map_from_camera, metres.
    pub tz_m: f64,
    /// Of map_from_camera, quaternion.
    pub qx: f64,
    /// Of map_from_camera, quaternion.
    pub qy: f64,
    /// Of map_from_camera, quaternion.
    pub qz: f64,
    /// Of map_from_camera, quaternion.
    pub qw: f64,
    /// Pixels, 8 to 8192. Default: 640.
    pub width: Option<u32>,
    /// Pixels, 8 to 8192. Default: 480.
    pub height: Option<u32>,
    /// Focal length, pixels. Default: the width, a view of 53 degrees.
    pub fx: Option<f64>,
    /// Focal length, pixels. Default: fx.
    pub fy: Option<f64>,
    /// Principal point, pixels. Default: the middle.
    pub cx: Option<f64>,
    /// Principal point, pixels. Default: the middle.
    pub cy: Option<f64>,
    /// What the picture shows. Default: color.
    #[serde(default)]
    #[param(inline)]
    pub output: Output,
    /// How it is written. Default: png.
    #[serde(default)]
    #[param(inline)]
    pub format: Format,
}

impl From<RenderQuery> for RenderRequest {
    fn from(q: RenderQuery) -> Self {
        let (width, height) = (q.width.unwrap_or(640), q.height.unwrap_or(480));
        let fx = q.fx.unwrap_or(f64::from(width));
        let middle = |side: u32| (f64::from(side) - 1.0) / 2.0;
        let (cx, cy) = (q.cx.unwrap_or(middle(width)), q.cy.unwrap_or(middle(height)));
        RenderRequest {
            map: q.map,
            map_from_camera: Pose {
                tx_m: q.tx_m,
                ty_m: q.ty_m,
                tz_m: q.tz_m,
                qx: q.qx,
                qy: q.qy,
                qz: q.qz,
                qw: q.qw,
            },
            camera: Camera { width, height, fx, fy: q.fy.unwrap_or(fx), cx, cy },
            output: q.output,
            format: q.format,
        }
    }
}

/// A picture of a map from a viewpoint, drawn by the same rasteriser that the agents map with. The header
/// `x-coma-map` names the map.
#[utoipa::path(post, path = "/api/v1/render", tag = "maps", request_body = RenderRequest, security(("token" = [])),
    responses((status = 200, description = "PNG or JPEG", body = Vec<u8>, content_type = "image/png"),
              (status = 400, description = "A bad field", body = Problem),
              (status = 404, description = "No such map", body = Problem),
              (status = 413, description = "Too many pixels or surfels", body = Problem),
              (status = 502, description = "An agent does not answer", body = Problem),
              (status = 503, description = "Too much under work", body = Problem)))]
pub async fn render_post(
    State(gateway): State<Arc<Gateway>>,
    Json(request): Json<RenderRequest>,
) -> Result<Response, ApiError> {
    render(&gateway, request, "map_from_camera", "camera.").await
}

/// The same, with parameters.
#[utoipa::path(get, path = "/api/v1/render", tag = "maps", params(RenderQuery), security(("token" = [])),
    responses((status = 200, description = "PNG or JPEG", body = Vec<u8>, content_type = "image/png"),
              (status = 400, description = "A bad parameter", body = Problem),
              (status = 404, description = "No such map", body = Problem),
              (status = 413, description = "Too many pixels or surfels", body = Problem),
              (status = 502, description = "An agent does not answer", body = Problem),
              (status = 503, description = "Too much under work", body = Problem)))]
pub async fn render_get(
    State(gateway): State<Arc<Gateway>>,
    Asked(query): Asked<RenderQuery>,
) -> Result<Response, ApiError> {
    render(&gateway, query.into(), "", "").await
}

/// `pose_at` and `camera_at` are where the caller wrote the pose and the camera's fields.
async fn render(
    gateway: &Gateway,
    request: RenderRequest,
    pose_at: &str,
    camera_at: &str,
) -> Result<Response, ApiError> {
    let RenderRequest { map, map_from_camera, camera, output, format } = request;
    let map = map.map(|map| map_id("map", &map)).transpose()?;
    let map_from_camera = map_from_camera.read(&At::Root(pose_at))?;
    let Camera { width, height, fx, fy, cx, cy } = camera;
    let camera = Intrinsics { width, height, fx, fy, cx, cy }.validated().map_err(|e| {
        ApiError::bad(
            &format!("{camera_at}{}", e.field),
            format!("{} is out of range: {}", e.value, e.needed),
        )
    })?;
    let limit = gateway.config.max_render_pixels;
    if camera.pixels() > limit {
        let message = format!("{width} x {height} pixels, at most {limit} are rendered");
        return Err(ApiError::too_large(&format!("{camera_at}width"), message));
    }
    let scene = scene::scene(&gateway.directory, map).await?;
    let parts = scene::load(&gateway.directory, &gateway.cache, &scene, gateway.config.max_surfels).await?;
    let draw = move || {
        picture(&parts, &map_from_camera, &camera, output, format)
            .map_err(|e| ApiError::internal(e.to_string()))
    };
    let file = gateway.heavy(draw).await?;
    let headers = [
        (header::CONTENT_TYPE.as_str(), format.media_type().to_owned()),
        (header::CACHE_CONTROL.as_str(), "no-store".to_owned()),
        ("x-coma-map", scene.map.to_string()),
    ];
    Ok((headers, file).into_response())
}
