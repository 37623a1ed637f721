//! Blending splats front to back (eq. 3), tile by tile.

use super::GaussianView;
use super::project::{Splat, splats};
use crate::{ALPHA_MAX, GrowthTest, RenderSettings, TILE};
use coma_frame::Image;
use coma_geometry::Intrinsics;
use nalgebra::Vector2;
use rayon::prelude::*;

/// What a camera would see. `[height, width]`
#[derive(Debug)]
pub struct Picture {
    /// Blended colour over black.
    pub color: Image<[f32; 3]>,
    /// Expected depth D / A, metres; 0 where nothing was hit.
    pub depth_m: Image<f32>,
    /// Depth at which half of the light is blocked, metres; 0 where it never is.
    pub median_depth_m: Image<f32>,
    /// A, 0..1.
    pub opacity: Image<f32>,
    /// Eq. 5, if observed depth was given: a Gaussian's centre lies near it.
    pub near_surface: Option<Image<bool>>,
    /// Blended hits.
    pub hits: u64,
    /// What the backward pass needs.
    pub(super) splats: Vec<Splat>,
    /// Indices into the splats, from near to far, by tile.
    pub(super) tiles: Vec<Vec<u32>>,
}

/// Alpha of a splat at a pixel, not yet cut off at its least.
pub(super) fn alpha(splat: &Splat, x: usize, y: usize) -> (f32, Vector2<f32>) {
    let d = Vector2::new(x as f32, y as f32) - splat.pixel;
    let q = d.dot(&(splat.conic * d));
    ((splat.opacity * (-0.5 * q).exp()).min(ALPHA_MAX), d)
}

/// The first pixel of a tile and where it ends: columns, rows.
pub(super) fn extent(tile: usize, camera: &Intrinsics) -> ([usize; 2], [usize; 2]) {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let columns = width.div_ceil(TILE);
    let (x, y) = (tile % columns * TILE, tile / columns * TILE);
    ([x, (x + TILE).min(width)], [y, (y + TILE).min(height)])
}

/// One tile's pixels, row by row.
#[derive(Default)]
struct Tile {
    pixels: Vec<Pixel>,
    hits: u64,
}

#[derive(Clone, Copy, Default)]
struct Pixel {
    color: [f32; 3],
    depth_sum: f32,
    median: f32,
    opacity: f32,
    near: bool,
}

/// Renders. Gaussians behind the near plane, far outside the picture, or with parameters that are not finite, are left
/// out.
pub fn render(
    views: &[GaussianView<'_>],
    camera: &Intrinsics,
    settings: &RenderSettings,
    growth: Option<&GrowthTest<'_>>,
) -> Picture {
    let splats = splats(views, camera, settings);
    let tiles = tiles(&splats, camera);
    let blended: Vec<Tile> = tiles
        .par_iter()
        .enumerate()
        .map(|(tile, list)| blend(tile, list, &splats, camera, settings, growth))
        .collect();
    let (width, height) = (camera.width as usize, camera.height as usize);
    let columns = width.div_ceil(TILE);
    let at = |x: usize, y: usize| {
        let tile = y / TILE * columns + x / TILE;
        let ([x0, x1], [y0, _]) = extent(tile, camera);
        &blended[tile].pixels[(y - y0) * (x1 - x0) + x - x0]
    };
    let depth = |p: &Pixel| if p.opacity > 0.0 { p.depth_sum / p.opacity } else { 0.0 };
    Picture {
        color: Image::from_fn(width, height, |x, y| at(x, y).color),
        depth_m: Image::from_fn(width, height, |x, y| depth(at(x, y))),
        median_depth_m: Image::from_fn(width, height, |x, y| at(x, y).median),
        opacity: Image::from_fn(width, height, |x, y| at(x, y).opacity),
        near_surface: growth.map(|_| Image::from_fn(width, height, |x, y| at(x, y).near)),
        hits: blended.iter().map(|tile| tile.hits).sum(),
        splats,
        tiles,
    }
}

fn tiles(splats: &[Splat], camera: &Intrinsics) -> Vec<Vec<u32>> {
    let columns = (camera.width as usize).div_ceil(TILE);
    let rows = (camera.height as usize).div_ceil(TILE);
    let mut out = vec![Vec::new(); columns * rows];
    for (i, splat) in splats.iter().enumerate() {
        let [x0, x1, y0, y1] = splat.bounds.map(|v| v / TILE);
        for row in y0..=y1 {
            for column in x0..=x1 {
                out[row * columns + column].push(i as u32);
            }
        }
    }
    out
}

fn blend(
    tile: usize,
    list: &[u32],
    splats: &[Splat],
    camera: &Intrinsics,
    settings: &RenderSettings,
    growth: Option<&GrowthTest<'_>>,
) -> Tile {
    let ([x0, x1], [y0, y1]) = extent(tile, camera);
    let mut out = Tile::default();
    for (y, x) in (y0..y1).flat_map(|y| (x0..x1).map(move |x| (y, x))) {
        let observed = growth.map_or(0.0, |test| test.observed_depth_m[(x, y)]);
        let tolerance = growth.map_or(0.0, |test| {
            (test.sigma_factor * test.noise.sigma_m(observed)).max(test.relative * observed)
        });
        let (mut pixel, mut passing) = (Pixel::default(), 1.0f32);
        for index in list {
            let splat = &splats[*index as usize];
            let open = passing > settings.transmittance_min;
            // An observed pixel looks on for a Gaussian near it, but not past it.
            let looks = observed > 0.0 && !pixel.near && splat.z <= observed + tolerance;
            if !(open || looks) {
                break;
            }
            let (alpha, _) = alpha(splat, x, y);
            if !(alpha >= settings.alpha_min) {
                continue;
            }
            pixel.near |= observed > 0.0 && (splat.z - observed).abs() <= tolerance;
            if !open {
                continue;
            }
            let weight = alpha * passing;
            for c in 0..3 {
                pixel.color[c] += weight * splat.color[c];
            }
            pixel.depth_sum += weight * splat.z;
            let after = passing * (1.0 - alpha);
            if passing > 0.5 && after <= 0.5 {
                pixel.median = splat.z;
            }
            passing = after;
            out.hits += 1;
        }
        pixel.opacity = 1.0 - passing;
        out.pixels.push(pixel);
    }
    out
}
