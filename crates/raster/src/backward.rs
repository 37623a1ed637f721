//! From derivatives by pixels to derivatives by surfel parameters and by the camera's pose.
//!
//! Per tile the blend is walked front to back once more; what lies behind a hit is the pixel's total minus
//! what was blended so far. Sums per (tile, surfel) are added up per surfel in the order of tiles, so that
//! the result does not depend on the number of threads.

use crate::blend::TileSurfels;
use crate::forward::RenderState;
use crate::gradient::{SUMS, Sums, TileGradient, TileLoss};
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
/// If `submaps` and `camera` are not those that `rendering` was made of.
pub fn backward(
    submaps: &[SubmapView<'_>],
    camera: &Intrinsics,
    settings: &RenderSettings,
    rendering: &Rendering,
    pixels: &PixelGradients,
) -> Gradients {
    let state = &rendering.state;
    let per_tile: Vec<Vec<Sums>> = (0..state.grid.count())
        .into_par_iter()
        .map_init(
            || (TileSurfels::default(), TileLoss::empty()),
            |(surfels, loss), tile| {
                let entries = &state.blended[tile];
                if entries.is_empty() {
                    return Vec::new();
                }
                let origin = state.grid.origin(tile);
                surfels.gather_blended(entries, &state.order, &state.projected);
                loss.read(rendering, pixels, origin);
                let origin = origin.map(|v| v as f32);
                state.arch.dispatch(TileGradient { surfels, origin, camera, settings, loss })
            },
        )
        .collect();
    let totals = totals(state, &per_tile);
    to_parameters(submaps, camera, state, &totals)
}

/// Surfels that one task adds up, at least.
const CHUNK: usize = 4096;

/// Sums by rank. A task adds up a run of ranks, which is a run of every tile's entries, tile after tile.
fn totals(state: &RenderState, per_tile: &[Vec<Sums>]) -> Vec<Sums> {
    let mut totals = vec![[0.0f32; SUMS]; state.order.len()];
    let chunk = CHUNK.max(totals.len() / 16);
    totals.par_chunks_mut(chunk).enumerate().for_each(|(i, totals)| {
        let first = (i * chunk) as u32;
        let end = first + totals.len() as u32;
        for (entries, sums) in state.blended.iter().zip(per_tile) {
            let from = entries.partition_point(|e| e.rank < first);
            for (entry, sums) in entries[from..].iter().zip(&sums[from..]) {
                if entry.rank >= end {
                    break;
                }
                let total = &mut totals[(entry.rank - first) as usize];
                for (t, s) in total.iter_mut().zip(sums) {
                    *t += s;
                }
            }
        }
    });
    totals
}
