//! What log entries say.

use crate::field::{At, FieldError, Wire, limits};
use crate::log::hash;
use crate::v1::{self, loop_verdict::Outcome, payload::Kind};
use bytes::Bytes;
use coma_geometry::StampNs;
use coma_slam::log::*;
use prost::Message;
use std::collections::BTreeMap;

/// The bytes of a payload, as an entry keeps them. Equal payloads have equal bytes. Sentences are cut to
/// [`limits::SENTENCE`], names to [`limits::NAME`], and numbers that are not finite are left out, so that
/// what is written here can be read by everyone.
pub fn encode_payload(payload: &Payload) -> Vec<u8> {
    payload.to_wire().encode_to_vec()
}

/// Reads and checks a payload. Its fields are named from `payload` on.
pub fn decode_payload(bytes: &[u8]) -> Result<Payload, FieldError> {
    let at = At::Root("payload");
    at.at_most(bytes.len(), limits::PAYLOAD, "bytes")?;
    let message = v1::Payload::decode(bytes).map_err(|e| at.refuse(format!("is no Payload: {e}")))?;
    Payload::from_wire(message, &at)
}

fn cut(text: &str, limit: usize) -> String {
    text[..text.floor_char_boundary(limit)].to_owned()
}

fn writable(numbers: &BTreeMap<String, f64>) -> BTreeMap<String, f64> {
    let finite = numbers.iter().filter(|(_, value)| value.is_finite());
    finite.map(|(name, value)| (cut(name, limits::NAME), *value)).take(limits::NUMBERS).collect()
}

impl Wire for Evidence {
    type Message = v1::Evidence;

    fn to_wire(&self) -> v1::Evidence {
        v1::Evidence { hash: Bytes::copy_from_slice(&self.hash), size_bytes: self.size_bytes }
    }

    fn from_wire(m: v1::Evidence, at: &At<'_>) -> Result<Self, FieldError> {
        Ok(Evidence { hash: hash(&m.hash, &at.field("hash"))?, size_bytes: m.size_bytes })
    }
}

impl Wire for Payload {
    type Message = v1::Payload;

    fn to_wire(&self) -> v1::Payload {
        let kind = match self {
            Payload::AgentStarted(p) => Kind::AgentStarted(v1::AgentStarted {
                anchor_priority: p.anchor_priority,
                build: cut(&p.build, limits::NAME),
            }),
            Payload::SubmapOpened(p) => Kind::SubmapOpened(v1::SubmapOpened {
                id: Some(p.id.to_wire()),
                anchor_frame: p.anchor_frame,
                anchor_stamp_ns: p.anchor_stamp.0,
                agent_from_submap: Some(p.agent_from_submap.to_wire()),
                chain: p.chain,
            }),
            Payload::OdometryEdge(p) => Kind::OdometryEdge(v1::OdometryEdge {
                from: Some(p.from.to_wire()),
                to: Some(p.to.to_wire()),
                from_from_to: Some(p.from_from_to.to_wire()),
                information: Some(p.information.to_wire()),
            }),
            Payload::AnchorDescribed(p) => Kind::AnchorDescribed(v1::AnchorDescribed {
                submap_id: Some(p.submap.to_wire()),
                descriptors: p.descriptors.iter().map(Wire::to_wire).collect(),
                coarse: Some(p.coarse.to_wire()),
                full: Some(p.full.to_wire()),
            }),
            Payload::LoopVerdict(p) => Kind::LoopVerdict(p.to_wire()),
            Payload::LoopWithdrawn(p) => Kind::LoopWithdrawn(v1::LoopWithdrawn {
                verdict: Some(p.verdict.to_wire()),
                message: cut(&p.message, limits::SENTENCE),
            }),
            Payload::SolveDigest(p) => Kind::SolveDigest(v1::SolveDigest {
                map_id: Some(p.map_id.to_wire()),
                cut: Some(p.cut.to_wire()),
                digest: Bytes::copy_from_slice(&p.digest),
            }),
        };
        v1::Payload { kind: Some(kind) }
    }

    fn from_wire(m: v1::Payload, at: &At<'_>) -> Result<Self, FieldError> {
        let Some(kind) = m.kind else {
            return Err(at.field("kind").refuse("is missing or unknown to this version"));
        };
        Ok(match kind {
            Kind::AgentStarted(m) => {
                let at = at.field("agent_started");
                let build = at.field("build").text(m.build, limits::NAME)?;
                Payload::AgentStarted(AgentStarted { anchor_priority: m.anchor_priority, build })
            }
            Kind::SubmapOpened(m) => {
                let at = at.field("submap_opened");
                Payload::SubmapOpened(SubmapOpened {
                    id: at.field("id").required(m.id)?,
                    anchor_frame: m.anchor_frame,
                    anchor_stamp: StampNs(m.anchor_stamp_ns),
                    agent_from_submap: at.field("agent_from_submap").required(m.agent_from_submap)?,
                    chain: m.chain,
                })
            }
            Kind::OdometryEdge(m) => {
                let at = at.field("odometry_edge");
                Payload::OdometryEdge(OdometryEdge {
                    from: at.field("from").required(m.from)?,
                    to: at.field("to").required(m.to)?,
                    from_from_to: at.field("from_from_to").required(m.from_from_to)?,
                    information: at.field("information").required(m.information)?,
                })
            }
            Kind::AnchorDescribed(m) => {
                let at = at.field("anchor_described");
                Payload::AnchorDescribed(AnchorDescribed {
                    submap: at.field("submap_id").required(m.submap_id)?,
                    descriptors: at.field("descriptors").repeated(m.descriptors, limits::DESCRIPTORS)?,
                    coarse: at.field("coarse").required(m.coarse)?,
                    full: at.field("full").required(m.full)?,
                })
            }
            Kind::LoopVerdict(m) => {
                Payload::LoopVerdict(LoopVerdict::from_wire(m, &at.field("loop_verdict"))?)
            }
            Kind::LoopWithdrawn(m) => {
                let at = at.field("loop_withdrawn");
                Payload::LoopWithdrawn(LoopWithdrawn {
                    verdict: at.field("verdict").required(m.verdict)?,
                    message: at.field("message").text(m.message, limits::SENTENCE)?,
                })
            }
            Kind::SolveDigest(m) => {
                let at = at.field("solve_digest");
                Payload::SolveDigest(SolveDigest {
                    map_id: at.field("map_id").required(m.map_id)?,
                    cut: crate::version_vector(m.cut, &at.field("cut"))?,
                    digest: hash(&m.digest, &at.field("digest"))?,
                })
            }
        })
    }
}

impl Wire for LoopVerdict {
    type Message = v1::LoopVerdict;

    fn to_wire(&self) -> v1::LoopVerdict {
        let outcome = match &self.outcome {
            LoopOutcome::Accepted { from_from_to, information, numbers } => {
                Outcome::Accepted(v1::LoopAccepted {
                    from_from_to: Some(from_from_to.to_wire()),
                    information: Some(information.to_wire()),
                    numbers: writable(numbers),
                })
            }
            LoopOutcome::Rejected { reason, message, numbers } => Outcome::Rejected(v1::LoopRejected {
                reason: cut(reason, limits::NAME),
                message: cut(message, limits::SENTENCE),
                numbers: writable(numbers),
            }),
        };
        v1::LoopVerdict {
            from: Some(self.from.to_wire()),
            to: Some(self.to.to_wire()),
            similarity: self.similarity,
            space: cut(&self.space, limits::NAME),
            outcome: Some(outcome),
        }
    }

    fn from_wire(m: v1::LoopVerdict, at: &At<'_>) -> Result<Self, FieldError> {
        if !m.similarity.is_finite() {
            return Err(at.field("similarity").refuse(format!("{} is not finite", m.similarity)));
        }
        let outcome = match m.outcome {
            None => return Err(at.field("outcome").refuse("is missing or unknown to this version")),
            Some(Outcome::Accepted(m)) => {
                let at = at.field("accepted");
                LoopOutcome::Accepted {
                    from_from_to: at.field("from_from_to").required(m.from_from_to)?,
                    information: at.field("information").required(m.information)?,
                    numbers: at.field("numbers").numbers(m.numbers)?,
                }
            }
            Some(Outcome::Rejected(m)) => {
                let at = at.field("rejected");
                LoopOutcome::Rejected {
                    reason: at.field("reason").text(m.reason, limits::NAME)?,
                    message: at.field("message").text(m.message, limits::SENTENCE)?,
                    numbers: at.field("numbers").numbers(m.numbers)?,
                }
            }
        };
        Ok(LoopVerdict {
            from: at.field("from").required(m.from)?,
            to: at.field("to").required(m.to)?,
            similarity: m.similarity,
            space: at.field("space").text(m.space, limits::NAME)?,
            outcome,
        })
    }
}
