//! Log entries and version vectors.

use crate::field::{At, FieldError, Wire, limits};
use crate::v1;
use bytes::Bytes;
use coma_geometry::{AgentId, Epoch, MapId};
use coma_slam::log::{Entry, EntryKey, Hash, VersionVector};
use prost::Message;

/// A blake3 hash: 32 bytes.
pub fn hash(bytes: &[u8], at: &At<'_>) -> Result<Hash, FieldError> {
    bytes.try_into().map_err(|_| at.refuse(format!("{} bytes, 32 are needed", bytes.len())))
}

/// A version vector; absent means that nothing is known.
pub fn version_vector(message: Option<v1::VersionVector>, at: &At<'_>) -> Result<VersionVector, FieldError> {
    Ok(at.optional(message)?.unwrap_or_default())
}

impl Wire for MapId {
    type Message = v1::MapId;

    fn to_wire(&self) -> v1::MapId {
        v1::MapId { agent_id: self.agent.to_wire(), epoch: self.epoch.0, first_submap: self.first_submap }
    }

    fn from_wire(m: v1::MapId, at: &At<'_>) -> Result<Self, FieldError> {
        let agent = AgentId::from_wire(m.agent_id, &at.field("agent_id"))?;
        Ok(MapId { agent, epoch: Epoch(m.epoch), first_submap: m.first_submap })
    }
}

impl Wire for VersionVector {
    type Message = v1::VersionVector;

    fn to_wire(&self) -> v1::VersionVector {
        let head = |((agent, epoch), length): (&(AgentId, Epoch), &u64)| v1::LogHead {
            agent_id: agent.to_wire(),
            epoch: epoch.0,
            length: *length,
        };
        v1::VersionVector { heads: self.iter().map(head).collect() }
    }

    fn from_wire(m: v1::VersionVector, at: &At<'_>) -> Result<Self, FieldError> {
        let at = at.field("heads");
        at.at_most(m.heads.len(), limits::LOGS, "logs")?;
        let mut out = VersionVector::new();
        for (i, head) in m.heads.into_iter().enumerate() {
            let at = at.index(i);
            let agent = AgentId::from_wire(head.agent_id, &at.field("agent_id"))?;
            if out.insert((agent, Epoch(head.epoch)), head.length).is_some() {
                return Err(at.refuse("names a log that was named before"));
            }
        }
        Ok(out)
    }
}

impl Wire for Entry {
    type Message = v1::Entry;

    fn to_wire(&self) -> v1::Entry {
        v1::Entry {
            key: Some(self.key.to_wire()),
            previous_hash: self.previous_hash.map_or_else(Bytes::new, |h| Bytes::copy_from_slice(&h)),
            payload: Bytes::copy_from_slice(&self.payload),
            signature: Bytes::copy_from_slice(&self.signature),
        }
    }

    /// The payload is not looked into: it may be of a kind that only newer agents know.
    fn from_wire(m: v1::Entry, at: &At<'_>) -> Result<Self, FieldError> {
        let key: EntryKey = at.field("key").required(m.key)?;
        let previous = at.field("previous_hash");
        let previous_hash = match (key.sequence, m.previous_hash.is_empty()) {
            (0, true) => None,
            (0, false) => return Err(previous.refuse("must be empty in sequence 0")),
            _ => Some(hash(&m.previous_hash, &previous)?),
        };
        at.field("payload").at_most(m.payload.len(), limits::PAYLOAD, "bytes")?;
        at.field("signature").at_most(m.signature.len(), limits::SIGNATURE, "bytes")?;
        Ok(Entry { key, previous_hash, payload: m.payload.to_vec(), signature: m.signature.to_vec() })
    }
}

/// An entry as it is kept on disk: its message, encoded.
pub fn entry_to_bytes(entry: &Entry) -> Vec<u8> {
    entry.to_wire().encode_to_vec()
}

/// Reads an entry that was kept on disk.
pub fn entry_from_bytes(bytes: &[u8]) -> Result<Entry, FieldError> {
    let at = At::Root("entry");
    let message = v1::Entry::decode(bytes).map_err(|e| at.refuse(format!("cannot be decoded: {e}")))?;
    Entry::from_wire(message, &at)
}
