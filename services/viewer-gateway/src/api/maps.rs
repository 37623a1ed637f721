//! Maps: which there are, merged, and how they stand to each other.

use super::Gateway;
use super::graph::{Views, newest_components};
use crate::ask::{Asked, map_id};
use crate::error::{ApiError, Problem};
use crate::json::{Pose, Unreachable};
use crate::scene;
use axum::Json;
use axum::body::Bytes;
use axum::extract::State;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use coma_geometry::{MapId, SubmapId};
use coma_surfel::{MergeSettings, Part, merge};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use utoipa::{IntoParams, ToSchema};

/// All maps.
#[derive(Debug, Serialize, ToSchema)]
pub struct Maps {
    /// By id. One map means that all agents agree on one frame of reference.
    pub maps: Vec<Map>,
    /// Agents that have no part in this.
    pub unreachable: Vec<Unreachable>,
}

/// One map.
#[derive(Debug, Serialize, ToSchema)]
pub struct Map {
    /// Its name: `agent/epoch` of its gauge, and `/s7` behind it where a later part of a run is a map of its own.
    pub id: String,
    /// Agents with a submap in it.
    pub agents: BTreeSet<String>,
    /// Its submaps.
    pub submaps: usize,
    /// Its surfels, before merging.
    pub surfels: u64,
}

/// The maps that there are now.
#[utoipa::path(get, path = "/api/v1/maps", tag = "maps", security(("token" = [])),
    responses((status = 200, description = "The maps", body = Maps)))]
pub async fn maps(State(gateway): State<Arc<Gateway>>) -> Json<Maps> {
    let (submaps, unreachable) = scene::submaps(&gateway.directory).await;
    let mut maps: BTreeMap<MapId, Map> = BTreeMap::new();
    for submap in &submaps {
        let empty = || Map { id: submap.map.to_string(), agents: BTreeSet::new(), submaps: 0, surfels: 0 };
        let map = maps.entry(submap.map.clone()).or_insert_with(empty);
        map.agents.insert(submap.id.agent.to_string());
        map.submaps += 1;
        map.surfels = map.surfels.saturating_add(submap.surfels);
    }
    Json(Maps { maps: maps.into_values().collect(), unreachable })
}

/// Which map.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields, default)]
pub struct MapQuery {
    /// `agent/epoch`; by default the map with most surfels.
    pub map: Option<String>,
}

/// A map as one binary PLY in the layout of 3D Gaussian Splatting (third scale: 1 micrometre), for splat viewers.
/// Surfels of a submap that show what a submap before already shows are left out. The header `x-coma-map` names the
/// map, `x-coma-unreachable` counts agents that have no part in it.
#[utoipa::path(get, path = "/api/v1/map.ply", tag = "maps", params(MapQuery), security(("token" = [])),
    responses((status = 200, description = "The map", body = Vec<u8>, content_type = "application/octet-stream"),
              (status = 400, description = "A bad parameter", body = Problem),
              (status = 404, description = "No such map", body = Problem),
              (status = 413, description = "Too many surfels", body = Problem),
              (status = 502, description = "An agent does not answer", body = Problem),
              (status = 503, description = "Too much under work", body = Problem)))]
pub async fn ply(
    State(gateway): State<Arc<Gateway>>,
    Asked(query): Asked<MapQuery>,
) -> Result<Response, ApiError> {
    let map = query.map.map(|map| map_id("map", &map)).transpose()?;
    let scene = scene::scene(&gateway.directory, map).await?;
    let placed = scene::load(&gateway.directory, &gateway.cache, &scene, gateway.config.max_surfels).await?;
    let write = move || {
        let part = |(map_from_submap, surfels): &'_ scene::Placed| (*map_from_submap, surfels.clone());
        let parts: Vec<_> = placed.iter().map(part).collect();
        let parts: Vec<Part<'_>> =
            parts.iter().map(|(pose, surfels)| Part { surfels, map_from_submap: *pose }).collect();
        Ok(Bytes::from(coma_surfel::ply::to_bytes(&merge(&parts, &MergeSettings::default()))))
    };
    let file = gateway.heavy(write).await?;
    let headers = [
        (header::CONTENT_TYPE.as_str(), "application/octet-stream".to_owned()),
        (header::CONTENT_DISPOSITION.as_str(), "attachment; filename=\"map.ply\"".to_owned()),
        ("x-coma-map", scene.map.to_string()),
        ("x-coma-unreachable", scene.unreachable.len().to_string()),
    ];
    Ok((headers, file).into_response())
}

/// Which two maps.
#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
pub struct RelationQuery {
    /// A map, `agent/epoch`, that was served before.
    pub old: String,
    /// The map to go to.
    pub new: String,
}

/// How two maps stand to each other.
#[derive(Debug, Serialize, ToSchema)]
pub struct Relation {
    /// The map to come from.
    pub old: String,
    /// The map to go to.
    pub new: String,
    /// Takes points of the old map to the new one. Absent if nothing ties them together.
    pub new_map_from_old_map: Option<Pose>,
    /// Why it is absent.
    pub reason: Option<String>,
}

/// Takes what was drawn in an old map to a newer one, for any two maps that were served: as when two maps joined.
/// A map's frame is that of its gauge's first submap, so two maps are tied where both submaps lie in one component.
#[utoipa::path(get, path = "/api/v1/maps/relation", tag = "maps", params(RelationQuery), security(("token" = [])),
    responses((status = 200, description = "The relation, or why there is none", body = Relation),
              (status = 400, description = "A bad parameter", body = Problem)))]
pub async fn relation(
    State(gateway): State<Arc<Gateway>>,
    Asked(query): Asked<RelationQuery>,
) -> Result<Json<Relation>, ApiError> {
    let (old, new) = (map_id("old", &query.old)?, map_id("new", &query.new)?);
    let views = Views::ask(&gateway.directory).await;
    let related = relate(&newest_components(&views), &old, &new);
    let (pose, reason) = match related {
        Ok(pose) => (Some((&pose).into()), None),
        Err(reason) => (None, Some(reason)),
    };
    Ok(Json(Relation { old: old.to_string(), new: new.to_string(), new_map_from_old_map: pose, reason }))
}

/// `new_map_from_old_map`, or why there is none.
fn relate(
    components: &[BTreeMap<SubmapId, coma_geometry::Pose>],
    old: &MapId,
    new: &MapId,
) -> Result<coma_geometry::Pose, String> {
    if old == new {
        return Ok(coma_geometry::Pose::identity());
    }
    let both = components.iter().find_map(|poses| Some((poses.get(&old.gauge())?, poses.get(&new.gauge())?)));
    if let Some((map_from_old, map_from_new)) = both {
        return Ok(map_from_new.inv_mul(map_from_old));
    }
    for map in [old, new] {
        if !components.iter().any(|poses| poses.contains_key(&map.gauge())) {
            return Err(format!("no result of the graph has the first submap of {map}"));
        }
    }
    Err(format!("{old} and {new} are not joined: no accepted loops tie them together"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_geometry::{AgentId, Epoch, Tangent, se3};

    #[test]
    fn maps_of_one_component_are_related_by_their_first_submaps() {
        let first = |name: &str| SubmapId { agent: AgentId::new(name).unwrap(), epoch: Epoch(1), number: 0 };
        let map = |name: &str| MapId::of(&first(name));
        let map_from_b = se3::exp(&Tangent::new(1.0, 2.0, 3.0, 0.1, 0.2, 0.3));
        let map_from_c = se3::exp(&Tangent::new(-1.0, 0.5, 0.0, 0.4, 0.0, 0.3));
        let mut joined = BTreeMap::from([
            (first("a"), coma_geometry::Pose::identity()),
            (first("b"), map_from_b),
            (first("c"), map_from_c),
        ]);
        let alone = BTreeMap::from([(first("d"), coma_geometry::Pose::identity())]);
        // A part of d's run that lost contact with its beginning, and met b.
        let part = SubmapId { number: 7, ..first("d") };
        let map_from_part = se3::exp(&Tangent::new(0.0, 0.5, 2.0, 0.0, 0.3, 0.0));
        joined.insert(part.clone(), map_from_part);
        let components = [joined, alone];
        let near = |a: coma_geometry::Pose, b| se3::distance(&a, &b).0 < 1e-12;
        assert!(near(relate(&components, &map("b"), &map("a")).unwrap(), map_from_b));
        assert!(near(relate(&components, &map("b"), &map("c")).unwrap(), map_from_c.inv_mul(&map_from_b)));
        assert!(near(relate(&components, &MapId::of(&part), &map("a")).unwrap(), map_from_part));
        assert!(relate(&components, &map("d"), &map("a")).unwrap_err().contains("not joined"));
        assert!(relate(&components, &map("x"), &map("a")).unwrap_err().contains("x/1"));
        assert!(near(relate(&[], &map("x"), &map("x")).unwrap(), coma_geometry::Pose::identity()));
    }
}
