//! The three faces of an agent: to its clients, to its peers, to viewers.

pub mod agent;
pub mod peer;
pub mod viewer;
