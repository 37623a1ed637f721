//! Where one surfel of twice the size stands for four: on a plane whose colour changes no faster than a picture of half the
//! resolution can show.

use super::seed::SeedGrid;
use coma_frame::{Image, RgbdFrame};
use rayon::prelude::*;

/// Depth that bends by less than so many standard deviations is that of a plane.
const PLANE_SIGMA: f32 = 2.0;

/// Squares of two by two pixels of a seed grid.
pub(super) struct Squares<'a> {
    frame: &'a RgbdFrame,
    spacing: usize,
    /// Mean colour of the pixels that a pixel of the grid stands for; whole cells only.
    cells: Image<[f32; 3]>,
    /// Mean colour of the cells of a square; whole squares only.
    colors: Image<[f32; 3]>,
}

/// What one larger surfel is made of.
pub(super) struct Even {
    /// The square's middle, a pixel of the frame.
    pub middle: (usize, usize),
    /// Mean around the middle, as far as the square reaches.
    pub color: [f32; 3],
}

impl<'a> Squares<'a> {
    /// Of a frame whose colours are those of `color_at`.
    pub fn of(
        frame: &'a RgbdFrame,
        grid: &SeedGrid,
        color_at: &(impl Fn(usize, usize) -> [f32; 3] + Sync),
    ) -> Self {
        let spacing = grid.spacing;
        let (width, height) = (frame.color.width() / spacing, frame.color.height() / spacing);
        let cells = means(width, height, spacing, color_at);
        let colors = means(width / 2, height / 2, 2, &|i, j| cells[(i, j)]);
        Squares { frame, spacing, cells, colors }
    }

    /// The square whose first pixel of the grid is `(i, j)`, both even, if it is plane and its cells' colours are to
    /// within `tolerance` those of squares, interpolated.
    pub fn even(
        &self,
        i: usize,
        j: usize,
        tolerance: f32,
        color_at: &impl Fn(usize, usize) -> [f32; 3],
    ) -> Option<Even> {
        self.colors.get(i / 2, j / 2)?;
        let cells = [(i, j), (i + 1, j), (i, j + 1), (i + 1, j + 1)];
        let shown = cells.iter().all(|(i, j)| {
            let (cell, shown) = (self.cells[(*i, *j)], self.interpolated(*i, *j));
            (0..3).all(|channel| (cell[channel] - shown[channel]).abs() <= tolerance)
        });
        let middle = (self.spacing * (i + 1), self.spacing * (j + 1));
        if !(shown && lies_in_plane(self.frame, middle.0, middle.1, self.spacing)) {
            return None;
        }
        // The square's own mean belongs half a pixel beside its middle pixel, where the surfel lies: one that is symmetric
        // about that pixel doesn't shift the picture.
        let first = (middle.0 - self.spacing, middle.1 - self.spacing);
        Some(Even { middle, color: mean(first, 2 * self.spacing + 1, color_at) })
    }

    /// Colour at a cell, between the squares around it.
    fn interpolated(&self, i: usize, j: usize) -> [f32; 3] {
        // A cell lies a quarter of a square beside the middle of its own.
        let beside = |at: usize, count: usize| {
            let next = if at.is_multiple_of(2) { (at / 2).saturating_sub(1) } else { at / 2 + 1 };
            next.min(count - 1)
        };
        let (own_i, own_j) = (i / 2, j / 2);
        let (next_i, next_j) = (beside(i, self.colors.width()), beside(j, self.colors.height()));
        let c = |i, j| self.colors[(i, j)];
        let (a, b, d, e) = (c(own_i, own_j), c(next_i, own_j), c(own_i, next_j), c(next_i, next_j));
        std::array::from_fn(|k| 0.75 * (0.75 * a[k] + 0.25 * b[k]) + 0.25 * (0.75 * d[k] + 0.25 * e[k]))
    }
}

/// Means over squares of `side` values.
fn means(
    width: usize,
    height: usize,
    side: usize,
    value: &(impl Fn(usize, usize) -> [f32; 3] + Sync),
) -> Image<[f32; 3]> {
    let mut out = Image::filled(width, height, [0.0f32; 3]);
    out.pixels_mut().par_chunks_mut(width.max(1)).enumerate().for_each(|(j, row)| {
        for (i, out) in row.iter_mut().enumerate() {
            *out = mean((side * i, side * j), side, value);
        }
    });
    out
}

/// Mean over the square of `side` values that begins at `(x, y)`.
fn mean((x, y): (usize, usize), side: usize, value: &impl Fn(usize, usize) -> [f32; 3]) -> [f32; 3] {
    let mut sum = [0.0f32; 3];
    for (v, u) in (0..side).flat_map(|v| (0..side).map(move |u| (v, u))) {
        let value = value(x + u, y + v);
        for (sum, value) in sum.iter_mut().zip(value) {
            *sum += value;
        }
    }
    sum.map(|sum| sum / (side * side) as f32)
}

/// True if depth around a pixel is that of a plane, as far as noise lets one say. The inverse depth of a plane is linear
/// over the picture.
fn lies_in_plane(frame: &RgbdFrame, x: usize, y: usize, reach: usize) -> bool {
    let (width, height) = (frame.depth_m.width(), frame.depth_m.height());
    if x < reach || y < reach || x + reach >= width || y + reach >= height {
        return false;
    }
    let inverse = |x: usize, y: usize| Some(frame.depth_m[(x, y)]).filter(|z| *z > 0.0).map(|z| 1.0 / z);
    let Some(here) = inverse(x, y) else { return false };
    // Of a sum with weights 1, -2, 1.
    let sigma = 2.45 * frame.noise.sigma_m(1.0 / here) * here * here;
    let ends = [
        ((x - reach, y), (x + reach, y)),
        ((x, y - reach), (x, y + reach)),
        ((x - reach, y - reach), (x + reach, y + reach)),
        ((x - reach, y + reach), (x + reach, y - reach)),
    ];
    ends.iter().all(|(a, b)| match (inverse(a.0, a.1), inverse(b.0, b.1)) {
        (Some(a), Some(b)) => (a + b - 2.0 * here).abs() <= PLANE_SIGMA * sigma,
        _ => false,
    })
}
