//! Settings of the renderer.

use crate::TILE;
use crate::blend::TileImage;
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
    /// Hits that lie within this share of the depth are one surface (for the surface depth).
    pub surface_relative: f32,
}

impl Default for RenderSettings {
    fn default() -> Self {
        RenderSettings {
            near_m: 0.05,
            alpha_min: 1.0 / 255.0,
            transmittance_min: 1e-4,
            low_pass_px: std::f32::consts::FRAC_1_SQRT_2,
            surface_relative: 0.015,
        }
    }
}

impl RenderSettings {
    /// The same for a picture of `factor` times the resolution: the low-pass keeps its size in the scene.
    pub fn resized(&self, factor: f64) -> RenderSettings {
        RenderSettings { low_pass_px: self.low_pass_px * factor as f32, ..*self }
    }
}

/// Eq. 5 in the blending pass: is there a surfel near the observed depth? One that is hidden counts too: what
/// is known need not grow again.
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

/// Which images a rendering holds besides opacity and the growth test; the others are left empty (0 x 0).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outputs {
    /// Everything.
    All,
    /// What a frame is tracked against: the front surface's depth and intensity.
    Tracking,
    /// What losses are made of, and all that [`crate::backward`] needs: blended colour and expected depth.
    Optimising,
}

impl Outputs {
    /// Blended colour and expected depth.
    pub const fn blended(self) -> bool {
        !matches!(self, Outputs::Tracking)
    }

    /// Depth and intensity of the front surface.
    pub const fn surface(self) -> bool {
        !matches!(self, Outputs::Optimising)
    }

    /// Median and spread of depth, and normals.
    pub const fn detail(self) -> bool {
        matches!(self, Outputs::All)
    }
}

/// Observed depth and tolerance of one tile's pixels.
pub(crate) struct ObservedTile {
    pub depth: TileImage,
    /// Negative without a measurement.
    pub tolerance: TileImage,
}

impl ObservedTile {
    pub fn none() -> Self {
        ObservedTile { depth: [0.0; TILE * TILE], tolerance: [-1.0; TILE * TILE] }
    }

    /// Reads the tile whose first pixel is `origin`.
    pub fn read(&mut self, test: &GrowthTest<'_>, origin: [usize; 2]) {
        *self = ObservedTile::none();
        for (i, [x, y]) in crate::tile_pixels().enumerate() {
            let depth = test.observed_depth_m.get(origin[0] + x, origin[1] + y).copied().unwrap_or(0.0);
            if depth > 0.0 {
                self.depth[i] = depth;
                self.tolerance[i] =
                    (test.sigma_factor * test.noise.sigma_m(depth)).max(test.relative * depth);
            }
        }
    }
}
