//! The backward pass of one tile, surfel by surfel: a surfel's sums stay in registers while it visits the blocks
//! in which it was blended.

use crate::backward::PixelGradients;
use crate::blend::{TileImage, TileSurfels};
use crate::hit::{Constants, Hits, Pixels};
use crate::lanes::Lanes;
use crate::{ALPHA_MAX, BLOCK, LANES, RenderSettings, Rendering, TILE};
use coma_geometry::Intrinsics;
use pulp::{Simd, WithSimd};

/// Sums of one surfel: by a (3), b (3), n (3), k, pixel (2), centre depth, opacity, colour (3).
pub(crate) const SUMS: usize = 17;
pub(crate) type Sums = [f32; SUMS];

/// What the loss says of a tile's pixels, and the totals of the blend.
pub(crate) struct TileLoss {
    color: [TileImage; 3],
    /// By D, that is by the unnormalised depth sum.
    depth: TileImage,
    /// By A.
    opacity: TileImage,
    /// Sum over all hits of weight * q, where q is the loss's derivative by the weight; less what was blended
    /// so far.
    behind: TileImage,
    passing: TileImage,
}

impl TileLoss {
    pub fn empty() -> Self {
        let zero = [0.0; TILE * TILE];
        TileLoss { color: [zero; 3], depth: zero, opacity: zero, behind: zero, passing: zero }
    }

    /// Reads the tile whose first pixel is `origin`; outside the image no light passes.
    pub fn read(&mut self, rendering: &Rendering, pixels: &PixelGradients, origin: [usize; 2]) {
        let (width, height) = (rendering.color.width(), rendering.color.height());
        self.passing = [0.0; TILE * TILE];
        let columns = TILE.min(width - origin[0]);
        for row in 0..TILE.min(height - origin[1]) {
            let from = (origin[1] + row) * width + origin[0];
            let range = from..from + columns;
            let color = &rendering.color.pixels()[range.clone()];
            let depth = &rendering.depth_m.pixels()[range.clone()];
            let opacity = &rendering.opacity.pixels()[range.clone()];
            let by_color = &pixels.color.pixels()[range.clone()];
            let by_depth = &pixels.depth_m.pixels()[range.clone()];
            let by_opacity = &pixels.opacity.pixels()[range];
            for x in 0..columns {
                let i = (row / BLOCK * BLOCK + x / BLOCK) * LANES + row % BLOCK * BLOCK + x % BLOCK;
                let a = opacity[x];
                // E = D / A: by D it is g / A, by A it is -g E / A.
                let by_d = if a > 1e-6 { by_depth[x] / a } else { 0.0 };
                let by_a = by_opacity[x] - by_d * depth[x];
                let mut behind = by_d * depth[x] * a + by_a * a;
                for c in 0..3 {
                    self.color[c][i] = by_color[x][c];
                    behind += by_color[x][c] * color[x][c];
                }
                self.depth[i] = by_d;
                self.opacity[i] = by_a;
                self.behind[i] = behind;
                self.passing[i] = 1.0;
            }
        }
    }
}

/// Sums for each entry of a tile.
pub(crate) struct TileGradient<'a> {
    /// Blended surfels, and in which blocks.
    pub surfels: &'a TileSurfels,
    /// The tile's first pixel.
    pub origin: [f32; 2],
    pub camera: &'a Intrinsics,
    pub settings: &'a RenderSettings,
    /// Used up.
    pub loss: &'a mut TileLoss,
}

impl WithSimd for TileGradient<'_> {
    type Output = Vec<Sums>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Vec<Sums> {
        let constants = Constants::new(simd, self.camera, self.settings);
        let mut out = Vec::with_capacity(self.surfels.entries.len());
        for (entry, p) in self.surfels.entries.iter().zip(&self.surfels.projected) {
            let mut sums = [Lanes::splat(simd, 0.0); SUMS];
            let mut left = entry.blocks;
            while left != 0 {
                let block = left.trailing_zeros() as usize % LANES;
                left &= left - 1;
                let corner = [(block % BLOCK * BLOCK) as f32, (block / BLOCK * BLOCK) as f32];
                let corner = [corner[0] + self.origin[0], corner[1] + self.origin[1]];
                for part in 0..LANES / S::F32_LANES {
                    let at = block * (LANES / S::F32_LANES) + part;
                    let pixels = Pixels::of(simd, &constants, corner, part);
                    add(simd, p, &pixels, &constants, self.loss, at, &mut sums);
                }
            }
            let mut sums = sums.map(Lanes::sum);
            // By opacity: alpha is proportional to it.
            sums[13] /= p.opacity;
            out.push(sums);
        }
        out
    }
}

/// Adds what a surfel's hits on a vector of pixels do to the loss.
#[inline(always)]
fn add<S: Simd>(
    simd: S,
    p: &crate::project::Projected,
    pixels: &Pixels<S>,
    constants: &Constants<S>,
    loss: &mut TileLoss,
    at: usize,
    sums: &mut [Lanes<S>; SUMS],
) {
    let number = |value: f32| Lanes::splat(simd, value);
    let (zero, one) = (number(0.0), number(1.0));
    let hit = Hits::of(simd, p, pixels, constants);
    let passing = Lanes::load(simd, &loss.passing, at);
    let live = constants.alpha_min.at_most(hit.alpha).and(constants.transmittance_min.less(passing));
    let alpha = live.select(hit.alpha, zero);
    let weight = alpha * passing;
    let color: [Lanes<S>; 3] = std::array::from_fn(|c| Lanes::load(simd, &loss.color[c], at));
    let by_d = Lanes::load(simd, &loss.depth, at);
    // The loss's derivative by this hit's weight.
    let q = by_d.mul_add(hit.depth, Lanes::load(simd, &loss.opacity, at));
    let q = color[0].mul_add(number(p.color[0]), color[1].mul_add(number(p.color[1]), q));
    let q = color[2].mul_add(number(p.color[2]), q);
    let behind = weight.neg_mul_add(q, Lanes::load(simd, &loss.behind, at));
    behind.store(&mut loss.behind, at);
    (passing - weight).store(&mut loss.passing, at);
    let by_alpha = passing * q - behind / (one - alpha);
    // A clamped alpha does not move.
    let alpha_by_alpha = live.and(alpha.less(number(ALPHA_MAX))).select(alpha * by_alpha, zero);
    let by_depth = weight * by_d;

    // alpha = o exp(-rho / 2): by rho it is -alpha / 2, and rho = u^2 + v^2 on the disc.
    let by_plane = hit.plane.select(alpha_by_alpha, zero);
    let by_screen = alpha_by_alpha - by_plane;
    let plane_depth = hit.plane.select(by_depth, zero);
    // Kept finite where the plane does not count.
    let (u, v) = (hit.plane.select(hit.u, zero), hit.plane.select(hit.v, zero));
    let inv = hit.plane.select(hit.inv, zero);
    let scaled = zero - by_plane * inv;
    let (by_u, by_v) = (scaled * u, scaled * v);
    // depth = k inv, and by n: -(by u * u + by v * v + by depth * depth) inv.
    let by_k = plane_depth * inv;
    let by_n = zero - by_u.mul_add(u, by_v.mul_add(v, by_k * hit.depth));
    let on_screen = by_screen * constants.low_pass;
    let (dx, dy) = (pixels.dx, pixels.dy);
    for (i, by) in [by_u, by_v, by_n].into_iter().enumerate() {
        sums[3 * i] = by.mul_add(dx, sums[3 * i]);
        sums[3 * i + 1] = by.mul_add(dy, sums[3 * i + 1]);
        sums[3 * i + 2] = sums[3 * i + 2] + by;
    }
    sums[9] = sums[9] + by_k;
    sums[10] = on_screen.mul_add(hit.ex, sums[10]);
    sums[11] = on_screen.mul_add(hit.ey, sums[11]);
    sums[12] = sums[12] + (by_depth - plane_depth);
    sums[13] = sums[13] + alpha_by_alpha;
    for c in 0..3 {
        sums[14 + c] = weight.mul_add(color[c], sums[14 + c]);
    }
}
