//! Closed submaps by id and revision, up to a number of bytes; the least recently used go first.

use bytes::Bytes;
use coma_geometry::SubmapId;
use coma_surfel::SurfelCloud;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

/// One submap's surfels, packed as the agent sent them, and unpacked when first asked for.
#[derive(Debug)]
pub struct CachedSurfels {
    /// Of the agent's answer.
    pub revision: u64,
    /// As [`coma_surfel::pack`] has them.
    pub packed: Bytes,
    unpacked: OnceLock<Arc<SurfelCloud>>,
}

impl CachedSurfels {
    /// Surfels as they came.
    pub fn new(revision: u64, packed: Bytes) -> Self {
        CachedSurfels { revision, packed, unpacked: OnceLock::new() }
    }

    /// The surfels; refused if the bytes are none or hold more than `max_surfels`.
    pub fn surfels(&self, max_surfels: usize) -> Result<Arc<SurfelCloud>, coma_surfel::pack::UnpackError> {
        if let Some(surfels) = self.unpacked.get() {
            return Ok(surfels.clone());
        }
        let surfels = Arc::new(coma_surfel::pack::unpack(&self.packed, max_surfels)?);
        Ok(self.unpacked.get_or_init(|| surfels).clone())
    }

    /// Bytes that it may come to take.
    fn weight(&self) -> usize {
        self.packed.len() + self.packed.len() / coma_surfel::pack::SURFEL_BYTES * SurfelCloud::SURFEL_BYTES
    }
}

#[derive(Default)]
struct State {
    clock: u64,
    bytes: usize,
    entries: HashMap<(SubmapId, u64), (u64, Arc<CachedSurfels>)>,
}

/// See the module.
pub struct SurfelCache {
    limit_bytes: usize,
    state: Mutex<State>,
}

impl SurfelCache {
    /// An empty one.
    pub fn new(limit_bytes: usize) -> Self {
        SurfelCache { limit_bytes, state: Mutex::new(State::default()) }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A closed submap, if it is here in that revision.
    pub fn get(&self, id: &SubmapId, revision: u64) -> Option<Arc<CachedSurfels>> {
        let mut state = self.state();
        state.clock += 1;
        let now = state.clock;
        let (used, surfels) = state.entries.get_mut(&(id.clone(), revision))?;
        *used = now;
        Some(surfels.clone())
    }

    /// Keeps a closed submap. One that is larger than the whole cache is not kept.
    pub fn put(&self, id: SubmapId, surfels: Arc<CachedSurfels>) {
        let weight = surfels.weight();
        if weight > self.limit_bytes {
            return;
        }
        let mut state = self.state();
        state.clock += 1;
        let now = state.clock;
        if let Some((_, before)) = state.entries.insert((id, surfels.revision), (now, surfels)) {
            state.bytes -= before.weight();
        }
        state.bytes += weight;
        while state.bytes > self.limit_bytes {
            let oldest = state.entries.iter().min_by_key(|(_, (used, _))| *used).map(|(key, _)| key.clone());
            let Some((_, gone)) = oldest.and_then(|key| state.entries.remove(&key)) else { return };
            state.bytes -= gone.weight();
        }
    }

    /// Bytes kept, counted as if all were unpacked.
    pub fn bytes(&self) -> usize {
        self.state().bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_geometry::{AgentId, Epoch};

    fn id(number: u32) -> SubmapId {
        SubmapId { agent: AgentId::new("a").unwrap(), epoch: Epoch(0), number }
    }

    fn surfels(revision: u64, bytes: usize) -> Arc<CachedSurfels> {
        Arc::new(CachedSurfels::new(revision, Bytes::from(vec![0; bytes])))
    }

    #[test]
    fn the_least_recently_used_go_first_and_the_limit_holds() {
        let weight = surfels(0, 1000).weight();
        let cache = SurfelCache::new(3 * weight);
        for number in 0..3 {
            cache.put(id(number), surfels(1, 1000));
        }
        assert!(cache.get(&id(0), 1).is_some());
        cache.put(id(3), surfels(1, 1000));
        assert_eq!(cache.bytes(), 3 * weight);
        assert!(cache.get(&id(1), 1).is_none(), "it was used longest ago");
        assert!(cache.get(&id(0), 1).is_some() && cache.get(&id(3), 1).is_some());
        assert!(cache.get(&id(0), 2).is_none(), "another revision is another entry");
        cache.put(id(4), surfels(1, 100_000));
        assert!(cache.get(&id(4), 1).is_none(), "larger than everything");
        cache.put(id(0), surfels(1, 1000));
        assert_eq!(cache.bytes(), 3 * weight, "put again, counted once");
    }
}
