//! 3D Gaussians in place of surfels, to compare with: EWA splatting (Zwicker et al. 2001) as in Kerbl et al. 2023,
//! "3D Gaussian Splatting for real-time radiance field rendering", with gradients of its own.
//!
//! A plain path: no SIMD, bounding boxes instead of exact tiles. Its speed says nothing of 3D Gaussians.

mod backward;
mod cloud;
mod forward;
pub mod oracle;
mod project;

pub use backward::{GaussianGradients, backward};
pub use cloud::{Gaussian, GaussianCloud};
pub use forward::{Picture, render};

use coma_geometry::Pose;

/// Gaussians and where they lie.
#[derive(Clone, Copy, Debug)]
pub struct GaussianView<'a> {
    /// In their submap's frame.
    pub gaussians: &'a GaussianCloud,
    /// Takes the submap's points to the camera.
    pub camera_from_submap: Pose,
}

/// Variance that is added to every splat, pixels squared (3D Gaussian Splatting's 0.3): none is smaller than a pixel.
pub(crate) const LOW_PASS_PX2: f32 = 0.3;
/// Centres farther outside the picture than this share of its half size are left out: the projection is taken as linear
/// about the centre, which is far from true there.
pub(crate) const OUTSIDE: f64 = 1.3;
