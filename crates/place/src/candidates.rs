//! Which pairs of anchors are worth a geometric verification (CoMA-SLAM, section 3.3): similar, not merely
//! neighbours in time, and surrounded by anchors that are similar too.

use crate::descriptor::{Descriptor, Space, similarity};
use crate::encoder::Thresholds;
use crate::index::{ExactIndex, Hit, Index};
use coma_geometry::{AgentId, SubmapId};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;

/// Settings of [`Candidates`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Within one life of one agent, anchors must be more than this many frames apart (the paper's tau_min).
    pub min_gap_frames: u64,
    /// Anchors at most this many frames before or after belong to an anchor's window. Frames, not anchors: what
    /// counts is how far the camera has moved on. Calibrated on a real kitchen; wider ones see another place.
    pub window_frames: u64,
    /// Most similar anchors that are looked at per query.
    pub nearest: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Settings { min_gap_frames: 20, window_frames: 25, nearest: 20 }
    }
}

/// A pair of anchors that may show one place.
#[derive(Clone, Debug, PartialEq)]
pub struct Candidate {
    /// The smaller id.
    pub a: SubmapId,
    /// The larger id.
    pub b: SubmapId,
    /// In which space they are similar.
    pub space: Space,
    /// Cosine of the two anchors.
    pub similarity: f32,
    /// Mean cosine of the anchors of both windows with their best counterparts in the other window.
    pub window_similarity: f32,
}

/// Which anchors may answer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Filter {
    /// Those of these agents; none: of all.
    pub agents: Option<BTreeSet<AgentId>>,
    /// Those whose frame lies in here. Frames of different agents or lives have no common count.
    pub frames: RangeInclusive<u64>,
}

impl Default for Filter {
    /// All of them.
    fn default() -> Self {
        Filter { agents: None, frames: 0..=u64::MAX }
    }
}

/// Anchors' descriptors, searched one way or another.
type AnchorIndex = Box<dyn Index<SubmapId> + Send + Sync>;

/// All anchors known, and the pairs already proposed.
pub struct Candidates {
    settings: Settings,
    thresholds: BTreeMap<Space, Thresholds>,
    index: AnchorIndex,
    anchors: BTreeMap<SubmapId, Anchor>,
    tried: BTreeSet<(SubmapId, SubmapId)>,
}

#[derive(Clone, Debug)]
struct Anchor {
    frame: u64,
    descriptors: BTreeMap<Space, Descriptor>,
}

/// Pairs with their margins over the thresholds.
type Rated = BTreeMap<(SubmapId, SubmapId), (f32, Candidate)>;

impl Candidates {
    /// Empty. Spaces without thresholds are stored but propose nothing.
    pub fn new(settings: Settings, thresholds: BTreeMap<Space, Thresholds>) -> Self {
        Self::with_index(settings, thresholds, Box::new(ExactIndex::default()))
    }

    /// The same, searched by another index, which must be empty.
    pub fn with_index(
        settings: Settings,
        thresholds: BTreeMap<Space, Thresholds>,
        index: AnchorIndex,
    ) -> Self {
        Candidates { settings, thresholds, index, anchors: BTreeMap::new(), tried: BTreeSet::new() }
    }

    /// Number of anchors.
    pub fn len(&self) -> usize {
        self.anchors.len()
    }

    /// True without anchors.
    pub fn is_empty(&self) -> bool {
        self.anchors.is_empty()
    }

    /// Adds an anchor's descriptor; `frame` is the sequence number of its frame. An anchor may have one per space.
    pub fn insert(&mut self, id: SubmapId, frame: u64, descriptor: Descriptor) {
        self.index.insert(id.clone(), &descriptor);
        let anchor = self.anchors.entry(id).or_insert(Anchor { frame, descriptors: BTreeMap::new() });
        anchor.descriptors.insert(descriptor.space().clone(), descriptor);
    }

    /// Remembers a pair that was decided elsewhere: it will not be proposed.
    pub fn mark_tried(&mut self, a: &SubmapId, b: &SubmapId) {
        self.tried.insert(ordered(a, b));
    }

    /// True if the anchor is known.
    pub fn contains(&self, id: &SubmapId) -> bool {
        self.anchors.contains_key(id)
    }

    /// The spaces of an anchor's descriptors; none for an unknown anchor.
    pub fn spaces(&self, id: &SubmapId) -> impl Iterator<Item = &Space> + '_ {
        self.anchors.get(id).into_iter().flat_map(|anchor| anchor.descriptors.keys())
    }

    /// The anchors most similar to a descriptor, of those that the filter lets pass; no threshold counts.
    pub fn similar(&self, descriptor: &Descriptor, count: usize, filter: &Filter) -> Vec<Hit<SubmapId>> {
        let admit = |id: &SubmapId| {
            filter.agents.as_ref().is_none_or(|agents| agents.contains(&id.agent))
                && self.anchors.get(id).is_some_and(|anchor| filter.frames.contains(&anchor.frame))
        };
        self.index.query(descriptor, count, &admit)
    }

    /// The new candidates that `id` and its window take part in (a new anchor also completes the windows of
    /// its neighbours), best first, equal ones by their ids. Each pair is proposed once, ever.
    pub fn propose(&mut self, id: &SubmapId) -> Vec<Candidate> {
        let mut rated = Rated::new();
        for member in self.window(id) {
            self.rate(&member, &|other| !self.tried.contains(&ordered(&member, other)), &mut rated);
        }
        self.tried.extend(rated.keys().cloned());
        ranked(rated)
    }

    /// The candidates that `id` itself takes part in, best first, equal ones by their ids. Nothing is
    /// remembered: pairs that were proposed or decided are among them, and asking again gives the same answer.
    pub fn of(&self, id: &SubmapId) -> Vec<Candidate> {
        let mut rated = Rated::new();
        self.rate(id, &|_| true, &mut rated);
        ranked(rated)
    }

    /// Rates the anchors that are similar to `member` and admitted; of one pair the best space counts.
    fn rate(&self, member: &SubmapId, admit: &(dyn Fn(&SubmapId) -> bool + Sync), rated: &mut Rated) {
        let Some(anchor) = self.anchors.get(member) else { return };
        for (space, descriptor) in &anchor.descriptors {
            let Some(thresholds) = self.thresholds.get(space) else { continue };
            let admit = |other: &SubmapId| self.far_enough(member, other) && admit(other);
            for hit in self.index.query(descriptor, self.settings.nearest, &admit) {
                if !(hit.similarity > thresholds.theta_sim) {
                    break;
                }
                let window_similarity = self.window_similarity(member, &hit.key, space);
                if !(window_similarity > thresholds.theta_multi) {
                    continue;
                }
                // Margins make spaces comparable.
                let margin =
                    (hit.similarity - thresholds.theta_sim) + (window_similarity - thresholds.theta_multi);
                let pair = ordered(member, &hit.key);
                let candidate = Candidate {
                    a: pair.0.clone(),
                    b: pair.1.clone(),
                    space: space.clone(),
                    similarity: hit.similarity,
                    window_similarity,
                };
                let known = rated.get(&pair).map_or(f32::NEG_INFINITY, |known| known.0);
                if margin > known {
                    rated.insert(pair, (margin, candidate));
                }
            }
        }
    }

    /// Temporal filter. Frames of different agents or lives have no common count.
    fn far_enough(&self, a: &SubmapId, b: &SubmapId) -> bool {
        if a.agent != b.agent || a.epoch != b.epoch {
            return true;
        }
        match (self.anchors.get(a), self.anchors.get(b)) {
            (Some(x), Some(y)) => x.frame.abs_diff(y.frame) > self.settings.min_gap_frames,
            _ => false,
        }
    }

    /// The anchors of the same life within [`Settings::window_frames`], `id` included; none for an unknown one.
    fn window(&self, id: &SubmapId) -> Vec<SubmapId> {
        let Some(anchor) = self.anchors.get(id) else { return Vec::new() };
        let near = |(other, known): &(&SubmapId, &Anchor)| {
            other.agent == id.agent
                && other.epoch == id.epoch
                && known.frame.abs_diff(anchor.frame) <= self.settings.window_frames
        };
        let before = self.anchors.range(..id).rev().take_while(near).map(|(other, _)| other.clone());
        let mut ids: Vec<SubmapId> = before.collect();
        ids.reverse();
        ids.extend(self.anchors.range(id..).take_while(near).map(|(other, _)| other.clone()));
        ids
    }

    /// How alike two windows are: each anchor's best counterpart in the other window, on average. The paper takes
    /// the mean over all pairs, which also asks that the ends of both windows look alike; on a real kitchen the
    /// best counterparts tell a place from another more often. Neighbours in time are no counterparts.
    fn window_similarity(&self, a: &SubmapId, b: &SubmapId, space: &Space) -> f32 {
        let of = |id: &SubmapId| -> Vec<(SubmapId, &Descriptor)> {
            let known = |id: SubmapId| Some((id.clone(), self.anchors.get(&id)?.descriptors.get(space)?));
            self.window(id).into_iter().filter_map(known).collect()
        };
        let (left, right) = (of(a), of(b));
        let mut best: Vec<f32> = vec![f32::NEG_INFINITY; left.len() + right.len()];
        for (i, (x, from)) in left.iter().enumerate() {
            for (j, (y, to)) in right.iter().enumerate() {
                let alike = similarity(from, to).filter(|_| self.far_enough(x, y));
                for at in [i, left.len() + j] {
                    best[at] = best[at].max(alike.unwrap_or(f32::NEG_INFINITY));
                }
            }
        }
        let (mut left, mut right) = (best[..left.len()].to_vec(), best[left.len()..].to_vec());
        let mean = |best: &mut Vec<f32>| {
            best.retain(|s| s.is_finite());
            best.iter().sum::<f32>() / best.len() as f32
        };
        // Without any counterpart NaN, which passes no threshold.
        0.5 * (mean(&mut left) + mean(&mut right))
    }
}

fn ranked(rated: Rated) -> Vec<Candidate> {
    let mut ranked: Vec<(f32, Candidate)> = rated.into_values().collect();
    // Stable: equal margins keep the order of the ids.
    ranked.sort_by(|x, y| y.0.total_cmp(&x.0));
    ranked.into_iter().map(|(_, candidate)| candidate).collect()
}

fn ordered(a: &SubmapId, b: &SubmapId) -> (SubmapId, SubmapId) {
    if a <= b { (a.clone(), b.clone()) } else { (b.clone(), a.clone()) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_geometry::{AgentId, Epoch};

    fn space() -> Space {
        Space::new("test/1").unwrap()
    }

    fn id(agent: &str, number: u32) -> SubmapId {
        SubmapId { agent: AgentId::new(agent).unwrap(), epoch: Epoch(0), number }
    }

    /// Looks like place `p`, turned a little by `turn`.
    fn at(p: usize, turn: f32) -> Descriptor {
        let mut v = vec![0.0; 16];
        v[p] = turn.cos();
        v[15] = turn.sin();
        Descriptor::from_f32(space(), &v).unwrap()
    }

    fn empty() -> Candidates {
        let thresholds = Thresholds { theta_sim: 0.8, theta_multi: 0.5 };
        Candidates::new(Settings::default(), BTreeMap::from([(space(), thresholds)]))
    }

    #[test]
    fn neighbours_in_time_are_no_loop_but_another_agent_s_are() {
        let mut known = empty();
        known.insert(id("a", 0), 0, at(0, 0.0));
        known.insert(id("a", 1), 20, at(0, 0.1));
        assert!(known.propose(&id("a", 1)).is_empty());
        known.insert(id("a", 2), 21, at(0, 0.1));
        let found = known.propose(&id("a", 2));
        assert_eq!(found.iter().map(|c| (c.a.number, c.b.number)).collect::<Vec<_>>(), vec![(0, 2)]);
        known.insert(id("b", 0), 0, at(0, 0.1));
        assert_eq!(known.propose(&id("b", 0)).len(), 3);
    }

    #[test]
    fn a_lone_similar_anchor_among_strange_ones_is_turned_down() {
        let mut known = empty();
        for n in 0..5 {
            // Agent b sees place 2 once, amid places that a never saw.
            known.insert(id("a", n), n as u64 * 20, at(n as usize, 0.0));
            known.insert(id("b", n), n as u64 * 20, at(if n == 2 { 2 } else { 8 + n as usize }, 0.0));
        }
        assert!(known.propose(&id("b", 2)).is_empty());
        // Where the whole stretch is shared, it is proposed.
        for n in 0..5 {
            known.insert(id("c", n), n as u64 * 20, at(0, 0.1 * n as f32));
            known.insert(id("d", n), n as u64 * 20, at(0, 0.1 * n as f32));
        }
        assert!(known.propose(&id("d", 2)).iter().any(|c| c.a == id("c", 2) && c.b == id("d", 2)));
    }

    #[test]
    fn windows_are_as_alike_as_their_best_counterparts() {
        let mut known = empty();
        // The same walk, there and back; then anchors that are too far on to count.
        for n in 0..5u32 {
            known.insert(id("a", n), n as u64 * 20, at(n as usize, 0.0));
            known.insert(id("b", n), n as u64 * 20, at(4 - n as usize, 0.0));
        }
        let found = known.propose(&id("b", 2));
        let middle = found.iter().find(|c| c.a == id("a", 2) && c.b == id("b", 2)).unwrap();
        assert!((middle.window_similarity - 1.0).abs() < 1e-6);
        // Seen once more by itself, the middle of a has two strange neighbours.
        known.insert(id("c", 0), 0, at(2, 0.0));
        let found = known.of(&id("c", 0));
        let lone = found.iter().find(|c| c.a == id("a", 2)).unwrap();
        assert!(
            (lone.window_similarity - 0.5 * (1.0 / 3.0 + 1.0)).abs() < 1e-6,
            "{}",
            lone.window_similarity
        );
    }

    #[test]
    fn neighbours_in_time_are_no_counterparts() {
        let mut known = empty();
        // One walk whose two windows share an anchor in the middle: it must not vouch for both.
        known.insert(id("a", 0), 0, at(0, 0.0));
        known.insert(id("a", 1), 20, at(5, 0.0));
        known.insert(id("a", 2), 40, at(0, 0.1));
        let found = known.of(&id("a", 2));
        let similarity = found[0].window_similarity;
        assert!((similarity - found[0].similarity).abs() < 1e-6, "{similarity}");
    }

    #[test]
    fn nothing_is_proposed_twice() {
        let mut known = empty();
        known.insert(id("a", 0), 0, at(0, 0.0));
        known.insert(id("b", 0), 0, at(0, 0.0));
        known.insert(id("c", 0), 0, at(0, 0.0));
        known.mark_tried(&id("c", 0), &id("a", 0));
        assert_eq!(known.propose(&id("a", 0)).len(), 1);
        assert!(known.propose(&id("a", 0)).is_empty());
        let rest = known.propose(&id("b", 0));
        assert_eq!(rest.iter().map(|c| (&c.a, &c.b)).collect::<Vec<_>>(), vec![(&id("b", 0), &id("c", 0))]);
    }

    #[test]
    fn asking_for_an_anchor_s_own_candidates_may_be_repeated() {
        let mut known = empty();
        known.insert(id("a", 0), 0, at(0, 0.0));
        known.insert(id("a", 1), 20, at(1, 0.0));
        known.insert(id("b", 0), 0, at(0, 0.0));
        known.insert(id("b", 1), 20, at(1, 0.0));
        let first = known.of(&id("b", 0));
        assert_eq!(first.iter().map(|c| (&c.a, &c.b)).collect::<Vec<_>>(), vec![(&id("a", 0), &id("b", 0))]);
        assert_eq!(known.propose(&id("b", 0)).len(), 2, "with the window's own");
        assert_eq!(known.of(&id("b", 0)), first);
        assert!(known.of(&id("c", 0)).is_empty());
    }

    #[test]
    fn the_best_candidate_comes_first_and_equal_ones_by_id() {
        let mut known = empty();
        known.insert(id("q", 0), 0, at(0, 0.0));
        for (agent, turn) in [("c", 0.3), ("a", 0.3), ("b", 0.1)] {
            known.insert(id(agent, 0), 0, at(0, turn));
        }
        let order: Vec<String> =
            known.propose(&id("q", 0)).iter().map(|c| c.a.agent.as_str().to_owned()).collect();
        assert_eq!(order, ["b", "a", "c"]);
    }

    #[test]
    fn a_space_without_thresholds_proposes_nothing() {
        let mut known = Candidates::new(Settings::default(), BTreeMap::new());
        known.insert(id("a", 0), 0, at(0, 0.0));
        known.insert(id("b", 0), 0, at(0, 0.0));
        assert!(known.propose(&id("a", 0)).is_empty());
    }

    #[test]
    fn similar_anchors_may_be_asked_for_by_agent_and_time() {
        let mut known = empty();
        for n in 0..4 {
            known.insert(id("a", n), n as u64 * 20, at(0, 0.1 * n as f32));
            known.insert(id("b", n), n as u64 * 20, at(0, 0.1 * n as f32));
        }
        let ask = |filter: &Filter| -> Vec<(String, u32)> {
            let hits = known.similar(&at(0, 0.0), 10, filter);
            hits.iter().map(|hit| (hit.key.agent.to_string(), hit.key.number)).collect()
        };
        assert_eq!(ask(&Filter::default()).len(), 8);
        let only_b = Filter { agents: Some([AgentId::new("b").unwrap()].into()), frames: 20..=40 };
        assert_eq!(ask(&only_b), [("b".to_owned(), 1), ("b".to_owned(), 2)]);
    }
}
