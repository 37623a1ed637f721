//! The backward pass of one tile, surfel by surfel: a surfel's sums stay in registers while it visits the blocks
//! in which it was blended.

use crate::backward::PixelGradients;
use crate::blend::{TileImage, TileSurfels};
use crate::hit::{Constants, Hits, Pixels, TilePixels};
use crate::lanes::Lanes;
use crate::project::Projected;
use crate::{ALPHA_MAX, BLOCK, LANES, RenderSettings, Rendering, TILE};
use bytemuck::Zeroable;
use coma_geometry::Intrinsics;
use pulp::{Simd, WithSimd};

/// What a surfel's hits are summed into: by a (3), b (3), n (3), k, pixel (2), centre depth, opacity, colour (3).
const SUMS: usize = 17;

/// Those sums in one line of the cache: the normal is of unit length, so what of its derivative lies along it
/// is free; it is chosen so that the entry at the normal's largest axis is zero, which is not kept.
#[derive(Clone, Copy, Debug, Zeroable)]
#[repr(C, align(64))]
pub(crate) struct Sums([f32; 16]);

/// Sums, by name.
pub(crate) struct Named {
    pub a: [f32; 3],
    pub b: [f32; 3],
    pub n: [f32; 3],
    pub k: f32,
    pub pixel: [f32; 2],
    pub z: f32,
    pub opacity: f32,
    pub color: [f32; 3],
}

impl Sums {
    fn of(sums: &[f32; SUMS], p: &Projected) -> Self {
        let axis = largest(&p.n);
        let along = sums[6 + axis] / p.n[axis];
        let (i, j) = ((axis + 1) % 3, (axis + 2) % 3);
        let s = sums;
        let by_n = [s[6 + i] - along * p.n[i], s[6 + j] - along * p.n[j]];
        // By opacity: alpha is proportional to it.
        let opacity = s[13] / p.opacity;
        Sums([
            s[0], s[1], s[2], s[3], s[4], s[5], by_n[0], by_n[1], s[9], s[10], s[11], s[12], opacity, s[14],
            s[15], s[16],
        ])
    }

    pub fn add(&mut self, other: &Sums) {
        for (sum, value) in self.0.iter_mut().zip(&other.0) {
            *sum += value;
        }
    }

    /// `p` is the surfel that was summed.
    pub fn named(&self, p: &Projected) -> Named {
        let s = &self.0;
        let axis = largest(&p.n);
        let mut n = [0.0; 3];
        (n[(axis + 1) % 3], n[(axis + 2) % 3]) = (s[6], s[7]);
        Named {
            a: [s[0], s[1], s[2]],
            b: [s[3], s[4], s[5]],
            n,
            k: s[8],
            pixel: [s[9], s[10]],
            z: s[11],
            opacity: s[12],
            color: [s[13], s[14], s[15]],
        }
    }
}

/// The axis along which a vector is longest.
fn largest(v: &[f32; 3]) -> usize {
    let [x, y, z] = v.map(f32::abs);
    if z >= x && z >= y { 2 } else { (y > x) as usize }
}

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
    /// One is added for each surfel.
    pub out: &'a mut Vec<Sums>,
}

impl WithSimd for TileGradient<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let constants = Constants::new(simd, self.camera, self.settings);
        let tile = TilePixels::of(simd, &constants, self.origin);
        for (entry, p) in self.surfels.entries.iter().zip(&self.surfels.projected) {
            let mut sums = [Lanes::splat(simd, 0.0); SUMS];
            let mut left = entry.blocks;
            while left != 0 {
                let block = left.trailing_zeros() as usize % LANES;
                left &= left - 1;
                for part in 0..LANES / S::F32_LANES {
                    let at = block * (LANES / S::F32_LANES) + part;
                    let pixels = tile.load(simd, at);
                    add(simd, p, &pixels, &constants, self.loss, at, &mut sums);
                }
            }
            let mut sum = [0.0; SUMS];
            for k in 0..SUMS {
                sum[k] = sums[k].sum();
            }
            self.out.push(Sums::of(&sum, p));
        }
    }
}

/// Adds what a surfel's hits on a vector of pixels do to the loss.
#[inline(always)]
fn add<S: Simd>(
    simd: S,
    p: &Projected,
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
    let [red, green, blue] = &loss.color;
    let color = [Lanes::load(simd, red, at), Lanes::load(simd, green, at), Lanes::load(simd, blue, at)];
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
    let by = [by_u, by_v, by_n];
    for i in 0..3 {
        sums[3 * i] = by[i].mul_add(dx, sums[3 * i]);
        sums[3 * i + 1] = by[i].mul_add(dy, sums[3 * i + 1]);
        sums[3 * i + 2] = sums[3 * i + 2] + by[i];
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
