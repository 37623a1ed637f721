//! One agent's life as a pure state machine: frames and answers in, events and requests out.
//!
//! Start at [`agent`]: it reads like the paper's figure. [`loop_closure`] is what an agent makes of its own
//! and its peers' places; [`log`] is how agents tell each other.

pub mod agent;
pub mod gaussians;
pub mod log;
pub mod loop_closure;
pub mod mapping;
mod odometry;
pub mod tracking;
