//! Which surfels touch which blocks of which tile, from near to far.

use crate::TILE;
use crate::reach::Reach;
use coma_geometry::Intrinsics;
use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

/// A surfel in a tile.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Entry {
    /// Its place from near to far.
    pub rank: u32,
    /// The blocks of the tile that it touches, one bit each.
    pub blocks: u16,
}

/// How an image is cut into tiles, row by row.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Grid {
    pub columns: usize,
    pub rows: usize,
}

impl Grid {
    pub fn of(camera: &Intrinsics) -> Self {
        Grid {
            columns: (camera.width as usize).div_ceil(TILE),
            rows: (camera.height as usize).div_ceil(TILE),
        }
    }

    pub fn count(&self) -> usize {
        self.columns * self.rows
    }

    /// The tile's first pixel.
    pub fn origin(&self, tile: usize) -> [usize; 2] {
        [tile % self.columns * TILE, tile / self.columns * TILE]
    }
}

/// Surfels that one task sorts into tiles.
const CHUNK: usize = 4096;

/// Entries of a run of ranks, tile by tile.
struct Run {
    /// Entries of tile `t` are `entries[starts[t]..starts[t + 1]]`.
    starts: Vec<u32>,
    entries: Vec<Entry>,
}

/// The entries of every tile, from near to far, as runs of ranks.
pub(crate) struct Tiles {
    runs: Vec<Run>,
}

impl Tiles {
    /// `order` names the slots of the surfels from near to far.
    pub fn build(arch: Arch, order: &[u32], reach: &[Reach], grid: Grid) -> Self {
        let run = |(chunk, slots)| arch.dispatch(Fill { slots, first_rank: chunk * CHUNK, reach, grid });
        Tiles { runs: order.par_chunks(CHUNK).enumerate().map(run).collect() }
    }

    pub fn entries(&self, tile: usize) -> impl Iterator<Item = Entry> {
        self.runs
            .iter()
            .flat_map(move |run| &run.entries[run.starts[tile] as usize..run.starts[tile + 1] as usize])
            .copied()
    }
}

/// One run: finds the entries surfel by surfel, then sorts them by tile (counting first).
struct Fill<'a> {
    slots: &'a [u32],
    first_rank: usize,
    reach: &'a [Reach],
    grid: Grid,
}

impl WithSimd for Fill<'_> {
    type Output = Run;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Run {
        let mut found: Vec<(u32, Entry)> = Vec::with_capacity(2 * self.slots.len());
        let mut starts = vec![0u32; self.grid.count() + 1];
        // Fetched in a loop of its own: its cache misses overlap.
        let reach: Vec<Reach> = self.slots.iter().map(|slot| self.reach[*slot as usize]).collect();
        for (i, reach) in reach.iter().enumerate() {
            let [x0, y0, x1, y1] = reach.tiles();
            for y in y0..=y1 {
                for x in x0..=x1 {
                    let blocks = reach.blocks(simd, [(x * TILE) as f32, (y * TILE) as f32]);
                    if blocks != 0 {
                        let tile = y * self.grid.columns + x;
                        starts[tile + 1] += 1;
                        found.push((tile as u32, Entry { rank: (self.first_rank + i) as u32, blocks }));
                    }
                }
            }
        }
        for tile in 0..self.grid.count() {
            starts[tile + 1] += starts[tile];
        }
        let mut next = starts.clone();
        let mut entries = vec![Entry { rank: 0, blocks: 0 }; found.len()];
        for (tile, entry) in found {
            let place = &mut next[tile as usize];
            entries[*place as usize] = entry;
            *place += 1;
        }
        Run { starts, entries }
    }
}
