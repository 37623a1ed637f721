//! The anchors of every caller, in bounded numbers.

use coma_geometry::{AgentId, SubmapId};
use coma_place::{Candidate, Candidates, Descriptor, Settings, Space, Thresholds};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, PoisonError, RwLock};
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

struct Kept {
    index: Arc<RwLock<PlaceIndex>>,
    last_used: u64,
}

/// The indices of all callers, by name; the least recently used one makes room for a new one.
pub struct Indices {
    settings: Settings,
    thresholds: BTreeMap<Space, Thresholds>,
    max_indices: usize,
    max_anchors: usize,
    kept: Mutex<(BTreeMap<String, Kept>, u64)>,
}

impl Indices {
    /// None yet.
    pub fn new(
        settings: Settings,
        thresholds: BTreeMap<Space, Thresholds>,
        max_indices: usize,
        max_anchors: usize,
    ) -> Self {
        Indices { settings, thresholds, max_indices, max_anchors, kept: Mutex::default() }
    }

    /// An index that is here.
    pub fn get(&self, name: &str) -> Option<Arc<RwLock<PlaceIndex>>> {
        let mut guard = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        let (kept, clock) = &mut *guard;
        *clock += 1;
        let found = kept.get_mut(name)?;
        found.last_used = *clock;
        Some(found.index.clone())
    }

    /// An index, made where it is not here.
    pub fn get_or_make(&self, name: &str) -> Arc<RwLock<PlaceIndex>> {
        if let Some(found) = self.get(name) {
            return found;
        }
        let mut guard = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        let (kept, clock) = &mut *guard;
        if kept.len() >= self.max_indices
            && !kept.contains_key(name)
            && let Some(oldest) = kept.iter().min_by_key(|(_, k)| k.last_used).map(|(name, _)| name.clone())
        {
            warn!(
                dropped = oldest,
                max_indices = self.max_indices,
                "the least recently used index made room"
            );
            kept.remove(&oldest);
        }
        *clock += 1;
        let last_used = *clock;
        let made = || PlaceIndex {
            candidates: Candidates::new(self.settings, self.thresholds.clone()),
            comparable: self.thresholds.keys().cloned().collect(),
            spaces: BTreeMap::new(),
            max_anchors: self.max_anchors,
        };
        let entry = kept.entry(name.to_owned());
        entry.or_insert_with(|| Kept { index: Arc::new(RwLock::new(made())), last_used }).index.clone()
    }

    /// Anchors over all indices.
    pub fn anchors(&self) -> usize {
        let guard = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        guard.0.values().map(|k| k.index.read().unwrap_or_else(PoisonError::into_inner).len()).sum()
    }
}
