//! Names: agents, submaps, keyframes, entries.

use crate::field::{At, FieldError, Wire};
use crate::v1;
use coma_geometry::{AgentId, Epoch, KeyframeId, SubmapId};
use coma_slam::log::EntryKey;

impl Wire for AgentId {
    type Message = String;

    fn to_wire(&self) -> String {
        self.as_str().to_owned()
    }

    fn from_wire(text: String, at: &At<'_>) -> Result<Self, FieldError> {
        AgentId::new(&text).map_err(|e| at.refuse(e.to_string()))
    }
}

impl Wire for SubmapId {
    type Message = v1::SubmapId;

    fn to_wire(&self) -> v1::SubmapId {
        v1::SubmapId { agent_id: self.agent.to_wire(), epoch: self.epoch.0, number: self.number }
    }

    fn from_wire(m: v1::SubmapId, at: &At<'_>) -> Result<Self, FieldError> {
        let agent = AgentId::from_wire(m.agent_id, &at.field("agent_id"))?;
        Ok(SubmapId { agent, epoch: Epoch(m.epoch), number: m.number })
    }
}

impl Wire for KeyframeId {
    type Message = v1::KeyframeId;

    fn to_wire(&self) -> v1::KeyframeId {
        v1::KeyframeId { agent_id: self.agent.to_wire(), epoch: self.epoch.0, number: self.number }
    }

    fn from_wire(m: v1::KeyframeId, at: &At<'_>) -> Result<Self, FieldError> {
        let agent = AgentId::from_wire(m.agent_id, &at.field("agent_id"))?;
        Ok(KeyframeId { agent, epoch: Epoch(m.epoch), number: m.number })
    }
}

impl Wire for EntryKey {
    type Message = v1::EntryKey;

    fn to_wire(&self) -> v1::EntryKey {
        v1::EntryKey { agent_id: self.agent.to_wire(), epoch: self.epoch.0, sequence: self.sequence }
    }

    fn from_wire(m: v1::EntryKey, at: &At<'_>) -> Result<Self, FieldError> {
        let agent = AgentId::from_wire(m.agent_id, &at.field("agent_id"))?;
        Ok(EntryKey { agent, epoch: Epoch(m.epoch), sequence: m.sequence })
    }
}
