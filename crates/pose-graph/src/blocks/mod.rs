//! Block by block: a graph that no agent holds whole (Riemannian block-coordinate descent, Tian et al., T-RO 2021).
//!
//! Each agent has a [`Block`]: its own nodes, the measurements among them, and those to nodes of others. It minimises
//! over its own nodes while what it has last heard of its neighbours' stays fixed, and says where its boundary nodes
//! are now. That is all that agents tell each other: a [`Boundary`] holds the whole state that its reader needs, under a
//! sequence number, so that loss, delay, repetition and disorder cost time and nothing else. No agent waits for another.
//!
//! * [`cut`]: blocks of a problem.
//! * [`agent`]: one agent's state machine: messages in, messages out.
//! * [`grid`], [`field`]: smooth motions of the whole map, so that what is far apart need not wait for what lies between.
//!   [`coarse`]: the rounds in which all blocks come to move by one.
//! * [`message`]: what they say. [`stillness`]: how they come to know that there is nothing left to say.
//! * [`own`]: one agent's block of a graph that is known from log entries, with the trust that each loop deserves.
//! * [`simulation`]: many agents in one process, over a network that loses and delays.

pub mod agent;
pub mod coarse;
pub mod cut;
pub mod field;
pub mod grid;
mod local;
pub mod message;
pub mod own;
pub mod simulation;
pub mod stillness;

pub use agent::{BlockAgent, BlockSettings};
pub use cut::{Block, BlockEdge, blocks};
pub use message::Boundary;
pub use own::OwnBlock;
pub use simulation::{Network, Simulation, Traffic};
pub use stillness::{Standing, Stillness};

/// The number of a block.
pub type BlockId = u32;
/// A node, by its index in the whole problem.
pub type NodeId = u32;
