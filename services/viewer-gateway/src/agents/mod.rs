//! The agents: who they are, whether they answer, and what they are asked.

mod calls;
mod directory;
mod events;
mod link;

pub use calls::{PlacedSubmap, Whole, failed};
pub use directory::Directory;
pub use events::LiveEvent;
pub use link::Link;
