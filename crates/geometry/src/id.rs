//! Identifiers. An id has a type: a submap is never a bare `u32`.

use serde::{Deserialize, Serialize};
use std::fmt;
use std::sync::Arc;

/// The name of an agent, unique in its cluster: 1 to 64 characters of `a-z`, `0-9` and `-`, starting
/// with a letter or digit (so that it can be a DNS label and a certificate's name).
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct AgentId(Arc<str>);

/// Why a text is no [`AgentId`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("agent id {text:?} must be 1 to 64 characters of a-z, 0-9 and '-', starting with a letter or digit")]
pub struct InvalidAgentId {
    /// The refused text, cut to 80 characters.
    pub text: String,
}

impl AgentId {
    /// Parses and checks a name.
    pub fn new(text: &str) -> Result<Self, InvalidAgentId> {
        let allowed = |c: u8| c.is_ascii_lowercase() || c.is_ascii_digit() || c == b'-';
        let ok = (1..=64).contains(&text.len()) && text.bytes().all(allowed) && !text.starts_with('-');
        if ok {
            Ok(AgentId(text.into()))
        } else {
            Err(InvalidAgentId { text: text.chars().take(80).collect() })
        }
    }

    /// The name's text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl TryFrom<String> for AgentId {
    type Error = InvalidAgentId;
    fn try_from(text: String) -> Result<Self, InvalidAgentId> {
        AgentId::new(&text)
    }
}

impl From<AgentId> for String {
    fn from(id: AgentId) -> String {
        id.0.to_string()
    }
}

impl std::str::FromStr for AgentId {
    type Err = InvalidAgentId;
    fn from_str(text: &str) -> Result<Self, InvalidAgentId> {
        AgentId::new(text)
    }
}

impl fmt::Display for AgentId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl fmt::Debug for AgentId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// Counts the lives of an agent's data folder: an agent that starts without its disk takes a new one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Epoch(pub u64);

/// A submap: `number` counts from 0 within one epoch of one agent.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct SubmapId {
    /// Whose submap.
    pub agent: AgentId,
    /// In which life of that agent.
    pub epoch: Epoch,
    /// Counted from 0.
    pub number: u32,
}

impl fmt::Display for SubmapId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}/s{}", self.agent, self.epoch.0, self.number)
    }
}

impl fmt::Debug for SubmapId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// The name of a map: its gauge agent and epoch, and, for a part of an agent's run that has lost contact with the
/// beginning, the number of that part's first submap (otherwise 0). The map's frame is this submap's.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct MapId {
    /// The gauge agent.
    pub agent: AgentId,
    /// In which life.
    pub epoch: Epoch,
    /// Number of the submap whose frame is the map's.
    pub first_submap: u32,
}

/// Why a text is no [`MapId`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{text:?} is no map: agent/epoch or agent/epoch/s and the number of its first submap is needed")]
pub struct InvalidMapId {
    /// The refused text, cut to 100 characters.
    pub text: String,
}

impl MapId {
    /// The map whose frame is this submap's.
    pub fn of(gauge: &SubmapId) -> Self {
        MapId { agent: gauge.agent.clone(), epoch: gauge.epoch, first_submap: gauge.number }
    }

    /// The submap whose frame is the map's.
    pub fn gauge(&self) -> SubmapId {
        SubmapId { agent: self.agent.clone(), epoch: self.epoch, number: self.first_submap }
    }
}

/// `agent/epoch`, and `agent/epoch/s7` where the first submap is not 0.
impl fmt::Display for MapId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.agent, self.epoch.0)?;
        if self.first_submap == 0 { Ok(()) } else { write!(f, "/s{}", self.first_submap) }
    }
}

impl fmt::Debug for MapId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// Undoes [`fmt::Display`].
impl std::str::FromStr for MapId {
    type Err = InvalidMapId;
    fn from_str(text: &str) -> Result<Self, InvalidMapId> {
        let refuse = || InvalidMapId { text: text.chars().take(100).collect() };
        let (agent, rest) = text.split_once('/').ok_or_else(refuse)?;
        let (epoch, first_submap) = match rest.split_once("/s") {
            Some((epoch, number)) => (epoch, number.parse().map_err(|_| refuse())?),
            None => (rest, 0),
        };
        Ok(MapId {
            agent: agent.parse().map_err(|_| refuse())?,
            epoch: Epoch(epoch.parse().map_err(|_| refuse())?),
            first_submap,
        })
    }
}

/// A keyframe: `number` counts from 0 within one epoch of one agent.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct KeyframeId {
    /// Whose keyframe.
    pub agent: AgentId,
    /// In which life of that agent.
    pub epoch: Epoch,
    /// Counted from 0.
    pub number: u32,
}

impl fmt::Display for KeyframeId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}/k{}", self.agent, self.epoch.0, self.number)
    }
}

impl fmt::Debug for KeyframeId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn agent_ids_are_dns_labels() {
        assert!(AgentId::new("agent-00").is_ok());
        for bad in ["", "-x", "Agent", "a/b", "ä", &"x".repeat(65)] {
            assert!(AgentId::new(bad).is_err(), "{bad:?}");
        }
    }

    #[test]
    fn a_map_is_named_by_agent_and_epoch_and_by_its_first_submap_where_there_are_several() {
        let submap = SubmapId { agent: AgentId::new("a").unwrap(), epoch: Epoch(2), number: 0 };
        let map = MapId::of(&submap);
        let part = MapId::of(&SubmapId { number: 7, ..submap });
        assert_eq!((map.to_string(), part.to_string()), ("a/2".into(), "a/2/s7".into()));
        assert_eq!(("a/2".parse(), "a/2/s7".parse()), (Ok(map), Ok(part)));
        for bad in ["", "a", "a/", "a/x", "/2", "a/2/", "a/2/7", "a/2/s", "a/2/s-1", "A/2"] {
            assert!(bad.parse::<MapId>().is_err(), "{bad:?}");
        }
    }

    #[test]
    fn submap_ids_sort_by_agent_then_epoch_then_number() {
        let id = |a: &str, e, n| SubmapId { agent: AgentId::new(a).unwrap(), epoch: Epoch(e), number: n };
        assert!(
            id("a", 9, 9) < id("b", 0, 0) && id("a", 0, 9) < id("a", 1, 0) && id("a", 1, 0) < id("a", 1, 1)
        );
    }
}
