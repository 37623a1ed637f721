//! What every process of the cluster needs, once: settings, logs, servers, channels, byte counting,
//! membership, metrics and an orderly end.
//!
//! * [`config::load`] reads a TOML file and environment overrides into a settings struct.
//! * [`server::Bound`] binds a gRPC server and serves it behind one stack of layers: byte counts,
//!   authorization, admission, deadlines; health and reflection included; TLS by setting.
//! * [`client::channel`] makes a channel with the same care from the other end.
//! * [`ledger::ByteLedger`] counts what is written to sockets, by class and message type.
//! * [`membership::Membership`] finds the other agents.

mod around;
mod auth;
mod deadline;
mod meter;
mod socket;

pub mod client;
pub mod config;
pub mod connection;
pub mod ledger;
pub mod logging;
pub mod membership;
pub mod metrics;
pub mod secret;
pub mod server;
pub mod shutdown;
pub mod tls;

pub use client::{Channel, ChannelError, ClientSettings, channel};
pub use config::{ConfigError, load};
pub use connection::Connection;
pub use ledger::{ByteLedger, Class, Sent};
pub use logging::{LogFormat, LogSettings};
pub use membership::{Member, Membership, MembershipSettings};
pub use secret::Secret;
pub use server::{Bound, Handle, ServeError, ServerSettings, Services};
pub use tls::{ClientTls, ServerTls};
pub use tokio_util::sync::CancellationToken;

/// Every frame takes and frees pictures of some megabytes. The system's allocator hands them back to the kernel each
/// time and gets them as zeroed pages again; this one keeps them for a moment.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;
