//! What listeners are told as it happens.

use super::calls::PlacedSubmap;
use crate::json::{self, Component, FramePose};
use coma_wire::entries::{LoopOutcome, LoopVerdict};
use coma_wire::v1::watch_response::Event;
use coma_wire::{At, FieldError, Wire};
use serde::Serialize;
use utoipa::ToSchema;

/// One live event; `type` names its kind.
#[derive(Clone, Debug, Serialize, ToSchema)]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum LiveEvent {
    /// Something was missed, or could not be known before: get the states again.
    Again {},
    /// An agent came, went, or changed its state: get the agents again.
    Agents {},
    /// A frame was tracked.
    Pose {
        /// Whose.
        agent: String,
        /// Where its camera is.
        pose: FramePose,
    },
    /// A submap was closed.
    Submap {
        /// The submap.
        submap: json::Submap,
    },
    /// The map was corrected: every submap of a component at once.
    Correction {
        /// The component.
        component: Component,
    },
    /// Two places were compared.
    Verdict {
        /// `agent/epoch/s0`.
        from: String,
        /// `agent/epoch/s0`.
        to: String,
        /// They are the same place, and how they stand to each other is known.
        accepted: bool,
        /// A stable name, where it was rejected.
        reason: Option<String>,
        /// Why it was rejected, as a sentence.
        message: Option<String>,
    },
}

impl LiveEvent {
    /// The name under which it is sent.
    pub fn kind(&self) -> &'static str {
        match self {
            LiveEvent::Again {} => "again",
            LiveEvent::Agents {} => "agents",
            LiveEvent::Pose { .. } => "pose",
            LiveEvent::Submap { .. } => "submap",
            LiveEvent::Correction { .. } => "correction",
            LiveEvent::Verdict { .. } => "verdict",
        }
    }
}

/// Reads an agent's event.
pub fn live_event(event: Event) -> Result<LiveEvent, FieldError> {
    Ok(match event {
        Event::Pose(pose) => {
            let pose = FramePose::read(pose, &At::Root("pose"))?;
            let agent = pose.submap.split('/').next().unwrap_or_default().to_owned();
            LiveEvent::Pose { agent, pose }
        }
        Event::Submap(info) => {
            LiveEvent::Submap { submap: PlacedSubmap::read(info, &At::Root("submap"))?.json() }
        }
        Event::Correction(component) => {
            LiveEvent::Correction { component: Component::read(component, &At::Root("correction"))?.0 }
        }
        Event::Verdict(verdict) => {
            let verdict = LoopVerdict::from_wire(verdict, &At::Root("verdict"))?;
            let (accepted, reason, message) = match verdict.outcome {
                LoopOutcome::Accepted { .. } => (true, None, None),
                LoopOutcome::Rejected { reason, message, .. } => (false, Some(reason), Some(message)),
            };
            let (from, to) = (verdict.from.to_string(), verdict.to.to_string());
            LiveEvent::Verdict { from, to, accepted, reason, message }
        }
    })
}
