//! Differentiable rendering of 2D Gaussian surfels on the CPU.
//!
//! [`render`] blends surfels front to back (eq. 3 of the CoMA-SLAM paper); [`backward`] takes derivatives of
//! a loss by pixels to derivatives by every surfel parameter and by the camera's pose.
//!
//! The surfel model is that of Huang et al., "2D Gaussian Splatting" (2024): exact intersection of the ray
//! with the surfel's plane, and a screen-space low-pass for surfels that are seen edge-on or from afar.

pub mod backward;
mod blend;
mod exp;
pub mod oracle;
mod project;
mod settings;
mod tiles;

pub use backward::{Gradients, PixelGradients, SurfelGradients, backward};
pub use settings::{GrowthTest, RenderSettings};

use coma_frame::Image;
use coma_geometry::{Intrinsics, Pose};
use coma_surfel::SurfelCloud;
use project::Projected;
use rayon::prelude::*;
use tiles::Tiles;

/// Surfels of one submap and where they lie.
#[derive(Clone, Copy, Debug)]
pub struct SubmapView<'a> {
    /// In the submap's frame.
    pub surfels: &'a SurfelCloud,
    /// Takes the submap's points to the camera.
    pub camera_from_submap: Pose,
}

/// What a camera would see. Images are `[height, width]`.
#[derive(Debug)]
pub struct Rendering {
    /// Blended colour over black.
    pub color: Image<[f32; 3]>,
    /// Expected depth D / A, metres; 0 where nothing was hit.
    pub depth_m: Image<f32>,
    /// Depth at which half of the light is blocked, metres; 0 where it never is.
    pub median_depth_m: Image<f32>,
    /// Standard deviation of depth within the blend, metres.
    pub depth_spread_m: Image<f32>,
    /// A, 0..1.
    pub opacity: Image<f32>,
    /// Blended unit normal in the camera, facing it; zero where nothing was hit.
    pub normal: Image<[f32; 3]>,
    /// Eq. 5, if observed depth was given: a blended surfel lies near it.
    pub near_surface: Option<Image<bool>>,
    /// Blended hits: alpha at least `alpha_min`, before termination.
    pub hits: u64,
    /// What the backward pass needs.
    pub(crate) state: RenderState,
}

/// What the forward pass leaves to the backward pass.
#[derive(Debug)]
pub(crate) struct RenderState {
    pub projected: Vec<Projected>,
    pub tiles: Tiles,
}

/// Side of a tile, pixels.
pub(crate) const TILE: usize = 16;
/// Pixels of a tile.
pub(crate) const LANES: usize = TILE * TILE;
/// Alpha is kept below 1, so that light that passed is never divided by zero.
pub(crate) const ALPHA_MAX: f32 = 0.999;

/// Renders submaps, sorted globally by the depth of their surfels' centres.
///
/// Surfels behind the near plane, or with parameters that are not finite, are left out.
pub fn render(
    submaps: &[SubmapView<'_>],
    camera: &Intrinsics,
    settings: &RenderSettings,
    growth: Option<&GrowthTest<'_>>,
) -> Rendering {
    let projected = project::project(submaps, camera, settings);
    let tiles = Tiles::build(&projected, camera);
    let (width, height) = (camera.width as usize, camera.height as usize);
    let blended: Vec<blend::TileImages> = (0..tiles.count())
        .into_par_iter()
        .map(|tile| {
            let (x0, y0) = tiles.origin(tile);
            let observed = growth.map(|test| test.tile(x0, y0));
            blend::blend_tile(
                &projected,
                tiles.list(tile),
                [x0 as f32, y0 as f32],
                camera,
                settings,
                observed.as_ref(),
            )
        })
        .collect();

    let mut out = Rendering {
        color: Image::filled(width, height, [0.0; 3]),
        depth_m: Image::filled(width, height, 0.0),
        median_depth_m: Image::filled(width, height, 0.0),
        depth_spread_m: Image::filled(width, height, 0.0),
        opacity: Image::filled(width, height, 0.0),
        normal: Image::filled(width, height, [0.0; 3]),
        near_surface: growth.map(|_| Image::filled(width, height, false)),
        hits: 0,
        state: RenderState { projected: Vec::new(), tiles: Tiles::default() },
    };
    for (tile, images) in blended.iter().enumerate() {
        let (x0, y0) = tiles.origin(tile);
        out.hits += images.hits;
        for row in 0..TILE.min(height - y0) {
            for column in 0..TILE.min(width - x0) {
                out.set(x0 + column, y0 + row, images, row * TILE + column);
            }
        }
    }
    out.state = RenderState { projected, tiles };
    out
}

impl Rendering {
    fn set(&mut self, x: usize, y: usize, tile: &blend::TileImages, lane: usize) {
        let opacity = tile.opacity[lane];
        self.color[(x, y)] = std::array::from_fn(|c| tile.color[c][lane]);
        self.opacity[(x, y)] = opacity;
        self.median_depth_m[(x, y)] = tile.median[lane];
        if let Some(near) = &mut self.near_surface {
            near[(x, y)] = tile.near[lane] > 0.0;
        }
        if opacity > 0.0 {
            let depth = tile.depth[lane] / opacity;
            self.depth_m[(x, y)] = depth;
            let variance = tile.depth_squared[lane] / opacity - depth * depth;
            self.depth_spread_m[(x, y)] = variance.max(0.0).sqrt();
            let n: [f32; 3] = std::array::from_fn(|c| tile.normal[c][lane]);
            let norm = (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]).sqrt();
            if norm > 1e-12 {
                self.normal[(x, y)] = n.map(|v| v / norm);
            }
        }
    }
}

#[cfg(test)]
mod tests;
