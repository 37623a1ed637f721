//! What an agent keeps on disk, so that what it acknowledged survives a kill at any moment.
//!
//! - [`AppendLog`]: records appended to segment files, each durable before its append returns;
//! - [`Blobs`]: evidence and submaps under the hash of their content, within a budget;
//! - [`Identity`]: who the agent is, and the lock that keeps a second process out of its folder.
//!
//! Everything here blocks on the disk: callers in an async program use a thread of their own.
mod blobs;
mod durable;
mod frame;
mod identity;
mod log;
mod segment;

pub use blobs::{BlobError, BlobName, BlobSettings, Blobs, InvalidBlobName};
pub use identity::{Identity, IdentityError};
pub use log::{AppendLog, LogError, LogLimits, Record, Records, Recovery};
