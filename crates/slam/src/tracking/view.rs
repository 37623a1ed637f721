//! What is aligned: a picture with depth, normals and intensity at several resolutions.

use coma_frame::{DepthNoise, Image, RgbdFrame, normals, pyramid};
use coma_geometry::Intrinsics;
use nalgebra::Vector3;
use rayon::prelude::*;
use std::sync::Arc;

/// Relative depth difference beyond which two neighbours lie on different surfaces.
pub const DEPTH_JUMP: f32 = 0.05;
/// Pixels next to a depth jump that are not trusted.
const JUMP_MARGIN_PX: usize = 2;
/// Normals need a base that is wide against the sensor's noise.
const NORMAL_STEP_PX: usize = 2;
/// Nearer points are not looked at, metres.
const NEAR_M: f32 = 0.05;
/// Surfaces seen under more than 75 degrees from their normal are not trusted.
const GRAZING_COS: f32 = 0.2588;

/// One resolution of a [`TrackingView`].
#[derive(Clone, Debug)]
pub struct Level {
    /// Camera of this resolution.
    pub camera: Intrinsics,
    /// Metres; 0 where there is none, or where it is not to be trusted. `[height, width]`
    pub depth_m: Image<f32>,
    /// Unit normals facing the camera, or zero. `[height, width]`
    pub normal: Image<[f32; 3]>,
    /// 0..1. `[height, width]`
    pub intensity: Image<f32>,
}

impl Level {
    /// Where a point of the camera's frame is seen, counted from the picture's corner: `(0.7, 3.2)` lies in pixel
    /// (0, 3). May lie outside; `None` behind the camera.
    pub fn place(&self, point: &Vector3<f32>) -> Option<(f32, f32)> {
        let c = &self.camera;
        let u = c.fx as f32 * point.x / point.z + c.cx as f32 + 0.5;
        let v = c.fy as f32 * point.y / point.z + c.cy as f32 + 0.5;
        (point.z > NEAR_M).then_some((u, v))
    }

    /// Intensity at a place inside the picture, between the pixels around it.
    pub fn intensity_at(&self, (u, v): (f32, f32)) -> f32 {
        let (last_x, last_y) = (self.intensity.width() - 1, self.intensity.height() - 1);
        let (u, v) = ((u - 0.5).max(0.0), (v - 0.5).max(0.0));
        let (x, y) = ((u as usize).min(last_x), (v as usize).min(last_y));
        let (right, below) = ((x + 1).min(last_x), (y + 1).min(last_y));
        let (fu, fv) = (u - x as f32, v - y as f32);
        let i = |x, y| self.intensity[(x, y)];
        let row = |y| i(x, y) * (1.0 - fu) + i(right, y) * fu;
        row(y) * (1.0 - fv) + row(below) * fv
    }

    /// The pixel at such a place, if it lies inside.
    pub fn pixel(&self, (u, v): (f32, f32)) -> Option<(usize, usize)> {
        let (width, height) = (self.depth_m.width() as f32, self.depth_m.height() as f32);
        (u >= 0.0 && v >= 0.0 && u < width && v < height).then_some((u as usize, v as usize))
    }
}

/// A picture to align or to align to; level 0 is the finest.
#[derive(Clone, Debug)]
pub struct TrackingView {
    /// From fine to coarse.
    pub levels: Vec<Arc<Level>>,
    /// How wrong its depth is.
    pub noise: DepthNoise,
}

impl TrackingView {
    /// A sensor's frame, with `levels` resolutions.
    pub fn from_frame(frame: &RgbdFrame, levels: usize) -> Self {
        Self::build(frame.camera, frame.depth_m.clone(), frame.color.luminance(), frame.noise, levels)
    }

    /// A picture given by depth (0 = none or not trusted) and intensity.
    pub fn build(
        camera: Intrinsics,
        depth_m: Image<f32>,
        intensity: Image<f32>,
        noise: DepthNoise,
        levels: usize,
    ) -> Self {
        let mut out = Vec::with_capacity(levels);
        let (mut camera, mut depth_m, mut intensity) = (camera, depth_m, intensity);
        for level in 0..levels {
            if level > 0 {
                camera = camera.halved();
                depth_m = pyramid::halve_depth(&depth_m, DEPTH_JUMP);
                intensity = pyramid::halve(&intensity);
            }
            // The depth of an inclined surface changes more from one coarse pixel to the next.
            let jump = DEPTH_JUMP * (1 << level) as f32;
            let mut normal = normals::normals_from_depth(&depth_m, &camera, jump, NORMAL_STEP_PX);
            drop_grazing(&mut normal, &camera);
            let margin = if level == 0 { JUMP_MARGIN_PX } else { 1 };
            let trusted = away_from_jumps(&depth_m, jump, margin);
            out.push(Arc::new(Level { camera, depth_m: trusted, normal, intensity: intensity.clone() }));
        }
        TrackingView { levels: out, noise }
    }

    /// The same without its `levels` finest resolutions; the coarsest always stays.
    pub fn coarser(&self, levels: usize) -> TrackingView {
        let first = levels.min(self.levels.len().saturating_sub(1));
        TrackingView { levels: self.levels[first..].to_vec(), noise: self.noise }
    }
}

/// Sets normals seen under a grazing angle to zero.
fn drop_grazing(normal: &mut Image<[f32; 3]>, camera: &Intrinsics) {
    let width = normal.width();
    normal.pixels_mut().par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, n) in row.iter_mut().enumerate() {
            let ray = camera.ray(x as f64, y as f64).cast::<f32>();
            let cos = -(n[0] * ray.x + n[1] * ray.y + n[2] * ray.z) / ray.norm();
            if !(cos >= GRAZING_COS) {
                *n = [0.0; 3];
            }
        }
    });
}

/// Depth without the pixels that lie within `margin` of a jump between two measurements.
fn away_from_jumps(depth_m: &Image<f32>, relative: f32, margin: usize) -> Image<f32> {
    let (width, height) = (depth_m.width(), depth_m.height());
    let jump = |a: f32, b: f32| a > 0.0 && b > 0.0 && (a - b).abs() > relative * a.min(b);
    // Row by row first, then column by column: a square of `margin` around every jump.
    let mut near = Image::filled(width, height, false);
    near.pixels_mut().par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        let depth = depth_m.row(y);
        for x in 0..width {
            let right = x + 1 < width && jump(depth[x], depth[x + 1]);
            let below = y + 1 < height && jump(depth[x], depth_m[(x, y + 1)]);
            if right || below {
                let first = (x + 1).saturating_sub(margin);
                row[first..(x + margin + 1).min(width)].fill(true);
            }
        }
    });
    let mut out = depth_m.clone();
    out.pixels_mut().par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        let rows = (y + 1).saturating_sub(margin + 1)..(y + margin).min(height);
        for (x, z) in row.iter_mut().enumerate() {
            if rows.clone().any(|r| near[(x, r)]) {
                *z = 0.0;
            }
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Intrinsics = Intrinsics { width: 64, height: 48, fx: 60.0, fy: 60.0, cx: 31.5, cy: 23.5 };

    #[test]
    fn pixels_within_two_of_a_jump_are_not_trusted() {
        let depth = Image::from_fn(64, 48, |x, _| if x < 32 { 1.0 } else { 2.0 });
        let view = TrackingView::build(CAMERA, depth, Image::filled(64, 48, 0.5), DepthNoise::default(), 1);
        let kept: Vec<usize> = (0..64).filter(|x| view.levels[0].depth_m[(*x, 20)] == 0.0).collect();
        assert_eq!(kept, [30, 31, 32, 33]);
    }

    #[test]
    fn surfaces_seen_from_the_side_have_no_normal() {
        // A floor under the camera: rays at `slope` below the horizon meet it at atan(slope) from grazing.
        let depth = Image::from_fn(64, 48, |_, y| {
            let slope = (y as f32 - 13.5) / 60.0;
            if slope > 0.05 { 1.0 / slope } else { 0.0 }
        });
        let camera = Intrinsics { cy: 13.5, ..CAMERA };
        let mut normal = normals::normals_from_depth(&depth, &camera, 0.2, 1);
        assert_ne!(normal[(32, 24)], [0.0; 3]);
        drop_grazing(&mut normal, &camera);
        assert_eq!(normal[(32, 24)], [0.0; 3], "10 degrees from grazing");
        assert_ne!(normal[(32, 40)], [0.0; 3], "24 degrees from grazing");
    }
}
