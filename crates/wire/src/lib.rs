//! The wire: what the contract in `proto/coma/v1` says, and how its messages become domain types.
//!
//! * [`v1`] is generated from the contract; this is the only crate that knows prost.
//! * [`Wire`] carries a domain type to its message and back. The way back checks everything: a value
//!   that came through is finite, in range, and of bounded size. What is refused is refused with the
//!   path of its field ([`FieldError`]).
//! * [`Limited`] sets the message limit of a generated server or client.

mod camera;
mod evidence;
mod field;
mod frame;
mod full;
mod geometry;
mod id;
mod limited;
mod log;
mod payload;
mod place;
mod submap;

pub use camera::Calibration;
pub use evidence::{EvidenceBlob, decode_evidence, encode_evidence};
pub use field::{At, FieldError, Wire, checked, field_errors_of, invalid, invalid_fields, limits};
pub use frame::{ColorData, DepthData, EncodedFrame, encode_frame, read_color, session_id};
pub use full::{full, is_full};
pub use geometry::finite;
pub use limited::Limited;
pub use log::{entry_from_bytes, entry_to_bytes, hash, version_vector};
pub use payload::{decode_payload, encode_payload};
pub use prost::Message;
pub use submap::packed_surfels;

/// The words of the log that conversions give, for services that know agents by their messages alone.
pub mod entries {
    pub use coma_slam::log::{
        AgentStarted, Entry, EntryKey, Hash, LoopOutcome, LoopVerdict, LoopWithdrawn, OdometryEdge, Payload,
        SolveDigest, SubmapOpened, VersionVector,
    };
}

/// Messages, clients and servers, generated from `proto/coma/v1`.
#[allow(missing_docs, clippy::all, clippy::pedantic)]
pub mod v1 {
    tonic::include_proto!("coma.v1");
}

/// The contract as an encoded `google.protobuf.FileDescriptorSet`, for reflection.
pub const FILE_DESCRIPTOR_SET: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/coma.descriptors.bin"));

/// Peers of another major version are refused.
pub const PROTOCOL_MAJOR: u32 = 1;
/// Grows with every addition; both sides use what both know.
pub const PROTOCOL_MINOR: u32 = 0;
