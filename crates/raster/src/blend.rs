//! Front-to-back blending of one tile (eq. 3), block by block: a block's sums stay in registers while its
//! surfels pass by, and a block whose pixels are done stops.

use crate::hit::{Constants, Hits, TilePixels};
use crate::lanes::Lanes;
use crate::project::Projected;
use crate::settings::ObservedTile;
use crate::tiles::Entry;
use crate::{BLOCKS, LANES, RenderSettings, TILE};
use coma_geometry::Intrinsics;
use pulp::{Simd, WithSimd};

/// One number for each pixel of a tile, block by block. `[block, row, column]`
pub(crate) type TileImage = [f32; TILE * TILE];

/// A blended tile.
pub(crate) struct TileImages {
    pub color: [TileImage; 3],
    /// Expected depth.
    pub depth: TileImage,
    pub opacity: TileImage,
    pub median: TileImage,
    pub surface: TileImage,
    /// Of the front surface.
    pub intensity: TileImage,
    pub spread: TileImage,
    /// Unit length, or zero.
    pub normal: [TileImage; 3],
    /// Over 0 where a surfel lies near the observed depth.
    pub near: TileImage,
    pub hits: u64,
}

impl TileImages {
    pub fn empty() -> Self {
        let zero = [0.0; TILE * TILE];
        TileImages {
            color: [zero; 3],
            depth: zero,
            opacity: zero,
            median: zero,
            surface: zero,
            intensity: zero,
            spread: zero,
            normal: [zero; 3],
            near: zero,
            hits: 0,
        }
    }
}

/// A tile's surfels from near to far.
#[derive(Default)]
pub(crate) struct TileSurfels {
    /// On return from the blend: the blocks in which something was blended.
    pub entries: Vec<Entry>,
    /// As the entries.
    pub projected: Vec<Projected>,
    /// Which of them touch a block.
    blocks: [Vec<u32>; BLOCKS],
}

impl TileSurfels {
    /// Takes a tile's entries; `projected` is by slot.
    pub fn gather(&mut self, entries: impl Iterator<Item = Entry>, projected: &[Projected]) {
        self.entries.clear();
        self.entries.extend(entries);
        self.fetch(projected);
        self.blocks.iter_mut().for_each(Vec::clear);
        for (index, entry) in self.entries.iter_mut().enumerate() {
            let mut left = std::mem::take(&mut entry.blocks);
            while left != 0 {
                self.blocks[left.trailing_zeros() as usize % BLOCKS].push(index as u32);
                left &= left - 1;
            }
        }
    }

    /// Takes what the blend left.
    pub fn gather_blended(&mut self, entries: &[Entry], projected: &[Projected]) {
        self.entries.clear();
        self.entries.extend_from_slice(entries);
        self.fetch(projected);
    }

    /// A loop of its own: its cache misses overlap, as they would not between the blend's computations.
    fn fetch(&mut self, projected: &[Projected]) {
        self.projected.clear();
        self.projected.extend(self.entries.iter().map(|entry| projected[entry.slot as usize]));
    }
}

/// Blends a tile. `BLENDED`: colour and expected depth. `SURFACE`: depth and intensity of the front surface. `DETAIL`:
/// median and spread of depth, and normals; needs `BLENDED`. `GROWTH`: looks for surfels near the observed depth, in front
/// or hidden.
pub(crate) struct Blend<'a, const BLENDED: bool, const SURFACE: bool, const DETAIL: bool, const GROWTH: bool>
{
    pub surfels: &'a mut TileSurfels,
    /// The tile's first pixel.
    pub origin: [f32; 2],
    pub camera: &'a Intrinsics,
    pub settings: &'a RenderSettings,
    /// Only looked at for `GROWTH`.
    pub observed: &'a ObservedTile,
    pub out: &'a mut TileImages,
}

/// Weight of a hit in the front surface's depth. Discs are planes: beside the place where it touches a bent surface, a
/// disc lies before it or behind, by the square of the distance, and on convex things every disc lies before it. So the
/// nearest disc says nearly all; those beside it take over smoothly.
#[inline(always)]
fn eighth_power<S: Simd>(alpha: Lanes<S>) -> Lanes<S> {
    let squared = alpha * alpha;
    let fourth = squared * squared;
    fourth * fourth
}

/// After so many surfels a block looks whether its pixels are done.
const PATIENCE: usize = 4;

impl<const BLENDED: bool, const SURFACE: bool, const DETAIL: bool, const GROWTH: bool> WithSimd
    for Blend<'_, BLENDED, SURFACE, DETAIL, GROWTH>
{
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let constants = Constants::new(simd, self.camera, self.settings);
        let number = |value: f32| Lanes::splat(simd, value);
        let (zero, one, half) = (number(0.0), number(1.0), number(0.5));
        let TileSurfels { entries, projected, blocks } = self.surfels;
        let out = self.out;
        let tile = TilePixels::of(simd, &constants, self.origin);
        let mut hits = 0.0f64;
        for (block, list) in blocks.iter().enumerate() {
            for part in 0..LANES / S::F32_LANES {
                let at = block * (LANES / S::F32_LANES) + part;
                let pixels = tile.load(simd, at);
                let mut passing = pixels.inside(&constants).select(one, zero);
                let (mut color, mut normal) = ([zero; 3], [zero; 3]);
                let (mut depth, mut depth_squared, mut median) = (zero, zero, zero);
                let (mut surface, mut surface_depth) = (zero, zero);
                let (mut shaded, mut surface_intensity) = (zero, zero);
                let (mut near, mut counted) = (zero, zero);
                let observed = Lanes::load(simd, &self.observed.depth, at);
                let tolerance = Lanes::load(simd, &self.observed.tolerance, at);
                for (step, index) in list.iter().enumerate() {
                    if step % PATIENCE == 0 {
                        let mut open = constants.transmittance_min.less(passing);
                        if GROWTH {
                            // An observed pixel looks on for a surfel near it.
                            open = open.or(near.less(half).and(zero.less(tolerance)));
                        }
                        if !open.any() {
                            break;
                        }
                    }
                    let p = &projected[*index as usize];
                    let hit = Hits::of(simd, p, &pixels, &constants);
                    let found = constants.alpha_min.at_most(hit.alpha);
                    let live = found.and(constants.transmittance_min.less(passing));
                    entries[*index as usize].blocks |= (live.any() as u16) << block;
                    let weight = live.select(hit.alpha * passing, zero);
                    let after = passing - weight;
                    counted = counted + live.select(one, zero);
                    let weighted_depth = weight * hit.depth;
                    if BLENDED {
                        for c in 0..3 {
                            color[c] = weight.mul_add(number(p.color[c]), color[c]);
                        }
                        depth = depth + weighted_depth;
                    }
                    if SURFACE {
                        // One surface is what lies together; the first that outweighs what came before it counts.
                        let alpha = live.select(hit.alpha, zero);
                        let nearness = eighth_power(alpha);
                        let gap = hit.depth.mul_add(surface, zero - surface_depth).abs();
                        let joins = gap.at_most(constants.surface_relative * hit.depth * surface);
                        let outweighs = surface.less(nearness);
                        let grown = |sum, by| joins.select(sum + by, outweighs.select(by, sum));
                        surface_depth = grown(surface_depth, nearness * hit.depth);
                        surface = grown(surface, nearness);
                        surface_intensity = grown(surface_intensity, alpha * number(p.intensity));
                        shaded = grown(shaded, alpha);
                    }
                    if DETAIL {
                        depth_squared = weighted_depth.mul_add(hit.depth, depth_squared);
                        median = half.less(passing).and(after.at_most(half)).select(hit.depth, median);
                        // The normal that faces the camera: its plane's offset is negative.
                        let facing = if p.k > 0.0 { -1.0 } else { 1.0 };
                        for c in 0..3 {
                            normal[c] = weight.mul_add(number(facing * p.n[c]), normal[c]);
                        }
                    }
                    if GROWTH {
                        let close = (hit.depth - observed).abs().at_most(tolerance);
                        near = close.and(found).select(one, near);
                    }
                    passing = after;
                }
                hits += counted.sum() as f64;
                let opacity = one - passing;
                let covered = zero.less(opacity);
                let share = covered.select(one / opacity, zero);
                let expected = depth * share;
                opacity.store(&mut out.opacity, at);
                if BLENDED {
                    expected.store(&mut out.depth, at);
                    for c in 0..3 {
                        color[c].store(&mut out.color[c], at);
                    }
                }
                if SURFACE {
                    let found = zero.less(surface);
                    found.select(surface_depth / surface, zero).store(&mut out.surface, at);
                    found.select(surface_intensity / shaded, zero).store(&mut out.intensity, at);
                }
                if DETAIL {
                    let variance = depth_squared * share - expected * expected;
                    variance.max(zero).sqrt().store(&mut out.spread, at);
                    median.store(&mut out.median, at);
                    let squared =
                        normal[0].mul_add(normal[0], normal[1].mul_add(normal[1], normal[2] * normal[2]));
                    let length = squared.sqrt();
                    let scale = number(1e-12).less(length).select(one / length, zero);
                    for c in 0..3 {
                        (normal[c] * scale).store(&mut out.normal[c], at);
                    }
                }
                if GROWTH {
                    near.store(&mut out.near, at);
                }
            }
        }
        out.hits = hits as u64;
    }
}
