//! Bytes by whom they were for and which message they were.

use serde::{Deserialize, Serialize};

/// Whom bytes were for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TrafficClass {
    /// Another agent, or a service beside another agent.
    Peer,
    /// Membership datagrams.
    Gossip,
    /// One's own place-recognition or dpgo service.
    Local,
    /// Robots, players, gateways.
    Client,
}

impl TrafficClass {
    /// All, those between agents first.
    pub const ALL: [Self; 4] = [Self::Peer, Self::Gossip, Self::Local, Self::Client];

    /// Its name, as in JSON.
    pub fn name(self) -> &'static str {
        match self {
            Self::Peer => "peer",
            Self::Gossip => "gossip",
            Self::Local => "local",
            Self::Client => "client",
        }
    }

    /// The class of a name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|class| class.name() == name)
    }

    /// True for what counts as bytes between agents.
    pub fn is_between_agents(self) -> bool {
        matches!(self, Self::Peer | Self::Gossip)
    }
}

/// Bytes of one kind.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct SentBytes {
    /// For whom.
    pub class: TrafficClass,
    /// Which message; `framing` for what no message accounts for.
    pub message_type: String,
    /// Written to sockets, counted once at the sender.
    pub bytes: u64,
    /// In how many messages.
    pub messages: u64,
}

/// All bytes of a run, discovery and the drain at the end included.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "Vec<SentBytes>", into = "Vec<SentBytes>")]
pub struct Traffic(Vec<SentBytes>);

impl From<Vec<SentBytes>> for Traffic {
    fn from(lines: Vec<SentBytes>) -> Self {
        Self::of(lines)
    }
}

impl From<Traffic> for Vec<SentBytes> {
    fn from(traffic: Traffic) -> Self {
        traffic.0
    }
}

impl Traffic {
    /// Adds up lines of one kind (those of several agents), sorted by class, then message type.
    pub fn of(lines: impl IntoIterator<Item = SentBytes>) -> Self {
        let mut sums = std::collections::BTreeMap::<(TrafficClass, String), (u64, u64)>::new();
        for line in lines {
            let sum = sums.entry((line.class, line.message_type)).or_default();
            *sum = (sum.0.saturating_add(line.bytes), sum.1.saturating_add(line.messages));
        }
        let line =
            |((class, message_type), (bytes, messages))| SentBytes { class, message_type, bytes, messages };
        Traffic(sums.into_iter().map(line).collect())
    }

    /// The sums, sorted by class, then message type.
    pub fn lines(&self) -> &[SentBytes] {
        &self.0
    }

    /// All bytes of a class.
    pub fn total(&self, class: TrafficClass) -> u64 {
        self.0.iter().filter(|line| line.class == class).map(|line| line.bytes).sum()
    }

    /// Everything written between agents, membership included.
    pub fn between_agents(&self) -> u64 {
        self.0.iter().filter(|line| line.class.is_between_agents()).map(|line| line.bytes).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(class: TrafficClass, message_type: &str, bytes: u64) -> SentBytes {
        SentBytes { class, message_type: message_type.into(), bytes, messages: 1 }
    }

    #[test]
    fn lines_of_several_agents_add_up() {
        use TrafficClass::*;
        let traffic =
            Traffic::of([line(Local, "A", 7), line(Peer, "B", 1), line(Peer, "A", 2), line(Peer, "B", 3)]);
        let kinds: Vec<_> =
            traffic.lines().iter().map(|l| (l.class, l.message_type.as_str(), l.bytes)).collect();
        assert_eq!(kinds, [(Peer, "A", 2), (Peer, "B", 4), (Local, "A", 7)]);
        assert_eq!(traffic.lines()[1].messages, 2);
    }

    #[test]
    fn only_peers_and_gossip_are_between_agents() {
        let traffic =
            Traffic::of(TrafficClass::ALL.into_iter().zip([1, 10, 100, 1000]).map(|(c, b)| line(c, "A", b)));
        assert_eq!((traffic.between_agents(), traffic.total(TrafficClass::Client)), (11, 1000));
    }

    #[test]
    fn names_are_those_of_the_json() {
        for class in TrafficClass::ALL {
            assert_eq!(serde_json::to_value(class).unwrap(), class.name());
            assert_eq!(TrafficClass::from_name(class.name()), Some(class));
        }
        assert_eq!(TrafficClass::from_name("Peer"), None);
    }
}
