//! What an agent makes of places that it or a peer has seen before.
//!
//! Entries of all logs come in; requests to recognise places go out; candidates come back; those that this
//! agent is to verify are handed out one by one; each ends as a verdict in this agent's log. Nothing is
//! tried twice, and nothing waits for a coordinator.

pub mod agreement;
pub mod corrections;

use crate::log::{AnchorDescribed, EntryKey, LoopOutcome, LoopVerdict, Payload, SubmapOpened};
use coma_geometry::{AgentId, SubmapId};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// How loops are looked for.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LoopSettings {
    /// Off: places are described and shared, but no candidate is verified.
    pub enabled: bool,
    /// Candidates that are asked for per anchor.
    pub candidates_per_anchor: u32,
    /// An anchor is looked up again when another one of its life, at most this many frames before or after it, is
    /// described: its window, by which place recognition rates candidates, is wider then. As place recognition's
    /// `candidates.window_frames`.
    pub window_frames: u64,
    /// Without a verdict for so long, seconds, the other end verifies.
    pub takeover_s: f64,
    /// Evidence that nobody held is asked for again after so long, seconds.
    pub retry_s: f64,
}

impl Default for LoopSettings {
    fn default() -> Self {
        LoopSettings {
            enabled: true,
            candidates_per_anchor: 6,
            window_frames: 25,
            takeover_s: 10.0,
            retry_s: 5.0,
        }
    }
}

/// Two submaps that may show one place; `from < to`.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Pair {
    /// The smaller id: target of the registration.
    pub from: SubmapId,
    /// The larger id: source of the registration.
    pub to: SubmapId,
}

impl Pair {
    /// In canonical order; `None` for a submap and itself.
    pub fn new(a: &SubmapId, b: &SubmapId) -> Option<Self> {
        match a.cmp(b) {
            std::cmp::Ordering::Less => Some(Pair { from: a.clone(), to: b.clone() }),
            std::cmp::Ordering::Greater => Some(Pair { from: b.clone(), to: a.clone() }),
            std::cmp::Ordering::Equal => None,
        }
    }

    /// Which of the two ends' agents verifies: the live one with the larger hash of (pair, agent).
    pub fn verifier(&self, is_live: impl Fn(&AgentId) -> bool) -> Option<AgentId> {
        let score = |agent: &AgentId| {
            let text = format!("{}|{}|{}", self.from, self.to, agent);
            *blake3::hash(text.as_bytes()).as_bytes()
        };
        [&self.from.agent, &self.to.agent]
            .into_iter()
            .filter(|a| is_live(a))
            .max_by_key(|a| score(a))
            .cloned()
    }
}

/// A pair that place recognition found.
#[derive(Clone, Debug, PartialEq)]
pub struct Candidate {
    /// Which two.
    pub pair: Pair,
    /// Of the two anchors.
    pub similarity: f32,
    /// Mean over the pairs of both windows.
    pub window_similarity: f32,
    /// Descriptor space of both.
    pub space: String,
}

#[derive(Clone, Debug)]
struct Waiting {
    candidate: Candidate,
    since_s: f64,
    not_before_s: f64,
    in_work: bool,
}

/// What a submap's agent said of it.
#[derive(Clone, Debug)]
pub struct SubmapFacts {
    /// Where and when it began.
    pub opened: SubmapOpened,
    /// How it can be recognised; follows soon after.
    pub anchor: Option<AnchorDescribed>,
}

/// The state: what all logs say, and what is still to be verified here.
pub struct LoopCloser {
    own: AgentId,
    settings: LoopSettings,
    submaps: BTreeMap<SubmapId, SubmapFacts>,
    verdicts: BTreeMap<Pair, BTreeMap<EntryKey, LoopVerdict>>,
    withdrawn: BTreeMap<EntryKey, String>,
    waiting: BTreeMap<Pair, Waiting>,
    to_query: BTreeSet<SubmapId>,
    to_insert: BTreeSet<SubmapId>,
    /// Anchors for which place recognition has no room.
    no_room: BTreeSet<SubmapId>,
    graph_changed: bool,
    agreement: agreement::Agreement,
}

impl LoopCloser {
    /// Nothing known yet.
    pub fn new(own: AgentId, settings: LoopSettings) -> Self {
        LoopCloser {
            own,
            settings,
            submaps: BTreeMap::new(),
            verdicts: BTreeMap::new(),
            withdrawn: BTreeMap::new(),
            waiting: BTreeMap::new(),
            to_query: BTreeSet::new(),
            to_insert: BTreeSet::new(),
            no_room: BTreeSet::new(),
            graph_changed: false,
            agreement: agreement::Agreement::default(),
        }
    }

    /// What every agent's solver made of the graph.
    pub fn agreement(&self) -> &agreement::Agreement {
        &self.agreement
    }

    /// Takes an entry of any log; entries of one log come in order.
    pub fn on_entry(&mut self, key: &EntryKey, payload: &Payload) {
        match payload {
            Payload::SubmapOpened(opened) if opened.id.agent == key.agent => {
                let facts = SubmapFacts { opened: opened.clone(), anchor: None };
                self.submaps.entry(opened.id.clone()).or_insert(facts);
                self.graph_changed = true;
            }
            Payload::AnchorDescribed(anchor) if anchor.submap.agent == key.agent => {
                if let Some(facts) = self.submaps.get_mut(&anchor.submap) {
                    facts.anchor = Some(anchor.clone());
                    self.to_insert.insert(anchor.submap.clone());
                    self.to_query.insert(anchor.submap.clone());
                    let wider = self.window_of(&anchor.submap);
                    self.to_query.extend(wider);
                }
            }
            Payload::LoopVerdict(verdict) => {
                let Some(pair) = Pair::new(&verdict.from, &verdict.to) else { return };
                self.waiting.remove(&pair);
                self.graph_changed |= matches!(verdict.outcome, LoopOutcome::Accepted { .. });
                self.verdicts.entry(pair).or_default().insert(key.clone(), verdict.clone());
            }
            Payload::LoopWithdrawn(withdrawn) if withdrawn.verdict.agent == key.agent => {
                self.withdrawn.insert(withdrawn.verdict.clone(), withdrawn.message.clone());
                self.graph_changed = true;
            }
            Payload::OdometryEdge(_) => self.graph_changed = true,
            Payload::SolveDigest(said) => self.agreement.on_digest(&key.agent, said),
            _ => {}
        }
    }

    /// Described anchors of the same life around a submap's, which it widens the windows of.
    fn window_of(&self, id: &SubmapId) -> Vec<SubmapId> {
        let Some(own) = self.submaps.get(id) else { return Vec::new() };
        let near = |(other, facts): &(&SubmapId, &SubmapFacts)| {
            other.agent == id.agent
                && other.epoch == id.epoch
                && facts.opened.anchor_frame.abs_diff(own.opened.anchor_frame) <= self.settings.window_frames
        };
        let before = self.submaps.range(..id).rev().take_while(near);
        let after = self.submaps.range(id..).skip(1).take_while(near);
        let described = before.chain(after).filter(|(_, facts)| facts.anchor.is_some());
        described.map(|(other, _)| other.clone()).collect()
    }

    /// Anchors that place recognition should learn; the caller reports back by asking again.
    pub fn take_inserts(&mut self) -> Vec<SubmapId> {
        std::mem::take(&mut self.to_insert).into_iter().collect()
    }

    /// Anchors to look up, after they were inserted.
    pub fn take_queries(&mut self) -> Vec<SubmapId> {
        let queries = std::mem::take(&mut self.to_query);
        let known = queries.into_iter().filter(|id| !self.no_room.contains(id));
        if self.settings.enabled { known.collect() } else { Vec::new() }
    }

    /// Puts back what could not be done.
    pub fn retry(&mut self, inserts: Vec<SubmapId>, queries: Vec<SubmapId>) {
        self.to_insert.extend(inserts);
        self.to_query.extend(queries);
    }

    /// Place recognition has no room for these: they are neither inserted nor looked up until it starts anew.
    pub fn set_aside(&mut self, submaps: Vec<SubmapId>) {
        for id in submaps {
            self.to_query.remove(&id);
            self.no_room.insert(id);
        }
    }

    /// Place recognition lost what it had: every anchor is inserted again.
    pub fn insert_all_again(&mut self) {
        self.no_room.clear();
        let described = self.submaps.iter().filter(|(_, facts)| facts.anchor.is_some());
        self.to_insert.extend(described.map(|(id, _)| id.clone()));
    }

    /// Anchors that were handed out to be inserted.
    pub fn inserted(&self) -> usize {
        let described = self.submaps.values().filter(|facts| facts.anchor.is_some()).count();
        described - self.to_insert.len() - self.no_room.len()
    }

    /// Takes candidates; keeps those that have an end here and no verdict.
    pub fn on_candidates(&mut self, candidates: Vec<Candidate>, now_s: f64) {
        for candidate in candidates {
            let pair = &candidate.pair;
            let mine = pair.from.agent == self.own || pair.to.agent == self.own;
            let known = self.submaps.contains_key(&pair.from) && self.submaps.contains_key(&pair.to);
            if mine && known && !self.verdicts.contains_key(pair) {
                let pair = pair.clone();
                // One that waits already keeps its turn, and takes the similarity of the wider window.
                let waiting = self.waiting.entry(pair).or_insert_with(|| Waiting {
                    candidate: candidate.clone(),
                    since_s: now_s,
                    not_before_s: now_s,
                    in_work: false,
                });
                waiting.candidate = candidate;
            }
        }
    }

    /// The next pair to verify here, best first: pairs of agents with few accepted loops before others, then
    /// by similarity. It is in work until [`LoopCloser::on_verified`] or [`LoopCloser::put_off`].
    pub fn next_to_verify(&mut self, is_live: impl Fn(&AgentId) -> bool, now_s: f64) -> Option<Candidate> {
        let accepted = self.accepted_by_agents();
        let mut best: Option<(u32, f32, Pair)> = None;
        for (pair, waiting) in &self.waiting {
            let due = now_s >= waiting.not_before_s && !waiting.in_work;
            let mine = pair.verifier(&is_live).is_none_or(|agent| agent == self.own)
                || now_s - waiting.since_s > self.settings.takeover_s;
            if !(due && mine) {
                continue;
            }
            let between = (pair.from.agent.clone(), pair.to.agent.clone());
            let tied = accepted.get(&between).copied().unwrap_or(0).min(3);
            let score = waiting.candidate.window_similarity;
            if best.as_ref().is_none_or(|(t, s, _)| tied < *t || (tied == *t && score > *s)) {
                best = Some((tied, score, pair.clone()));
            }
        }
        let waiting = self.waiting.get_mut(&best?.2)?;
        waiting.in_work = true;
        Some(waiting.candidate.clone())
    }

    fn accepted_by_agents(&self) -> BTreeMap<(AgentId, AgentId), u32> {
        let mut out = BTreeMap::new();
        for (pair, _, _) in
            self.decided().filter(|(_, _, v)| matches!(v.outcome, LoopOutcome::Accepted { .. }))
        {
            *out.entry((pair.from.agent.clone(), pair.to.agent.clone())).or_insert(0) += 1;
        }
        out
    }

    /// A pair whose evidence nobody held: it is tried again later.
    pub fn put_off(&mut self, pair: &Pair, now_s: f64) {
        if let Some(waiting) = self.waiting.get_mut(pair) {
            waiting.in_work = false;
            waiting.not_before_s = now_s + self.settings.retry_s;
        }
    }

    /// The verdict on a pair that was handed out; goes to this agent's log, and comes back by `on_entry`.
    pub fn on_verified(&mut self, candidate: &Candidate, outcome: LoopOutcome) -> Payload {
        Payload::LoopVerdict(LoopVerdict {
            from: candidate.pair.from.clone(),
            to: candidate.pair.to.clone(),
            similarity: candidate.similarity,
            space: candidate.space.clone(),
            outcome,
        })
    }

    /// True once after entries came that change the graph.
    pub fn take_graph_changed(&mut self) -> bool {
        std::mem::take(&mut self.graph_changed)
    }

    /// True while entries that change the graph wait to be solved.
    pub fn graph_changed(&self) -> bool {
        self.graph_changed
    }

    /// Candidates without a verdict that have an end here.
    pub fn pending(&self) -> usize {
        self.waiting.len()
    }

    /// Anchors not yet looked up.
    pub fn unqueried(&self) -> usize {
        self.to_insert.len() + if self.settings.enabled { self.to_query.len() } else { 0 }
    }

    /// Everything known of a submap.
    pub fn submap(&self, id: &SubmapId) -> Option<&SubmapFacts> {
        self.submaps.get(id)
    }

    /// All submaps, by id.
    pub fn submaps(&self) -> impl Iterator<Item = (&SubmapId, &SubmapFacts)> {
        self.submaps.iter()
    }

    /// The verdict that counts for each pair: the one with the smallest key; with the reason if its author
    /// took it back.
    pub fn decided(&self) -> impl Iterator<Item = (&Pair, &EntryKey, &LoopVerdict)> {
        self.verdicts.iter().filter_map(|(pair, verdicts)| {
            let (key, verdict) = verdicts.iter().find(|(key, _)| !self.withdrawn.contains_key(*key))?;
            Some((pair, key, verdict))
        })
    }
}

#[cfg(test)]
#[path = "loop_closure_tests.rs"]
mod tests;
