//! Which surfels touch which tile, from near to far.

use crate::TILE;
use crate::project::Projected;
use coma_geometry::Intrinsics;

/// Lists of surfels, one per tile, tiles row by row.
#[derive(Debug, Default)]
pub(crate) struct Tiles {
    columns: usize,
    /// List of tile `t` is `entries[starts[t]..starts[t + 1]]`.
    starts: Vec<usize>,
    entries: Vec<u32>,
}

impl Tiles {
    /// Counts first, then fills; surfels come sorted, so every list is.
    pub fn build(projected: &[Projected], camera: &Intrinsics) -> Self {
        let columns = (camera.width as usize).div_ceil(TILE);
        let rows = (camera.height as usize).div_ceil(TILE);
        let touched = |p: &Projected| {
            let [x0, y0, x1, y1] = p.bounds.map(|v| v as usize / TILE);
            (y0..=y1).flat_map(move |y| (x0..=x1).map(move |x| y * columns + x))
        };
        let mut starts = vec![0usize; columns * rows + 1];
        projected.iter().flat_map(touched).for_each(|tile| starts[tile + 1] += 1);
        for tile in 0..columns * rows {
            starts[tile + 1] += starts[tile];
        }
        let mut next = starts.clone();
        let mut entries = vec![0u32; starts[columns * rows]];
        for (i, p) in projected.iter().enumerate() {
            for tile in touched(p) {
                entries[next[tile]] = i as u32;
                next[tile] += 1;
            }
        }
        Tiles { columns, starts, entries }
    }

    pub fn count(&self) -> usize {
        self.starts.len().saturating_sub(1)
    }

    pub fn list(&self, tile: usize) -> &[u32] {
        &self.entries[self.starts[tile]..self.starts[tile + 1]]
    }

    /// The tile's first pixel.
    pub fn origin(&self, tile: usize) -> (usize, usize) {
        (tile % self.columns * TILE, tile / self.columns * TILE)
    }
}
