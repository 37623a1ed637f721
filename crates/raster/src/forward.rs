//! The forward pass: project, sort, tile, blend; tiles are blended and written in rows of tiles.

use crate::blend::{Blend, TileImage, TileImages, TileSurfels};
use crate::project::{Projected, project};
use crate::settings::{GrowthTest, ObservedTile, Outputs, RenderSettings};
use crate::tiles::{Entry, Grid, Tiles};
use crate::{BLOCK, LANES, Rendering, SubmapView, TILE, sort};
use coma_frame::Image;
use coma_geometry::Intrinsics;
use pulp::Arch;
use rayon::prelude::*;
use std::slice::ChunksMut;

/// What the forward pass leaves to the backward pass.
#[derive(Debug)]
pub(crate) struct RenderState {
    pub arch: Arch,
    pub grid: Grid,
    /// By slot.
    pub projected: Vec<Projected>,
    /// Slots from near to far.
    pub order: Vec<u32>,
    /// What was blended, one for each row of tiles.
    pub blended: Vec<BlendedRow>,
}

/// What was blended in a row of tiles.
#[derive(Debug)]
pub(crate) struct BlendedRow {
    /// Entries of the tile in column `c` are `entries[starts[c]..starts[c + 1]]`, from near to far.
    pub starts: Vec<u32>,
    pub entries: Vec<Entry>,
}

impl BlendedRow {
    pub fn tile(&self, column: usize) -> &[Entry] {
        &self.entries[self.starts[column] as usize..self.starts[column + 1] as usize]
    }
}

/// Renders submaps, sorted globally by the depth of their surfels' centres.
///
/// Surfels behind the near plane, or with parameters that are not finite, are left out.
///
/// # Panics
/// If there are 2^32 surfels or more.
pub fn render(
    submaps: &[SubmapView<'_>],
    camera: &Intrinsics,
    settings: &RenderSettings,
    growth: Option<&GrowthTest<'_>>,
) -> Rendering {
    render_only(submaps, camera, settings, growth, Outputs::ALL)
}

/// As [`render`], without the images that are not wanted.
///
/// # Panics
/// If there are 2^32 surfels or more.
pub fn render_only(
    submaps: &[SubmapView<'_>],
    camera: &Intrinsics,
    settings: &RenderSettings,
    growth: Option<&GrowthTest<'_>>,
    outputs: Outputs,
) -> Rendering {
    render_on(Arch::new(), submaps, camera, settings, growth, outputs)
}

pub(crate) fn render_on(
    arch: Arch,
    submaps: &[SubmapView<'_>],
    camera: &Intrinsics,
    settings: &RenderSettings,
    growth: Option<&GrowthTest<'_>>,
    outputs: Outputs,
) -> Rendering {
    let grid = Grid::of(camera);
    let scene = project(submaps, camera, settings);
    let order = sort::by_upper_half(scene.keys);
    let tiles = Tiles::build(arch, &order, &scene.reach, grid);
    let mut out = empty(camera, growth.is_some(), outputs);
    let mut bands = Bands::new(&mut out, camera);
    let bands: Vec<Band<'_>> = (0..grid.rows).map(|_| bands.next()).collect();
    let kernel = kernel(outputs, growth.is_some());
    let blended: Vec<(BlendedRow, u64)> = bands
        .into_par_iter()
        .enumerate()
        .map_init(Scratch::new, |scratch, (row, mut band)| {
            let mut hits = 0;
            let mut blended = BlendedRow { starts: vec![0], entries: Vec::new() };
            for column in 0..grid.columns {
                let tile = row * grid.columns + column;
                let origin = grid.origin(tile);
                scratch.surfels.gather(tiles.entries(tile), &order, &scene.projected);
                if let Some(test) = growth {
                    scratch.observed.read(test, origin);
                }
                kernel(arch, scratch, origin.map(|v| v as f32), camera, settings);
                hits += scratch.images.hits;
                band.write(&scratch.images, origin[0]);
                blended.entries.extend(scratch.surfels.entries.iter().filter(|e| e.blocks != 0));
                blended.starts.push(blended.entries.len() as u32);
            }
            (blended, hits)
        })
        .collect();
    out.hits = blended.iter().map(|(_, hits)| hits).sum();
    let blended = blended.into_iter().map(|(row, _)| row).collect();
    out.state = RenderState { arch, grid, projected: scene.projected, order, blended };
    out
}

fn empty(camera: &Intrinsics, growth: bool, outputs: Outputs) -> Rendering {
    let size = |wanted: bool| if wanted { (camera.width as usize, camera.height as usize) } else { (0, 0) };
    let number = |wanted: bool| Image::filled(size(wanted).0, size(wanted).1, 0.0f32);
    let triple = |wanted: bool| Image::filled(size(wanted).0, size(wanted).1, [0.0f32; 3]);
    Rendering {
        color: triple(true),
        depth_m: number(true),
        median_depth_m: number(outputs.depth_detail),
        depth_spread_m: number(outputs.depth_detail),
        opacity: number(true),
        normal: triple(outputs.normal),
        near_surface: growth.then(|| Image::filled(size(true).0, size(true).1, false)),
        hits: 0,
        state: RenderState {
            arch: Arch::Scalar,
            grid: Grid::default(),
            projected: Vec::new(),
            order: Vec::new(),
            blended: Vec::new(),
        },
    }
}

/// What a thread blends with.
struct Scratch {
    surfels: TileSurfels,
    observed: ObservedTile,
    images: TileImages,
}

impl Scratch {
    fn new() -> Self {
        Scratch {
            surfels: TileSurfels::default(),
            observed: ObservedTile::none(),
            images: TileImages::empty(),
        }
    }
}

type Kernel = fn(Arch, &mut Scratch, [f32; 2], &Intrinsics, &RenderSettings);

fn kernel(outputs: Outputs, growth: bool) -> Kernel {
    fn run<const DETAIL: bool, const NORMAL: bool, const GROWTH: bool>(
        arch: Arch,
        scratch: &mut Scratch,
        origin: [f32; 2],
        camera: &Intrinsics,
        settings: &RenderSettings,
    ) {
        let Scratch { surfels, observed, images: out } = scratch;
        arch.dispatch(Blend::<DETAIL, NORMAL, GROWTH> { surfels, origin, camera, settings, observed, out });
    }
    match (outputs.depth_detail, outputs.normal, growth) {
        (false, false, false) => run::<false, false, false>,
        (false, false, true) => run::<false, false, true>,
        (false, true, false) => run::<false, true, false>,
        (false, true, true) => run::<false, true, true>,
        (true, false, false) => run::<true, false, false>,
        (true, false, true) => run::<true, false, true>,
        (true, true, false) => run::<true, true, false>,
        (true, true, true) => run::<true, true, true>,
    }
}

/// The images cut into rows of tiles.
struct Bands<'a> {
    color: ChunksMut<'a, [f32; 3]>,
    depth: ChunksMut<'a, f32>,
    median: ChunksMut<'a, f32>,
    spread: ChunksMut<'a, f32>,
    opacity: ChunksMut<'a, f32>,
    normal: ChunksMut<'a, [f32; 3]>,
    near: ChunksMut<'a, bool>,
    width: usize,
}

/// One row of tiles; images that are not wanted are empty.
struct Band<'a> {
    color: &'a mut [[f32; 3]],
    depth: &'a mut [f32],
    median: &'a mut [f32],
    spread: &'a mut [f32],
    opacity: &'a mut [f32],
    normal: &'a mut [[f32; 3]],
    near: &'a mut [bool],
    width: usize,
}

impl<'a> Bands<'a> {
    fn new(out: &'a mut Rendering, camera: &Intrinsics) -> Self {
        let width = camera.width as usize;
        let size = TILE * width;
        let near = out.near_surface.as_mut().map(|image| image.pixels_mut()).unwrap_or_default();
        Bands {
            color: out.color.pixels_mut().chunks_mut(size),
            depth: out.depth_m.pixels_mut().chunks_mut(size),
            median: out.median_depth_m.pixels_mut().chunks_mut(size),
            spread: out.depth_spread_m.pixels_mut().chunks_mut(size),
            opacity: out.opacity.pixels_mut().chunks_mut(size),
            normal: out.normal.pixels_mut().chunks_mut(size),
            near: near.chunks_mut(size),
            width,
        }
    }

    fn next(&mut self) -> Band<'a> {
        Band {
            color: self.color.next().unwrap_or_default(),
            depth: self.depth.next().unwrap_or_default(),
            median: self.median.next().unwrap_or_default(),
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
    fn write(&mut self, tile: &TileImages, x0: usize) {
        let place = Place { width: self.width, x0 };
        place.write(self.depth, |i| tile.depth[i]);
        place.write(self.median, |i| tile.median[i]);
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
