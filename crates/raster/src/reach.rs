//! Where a surfel's alpha can reach its least value: inside its disc's conic or inside the low-pass circle.

use crate::lanes::Lanes;
use crate::project::InCamera;
use crate::{BLOCK, RenderSettings, TILE};
use bytemuck::Zeroable;
use coma_geometry::Intrinsics;
use pulp::Simd;

/// The region, as an ellipse and a circle in the image.
#[derive(Clone, Copy, Debug, Zeroable)]
pub(crate) struct Reach {
    /// First and last pixel inside the image, inclusive: x0, y0, x1, y1.
    pub bounds: [i32; 4],
    /// Middle of the ellipse, pixels.
    middle: [f32; 2],
    /// The ellipse: `xx x^2 + 2 xy x y + yy y^2 <= 1` about its middle. All zero: everywhere.
    conic: [f32; 3],
    /// Centre of the circle, pixels.
    center: [f32; 2],
    /// Its radius squared.
    radius2: f32,
}

/// Rounding of the conic: the ellipse is drawn this much larger, squared pixels ...
const MARGIN_PX2: f32 = 0.01;
/// ... and this share of its squared extent.
const MARGIN_SHARE: f32 = 1e-5;

impl Reach {
    /// `None` outside the image.
    pub fn of(
        s: &InCamera,
        pixel: [f32; 2],
        opacity: f32,
        camera: &Intrinsics,
        settings: &RenderSettings,
    ) -> Option<Reach> {
        let r2 = 2.0 * (opacity / settings.alpha_min).ln();
        let radius2 = r2 * settings.low_pass_px * settings.low_pass_px;
        let e1 = s.axes.column(0) * s.scale[0];
        let e2 = s.axes.column(1) * s.scale[1];
        // Projections of the axes, as seen from the centre's pixel: the centre itself falls on zero there.
        let (fx, fy) = (camera.fx as f32, camera.fy as f32);
        let (px, py) = (camera.cx as f32 - pixel[0], camera.cy as f32 - pixel[1]);
        let (x1, x2) = (fx * e1.x + px * e1.z, fx * e2.x + px * e2.z);
        let (y1, y2) = (fy * e1.y + py * e1.z, fy * e2.y + py * e2.z);
        // The dual conic of radius r (2D Gaussian Splatting, section 4.2); its last entry is negative while
        // the disc stays in front of the camera.
        let d = r2 * (e1.z * e1.z + e2.z * e2.z) - s.center.z * s.center.z;
        let far = (0.0, 0.0, camera.width as f32, camera.height as f32);
        let (middle, conic, (left, up, right, down)) = if d < 0.0 {
            let scale = r2 / d;
            let (mx, my) = (scale * (x1 * e1.z + x2 * e2.z), scale * (y1 * e1.z + y2 * e2.z));
            let xx = (mx * mx - scale * (x1 * x1 + x2 * x2)).max(0.0);
            let yy = (my * my - scale * (y1 * y1 + y2 * y2)).max(0.0);
            let xy = mx * my - scale * (x1 * y1 + x2 * y2);
            let margin = MARGIN_PX2 + MARGIN_SHARE * (xx + yy);
            let (xx, yy) = (xx + margin, yy + margin);
            let middle = [pixel[0] + mx, pixel[1] + my];
            let (half_x, half_y, radius) = (xx.sqrt(), yy.sqrt(), radius2.sqrt());
            let sides = (
                (middle[0] - half_x).min(pixel[0] - radius),
                (middle[1] - half_y).min(pixel[1] - radius),
                (middle[0] + half_x).max(pixel[0] + radius),
                (middle[1] + half_y).max(pixel[1] + radius),
            );
            let determinant = xx * yy - xy * xy;
            let conic = [yy / determinant, -xy / determinant, xx / determinant];
            let sound = determinant > 0.0 && conic.iter().all(|v| v.is_finite());
            (middle, if sound { conic } else { [0.0; 3] }, sides)
        } else {
            // The disc reaches the camera's plane: it may be anywhere.
            (pixel, [0.0; 3], far)
        };
        let (x0, x1) = (left.ceil().max(0.0), right.floor().min(camera.width as f32 - 1.0));
        let (y0, y1) = (up.ceil().max(0.0), down.floor().min(camera.height as f32 - 1.0));
        let bounds = [x0 as i32, y0 as i32, x1 as i32, y1 as i32];
        (x0 <= x1 && y0 <= y1).then_some(Reach { bounds, middle, conic, center: pixel, radius2 })
    }

    /// First and last tile of the bounds: x0, y0, x1, y1.
    pub fn tiles(&self) -> [usize; 4] {
        self.bounds.map(|v| v as usize / TILE)
    }

    /// Which of a tile's 16 blocks the region touches, one bit each. `origin` is the tile's first pixel.
    #[inline(always)]
    pub fn blocks<S: Simd>(&self, simd: S, origin: [f32; 2]) -> u16 {
        let number = |value: f32| Lanes::splat(simd, value);
        let (zero, last) = (number(0.0), number(BLOCK as f32 - 1.0));
        let [xx, xy, yy] = [number(self.conic[0]), number(self.conic[1]), number(self.conic[2])];
        // Where the conic's slope is zero along a column and along a row.
        let (y_of_x, x_of_y) = match self.conic {
            [xx, xy, yy] if xx > 0.0 && yy > 0.0 => (number(-xy / yy), number(-xy / xx)),
            _ => (zero, zero),
        };
        let mut touched = 0.0;
        for part in 0..16 / S::F32_LANES {
            let left = Lanes::load(simd, &BLOCK_X, part) + number(origin[0]);
            let up = Lanes::load(simd, &BLOCK_Y, part) + number(origin[1]);
            // The distance from the circle's centre to the block.
            let (cx, cy) = (number(self.center[0]), number(self.center[1]));
            let dx = (left - cx).max(cx - left - last).max(zero);
            let dy = (up - cy).max(cy - up - last).max(zero);
            let circle = dx.mul_add(dx, dy * dy).at_most(number(self.radius2));
            // The least value of the quadratic form over the block: zero inside, else on a side that faces
            // the middle.
            let (x0, y0) = (left - number(self.middle[0]), up - number(self.middle[1]));
            let (x1, y1) = (x0 + last, y0 + last);
            let (x, y) = (zero.max(x0).min(x1), zero.max(y0).min(y1));
            let form = |x: Lanes<S>, y: Lanes<S>| {
                let cross = xy * x * y;
                (xx * x).mul_add(x, (yy * y).mul_add(y, cross + cross))
            };
            let on_column = form(x, (y_of_x * x).max(y0).min(y1));
            let on_row = form((x_of_y * y).max(x0).min(x1), y);
            let ellipse = on_column.min(on_row).at_most(number(1.01));
            let bits = Lanes::load(simd, &BIT, part);
            touched += circle.or(ellipse).select(bits, zero).sum();
        }
        touched as u16
    }
}

const BLOCK_X: [f32; 16] = per_block(1, BLOCK as u32);
const BLOCK_Y: [f32; 16] = per_block(4, BLOCK as u32);
const BIT: [f32; 16] = {
    let mut out = [0.0; 16];
    let mut i = 0;
    while i < 16 {
        out[i] = (1u32 << i) as f32;
        i += 1;
    }
    out
};

/// `i / divisor % 4 * unit` for 16 things in four rows of four.
pub(crate) const fn per_block(divisor: u32, unit: u32) -> [f32; 16] {
    let mut out = [0.0; 16];
    let mut i = 0;
    while i < 16 {
        out[i as usize] = (i / divisor % 4 * unit) as f32;
        i += 1;
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::project::project;
    use crate::{ALPHA_MAX, SubmapView, TILE, oracle, scene};
    use coma_geometry::Pose;
    use coma_surfel::SurfelCloud;
    use pulp::WithSimd;

    struct Blocks<'a>(&'a Reach, [f32; 2]);

    impl WithSimd for Blocks<'_> {
        type Output = u16;
        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) -> u16 {
            self.0.blocks(simd, self.1)
        }
    }

    /// Blocks of the whole picture that hold a pixel at which alpha reaches its least, by the definition in
    /// double precision, and blocks that the reach names.
    fn compare(cloud: &SurfelCloud, shrink: f32) -> (usize, usize, usize) {
        let camera = scene::camera(96, 64);
        let settings = RenderSettings::default();
        let views = [SubmapView::new(cloud, Pose::identity())];
        let mut found = project(&views, &camera, &settings);
        let (mut missed, mut needed, mut named) = (0, 0, 0);
        for (slot, surfel) in oracle::in_camera(&views).iter().enumerate() {
            let reach = &mut found.reach[slot];
            let visible = found.projected[slot].z > 0.0;
            reach.conic = reach.conic.map(|v| v / shrink);
            reach.radius2 *= shrink;
            for tile in 0..6 * 4 {
                let (x0, y0) = (tile % 6 * TILE, tile / 6 * TILE);
                let [left, up, right, down] = reach.tiles();
                let in_box = (left..=right).contains(&(tile % 6)) && (up..=down).contains(&(tile / 6));
                let bits = if visible && in_box {
                    pulp::Arch::new().dispatch(Blocks(reach, [x0 as f32, y0 as f32]))
                } else {
                    0
                };
                for block in 0..16 {
                    let touched = (0..16).any(|i| {
                        let x = x0 + block % 4 * BLOCK + i % 4;
                        let y = y0 + block / 4 * BLOCK + i / 4;
                        let (alpha, _) = oracle::hit(surfel, x as f64, y as f64, &camera, &settings);
                        // Rounding may take the last thousandth.
                        alpha >= settings.alpha_min as f64 * 1.001 && alpha <= ALPHA_MAX as f64
                    });
                    needed += touched as usize;
                    named += (bits >> block & 1) as usize;
                    missed += (touched && bits >> block & 1 == 0) as usize;
                }
            }
        }
        (missed, needed, named)
    }

    #[test]
    fn no_hit_lies_outside_and_little_else_lies_inside() {
        let camera = scene::camera(96, 64);
        for (hits, limit) in [(3.0, 1.35), (200.0, 1.15), (2000.0, 1.1)] {
            let cloud = scene::scattered(&camera, 150, hits, 7);
            let (missed, needed, named) = compare(&cloud, 1.0);
            assert_eq!(missed, 0, "of {needed}");
            assert!((named as f64) < limit * needed as f64, "{named} blocks for {needed}");
            let (missed, _, _) = compare(&cloud, 0.5);
            assert!(missed > 0, "the harness sees regions that are too small");
        }
    }
}
