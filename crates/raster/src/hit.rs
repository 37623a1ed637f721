//! What one surfel does to a vector of pixels: both passes ask here, so that they agree to the bit.

use crate::blend::TileImage;
use crate::lanes::{Lanes, Mask};
use crate::project::Projected;
use crate::reach::per_block;
use crate::{ALPHA_MAX, BLOCK, BLOCKS, LANES, RenderSettings, TILE};
use coma_geometry::Intrinsics;
use pulp::Simd;

/// Column and row of every pixel of a block.
const COLUMN: [f32; LANES] = per_block(1, 1);
const ROW: [f32; LANES] = per_block(BLOCK as u32, 1);

/// A vector of pixels and their rays `(dx, dy, 1)`.
#[derive(Clone, Copy)]
pub(crate) struct Pixels<S: Simd> {
    pub x: Lanes<S>,
    pub y: Lanes<S>,
    pub dx: Lanes<S>,
    pub dy: Lanes<S>,
}

/// All pixels of a tile, block by block.
pub(crate) struct TilePixels {
    x: TileImage,
    y: TileImage,
    dx: TileImage,
    dy: TileImage,
}

/// Camera and settings, one value in every lane.
#[derive(Clone, Copy)]
pub(crate) struct Constants<S: Simd> {
    cx: Lanes<S>,
    cy: Lanes<S>,
    inv_fx: Lanes<S>,
    inv_fy: Lanes<S>,
    width: Lanes<S>,
    height: Lanes<S>,
    near: Lanes<S>,
    pub alpha_min: Lanes<S>,
    pub transmittance_min: Lanes<S>,
    /// One over the low-pass's variance.
    pub low_pass: Lanes<S>,
}

impl<S: Simd> Constants<S> {
    #[inline(always)]
    pub fn new(simd: S, camera: &Intrinsics, settings: &RenderSettings) -> Self {
        let number = |value: f32| Lanes::splat(simd, value);
        Constants {
            cx: number(camera.cx as f32),
            cy: number(camera.cy as f32),
            inv_fx: number((1.0 / camera.fx) as f32),
            inv_fy: number((1.0 / camera.fy) as f32),
            width: number(camera.width as f32),
            height: number(camera.height as f32),
            near: number(settings.near_m),
            alpha_min: number(settings.alpha_min),
            transmittance_min: number(settings.transmittance_min),
            low_pass: number(1.0 / (settings.low_pass_px * settings.low_pass_px)),
        }
    }
}

impl TilePixels {
    /// Of the tile whose first pixel is `origin`.
    #[inline(always)]
    pub fn of<S: Simd>(simd: S, constants: &Constants<S>, origin: [f32; 2]) -> Self {
        let zero = [0.0; TILE * TILE];
        let mut out = TilePixels { x: zero, y: zero, dx: zero, dy: zero };
        for block in 0..BLOCKS {
            let corner = [(block % BLOCK * BLOCK) as f32, (block / BLOCK * BLOCK) as f32];
            for part in 0..LANES / S::F32_LANES {
                let at = block * (LANES / S::F32_LANES) + part;
                let x = Lanes::load(simd, &COLUMN, part) + Lanes::splat(simd, corner[0] + origin[0]);
                let y = Lanes::load(simd, &ROW, part) + Lanes::splat(simd, corner[1] + origin[1]);
                x.store(&mut out.x, at);
                y.store(&mut out.y, at);
                ((x - constants.cx) * constants.inv_fx).store(&mut out.dx, at);
                ((y - constants.cy) * constants.inv_fy).store(&mut out.dy, at);
            }
        }
        out
    }

    /// The vector at `at`.
    #[inline(always)]
    pub fn load<S: Simd>(&self, simd: S, at: usize) -> Pixels<S> {
        Pixels {
            x: Lanes::load(simd, &self.x, at),
            y: Lanes::load(simd, &self.y, at),
            dx: Lanes::load(simd, &self.dx, at),
            dy: Lanes::load(simd, &self.dy, at),
        }
    }
}

impl<S: Simd> Pixels<S> {
    /// Those within the image.
    #[inline(always)]
    pub fn inside(&self, constants: &Constants<S>) -> Mask<S> {
        self.x.less(constants.width).and(self.y.less(constants.height))
    }
}

/// A surfel's hits.
pub(crate) struct Hits<S: Simd> {
    /// Not yet cut off at the least alpha.
    pub alpha: Lanes<S>,
    pub depth: Lanes<S>,
    /// Where the disc counts, not the low-pass.
    pub plane: Mask<S>,
    /// Where on the disc, in its scales; anything where the low-pass counts.
    pub u: Lanes<S>,
    pub v: Lanes<S>,
    /// One over `n . d`.
    pub inv: Lanes<S>,
    /// From the centre's pixel.
    pub ex: Lanes<S>,
    pub ey: Lanes<S>,
}

impl<S: Simd> Hits<S> {
    #[inline(always)]
    pub fn of(simd: S, p: &Projected, pixels: &Pixels<S>, constants: &Constants<S>) -> Self {
        let number = |value: f32| Lanes::splat(simd, value);
        let along =
            |v: &[f32; 3]| pixels.dx.mul_add(number(v[0]), pixels.dy.mul_add(number(v[1]), number(v[2])));
        let inv = number(1.0) / along(&p.n);
        let (u, v, z) = (along(&p.a) * inv, along(&p.b) * inv, number(p.k) * inv);
        let (ex, ey) = (pixels.x - number(p.pixel[0]), pixels.y - number(p.pixel[1]));
        let on_plane = u.mul_add(u, v * v);
        let on_screen = ex.mul_add(ex, ey * ey) * constants.low_pass;
        // NaN and infinities of a ray along the plane fall to the low-pass.
        let plane = on_plane.at_most(on_screen).and(constants.near.less(z));
        let rho = plane.select(on_plane, on_screen);
        let depth = plane.select(z, number(p.z));
        // exp(-rho / 2)
        let fall = (rho * number(-0.5 * std::f32::consts::LOG2_E)).exp2();
        let alpha = (number(p.opacity) * fall).min(number(ALPHA_MAX));
        Hits { alpha, depth, plane, u, v, inv, ex, ey }
    }
}
