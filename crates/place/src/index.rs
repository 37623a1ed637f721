//! The most similar descriptors.

use crate::descriptor::{Descriptor, MAX_DIMENSION, Space, dot};
use crate::saved::{self, Reader, SavedError};
use rayon::prelude::*;
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::collections::BTreeMap;

/// One answer of an index.
#[derive(Clone, Debug, PartialEq)]
pub struct Hit<K> {
    /// Whose descriptor.
    pub key: K,
    /// Cosine similarity to the query.
    pub similarity: f32,
}

/// Finds similar descriptors.
///
/// Laws: `query` returns only descriptors of the query's space and dimension whose key is admitted, at most
/// `count`, by falling similarity, equal ones by key; the order of insertion does not matter; inserting
/// under a key again replaces the descriptor of that space.
pub trait Index<K: Ord + Clone> {
    /// Adds or replaces.
    fn insert(&mut self, key: K, descriptor: &Descriptor);
    /// The nearest ones.
    fn query(
        &self,
        descriptor: &Descriptor,
        count: usize,
        admit: &(dyn Fn(&K) -> bool + Sync),
    ) -> Vec<Hit<K>>;
    /// Number of descriptors, over all spaces.
    fn len(&self) -> usize;
    /// True without descriptors.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// Exact search: compares with every descriptor; milliseconds at 10^4.
#[derive(Clone, Debug)]
pub struct ExactIndex<K> {
    blocks: BTreeMap<(Space, usize), Block<K>>,
}

/// All descriptors of one space and dimension.
#[derive(Clone, Debug)]
struct Block<K> {
    keys: Vec<K>,
    inverse_norms: Vec<f32>,
    /// `[keys, dimension]`
    values: Vec<i8>,
    slots: BTreeMap<K, usize>,
}

impl<K> Default for ExactIndex<K> {
    fn default() -> Self {
        ExactIndex { blocks: BTreeMap::new() }
    }
}

/// Below this many descriptors one thread is faster.
const PARALLEL_FROM: usize = 4096;

impl<K: Ord + Clone + Send + Sync> Index<K> for ExactIndex<K> {
    fn insert(&mut self, key: K, descriptor: &Descriptor) {
        let dimension = descriptor.values().len();
        let block = self.blocks.entry((descriptor.space().clone(), dimension)).or_insert_with(|| Block {
            keys: Vec::new(),
            inverse_norms: Vec::new(),
            values: Vec::new(),
            slots: BTreeMap::new(),
        });
        if let Some(&slot) = block.slots.get(&key) {
            block.values[slot * dimension..(slot + 1) * dimension].copy_from_slice(descriptor.values());
            block.inverse_norms[slot] = descriptor.inverse_norm();
            return;
        }
        block.slots.insert(key.clone(), block.keys.len());
        block.keys.push(key);
        block.values.extend_from_slice(descriptor.values());
        block.inverse_norms.push(descriptor.inverse_norm());
    }

    fn query(
        &self,
        descriptor: &Descriptor,
        count: usize,
        admit: &(dyn Fn(&K) -> bool + Sync),
    ) -> Vec<Hit<K>> {
        let query = descriptor.values();
        let Some(block) = self.blocks.get(&(descriptor.space().clone(), query.len())) else {
            return Vec::new();
        };
        let inverse_norm = descriptor.inverse_norm();
        let score = |slot: usize| {
            let values = &block.values[slot * query.len()..(slot + 1) * query.len()];
            let cosine = dot(query, values) as f32 * inverse_norm * block.inverse_norms[slot];
            (cosine.clamp(-1.0, 1.0), slot)
        };
        let admitted = |slot: &usize| admit(&block.keys[*slot]);
        let n = block.keys.len();
        let mut scored: Vec<(f32, usize)> = if n >= PARALLEL_FROM {
            (0..n).into_par_iter().filter(admitted).map(score).collect()
        } else {
            (0..n).filter(admitted).map(score).collect()
        };
        let order = |a: &(f32, usize), b: &(f32, usize)| {
            b.0.total_cmp(&a.0).then_with(|| block.keys[a.1].cmp(&block.keys[b.1]))
        };
        if count < scored.len() && count > 0 {
            scored.select_nth_unstable_by(count - 1, order);
        }
        scored.truncate(count);
        scored.sort_unstable_by(order);
        scored
            .into_iter()
            .map(|(similarity, slot)| Hit { key: block.keys[slot].clone(), similarity })
            .collect()
    }

    fn len(&self) -> usize {
        self.blocks.values().map(|b| b.keys.len()).sum()
    }
}

impl<K: Ord + Clone + Serialize + DeserializeOwned + Send + Sync> ExactIndex<K> {
    /// The index as bytes.
    pub fn to_bytes(&self) -> Vec<u8> {
        let head = |((space, dimension), block): (&(Space, usize), &Block<K>)| saved::Head {
            space: space.clone(),
            dimension: *dimension,
            keys: block.keys.clone(),
            bytes: block.values.len(),
        };
        let heads: Vec<_> = self.blocks.iter().map(head).collect();
        let values = self.blocks.values().flat_map(|block| block.values.iter().map(|v| *v as u8));
        saved::write(saved::EXACT, &heads, &values.collect::<Vec<u8>>())
    }

    /// The index that [`ExactIndex::to_bytes`] wrote.
    ///
    /// # Errors
    /// Bytes that are damaged or of something else.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, SavedError> {
        let mut reader = Reader::new(saved::EXACT, bytes)?;
        let mut index = ExactIndex::default();
        for saved::Head { space, dimension, keys, bytes } in reader.heads::<K>()? {
            if !(1..=MAX_DIMENSION).contains(&dimension) {
                return Err(SavedError::Field("dimension"));
            }
            let values = reader.take(bytes)?;
            if Some(bytes) != keys.len().checked_mul(dimension) {
                return Err(SavedError::Field("keys"));
            }
            for (key, values) in keys.into_iter().zip(values.chunks_exact(dimension)) {
                let values = values.iter().map(|v| *v as i8).collect();
                let descriptor = Descriptor::new(space.clone(), 1.0, values);
                index.insert(key, &descriptor.map_err(|_| SavedError::Field("values"))?);
            }
        }
        Ok(index)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::descriptor::similarity;

    pub(crate) fn descriptor(space: &str, seed: u32) -> Descriptor {
        let mut state = seed.wrapping_mul(2_654_435_761).wrapping_add(1);
        let values: Vec<f32> = (0..64)
            .map(|_| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 8) as f32 / (1 << 24) as f32 - 0.5
            })
            .collect();
        Descriptor::from_f32(Space::new(space).unwrap(), &values).unwrap()
    }

    #[test]
    fn the_nearest_come_first_whatever_the_order_of_insertion() {
        let all: Vec<(u32, Descriptor)> = (0..6000).map(|i| (i, descriptor("a", i % 5000))).collect();
        let (mut forth, mut back) = (ExactIndex::default(), ExactIndex::default());
        all.iter().for_each(|(k, d)| forth.insert(*k, d));
        all.iter().rev().for_each(|(k, d)| back.insert(*k, d));
        let query = descriptor("a", 17);
        let hits = forth.query(&query, 10, &|_| true);
        assert_eq!(hits, back.query(&query, 10, &|_| true));
        // 17 and 5017 are equal; the smaller key comes first.
        assert_eq!(hits[0].key, 17);
        assert_eq!(hits[1].key, 5017);
        let mut plain: Vec<(f32, u32)> =
            all.iter().map(|(k, d)| (similarity(&query, d).unwrap(), *k)).collect();
        plain.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        for (hit, (s, k)) in hits.iter().zip(&plain) {
            assert_eq!(hit.key, *k);
            assert!((hit.similarity - s).abs() < 1e-6);
        }
    }

    #[test]
    fn only_admitted_keys_of_the_same_space_answer() {
        let mut index = ExactIndex::default();
        for k in 0..20u32 {
            index.insert(k, &descriptor(if k % 2 == 0 { "a" } else { "b" }, k));
        }
        let hits = index.query(&descriptor("a", 4), 100, &|k| *k != 4);
        assert_eq!(hits.len(), 9);
        assert!(hits.iter().all(|h| h.key % 2 == 0 && h.key != 4));
        assert!(index.query(&descriptor("c", 4), 100, &|_| true).is_empty());
        assert!(index.query(&descriptor("a", 4), 0, &|_| true).is_empty());
    }

    #[test]
    fn inserting_again_replaces() {
        let mut index = ExactIndex::default();
        index.insert(1u32, &descriptor("a", 1));
        index.insert(1u32, &descriptor("a", 2));
        assert_eq!(index.len(), 1);
        assert!((index.query(&descriptor("a", 2), 1, &|_| true)[0].similarity - 1.0).abs() < 1e-6);
    }

    #[test]
    fn a_saved_index_answers_as_before_and_damage_is_found() {
        let mut index = ExactIndex::default();
        for key in 0..200u32 {
            index.insert(key, &descriptor(if key % 3 == 0 { "a" } else { "b" }, key));
        }
        let bytes = index.to_bytes();
        let back = ExactIndex::<u32>::from_bytes(&bytes).unwrap();
        assert_eq!(back.len(), 200);
        for space in ["a", "b"] {
            let ask = |index: &ExactIndex<u32>| index.query(&descriptor(space, 7), 20, &|k| k % 2 == 0);
            assert_eq!(ask(&back), ask(&index));
        }
        for damaged in saved::tests::damaged(&bytes) {
            assert!(ExactIndex::<u32>::from_bytes(&damaged).is_err());
        }
    }
}
