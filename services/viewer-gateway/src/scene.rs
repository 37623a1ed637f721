//! What a map is made of: which submaps, where, and their surfels.

use crate::agents::{Directory, Link, PlacedSubmap, failed};
use crate::cache::{CachedSurfels, SurfelCache};
use crate::error::ApiError;
use crate::json::Unreachable;
use coma_geometry::{MapId, Pose};
use coma_surfel::SurfelCloud;
use futures::{StreamExt, TryStreamExt, stream};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Submaps that are fetched at the same time.
const AT_ONCE: usize = 4;

/// A map's submaps, and who has no part in it.
pub struct Scene {
    /// Which map.
    pub map: MapId,
    /// Sorted by id.
    pub submaps: Vec<PlacedSubmap>,
    /// Agents that did not answer.
    pub unreachable: Vec<Unreachable>,
}

/// Every submap of every agent that answers, sorted by id.
pub async fn submaps(directory: &Directory) -> (Vec<PlacedSubmap>, Vec<Unreachable>) {
    let whole = directory.ask(async |link: Arc<Link>| link.submaps().await).await;
    let mut submaps: Vec<PlacedSubmap> = whole.answers.into_iter().flat_map(|(_, submaps)| submaps).collect();
    submaps.sort_by(|a, b| a.id.cmp(&b.id));
    submaps.dedup_by(|a, b| a.id == b.id);
    (submaps, whole.unreachable)
}

/// The submaps of one map; without a name, of the map with most surfels.
pub async fn scene(directory: &Directory, map: Option<MapId>) -> Result<Scene, ApiError> {
    let (mut submaps, unreachable) = submaps(directory).await;
    let nothing = || {
        let why = unreachable.iter().map(|u| format!("{}: {}", u.endpoint, u.error)).collect::<Vec<_>>();
        let why = if why.is_empty() { "no agent has mapped anything yet".into() } else { why.join("; ") };
        ApiError::not_found("map", format!("there is no map: {why}"))
    };
    let map = match map {
        Some(map) => map,
        None => largest(&submaps).ok_or_else(nothing)?,
    };
    submaps.retain(|submap| submap.map == map);
    if submaps.is_empty() {
        return Err(ApiError::not_found("map", format!("no agent has a submap in map {map}")));
    }
    Ok(Scene { map, submaps, unreachable })
}

fn largest(submaps: &[PlacedSubmap]) -> Option<MapId> {
    let mut surfels: BTreeMap<&MapId, u64> = BTreeMap::new();
    for submap in submaps {
        let sum = surfels.entry(&submap.map).or_default();
        *sum = sum.saturating_add(submap.surfels);
    }
    // The last of equals by `max_by`; the first is wanted.
    surfels.into_iter().rev().max_by_key(|(_, surfels)| *surfels).map(|(map, _)| map.clone())
}

/// One submap's surfels, from the cache or from the agent that has it. Only closed ones are kept.
pub async fn fetch(
    directory: &Directory,
    cache: &SurfelCache,
    submap: &PlacedSubmap,
    max_surfels: usize,
) -> Result<Arc<CachedSurfels>, ApiError> {
    if submap.closed
        && let Some(surfels) = cache.get(&submap.id, submap.revision)
    {
        return Ok(surfels);
    }
    let agent = &submap.id.agent;
    let link = directory.agent("agent", agent)?;
    let surfels = link.packed_surfels(&submap.id, max_surfels).await.map_err(|e| failed(agent, &e))?;
    let surfels = Arc::new(surfels);
    if submap.closed && surfels.revision == submap.revision {
        cache.put(submap.id.clone(), surfels.clone());
    }
    Ok(surfels)
}

/// Surfels and where they lie.
pub type Placed = (Pose, Arc<SurfelCloud>);

/// The surfels of a whole scene, in its order. A submap that has nothing to show yet is left out.
pub async fn load(
    directory: &Directory,
    cache: &SurfelCache,
    scene: &Scene,
    max_surfels: usize,
) -> Result<Vec<Placed>, ApiError> {
    let surfels = scene.submaps.iter().fold(0u64, |sum, submap| sum.saturating_add(submap.surfels));
    if surfels > max_surfels as u64 {
        let map = scene.map.to_string();
        let message =
            format!("map {map} has {surfels} surfels, at most {max_surfels} (max_surfels) are taken");
        return Err(ApiError::too_large("map", message));
    }
    let with_surfels: Vec<PlacedSubmap> = scene.submaps.iter().filter(|s| s.surfels > 0).cloned().collect();
    let fetched: Vec<(Pose, Arc<CachedSurfels>)> = stream::iter(with_surfels)
        .map(|submap: PlacedSubmap| async move {
            Ok::<_, ApiError>((submap.map_from_submap, fetch(directory, cache, &submap, max_surfels).await?))
        })
        .buffered(AT_ONCE)
        .try_collect()
        .await?;
    let unpack = move || {
        let surfels = fetched.into_iter().map(|(map_from_submap, cached)| {
            let surfels = cached.surfels(max_surfels);
            surfels
                .map(|surfels| (map_from_submap, surfels))
                .map_err(|e| ApiError::agent(format!("surfels: {e}")))
        });
        surfels.collect()
    };
    tokio::task::spawn_blocking(unpack).await.map_err(|e| ApiError::internal(e.to_string()))?
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_geometry::{AgentId, Epoch, SubmapId};

    #[test]
    fn the_map_with_most_surfels_is_taken_and_of_equals_the_first() {
        let submap = |agent: &str, map: &str, surfels| PlacedSubmap {
            id: SubmapId { agent: AgentId::new(agent).unwrap(), epoch: Epoch(0), number: 0 },
            surfels,
            closed: true,
            revision: 1,
            agent_from_submap: Pose::identity(),
            map_from_submap: Pose::identity(),
            map: MapId { agent: AgentId::new(map).unwrap(), epoch: Epoch(0), first_submap: 0 },
        };
        let name = |submaps: &[PlacedSubmap]| largest(submaps).map(|map| map.to_string());
        assert_eq!(name(&[]), None);
        assert_eq!(name(&[submap("a", "a", 5), submap("b", "b", 5)]).as_deref(), Some("a/0"));
        let three = [submap("a", "a", 5), submap("b", "b", 3), submap("c", "b", 3)];
        assert_eq!(name(&three).as_deref(), Some("b/0"));
    }
}
