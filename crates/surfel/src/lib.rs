//! 2D Gaussian surfels: flat, oriented discs with colour and opacity.

pub mod cloud;
pub mod merge;
pub mod pack;
pub mod ply;

pub use cloud::{Surfel, SurfelCloud};
pub use merge::{Keepers, MergeSettings, Part, merge};
