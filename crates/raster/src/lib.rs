//! Differentiable rendering of 2D Gaussian surfels on the CPU.
//!
//! [`render`] blends surfels front to back (eq. 3 of the CoMA-SLAM paper); [`backward`] takes derivatives of
//! a loss by pixels to derivatives by every surfel parameter and by the camera's pose.
//!
//! The surfel model is that of Huang et al., "2D Gaussian Splatting" (2024): exact intersection of the ray
//! with the surfel's plane, and a screen-space low-pass for surfels that are seen edge-on or from afar.

mod backward;
mod bands;
mod blend;
pub mod ewa;
mod forward;
mod gradient;
mod hit;
mod lanes;
pub mod oracle;
mod parameters;
mod project;
mod reach;
pub mod scene;
mod seen;
mod settings;
mod sort;
mod tiles;

pub use backward::{Gradients, PixelGradients, SurfelGradients, backward};
pub use forward::{Projection, Sorted, Tiled, render, render_only};
pub use seen::seen;
pub use settings::{GrowthTest, Outputs, RenderSettings};

use coma_frame::Image;
use coma_geometry::Pose;
use coma_surfel::SurfelCloud;

/// Surfels of one submap and where they lie.
#[derive(Clone, Copy, Debug)]
pub struct SubmapView<'a> {
    /// In the submap's frame.
    pub surfels: &'a SurfelCloud,
    /// Takes the submap's points to the camera.
    pub camera_from_submap: Pose,
    /// What the surfels' intensity is taken for, one for each, 0..1: for [`Rendering::surface_intensity`] alone. Without
    /// it that of their colour.
    pub intensity: Option<&'a [f32]>,
}

impl<'a> SubmapView<'a> {
    /// With the intensity of the surfels' colours.
    pub fn new(surfels: &'a SurfelCloud, camera_from_submap: Pose) -> Self {
        SubmapView { surfels, camera_from_submap, intensity: None }
    }
}

/// What a camera would see. Images are `[height, width]`; those that were not asked for are empty.
#[derive(Debug)]
pub struct Rendering {
    /// Blended colour over black, 0..1.
    pub color: Image<[f32; 3]>,
    /// Expected depth D / A, metres; 0 where nothing was hit.
    pub depth_m: Image<f32>,
    /// Depth at which half of the light is blocked, metres; 0 where it never is.
    pub median_depth_m: Image<f32>,
    /// Depth of the front surface, metres: the mean over its hits by the eighth power of their alpha; 0 where nothing was
    /// hit. Expected depth is drawn towards the camera, as nearer surfels of one surface hide those behind, and the
    /// planes of discs lie before what is convex; this is not.
    pub surface_depth_m: Image<f32>,
    /// Mean intensity of the front surface's hits by their alpha alone, 0..1. Blended colour at a pixel is mostly that of
    /// the nearest surfel that reaches it, so that what is painted on an inclined surface is drawn away from the camera;
    /// this is not.
    pub surface_intensity: Image<f32>,
    /// Standard deviation of depth within the blend, metres.
    pub depth_spread_m: Image<f32>,
    /// A, 0..1.
    pub opacity: Image<f32>,
    /// Blended unit normal in the camera, facing it; zero where nothing was hit.
    pub normal: Image<[f32; 3]>,
    /// Eq. 5, if observed depth was given: a surfel lies near it, blended or hidden.
    pub near_surface: Option<Image<bool>>,
    /// Blended hits: alpha at least `alpha_min`, before termination.
    pub hits: u64,
    /// What the backward pass needs.
    pub(crate) state: forward::RenderState,
}

/// Side of a tile, pixels.
pub(crate) const TILE: usize = 16;
/// Side of a block, pixels; a row of a tile has as many blocks.
pub(crate) const BLOCK: usize = 4;
/// Blocks of a tile.
pub(crate) const BLOCKS: usize = BLOCK * BLOCK;
/// Pixels of a block.
pub(crate) const LANES: usize = BLOCK * BLOCK;
/// Alpha is kept below 1, so that light that passed is never divided by zero.
pub(crate) const ALPHA_MAX: f32 = 0.999;

/// Where a tile's pixels lie, `[column, row]`, in the order of a tile's images: block by block.
pub(crate) fn tile_pixels() -> impl Iterator<Item = [usize; 2]> {
    (0..TILE * TILE).map(|i| {
        let (block, lane) = (i / LANES, i % LANES);
        [block % BLOCK * BLOCK + lane % BLOCK, block / BLOCK * BLOCK + lane / BLOCK]
    })
}

/// Every instruction set that this processor has and the kernels know; the first is the portable one.
#[cfg(test)]
pub(crate) fn architectures() -> Vec<pulp::Arch> {
    let mut out = vec![pulp::Arch::Scalar];
    #[cfg(target_arch = "x86_64")]
    {
        out.extend(pulp::x86::V3::try_new().map(pulp::Arch::V3));
        out.extend(pulp::x86::V4::try_new().map(pulp::Arch::V4));
    }
    out
}

#[cfg(test)]
mod tests;
