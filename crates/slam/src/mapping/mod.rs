//! What does the camera see? Surfels are seeded, grown, optimised and pruned.

mod even;
pub mod fuse;
pub mod growth;
pub mod inherit;
pub mod optimise;
pub mod refine;
pub mod seed;
pub mod ssim;
pub mod submap;
mod unfitted;
