//! Every byte that is written to a socket, by class, and what of it was which message.
//!
//! Bytes are counted once, at the sender. The totals come from the sockets themselves (below TLS and
//! HTTP/2), the shares of message types from the gRPC bodies; what is left over is `framing`.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard};

/// Whom bytes were meant for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Class {
    /// Another agent, or a service that another agent's machine runs.
    Peer,
    /// One's own place-recognition or dpgo service.
    Local,
    /// Robots, players, gateways.
    Client,
    /// Membership datagrams.
    Gossip,
}

impl Class {
    /// Its name in reports and in `ByteCount.class`.
    pub fn name(self) -> &'static str {
        match self {
            Class::Peer => "peer",
            Class::Local => "local",
            Class::Client => "client",
            Class::Gossip => "gossip",
        }
    }
}

/// The message type of what no message accounts for: HTTP/2 frames and headers, TLS records.
pub const FRAMING: &str = "framing";

/// One line of a snapshot.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sent {
    /// For whom.
    pub class: Class,
    /// Which message (`PullEntriesResponse`), or [`FRAMING`].
    pub message_type: String,
    /// How many bytes.
    pub bytes: u64,
    /// In how many messages; 0 for framing.
    pub messages: u64,
}

#[derive(Default)]
struct Counts {
    socket_bytes: u64,
    messages: BTreeMap<String, (u64, u64)>,
}

impl Counts {
    fn add(&mut self, other: &Counts) {
        self.socket_bytes += other.socket_bytes;
        for (name, (bytes, messages)) in &other.messages {
            let sum = self.messages.entry(name.clone()).or_default();
            sum.0 += bytes;
            sum.1 += messages;
        }
    }
}

#[derive(Default)]
struct State {
    next: u64,
    open: BTreeMap<u64, (Class, Counts)>,
    closed: BTreeMap<Class, Counts>,
}

/// One process's (or one agent's) account. Clones share it.
#[derive(Clone, Default)]
pub struct ByteLedger(Arc<Mutex<State>>);

impl std::fmt::Debug for ByteLedger {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("ByteLedger").field(&self.snapshot()).finish()
    }
}

impl ByteLedger {
    fn state(&self) -> MutexGuard<'_, State> {
        // Counters stay meaningful whatever panicked while they were held.
        self.0.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    /// A new account for one connection (or one channel, or one socket).
    pub fn open(&self, class: Class) -> Tally {
        let mut state = self.state();
        let id = state.next;
        state.next += 1;
        state.open.insert(id, (class, Counts::default()));
        Tally(Arc::new(OpenTally { ledger: self.clone(), id }))
    }

    /// What was sent so far, by class and message type. Per class, the lines sum to what its sockets took.
    pub fn snapshot(&self) -> Vec<Sent> {
        let mut sums: BTreeMap<Class, Counts> = BTreeMap::new();
        let state = self.state();
        let open = state.open.values().map(|(class, counts)| (class, counts));
        for (class, counts) in state.closed.iter().chain(open) {
            sums.entry(*class).or_default().add(counts);
        }
        drop(state);
        let mut out = Vec::new();
        for (class, counts) in sums {
            let mut in_messages = 0;
            for (message_type, (bytes, messages)) in counts.messages {
                in_messages += bytes;
                out.push(Sent { class, message_type, bytes, messages });
            }
            // A message is counted when it is handed to the connection, a little before the socket has it.
            let bytes = counts.socket_bytes.saturating_sub(in_messages);
            if bytes > 0 {
                out.push(Sent { class, message_type: FRAMING.into(), bytes, messages: 0 });
            }
        }
        out
    }

    /// All bytes that a class's sockets took.
    pub fn total(&self, class: Class) -> u64 {
        let state = self.state();
        let open = state.open.values().filter(|(c, _)| *c == class).map(|(_, counts)| counts);
        open.chain(state.closed.get(&class)).map(|counts| counts.socket_bytes).sum()
    }
}

struct OpenTally {
    ledger: ByteLedger,
    id: u64,
}

impl Drop for OpenTally {
    fn drop(&mut self) {
        let mut state = self.ledger.state();
        if let Some((class, counts)) = state.open.remove(&self.id) {
            state.closed.entry(class).or_default().add(&counts);
        }
    }
}

/// The account of one connection. Clones share it.
#[derive(Clone)]
pub struct Tally(Arc<OpenTally>);

impl std::fmt::Debug for Tally {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Tally({})", self.0.id)
    }
}

impl Tally {
    fn with(&self, change: impl FnOnce(&mut (Class, Counts))) {
        if let Some(open) = self.0.ledger.state().open.get_mut(&self.0.id) {
            change(open);
        }
    }

    /// Books this connection under another class: what it sent before as well.
    pub fn set_class(&self, class: Class) {
        self.with(|open| open.0 = class);
    }

    /// The socket took so many bytes.
    pub fn add_socket(&self, bytes: u64) {
        self.with(|open| open.1.socket_bytes += bytes);
    }

    /// Of these, so many were of a message type.
    pub fn add_message(&self, message_type: &str, bytes: u64, messages: u64) {
        self.with(|open| match open.1.messages.get_mut(message_type) {
            Some(sum) => *sum = (sum.0 + bytes, sum.1 + messages),
            None => drop(open.1.messages.insert(message_type.to_owned(), (bytes, messages))),
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_of_a_class_sum_to_its_sockets() {
        let ledger = ByteLedger::default();
        let (a, b) = (ledger.open(Class::Client), ledger.open(Class::Peer));
        a.add_socket(100);
        a.add_message("FrameAck", 60, 2);
        b.add_socket(10);
        // It said hello: what it sent before was for a peer too.
        a.set_class(Class::Peer);
        drop(a);
        assert_eq!((ledger.total(Class::Peer), ledger.total(Class::Client)), (110, 0));
        let line = |message_type: &str, bytes, messages| Sent {
            class: Class::Peer,
            message_type: message_type.into(),
            bytes,
            messages,
        };
        assert_eq!(ledger.snapshot(), [line("FrameAck", 60, 2), line(FRAMING, 50, 0)]);
    }
}
