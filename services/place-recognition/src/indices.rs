//! The anchors of every caller, in bounded numbers.

use coma_geometry::{AgentId, SubmapId};
use coma_place::{Candidate, Candidates, Descriptor, Settings, Space, Thresholds};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, RwLock};
use tracing::warn;

/// An anchor as it came.
pub struct Anchor {
    /// Whose.
    pub submap: SubmapId,
    /// Position of its frame in its agent's stream.
    pub frame: u64,
    /// One per space, at least one.
    pub descriptors: Vec<Descriptor>,
}

/// One caller's anchors.
pub struct PlaceIndex {
    candidates: Candidates,
    /// Spaces in which this service compares.
    comparable: BTreeSet<Space>,
    /// By agent: the spaces of its descriptors.
    spaces: BTreeMap<AgentId, BTreeSet<Space>>,
    max_anchors: usize,
}

/// An index that would hold more anchors than it may.
#[derive(Debug, PartialEq, Eq)]
pub struct Full {
    /// Anchors in the index.
    pub held: usize,
    /// New ones in the call.
    pub new: usize,
}

impl PlaceIndex {
    /// Adds anchors, all or none; those that are known are left as they are. Gives the number held.
    pub fn insert(&mut self, anchors: Vec<Anchor>) -> Result<usize, Full> {
        let held = self.candidates.len();
        let new: BTreeSet<&SubmapId> =
            anchors.iter().map(|a| &a.submap).filter(|id| !self.candidates.contains(id)).collect();
        if held + new.len() > self.max_anchors {
            return Err(Full { held, new: new.len() });
        }
        for Anchor { submap, frame, descriptors } in anchors {
            if self.candidates.contains(&submap) {
                continue;
            }
            let spaces = self.spaces.entry(submap.agent.clone()).or_default();
            for descriptor in descriptors {
                spaces.insert(descriptor.space().clone());
                self.candidates.insert(submap.clone(), frame, descriptor);
            }
        }
        Ok(self.candidates.len())
    }

    /// Anchors held.
    pub fn len(&self) -> usize {
        self.candidates.len()
    }

    /// An anchor's candidates, best first, at most `limit`, and the agents with whom its own shares no
    /// space in which this service compares. `None` for an unknown anchor.
    pub fn query(&self, submap: &SubmapId, limit: usize) -> Option<(Vec<Candidate>, Vec<AgentId>)> {
        if !self.candidates.contains(submap) {
            return None;
        }
        let own: BTreeSet<&Space> =
            self.candidates.spaces(submap).filter(|space| self.comparable.contains(space)).collect();
        let apart = |(agent, spaces): (&AgentId, &BTreeSet<Space>)| {
            let shared = *agent == submap.agent || spaces.iter().any(|space| own.contains(space));
            (!shared).then(|| agent.clone())
        };
        let strangers = self.spaces.iter().filter_map(apart).collect();
        let mut candidates = self.candidates.of(submap);
        candidates.truncate(limit);
        Some((candidates, strangers))
    }
}

#[derive(Default)]
struct Shelf {
    /// By name: when an index was last used, and the index.
    indices: BTreeMap<String, (u64, Arc<RwLock<PlaceIndex>>)>,
    /// Counts uses.
    clock: u64,
}

/// The indices of all callers, by name; the least recently used one makes room for a new one.
pub struct Indices {
    settings: Settings,
    thresholds: BTreeMap<Space, Thresholds>,
    max_indices: usize,
    max_anchors: usize,
    shelf: Mutex<Shelf>,
}

impl Indices {
    /// None yet.
    pub fn new(
        settings: Settings,
        thresholds: BTreeMap<Space, Thresholds>,
        max_indices: usize,
        max_anchors: usize,
    ) -> Self {
        Indices { settings, thresholds, max_indices, max_anchors, shelf: Mutex::default() }
    }

    fn lock(&self) -> MutexGuard<'_, Shelf> {
        self.shelf.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// An index that is here.
    pub fn get(&self, name: &str) -> Option<Arc<RwLock<PlaceIndex>>> {
        let Shelf { indices, clock } = &mut *self.lock();
        *clock += 1;
        let (last_used, index) = indices.get_mut(name)?;
        *last_used = *clock;
        Some(index.clone())
    }

    /// An index, made where it is not here.
    pub fn get_or_make(&self, name: &str) -> Arc<RwLock<PlaceIndex>> {
        let Shelf { indices, clock } = &mut *self.lock();
        *clock += 1;
        if let Some((last_used, index)) = indices.get_mut(name) {
            *last_used = *clock;
            return index.clone();
        }
        if indices.len() >= self.max_indices
            && let Some(oldest) =
                indices.iter().min_by_key(|(_, (used, _))| *used).map(|(name, _)| name.clone())
        {
            warn!(
                dropped = oldest,
                max_indices = self.max_indices,
                "the least recently used index made room"
            );
            indices.remove(&oldest);
        }
        let index = Arc::new(RwLock::new(PlaceIndex {
            candidates: Candidates::new(self.settings, self.thresholds.clone()),
            comparable: self.thresholds.keys().cloned().collect(),
            spaces: BTreeMap::new(),
            max_anchors: self.max_anchors,
        }));
        indices.insert(name.to_owned(), (*clock, index.clone()));
        index
    }

    /// Anchors over all indices.
    pub fn anchors(&self) -> usize {
        let indices: Vec<_> = self.lock().indices.values().map(|(_, index)| index.clone()).collect();
        indices.iter().map(|index| index.read().unwrap_or_else(PoisonError::into_inner).len()).sum()
    }
}
