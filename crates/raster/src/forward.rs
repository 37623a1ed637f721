//! The forward pass: project, sort, tile, blend; tiles are blended and written in rows of tiles.

use crate::bands::{Band, Bands};
use crate::blend::{Blend, TileImages, TileSurfels};
use crate::project::{Projected, Scene, project};
use crate::reach::Reach;
use crate::settings::{GrowthTest, ObservedTile, Outputs, RenderSettings};
use crate::tiles::{Entry, Grid, Tiles};
use crate::{Rendering, SubmapView, sort};
use coma_frame::Image;
use coma_geometry::Intrinsics;
use pulp::Arch;
use rayon::prelude::*;

/// What the forward pass leaves to the backward pass.
#[derive(Debug)]
pub(crate) struct RenderState {
    pub arch: Arch,
    pub grid: Grid,
    /// By slot.
    pub projected: Vec<Projected>,
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
    render_only(submaps, camera, settings, growth, Outputs::All)
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
    let view = View { arch, camera, settings };
    Projection::on(view, submaps).sort().tile().blend(growth, outputs)
}

#[derive(Clone, Copy)]
struct View<'a> {
    arch: Arch,
    camera: &'a Intrinsics,
    settings: &'a RenderSettings,
}

/// The first step of [`render`], for those who time each: surfels as the camera sees them.
pub struct Projection<'a> {
    view: View<'a>,
    scene: Scene,
}

/// The second step: their order from near to far.
pub struct Sorted<'a> {
    view: View<'a>,
    projected: Vec<Projected>,
    reach: Vec<Reach>,
    order: Vec<u32>,
}

/// The third step: which tiles and blocks they touch.
pub struct Tiled<'a> {
    view: View<'a>,
    projected: Vec<Projected>,
    tiles: Tiles,
}

impl<'a> Projection<'a> {
    /// Projects.
    pub fn of(submaps: &[SubmapView<'_>], camera: &'a Intrinsics, settings: &'a RenderSettings) -> Self {
        Projection::on(View { arch: Arch::new(), camera, settings }, submaps)
    }

    fn on(view: View<'a>, submaps: &[SubmapView<'_>]) -> Self {
        Projection { view, scene: project(submaps, view.camera, view.settings) }
    }

    /// Sorts.
    pub fn sort(self) -> Sorted<'a> {
        let Scene { projected, reach, keys } = self.scene;
        Sorted { view: self.view, projected, reach, order: sort::by_upper_half(keys) }
    }
}

impl<'a> Sorted<'a> {
    /// Finds the tiles.
    pub fn tile(self) -> Tiled<'a> {
        let tiles = Tiles::build(self.view.arch, &self.order, &self.reach, Grid::of(self.view.camera));
        Tiled { view: self.view, projected: self.projected, tiles }
    }
}

impl Tiled<'_> {
    /// Blends and writes the images.
    pub fn blend(self, growth: Option<&GrowthTest<'_>>, outputs: Outputs) -> Rendering {
        let Tiled { view: View { arch, camera, settings }, projected, tiles } = self;
        let grid = Grid::of(camera);
        let mut out = empty(camera, growth.is_some(), outputs);
        let mut bands = Bands::new(&mut out, camera);
        let bands: Vec<Band<'_>> = (0..grid.rows).map(|_| bands.next()).collect();
        let kernel = kernel(outputs, growth.is_some());
        let row = |scratch: &mut Scratch, (row, mut band): (usize, Band<'_>)| {
            let mut hits = 0;
            let mut blended = BlendedRow { starts: vec![0], entries: Vec::new() };
            for column in 0..grid.columns {
                let tile = row * grid.columns + column;
                let origin = grid.origin(tile);
                scratch.surfels.gather(tiles.entries(tile), &projected);
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
        };
        let rows: Vec<(BlendedRow, u64)> =
            bands.into_par_iter().enumerate().map_init(Scratch::new, row).collect();
        out.hits = rows.iter().map(|(_, hits)| hits).sum();
        let blended = rows.into_iter().map(|(row, _)| row).collect();
        out.state = RenderState { arch, grid, projected, blended };
        out
    }
}

fn empty(camera: &Intrinsics, growth: bool, outputs: Outputs) -> Rendering {
    let size = |wanted: bool| if wanted { (camera.width as usize, camera.height as usize) } else { (0, 0) };
    let number = |wanted: bool| Image::filled(size(wanted).0, size(wanted).1, 0.0f32);
    let triple = |wanted: bool| Image::filled(size(wanted).0, size(wanted).1, [0.0f32; 3]);
    Rendering {
        color: triple(outputs.blended()),
        depth_m: number(outputs.blended()),
        median_depth_m: number(outputs.detail()),
        surface_depth_m: number(outputs.surface()),
        surface_intensity: number(outputs.surface()),
        depth_spread_m: number(outputs.detail()),
        opacity: number(true),
        normal: triple(outputs.detail()),
        near_surface: growth.then(|| Image::filled(size(true).0, size(true).1, false)),
        hits: 0,
        state: RenderState {
            arch: Arch::Scalar,
            grid: Grid::default(),
            projected: Vec::new(),
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
    fn run<const BLENDED: bool, const SURFACE: bool, const DETAIL: bool, const GROWTH: bool>(
        arch: Arch,
        scratch: &mut Scratch,
        origin: [f32; 2],
        camera: &Intrinsics,
        settings: &RenderSettings,
    ) {
        let Scratch { surfels, observed, images: out } = scratch;
        let observed = &*observed;
        arch.dispatch(Blend::<BLENDED, SURFACE, DETAIL, GROWTH> {
            surfels,
            origin,
            camera,
            settings,
            observed,
            out,
        });
    }
    match (outputs, growth) {
        (Outputs::All, false) => run::<true, true, true, false>,
        (Outputs::All, true) => run::<true, true, true, true>,
        (Outputs::Tracking, false) => run::<false, true, false, false>,
        (Outputs::Tracking, true) => run::<false, true, false, true>,
        (Outputs::Optimising, false) => run::<true, false, false, false>,
        (Outputs::Optimising, true) => run::<true, false, false, true>,
    }
}
