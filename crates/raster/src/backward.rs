//! From derivatives by pixels to derivatives by surfel parameters and by the camera's pose.
//!
//! Per tile the blend is walked front to back once more; what lies behind a hit is the pixel's total minus
//! what was blended so far. Sums per (tile, surfel) are added up per surfel in the order of tiles, so that
//! the result does not depend on the number of threads.

use crate::blend::TileSurfels;
use crate::gradient::{RUN, Run, Sums, TileGradient, TileLoss};
use crate::parameters::to_parameters;
use crate::{RenderSettings, Rendering, SubmapView};
use coma_frame::Image;
use coma_geometry::{Intrinsics, Tangent};
use rayon::prelude::*;

/// Derivatives of a loss by what [`crate::render`] returned. `[height, width]`
#[derive(Clone, Debug)]
pub struct PixelGradients {
    /// By colour.
    pub color: Image<[f32; 3]>,
    /// By expected depth D / A.
    pub depth_m: Image<f32>,
    /// By opacity.
    pub opacity: Image<f32>,
}

/// Derivatives by the parameters of one submap's surfels, in its frame.
#[derive(Clone, Debug, Default)]
pub struct SurfelGradients {
    /// By the centre. `[n, 3]`
    pub center_m: Vec<[f32; 3]>,
    /// By a rotation vector that turns the surfel about its own axes: `R * exp(w)`. `[n, 3]`
    pub rotation: Vec<[f32; 3]>,
    /// By the two scales. `[n, 2]`
    pub scale_m: Vec<[f32; 2]>,
    /// By opacity. `[n]`
    pub opacity: Vec<f32>,
    /// By colour. `[n, 3]`
    pub color: Vec<[f32; 3]>,
}

/// Derivatives of a loss by everything that was rendered.
#[derive(Clone, Debug)]
pub struct Gradients {
    /// One per submap.
    pub submaps: Vec<SurfelGradients>,
    /// By the camera's pose, perturbed on the right: `map_from_camera * exp(xi)`, that is every
    /// `camera_from_submap` becomes `exp(-xi) * camera_from_submap`.
    pub pose: Tangent,
}

/// Derivatives of a loss whose derivatives by pixels are `pixels`, at what `rendering` was rendered from.
///
/// # Panics
/// If `submaps` and `camera` are not those that `rendering` was made of, or if it holds no blended colour.
pub fn backward(
    submaps: &[SubmapView<'_>],
    camera: &Intrinsics,
    settings: &RenderSettings,
    rendering: &Rendering,
    pixels: &PixelGradients,
) -> Gradients {
    assert!(!rendering.color.pixels().is_empty(), "a rendering for tracking has no gradients");
    let state = &rendering.state;
    let scratch = || (TileSurfels::default(), TileLoss::empty());
    let sums: Vec<Vec<Run>> = state
        .blended
        .par_iter()
        .enumerate()
        .map_init(scratch, |(surfels, loss), (row, blended)| {
            let mut out = Vec::new();
            out.resize_with(state.projected.len().div_ceil(RUN), Run::default);
            for column in 0..state.grid.columns {
                let entries = blended.tile(column);
                if entries.is_empty() {
                    continue;
                }
                let origin = state.grid.origin(row * state.grid.columns + column);
                surfels.gather_blended(entries, &state.projected);
                loss.read(rendering, pixels, origin);
                let (origin, out) = (origin.map(|v| v as f32), &mut out[..]);
                state.arch.dispatch(TileGradient { surfels, origin, camera, settings, loss, out });
            }
            out
        })
        .collect();
    to_parameters(submaps, camera, &state.projected, &totals(state.projected.len(), &sums))
}

/// Sums by slot; `sums` are those of the rows of tiles.
fn totals(slots: usize, sums: &[Vec<Run>]) -> Vec<Sums> {
    let mut totals: Vec<Sums> = bytemuck::zeroed_vec(slots);
    totals.par_chunks_mut(RUN).enumerate().for_each(|(run, totals)| {
        for row in sums {
            for (slot, sums) in row[run].slots.iter().zip(&row[run].sums) {
                totals[*slot as usize % RUN].add(sums);
            }
        }
    });
    totals
}
