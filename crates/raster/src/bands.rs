//! Images cut into rows of tiles, so that several threads write them.

use crate::blend::{TileImage, TileImages};
use crate::{BLOCK, LANES, Rendering, TILE};
use coma_geometry::Intrinsics;
use std::slice::ChunksMut;

/// The images cut into rows of tiles.
pub(crate) struct Bands<'a> {
    color: ChunksMut<'a, [f32; 3]>,
    depth: ChunksMut<'a, f32>,
    median: ChunksMut<'a, f32>,
    surface: ChunksMut<'a, f32>,
    intensity: ChunksMut<'a, f32>,
    spread: ChunksMut<'a, f32>,
    opacity: ChunksMut<'a, f32>,
    normal: ChunksMut<'a, [f32; 3]>,
    near: ChunksMut<'a, bool>,
    width: usize,
}

/// One row of tiles; images that are not wanted are empty.
pub(crate) struct Band<'a> {
    color: &'a mut [[f32; 3]],
    depth: &'a mut [f32],
    median: &'a mut [f32],
    surface: &'a mut [f32],
    intensity: &'a mut [f32],
    spread: &'a mut [f32],
    opacity: &'a mut [f32],
    normal: &'a mut [[f32; 3]],
    near: &'a mut [bool],
    width: usize,
}

impl<'a> Bands<'a> {
    pub fn new(out: &'a mut Rendering, camera: &Intrinsics) -> Self {
        let width = camera.width as usize;
        let size = TILE * width;
        let near = out.near_surface.as_mut().map(|image| image.pixels_mut()).unwrap_or_default();
        Bands {
            color: out.color.pixels_mut().chunks_mut(size),
            depth: out.depth_m.pixels_mut().chunks_mut(size),
            median: out.median_depth_m.pixels_mut().chunks_mut(size),
            surface: out.surface_depth_m.pixels_mut().chunks_mut(size),
            intensity: out.surface_intensity.pixels_mut().chunks_mut(size),
            spread: out.depth_spread_m.pixels_mut().chunks_mut(size),
            opacity: out.opacity.pixels_mut().chunks_mut(size),
            normal: out.normal.pixels_mut().chunks_mut(size),
            near: near.chunks_mut(size),
            width,
        }
    }

    pub fn next(&mut self) -> Band<'a> {
        Band {
            color: self.color.next().unwrap_or_default(),
            depth: self.depth.next().unwrap_or_default(),
            median: self.median.next().unwrap_or_default(),
            surface: self.surface.next().unwrap_or_default(),
            intensity: self.intensity.next().unwrap_or_default(),
            spread: self.spread.next().unwrap_or_default(),
            opacity: self.opacity.next().unwrap_or_default(),
            normal: self.normal.next().unwrap_or_default(),
            near: self.near.next().unwrap_or_default(),
            width: self.width,
        }
    }
}

impl Band<'_> {
    /// Writes a tile whose first column is `x0`.
    pub fn write(&mut self, tile: &TileImages, x0: usize) {
        let place = Place { width: self.width, x0 };
        place.write(self.depth, |i| tile.depth[i]);
        place.write(self.median, |i| tile.median[i]);
        place.write(self.surface, |i| tile.surface[i]);
        place.write(self.intensity, |i| tile.intensity[i]);
        place.write(self.spread, |i| tile.spread[i]);
        place.write(self.opacity, |i| tile.opacity[i]);
        let triple = |images: &[TileImage; 3], i: usize| [images[0][i], images[1][i], images[2][i]];
        place.write(self.color, |i| triple(&tile.color, i));
        place.write(self.normal, |i| triple(&tile.normal, i));
        place.write(self.near, |i| tile.near[i] > 0.0);
    }
}

/// Where a tile lies in its band.
struct Place {
    width: usize,
    x0: usize,
}

impl Place {
    /// Runs of a block's row: a tile's images are block by block, the band's row by row.
    #[inline(always)]
    fn write<T>(&self, band: &mut [T], value: impl Fn(usize) -> T) {
        for (y, row) in band.chunks_mut(self.width).enumerate() {
            let end = self.width.min(self.x0 + TILE);
            for (column, run) in row[self.x0..end].chunks_mut(BLOCK).enumerate() {
                let from = (y / BLOCK * BLOCK + column) * LANES + y % BLOCK * BLOCK;
                for (x, out) in run.iter_mut().enumerate() {
                    *out = value(from + x);
                }
            }
        }
    }
}
