//! Settings of the renderer.

use crate::{LANES, TILE};
use coma_frame::{DepthNoise, Image};
use serde::{Deserialize, Serialize};

/// How surfels become pixels.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RenderSettings {
    /// Nearer surfels are left out, metres.
    pub near_m: f32,
    /// Fainter hits are left out (3D Gaussian Splatting: 1/255).
    pub alpha_min: f32,
    /// A pixel is done when less light than this passes.
    pub transmittance_min: f32,
    /// Standard deviation of the screen-space low-pass, pixels (2D Gaussian Splatting: sqrt(2)/2).
    pub low_pass_px: f32,
}

impl Default for RenderSettings {
    fn default() -> Self {
        RenderSettings {
            near_m: 0.05,
            alpha_min: 1.0 / 255.0,
            transmittance_min: 1e-4,
            low_pass_px: std::f32::consts::FRAC_1_SQRT_2,
        }
    }
}

/// Eq. 5 in the blending pass: is a surfel of the blend near the observed depth?
#[derive(Clone, Copy, Debug)]
pub struct GrowthTest<'a> {
    /// Of the camera's size; 0 = no measurement (never near).
    pub observed_depth_m: &'a Image<f32>,
    /// How wrong it is.
    pub noise: DepthNoise,
    /// Near is within so many sigma(z) ...
    pub sigma_factor: f32,
    /// ... or within this share of the depth.
    pub relative: f32,
}

/// Observed depth and tolerance of one tile's pixels.
pub(crate) struct ObservedTile {
    pub depth: [f32; LANES],
    pub tolerance: [f32; LANES],
}

impl GrowthTest<'_> {
    pub(crate) fn tile(&self, x0: usize, y0: usize) -> ObservedTile {
        let mut out = ObservedTile { depth: [0.0; LANES], tolerance: [-1.0; LANES] };
        for lane in 0..LANES {
            let depth = self.observed_depth_m.get(x0 + lane % TILE, y0 + lane / TILE).copied().unwrap_or(0.0);
            if depth > 0.0 {
                out.depth[lane] = depth;
                out.tolerance[lane] =
                    (self.sigma_factor * self.noise.sigma_m(depth)).max(self.relative * depth);
            }
        }
        out
    }
}
