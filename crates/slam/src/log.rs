//! What an agent knows of itself, as an append-only log that only it writes, and the replica of
//! everybody's logs that every agent keeps.
//!
//! Entries are pulled by version vector, so loss, duplication, reordering, late joining and healed
//! partitions need no special case: an entry is taken when it is the next of its log and its
//! `previous_hash` fits, and left otherwise.

use coma_geometry::{AgentId, Epoch, MapId, SubmapId};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// blake3.
pub type Hash = [u8; 32];

/// How many entries of each log are known: sequences `0..length`.
pub type VersionVector = BTreeMap<(AgentId, Epoch), u64>;

/// Names an entry.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct EntryKey {
    /// Who wrote it.
    pub agent: AgentId,
    /// In which life.
    pub epoch: Epoch,
    /// Counted from 0.
    pub sequence: u64,
}

/// One line of a log. The payload stays encoded, so that hashes hold and unknown fields survive.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Entry {
    /// Its name.
    pub key: EntryKey,
    /// Hash of the entry before; `None` for sequence 0.
    pub previous_hash: Option<Hash>,
    /// An encoded `coma.v1.Payload`.
    pub payload: Vec<u8>,
    /// Reserved.
    pub signature: Vec<u8>,
}

impl Entry {
    /// What the next entry names as its `previous_hash`: covers key, previous hash and payload.
    pub fn hash(&self) -> Hash {
        let mut hasher = blake3::Hasher::new();
        let agent = self.key.agent.as_str().as_bytes();
        hasher.update(&(agent.len() as u64).to_le_bytes());
        hasher.update(agent);
        hasher.update(&self.key.epoch.0.to_le_bytes());
        hasher.update(&self.key.sequence.to_le_bytes());
        hasher.update(&self.previous_hash.unwrap_or_default());
        hasher.update(&self.payload);
        *hasher.finalize().as_bytes()
    }
}

/// What became of an entry that was offered to a [`Replica`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Offered {
    /// It was the next one and is kept.
    Taken,
    /// It was here already.
    Known,
    /// Entries before it are missing: pull from `have`.
    Gap {
        /// The length of that log here.
        have: u64,
    },
    /// Another entry stands under the same key, or its hash chain is broken. Users are told; neither
    /// side's continuation of this log is used.
    Conflict {
        /// Which key.
        key: EntryKey,
    },
}

#[derive(Clone, Debug, Default)]
struct Log {
    entries: Vec<Entry>,
    head: Option<Hash>,
    forked_at: Option<u64>,
}

/// Everybody's logs, as far as they are known here.
#[derive(Clone, Debug, Default)]
pub struct Replica {
    logs: BTreeMap<(AgentId, Epoch), Log>,
}

impl Replica {
    /// Takes an entry if it is the next of its log.
    pub fn offer(&mut self, entry: Entry) -> Offered {
        let log = self.logs.entry((entry.key.agent.clone(), entry.key.epoch)).or_default();
        let have = log.entries.len() as u64;
        let sequence = entry.key.sequence;
        if log.forked_at.is_some_and(|fork| sequence >= fork) {
            return Offered::Conflict { key: entry.key };
        }
        if let Some(known) = usize::try_from(sequence).ok().and_then(|i| log.entries.get(i)) {
            if *known == entry {
                return Offered::Known;
            }
            // Two entries under one key: neither is used, nor what follows.
            log.forked_at = Some(sequence);
            log.entries.truncate(sequence as usize);
            log.head = log.entries.last().map(Entry::hash);
            return Offered::Conflict { key: entry.key };
        }
        if sequence > have {
            return Offered::Gap { have };
        }
        if entry.previous_hash != log.head {
            log.forked_at = Some(sequence);
            return Offered::Conflict { key: entry.key };
        }
        log.head = Some(entry.hash());
        log.entries.push(entry);
        Offered::Taken
    }

    /// The length of every log.
    pub fn heads(&self) -> VersionVector {
        self.logs
            .iter()
            .filter(|(_, log)| !log.entries.is_empty())
            .map(|(k, log)| (k.clone(), log.entries.len() as u64))
            .collect()
    }

    /// The hash that the next entry of a log must name.
    pub fn head_hash(&self, agent: &AgentId, epoch: Epoch) -> Option<Hash> {
        self.logs.get(&(agent.clone(), epoch)).and_then(|log| log.head)
    }

    /// What the holder of `have` lacks, log by log, each in order, at most `limit` entries.
    pub fn missing<'a>(
        &'a self,
        have: &'a VersionVector,
        limit: usize,
    ) -> impl Iterator<Item = &'a Entry> + 'a {
        self.logs
            .iter()
            .flat_map(move |(key, log)| {
                let from = have.get(key).copied().unwrap_or(0).min(log.entries.len() as u64) as usize;
                &log.entries[from..]
            })
            .take(limit)
    }

    /// Every entry, by agent, epoch and sequence.
    pub fn entries(&self) -> impl Iterator<Item = &Entry> + '_ {
        self.logs.values().flat_map(|log| &log.entries)
    }

    /// Keys at which two different entries were seen.
    pub fn conflicts(&self) -> impl Iterator<Item = EntryKey> + '_ {
        self.logs.iter().filter_map(|((agent, epoch), log)| {
            log.forked_at.map(|sequence| EntryKey { agent: agent.clone(), epoch: *epoch, sequence })
        })
    }
}

/// The submap that a submap-level message speaks of, and others: see `coma.v1.Payload` for the wire form.
#[derive(Clone, Debug, PartialEq)]
pub enum Payload {
    /// Sequence 0 of every log.
    AgentStarted(AgentStarted),
    /// A submap began.
    SubmapOpened(SubmapOpened),
    /// Two submaps of one chain, tied by tracking.
    OdometryEdge(OdometryEdge),
    /// An anchor can be recognised.
    AnchorDescribed(AnchorDescribed),
    /// A candidate was decided.
    LoopVerdict(LoopVerdict),
    /// An accepted loop is taken back by its author.
    LoopWithdrawn(LoopWithdrawn),
    /// What this agent's solver made of a cut.
    SolveDigest(SolveDigest),
}

/// An agent's first entry.
#[derive(Clone, Debug, PartialEq)]
pub struct AgentStarted {
    /// The smallest (anchor_priority, id) holds the gauge.
    pub anchor_priority: u32,
    /// Program version.
    pub build: String,
}

/// A submap began.
#[derive(Clone, Debug, PartialEq)]
pub struct SubmapOpened {
    /// Its id.
    pub id: SubmapId,
    /// Position of its anchor in the agent's stream.
    pub anchor_frame: u64,
    /// Sensor stamp of its anchor.
    pub anchor_stamp: coma_geometry::StampNs,
    /// By odometry.
    pub agent_from_submap: coma_geometry::Pose,
    /// Submaps of one chain are tied by odometry.
    pub chain: u32,
}

/// Two submaps of one chain, tied by tracking.
#[derive(Clone, Debug, PartialEq)]
pub struct OdometryEdge {
    /// Earlier.
    pub from: SubmapId,
    /// Later.
    pub to: SubmapId,
    /// The motion.
    pub from_from_to: coma_geometry::Pose,
    /// Of the motion, perturbed on the right.
    pub information: coma_geometry::Matrix6,
}

/// Names a blob by content.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Evidence {
    /// blake3 of the blob.
    pub hash: Hash,
    /// Its size.
    pub size_bytes: u64,
}

/// An anchor can be recognised.
#[derive(Clone, Debug, PartialEq)]
pub struct AnchorDescribed {
    /// Whose anchor.
    pub submap: SubmapId,
    /// The builtin one is always among them.
    pub descriptors: Vec<coma_place::Descriptor>,
    /// Quarter resolution.
    pub coarse: Evidence,
    /// Full resolution.
    pub full: Evidence,
}

/// A candidate was decided.
#[derive(Clone, Debug, PartialEq)]
pub struct LoopVerdict {
    /// Target of the registration.
    pub from: SubmapId,
    /// Source of the registration.
    pub to: SubmapId,
    /// Of the places.
    pub similarity: f32,
    /// Descriptor space of the similarity.
    pub space: String,
    /// Yes or no.
    pub outcome: LoopOutcome,
}

/// Yes, with the motion; or no, with the reason.
#[derive(Clone, Debug, PartialEq)]
pub enum LoopOutcome {
    /// The loop holds.
    Accepted {
        /// The motion.
        from_from_to: coma_geometry::Pose,
        /// Of the motion, perturbed on the right.
        information: coma_geometry::Matrix6,
        /// What the decision rests on.
        numbers: BTreeMap<String, f64>,
    },
    /// It does not.
    Rejected {
        /// A stable name.
        reason: String,
        /// A plain sentence.
        message: String,
        /// What the decision rests on.
        numbers: BTreeMap<String, f64>,
    },
}

/// An accepted loop is taken back.
#[derive(Clone, Debug, PartialEq)]
pub struct LoopWithdrawn {
    /// Which verdict.
    pub verdict: EntryKey,
    /// Why.
    pub message: String,
}

/// What a solver made of a cut.
#[derive(Clone, Debug, PartialEq)]
pub struct SolveDigest {
    /// Which map.
    pub map_id: MapId,
    /// Entries that went in.
    pub cut: VersionVector,
    /// Of the poses.
    pub digest: Hash,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chain(agent: &str, length: u64, payload: u8) -> Vec<Entry> {
        let mut out: Vec<Entry> = Vec::new();
        for sequence in 0..length {
            out.push(Entry {
                key: EntryKey { agent: AgentId::new(agent).unwrap(), epoch: Epoch(1), sequence },
                previous_hash: out.last().map(Entry::hash),
                payload: vec![payload; sequence as usize],
                signature: vec![],
            });
        }
        out
    }

    #[test]
    fn any_order_and_repetition_ends_in_the_same_replica() {
        let all: Vec<Entry> = chain("a", 6, 1).into_iter().chain(chain("b", 5, 2)).collect();
        let mut forward = Replica::default();
        all.iter().for_each(|e| assert_eq!(forward.offer(e.clone()), Offered::Taken));
        let mut shuffled = Replica::default();
        // Worst order, again and again, until nothing is missing.
        for _ in 0..6 {
            for entry in all.iter().rev() {
                shuffled.offer(entry.clone());
            }
        }
        assert_eq!(forward.heads(), shuffled.heads());
        assert!(forward.entries().eq(shuffled.entries()));
    }

    #[test]
    fn what_is_missing_is_what_the_other_lacks() {
        let mut full = Replica::default();
        chain("a", 6, 1).into_iter().for_each(|e| drop(full.offer(e)));
        let mut partial = Replica::default();
        chain("a", 2, 1).into_iter().for_each(|e| drop(partial.offer(e)));
        let missing: Vec<u64> = full.missing(&partial.heads(), 3).map(|e| e.key.sequence).collect();
        assert_eq!(missing, [2, 3, 4]);
        // One who claims more than there is gets nothing, and no panic.
        let beyond = VersionVector::from([((AgentId::new("a").unwrap(), Epoch(1)), 99)]);
        assert_eq!(full.missing(&beyond, 10).count(), 0);
    }

    #[test]
    fn two_entries_under_one_key_are_a_conflict_and_neither_is_used() {
        let mut replica = Replica::default();
        chain("a", 4, 1).into_iter().for_each(|e| drop(replica.offer(e)));
        let other = chain("a", 4, 9).remove(2);
        let key = other.key.clone();
        assert_eq!(replica.offer(other), Offered::Conflict { key: key.clone() });
        assert_eq!(replica.heads().values().copied().collect::<Vec<_>>(), [2]);
        assert_eq!(replica.conflicts().collect::<Vec<_>>(), [key]);
    }

    #[test]
    fn a_broken_hash_chain_is_a_conflict() {
        let mut replica = Replica::default();
        let mut entries = chain("a", 3, 1);
        entries[1].previous_hash = Some([7; 32]);
        assert_eq!(replica.offer(entries[0].clone()), Offered::Taken);
        assert!(matches!(replica.offer(entries[1].clone()), Offered::Conflict { .. }));
    }
}
