//! What runs beside the mapping thread: describing places, pulling from peers, verifying, solving.

pub mod peers;
pub mod places;
pub mod solve;
pub mod verify;
