//! Approximate search for large sets, by a graph of neighbours (HNSW, through usearch).

use crate::descriptor::{Descriptor, MAX_DIMENSION, Space, dot};
use crate::index::{Hit, Index};
use crate::saved::{self, Reader, SavedError};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::collections::BTreeMap;
use usearch::{IndexOptions, MetricKind, ScalarKind};

/// Links of a node. Real descriptors come in walks, tight groups far from one another: with fewer links the groups
/// fall apart. Here and below calibrated by `coma bench index`, 200,000 descriptors of 384 values.
const LINKS: usize = 16;
/// Nodes that are looked at when one is added.
const ADDING: usize = 256;
/// Nodes that are looked at by a query.
const SEARCHING: usize = 512;
/// Room that is made at once, descriptors.
const ROOM: usize = 4096;

/// Approximate search: a query looks at a small part of the descriptors, and may miss some of the nearest. The laws
/// of [`Index`] hold but for two: hits are the nearest of those that were found, and the order of insertion decides
/// which these are. The same insertions in the same order give the same answers.
pub struct LargeIndex<K> {
    blocks: BTreeMap<(Space, usize), Block<K>>,
}

// Derived, it would ask keys for a default too.
impl<K> Default for LargeIndex<K> {
    fn default() -> Self {
        LargeIndex { blocks: BTreeMap::new() }
    }
}

/// All descriptors of one space and dimension.
struct Block<K> {
    graph: usearch::Index,
    keys: Vec<K>,
    slots: BTreeMap<K, usize>,
}

fn empty_graph(dimension: usize) -> usearch::Index {
    let options = IndexOptions {
        dimensions: dimension,
        metric: MetricKind::Cos,
        quantization: ScalarKind::I8,
        connectivity: LINKS,
        expansion_add: ADDING,
        expansion_search: SEARCHING,
        multi: false,
    };
    usearch::Index::new(&options).expect("a graph of these options can be made")
}

impl<K: Ord + Clone + Send + Sync> Index<K> for LargeIndex<K> {
    fn insert(&mut self, key: K, descriptor: &Descriptor) {
        let dimension = descriptor.values().len();
        let block = self.blocks.entry((descriptor.space().clone(), dimension)).or_insert_with(|| Block {
            graph: empty_graph(dimension),
            keys: Vec::new(),
            slots: BTreeMap::new(),
        });
        let slot = match block.slots.get(&key) {
            Some(&slot) => {
                block.graph.remove(slot as u64).expect("a known slot can be emptied");
                slot
            }
            None => {
                block.slots.insert(key.clone(), block.keys.len());
                block.keys.push(key);
                block.keys.len() - 1
            }
        };
        if block.graph.size() >= block.graph.capacity() {
            block.graph.reserve(block.graph.capacity() + ROOM).expect("memory for more descriptors");
        }
        block.graph.add(slot as u64, descriptor.values()).expect("a descriptor of the graph's dimension");
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
        if count == 0 {
            return Vec::new();
        }
        let admitted = |slot: u64| block.keys.get(slot as usize).is_some_and(admit);
        let found = block.graph.filtered_search(query, count, admitted);
        let slots = found.expect("a query of the graph's dimension").keys;
        let mut values = vec![0i8; query.len()];
        let mut hits: Vec<Hit<K>> = Vec::with_capacity(slots.len());
        for slot in slots {
            // Exactly as the exact index has it: the graph's own distance is rounded its own way.
            block.graph.get(slot, &mut values).expect("a slot that was found");
            let other = 1.0 / (dot(&values, &values) as f32).sqrt();
            let cosine = dot(query, &values) as f32 * descriptor.inverse_norm() * other;
            let key = block.keys[slot as usize].clone();
            hits.push(Hit { key, similarity: cosine.clamp(-1.0, 1.0) });
        }
        hits.sort_by(|a, b| b.similarity.total_cmp(&a.similarity).then_with(|| a.key.cmp(&b.key)));
        hits
    }

    fn len(&self) -> usize {
        self.blocks.values().map(|block| block.keys.len()).sum()
    }
}

impl<K: Ord + Clone + Serialize + DeserializeOwned> LargeIndex<K> {
    /// The index as bytes, its graphs included: loading builds nothing.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut heads = Vec::new();
        let mut body = Vec::new();
        for ((space, dimension), block) in &self.blocks {
            let mut graph = vec![0u8; block.graph.serialized_length()];
            block.graph.save_to_buffer(&mut graph).expect("a buffer of the graph's own length");
            let (space, dimension, keys) = (space.clone(), *dimension, block.keys.clone());
            heads.push(saved::Head { space, dimension, keys, bytes: graph.len() });
            body.extend(graph);
        }
        saved::write(saved::LARGE, &heads, &body)
    }

    /// The index that [`LargeIndex::to_bytes`] wrote. For files of one's own: damage is found, malice is not.
    ///
    /// # Errors
    /// Bytes that are damaged or of something else.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, SavedError> {
        let mut reader = Reader::new(saved::LARGE, bytes)?;
        let mut blocks = BTreeMap::new();
        for head in reader.heads::<K>()? {
            let saved::Head { space, dimension, keys, bytes } = head;
            if !(1..=MAX_DIMENSION).contains(&dimension) {
                return Err(SavedError::Field("dimension"));
            }
            let graph = empty_graph(dimension);
            graph.load_from_buffer(reader.take(bytes)?).map_err(|_| SavedError::Field("graph"))?;
            if graph.dimensions() != dimension || graph.size() != keys.len() {
                return Err(SavedError::Field("keys"));
            }
            graph.change_expansion_add(ADDING);
            graph.change_expansion_search(SEARCHING);
            let slots = keys.iter().cloned().enumerate().map(|(slot, key)| (key, slot)).collect();
            blocks.insert((space, dimension), Block { graph, keys, slots });
        }
        Ok(LargeIndex { blocks })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::index::{ExactIndex, tests::descriptor};

    #[test]
    fn most_of_the_nearest_are_found_with_the_exact_index_s_similarities() {
        let (mut exact, mut large) = (ExactIndex::default(), LargeIndex::default());
        for key in 0..5000u32 {
            exact.insert(key, &descriptor("a", key));
            large.insert(key, &descriptor("a", key));
        }
        assert_eq!(large.len(), 5000);
        let (mut found, mut wanted) = (0, 0);
        for query in (0..5000).step_by(50) {
            let query = descriptor("a", query);
            let truth = exact.query(&query, 10, &|_| true);
            let hits = large.query(&query, 10, &|_| true);
            assert!((hits[0].similarity - 1.0).abs() < 1e-6);
            found += truth.iter().filter(|hit| hits.contains(hit)).count();
            wanted += truth.len();
        }
        assert!(found * 100 >= wanted * 95, "{found} of {wanted}");
    }

    #[test]
    fn only_admitted_keys_of_the_same_space_answer_and_inserting_again_replaces() {
        let mut index = LargeIndex::default();
        for key in 0..40u32 {
            index.insert(key, &descriptor(if key % 2 == 0 { "a" } else { "b" }, key));
        }
        let hits = index.query(&descriptor("a", 4), 100, &|key| *key != 4);
        assert!(hits.len() == 19 && hits.iter().all(|hit| hit.key % 2 == 0 && hit.key != 4));
        assert!(index.query(&descriptor("c", 4), 100, &|_| true).is_empty());
        assert!(index.query(&descriptor("a", 4), 0, &|_| true).is_empty());
        index.insert(4, &descriptor("a", 99));
        assert_eq!(index.len(), 40);
        let best = index.query(&descriptor("a", 99), 1, &|_| true).remove(0);
        assert!(best.key == 4 && (best.similarity - 1.0).abs() < 1e-6);
    }

    #[test]
    fn a_saved_index_answers_as_before_and_damage_is_found() {
        let mut index = LargeIndex::default();
        (0..300u32).for_each(|key| index.insert(key, &descriptor("a", key)));
        let bytes = index.to_bytes();
        let mut back = LargeIndex::<u32>::from_bytes(&bytes).unwrap();
        let ask = |index: &LargeIndex<u32>| index.query(&descriptor("a", 7), 10, &|_| true);
        assert_eq!(ask(&back), ask(&index));
        back.insert(300, &descriptor("a", 300));
        assert_eq!(back.query(&descriptor("a", 300), 1, &|_| true)[0].key, 300);
        for damaged in saved::tests::damaged(&bytes) {
            assert!(LargeIndex::<u32>::from_bytes(&damaged).is_err());
        }
    }
}
