//! Chains: the longest stretches of submaps that odometry connects. An agent that never lost its tracking has
//! one. Chains are what loops join into components.

use crate::graph::{Cut, Edge, EdgeKey, UsableGraph, within};
use crate::uncertain::UncertainPose;
use coma_geometry::{Matrix6, Pose, SubmapId, se3};
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// A stretch of submaps connected by odometry; named by its first submap.
#[derive(Clone, Debug, PartialEq)]
pub struct Chain {
    /// The smallest id: the chain's frame of reference.
    pub first: SubmapId,
    /// All of its submaps.
    pub submaps: BTreeSet<SubmapId>,
    /// Its odometry by key.
    pub odometry: Vec<Edge>,
    /// The odometry that is solved for: what lies within the cut. The rest is appended by composition.
    pub solved_odometry: Vec<Edge>,
}

/// The submaps reached from `start` over `edges`.
fn reached<'a>(start: &'a SubmapId, edges: &'a [Edge]) -> BTreeSet<&'a SubmapId> {
    let neighbours = neighbours(edges);
    let mut seen = BTreeSet::from([start]);
    let mut open = vec![start];
    while let Some(submap) = open.pop() {
        for edge in neighbours.get(submap).into_iter().flatten() {
            let next = if &edge.from == submap { &edge.to } else { &edge.from };
            if seen.insert(next) {
                open.push(next);
            }
        }
    }
    seen
}

fn neighbours<'a>(edges: impl IntoIterator<Item = &'a Edge>) -> BTreeMap<&'a SubmapId, Vec<&'a Edge>> {
    let mut out: BTreeMap<&SubmapId, Vec<&Edge>> = BTreeMap::new();
    for edge in edges {
        out.entry(&edge.from).or_default().push(edge);
        out.entry(&edge.to).or_default().push(edge);
    }
    out
}

/// Splits a graph's submaps into chains, in the order of their first submaps.
pub fn chains(graph: &UsableGraph) -> Vec<Chain> {
    let mut chains = Vec::new();
    let mut taken: BTreeSet<SubmapId> = BTreeSet::new();
    let mut chain_of: BTreeMap<SubmapId, usize> = BTreeMap::new();
    let adjacent = neighbours(&graph.odometry);
    for first in graph.nodes.keys() {
        if taken.contains(first) {
            continue;
        }
        let mut submaps = BTreeSet::from([first.clone()]);
        let mut open = vec![first.clone()];
        while let Some(submap) = open.pop() {
            for edge in adjacent.get(&submap).into_iter().flatten() {
                for next in [&edge.from, &edge.to] {
                    if submaps.insert(next.clone()) {
                        open.push(next.clone());
                    }
                }
            }
        }
        taken.extend(submaps.iter().cloned());
        chain_of.extend(submaps.iter().map(|s| (s.clone(), chains.len())));
        chains.push(Chain {
            first: first.clone(),
            submaps,
            odometry: Vec::new(),
            solved_odometry: Vec::new(),
        });
    }
    for edge in &graph.odometry {
        if let Some(&chain) = chain_of.get(&edge.from) {
            chains[chain].odometry.push(edge.clone());
        }
    }
    let mut ends: BTreeMap<usize, BTreeSet<&SubmapId>> = BTreeMap::new();
    for end in graph.loops.iter().flat_map(|e| [&e.from, &e.to]) {
        if let Some(&chain) = chain_of.get(end) {
            ends.entry(chain).or_default().insert(end);
        }
    }
    for (index, ends) in ends {
        chains[index].solved_odometry = solved_part(&chains[index], &ends, &graph.cut);
    }
    chains
}

/// The odometry within the cut; all of it where that does not connect the loops' ends with the first submap
/// (logs that were not written in order).
fn solved_part(chain: &Chain, loop_ends: &BTreeSet<&SubmapId>, cut: &Cut) -> Vec<Edge> {
    let inside: Vec<Edge> = chain.odometry.iter().filter(|e| within(cut, &e.key)).cloned().collect();
    let from_first = reached(&chain.first, &inside);
    let touched = inside.iter().flat_map(|e| [&e.from, &e.to]).chain(loop_ends.iter().copied());
    let whole = touched.into_iter().any(|s| !from_first.contains(s));
    if whole { chain.odometry.clone() } else { inside }
}

/// Places submaps that are not in `placed` by composing odometry outwards, breadth first, edges by key.
/// Returns those that it added.
pub fn extend_by_composition(placed: &mut BTreeMap<SubmapId, Pose>, odometry: &[Edge]) -> BTreeSet<SubmapId> {
    let mut sorted: Vec<&Edge> = odometry.iter().collect();
    sorted.sort_by(|a, b| a.key.cmp(&b.key));
    let adjacent = neighbours(sorted);
    let mut added = BTreeSet::new();
    let mut open: VecDeque<SubmapId> = placed.keys().cloned().collect();
    while let Some(submap) = open.pop_front() {
        let Some(&pose) = placed.get(&submap) else { continue };
        for edge in adjacent.get(&submap).into_iter().flatten() {
            let (next, next_pose) = if edge.from == submap {
                (&edge.to, pose * edge.from_from_to)
            } else {
                (&edge.from, pose * edge.from_from_to.inverse())
            };
            if !placed.contains_key(next) {
                placed.insert(next.clone(), next_pose);
                added.insert(next.clone());
                open.push_back(next.clone());
            }
        }
    }
    added
}

/// A chain laid out: where its submaps stand to each other, and how sure that is.
#[derive(Clone, Debug)]
pub struct Trunk {
    /// `chain_from_submap`; the chain's frame is that of its first submap.
    pub chain_from_submap: BTreeMap<SubmapId, Pose>,
    /// Loops within it that none of the others supports, although most have support.
    pub lonely: BTreeSet<EdgeKey>,
    /// Where each submap stands in `along`.
    index: BTreeMap<SubmapId, usize>,
    along: Vec<Along>,
}

/// A submap's predecessor on the way from the first one, the number of steps, and the summed covariance of these steps,
/// in the chain's frame.
#[derive(Clone, Debug)]
struct Along {
    parent: usize,
    depth: usize,
    covariance: Matrix6,
}

impl Trunk {
    /// Lays a chain out by its odometry (what is solved for of it).
    pub fn new(chain: &Chain) -> Self {
        let mut along = vec![Along { parent: 0, depth: 0, covariance: Matrix6::zeros() }];
        let mut index = BTreeMap::from([(chain.first.clone(), 0)]);
        let mut chain_from_submap = BTreeMap::from([(chain.first.clone(), Pose::identity())]);
        let adjacent = neighbours(&chain.solved_odometry);
        let mut open = VecDeque::from([chain.first.clone()]);
        while let Some(submap) = open.pop_front() {
            let (parent, pose) = (index[&submap], chain_from_submap[&submap]);
            for edge in adjacent.get(&submap).into_iter().flatten() {
                let forward = edge.from == submap;
                let next = if forward { &edge.to } else { &edge.from };
                if index.contains_key(next) {
                    continue;
                }
                let between = if forward { edge.from_from_to } else { edge.from_from_to.inverse() };
                let next_pose = pose * between;
                // The measurement's error sits at its `to` end; seen from the chain's frame these errors add up.
                let carry = se3::adjoint(if forward { &next_pose } else { &pose });
                let own = edge.information.cholesky().map_or_else(Matrix6::zeros, |factor| factor.inverse());
                let covariance = along[parent].covariance + carry * own * carry.transpose();
                index.insert(next.clone(), along.len());
                along.push(Along { parent, depth: along[parent].depth + 1, covariance });
                chain_from_submap.insert(next.clone(), next_pose);
                open.push_back(next.clone());
            }
        }
        Trunk { chain_from_submap, lonely: BTreeSet::new(), index, along }
    }

    /// `a_from_b` with the covariance of the odometry between the two. `None` if one is not in the chain.
    pub fn between(&self, a: &SubmapId, b: &SubmapId) -> Option<UncertainPose> {
        let chain_from_b = self.chain_from_submap.get(b)?;
        let pose = self.chain_from_submap.get(a)?.inv_mul(chain_from_b);
        let (a, b) = (*self.index.get(a)?, *self.index.get(b)?);
        let covariance = |k: usize| self.along[k].covariance;
        let spread = covariance(a) + covariance(b) - covariance(self.fork(a, b)) * 2.0;
        let carry = se3::adjoint(&chain_from_b.inverse());
        let covariance = carry * spread * carry.transpose();
        Some(UncertainPose { pose, covariance: (covariance + covariance.transpose()) * 0.5 })
    }

    /// Steps of odometry between two submaps. `None` if one is not in the chain.
    pub fn steps_between(&self, a: &SubmapId, b: &SubmapId) -> Option<usize> {
        let (a, b) = (*self.index.get(a)?, *self.index.get(b)?);
        let depth = |k: usize| self.along[k].depth;
        Some(depth(a) + depth(b) - 2 * depth(self.fork(a, b)))
    }

    /// Steps of odometry from the first submap. `None` if it is not in the chain.
    pub fn depth(&self, submap: &SubmapId) -> Option<usize> {
        Some(self.along[*self.index.get(submap)?].depth)
    }

    /// The last submap that the ways to `a` and `b` share.
    fn fork(&self, mut a: usize, mut b: usize) -> usize {
        while a != b {
            let deeper = if self.along[a].depth >= self.along[b].depth { &mut a } else { &mut b };
            *deeper = self.along[*deeper].parent;
        }
        a
    }
}
