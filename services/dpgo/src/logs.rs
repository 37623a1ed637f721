//! The logs of one graph: contiguous per agent and epoch, each entry's hash, and what the entries say.

use crate::facts::{Fact, Graph, Life};
use coma_pose_graph::EdgeKey;
use coma_wire::entries::{Entry, Hash, VersionVector};
use coma_wire::limits;
use std::collections::BTreeMap;

#[derive(Debug, Default)]
struct Log {
    /// Of every entry, by sequence.
    hashes: Vec<Hash>,
    /// What the entries say, by sequence; entries that say nothing of the graph have none.
    facts: Vec<(u64, Fact)>,
    /// From here on nothing is used: two entries had this key, or the chain of hashes broke.
    forked_at: Option<(u64, &'static str)>,
}

impl Log {
    fn length(&self) -> u64 {
        self.hashes.len() as u64
    }
}

/// How much the logs of one graph may hold.
#[derive(Clone, Copy, Debug)]
pub struct Room {
    /// Entries of any kind.
    pub entries: usize,
    /// Entries that say something of the graph.
    pub facts: usize,
}

/// Why an entry found no room: the limit's name and value.
#[derive(Debug, PartialEq, Eq)]
pub struct Full {
    /// What there are too many of.
    pub what: &'static str,
    /// The limit.
    pub limit: usize,
}

/// A log that is shorter than was asked for.
#[derive(Debug, PartialEq, Eq)]
pub struct Lacking {
    /// Whose log.
    pub life: Life,
    /// Its length here.
    pub have: u64,
    /// The length asked for.
    pub needed: u64,
    /// Where it forked, if it did: it will not grow.
    pub forked_at: Option<u64>,
}

/// The logs of one graph.
#[derive(Debug, Default)]
pub struct Logs {
    logs: BTreeMap<Life, Log>,
    entries: usize,
    facts: usize,
    version: u64,
}

impl Logs {
    /// Takes an entry if it is the next of its log. One that is known changes nothing, one beyond a gap is left
    /// (see [`Logs::have`]); a different one under a known key, or one whose `previous_hash` does not fit, ends
    /// the log there.
    pub fn offer(&mut self, entry: &Entry, room: Room) -> Result<(), Full> {
        let life = (entry.key.agent.clone(), entry.key.epoch);
        if !self.logs.contains_key(&life) && self.logs.len() >= limits::LOGS {
            return Err(Full { what: "logs", limit: limits::LOGS });
        }
        let log = self.logs.entry(life).or_default();
        let sequence = entry.key.sequence;
        if log.forked_at.is_some_and(|(fork, _)| sequence >= fork) || sequence > log.length() {
            return Ok(());
        }
        let hash = entry.hash();
        if let Some(known) = log.hashes.get(sequence as usize) {
            if *known != hash {
                self.version += 1;
                log.forked_at = Some((sequence, "two different entries have this key"));
                self.entries -= log.hashes.len() - sequence as usize;
                log.hashes.truncate(sequence as usize);
                let kept = log.facts.partition_point(|(at, _)| *at < sequence);
                self.facts -= log.facts.len() - kept;
                log.facts.truncate(kept);
            }
            return Ok(());
        }
        if entry.previous_hash != log.hashes.last().copied() {
            self.version += 1;
            log.forked_at = Some((sequence, "its previous_hash is not that of the entry before it"));
            return Ok(());
        }
        if self.entries >= room.entries {
            return Err(Full { what: "max_entries_per_graph", limit: room.entries });
        }
        if let Some(fact) = Fact::of(entry) {
            if self.facts >= room.facts {
                return Err(Full { what: "max_facts_per_graph", limit: room.facts });
            }
            self.version += 1;
            self.facts += 1;
            log.facts.push((sequence, fact));
        }
        self.entries += 1;
        log.hashes.push(hash);
        Ok(())
    }

    /// Changes whenever something that a solve takes changes.
    pub fn version(&self) -> u64 {
        self.version
    }

    /// The length of every log.
    pub fn have(&self) -> VersionVector {
        let held = self.logs.iter().filter(|(_, log)| !log.hashes.is_empty());
        held.map(|(life, log)| (life.clone(), log.length())).collect()
    }

    /// The first log that is shorter than in `at_least`.
    pub fn lacking(&self, at_least: &VersionVector) -> Option<Lacking> {
        at_least.iter().find_map(|(life, &needed)| {
            let log = self.logs.get(life);
            let have = log.map_or(0, Log::length);
            let forked_at = log.and_then(|log| Some(log.forked_at?.0));
            (have < needed).then(|| Lacking { life: life.clone(), have, needed, forked_at })
        })
    }

    /// Everything that the logs say.
    pub fn graph(&self) -> Graph {
        let facts = self.logs.iter().flat_map(|((agent, epoch), log)| {
            log.facts.iter().map(|(sequence, fact)| {
                (EdgeKey { agent: agent.clone(), epoch: *epoch, sequence: *sequence }, fact)
            })
        });
        let mut graph = Graph::of(facts);
        for ((agent, epoch), log) in &self.logs {
            if let Some((sequence, reason)) = log.forked_at {
                let key = EdgeKey { agent: agent.clone(), epoch: *epoch, sequence };
                graph.rejected.push((key, format!("{reason}: it is not used, nor what follows in this log")));
            }
        }
        graph
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_geometry::{AgentId, Epoch};
    use coma_wire::entries::{AgentStarted, EntryKey, Payload};

    const ROOM: Room = Room { entries: 100, facts: 100 };

    fn chain(length: u64, build: &str) -> Vec<Entry> {
        let mut out: Vec<Entry> = Vec::new();
        for sequence in 0..length {
            let started = AgentStarted { anchor_priority: 7, build: build.into() };
            out.push(Entry {
                key: EntryKey { agent: AgentId::new("a").unwrap(), epoch: Epoch(1), sequence },
                previous_hash: out.last().map(Entry::hash),
                payload: coma_wire::encode_payload(&Payload::AgentStarted(started)),
                signature: Vec::new(),
            });
        }
        out
    }

    fn lengths(logs: &Logs) -> Vec<u64> {
        logs.have().into_values().collect()
    }

    #[test]
    fn a_gap_is_not_passed_and_repetition_changes_nothing() {
        let entries = chain(4, "x");
        let mut logs = Logs::default();
        logs.offer(&entries[0], ROOM).unwrap();
        logs.offer(&entries[2], ROOM).unwrap();
        assert_eq!(lengths(&logs), [1]);
        entries.iter().for_each(|e| logs.offer(e, ROOM).unwrap());
        let version = logs.version();
        entries.iter().for_each(|e| logs.offer(e, ROOM).unwrap());
        assert_eq!((lengths(&logs), logs.version()), (vec![4], version));
        let life = (AgentId::new("a").unwrap(), Epoch(1));
        let lacking = logs.lacking(&VersionVector::from([(life.clone(), 5)]));
        assert_eq!(lacking, Some(Lacking { life, have: 4, needed: 5, forked_at: None }));
    }

    #[test]
    fn two_entries_under_one_key_end_the_log_there() {
        let mut logs = Logs::default();
        chain(4, "x").iter().for_each(|e| logs.offer(e, ROOM).unwrap());
        logs.offer(&chain(3, "y")[0], ROOM).unwrap();
        assert_eq!(lengths(&logs), [0; 0]);
        chain(4, "x").iter().for_each(|e| logs.offer(e, ROOM).unwrap());
        assert_eq!(lengths(&logs), [0; 0], "a forked log does not grow again");
        let rejected = logs.graph().rejected;
        assert!(rejected.len() == 1 && rejected[0].1.contains("two different"), "{rejected:?}");
    }

    #[test]
    fn a_broken_chain_of_hashes_ends_the_log() {
        let mut entries = chain(3, "x");
        entries[1].previous_hash = Some([3; 32]);
        let mut logs = Logs::default();
        entries.iter().for_each(|e| logs.offer(e, ROOM).unwrap());
        assert_eq!(lengths(&logs), [1]);
        assert!(logs.graph().rejected[0].1.contains("previous_hash"));
    }

    #[test]
    fn a_full_graph_says_which_limit_it_is() {
        let mut logs = Logs::default();
        let entries = chain(3, "x");
        let small = Room { entries: 2, facts: 100 };
        let offered: Vec<_> = entries.iter().map(|e| logs.offer(e, small)).collect();
        assert_eq!(offered[1], Ok(()));
        assert_eq!(offered[2], Err(Full { what: "max_entries_per_graph", limit: 2 }));
        assert_eq!(lengths(&logs), [2]);
    }
}
