//! Every pixel of a view as a point that is found by projection: the last scales of refinement. Averages over voxels
//! cut corners by a share of their side; pixels don't.

use crate::cloud::{PointCloud, voxel};
use crate::icp::evenly;
use crate::settings::PixelScale;
use crate::view::Prepared;
use coma_frame::{Image, normals::normal_at, pyramid};
use coma_geometry::Intrinsics;
use nalgebra::{Point3, Vector3};
use std::borrow::Cow;

/// Surfaces seen under more than 75 degrees from their normal are left out: depth is poor there.
const GRAZING_COS: f32 = 0.2588;
/// No point lies at this pixel.
const NONE: u32 = u32::MAX;

/// The points of a view, and which pixel shows which.
#[derive(Clone, Debug)]
pub struct Pixels {
    /// Row by row, with normals and gradients.
    pub cloud: PointCloud,
    camera: Intrinsics,
    /// Index into the cloud, or [`NONE`].
    index: Image<u32>,
    /// Indices of the points that look for a counterpart, evenly over the surfaces.
    pub(crate) queries: Vec<u32>,
}

impl Pixels {
    /// Pixels that lie on a surface: all but those near a depth jump (relative) and those seen from the side.
    pub fn new(view: &Prepared, jump: f32, scale: &PixelScale) -> Self {
        let (mut depth_m, mut intensity, mut camera) =
            (Cow::Borrowed(&view.depth_m), Cow::Borrowed(&view.intensity), view.camera);
        let halvings = scale.bounded_halvings();
        for _ in 0..halvings {
            depth_m = Cow::Owned(pyramid::halve_depth(&depth_m, jump));
            intensity = Cow::Owned(pyramid::halve(&intensity));
            camera = camera.halved();
        }
        // Pixels to either side over which normals and gradients are taken: halved pictures are calmer.
        let step = if halvings == 0 { 2 } else { 1 };
        // The depth of an inclined surface changes more from one coarse pixel to the next.
        let jump = jump * (1 << halvings) as f32;
        let (width, height) = (depth_m.width(), depth_m.height());
        let mut index = Image::filled(width, height, NONE);
        let mut cloud = PointCloud::default();
        let point = |x: usize, y: usize| {
            camera.back_project(x as f64, y as f64, depth_m[(x, y)] as f64).cast::<f32>()
        };
        for y in 0..height {
            for x in 0..width {
                let Some(normal) = normal_at(&depth_m, &camera, jump, step, x, y) else { continue };
                let (p, normal) = (point(x, y), Vector3::from(normal));
                if !(-normal.dot(&p.coords) >= GRAZING_COS * p.coords.norm()) {
                    continue;
                }
                let (left, right, up, down) = ((x - step, y), (x + step, y), (x, y - step), (x, y + step));
                let across = point(right.0, right.1) - point(left.0, left.1);
                let along = point(down.0, down.1) - point(up.0, up.1);
                // The vector g of the tangent plane with g . across and g . along as the picture has them.
                let (du, dv) = (intensity[right] - intensity[left], intensity[down] - intensity[up]);
                let volume = across.dot(&along.cross(&normal));
                let gradient = (along.cross(&normal) * du + normal.cross(&across) * dv) / volume;
                index[(x, y)] = cloud.len() as u32;
                cloud.points.push(p);
                cloud.normals.push(normal);
                cloud.intensity.push(intensity[(x, y)]);
                cloud.gradients.push(if gradient.norm().is_finite() { gradient } else { Vector3::zeros() });
            }
        }
        let queries = evenly(&one_per_voxel(&cloud.points, scale.spacing_m), scale.points);
        Pixels { cloud, camera, index, queries }
    }

    /// The point at the pixel where another one of this camera's frame is seen, if it lies within `reach_m`.
    pub fn at(&self, point: &Point3<f32>, reach_m: f32) -> Option<usize> {
        let pixel = self.camera.project(&point.cast::<f64>())?;
        let (x, y) = ((pixel.x + 0.5).floor(), (pixel.y + 0.5).floor());
        let inside = x >= 0.0 && y >= 0.0 && x < self.index.width() as f64 && y < self.index.height() as f64;
        let found = if inside { self.index[(x as usize, y as usize)] } else { NONE };
        if found == NONE {
            return None;
        }
        let gap = self.cloud.points[found as usize] - point;
        (gap.norm_squared() <= reach_m * reach_m).then_some(found as usize)
    }
}

/// Of the points of every voxel the one with the least scrambled index: a regular pick would see only some columns.
fn one_per_voxel(points: &[Point3<f32>], voxel_m: f32) -> Vec<u32> {
    let scrambled = |i: u32| i.wrapping_mul(SCRAMBLE);
    let mut order: Vec<(u64, u32)> =
        points.iter().enumerate().map(|(i, p)| (voxel(p, voxel_m), scrambled(i as u32))).collect();
    order.sort_unstable();
    order.dedup_by_key(|entry| entry.0);
    order.into_iter().map(|entry| entry.1.wrapping_mul(UNSCRAMBLE)).collect()
}

/// An odd factor (Knuth's multiplicative hash), and its inverse modulo 2^32.
const SCRAMBLE: u32 = 2_654_435_761;
const UNSCRAMBLE: u32 = 244_002_641;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::outcome::Side;
    use crate::settings::Settings;
    use crate::view::View;
    use coma_frame::DepthNoise;

    /// A wall that leans away to the right, with a box 1 m before it on the left; intensity grows with x and y in metres.
    fn view() -> Prepared {
        let camera = Intrinsics { width: 160, height: 120, fx: 130.0, fy: 130.0, cx: 79.5, cy: 59.5 };
        let ray = |x: usize, y: usize| camera.ray(x as f64, y as f64);
        // x * 0.3 - z * 1 + 2 = 0 for x = ray.x * z.
        let depth = |x: usize, y: usize| if x < 40 { 1.0 } else { (2.0 / (1.0 - 0.3 * ray(x, y).x)) as f32 };
        let point = |x: usize, y: usize| ray(x, y) * depth(x, y) as f64;
        let intensity =
            |x: usize, y: usize| (0.4 + 0.1 * point(x, y).x + 0.05 * point(x, y).y).clamp(0.0, 1.0) as f32;
        let view = View {
            depth_m: Image::from_fn(160, 120, depth),
            intensity: Image::from_fn(160, 120, intensity),
            camera,
            noise: DepthNoise::default(),
        };
        Prepared::new(&view, &Settings::default(), Side::Source).unwrap()
    }

    const SCALE: PixelScale = PixelScale {
        halvings: 0,
        points: 10_000,
        spacing_m: 0.025,
        max_correspondence_m: 0.04,
        iterations: 8,
    };

    #[test]
    fn normals_and_gradients_are_those_of_the_surface() {
        let pixels = Pixels::new(&view(), 0.05, &SCALE);
        let normal = Vector3::new(0.3, 0.0, -1.0).normalize();
        // The change of intensity along the wall: that in space without its part along the normal.
        let in_space = Vector3::new(0.1, 0.05, 0.0);
        let gradient = in_space - normal * normal.dot(&in_space);
        let right = (0..pixels.cloud.len()).filter(|&i| pixels.cloud.points[i].z > 1.5);
        assert!(right.clone().count() > 5000);
        for i in right {
            assert!((pixels.cloud.normals[i] - normal).norm() < 1e-3, "{}", pixels.cloud.normals[i]);
            assert!((pixels.cloud.gradients[i] - gradient).norm() < 2e-3, "{}", pixels.cloud.gradients[i]);
        }
    }

    #[test]
    fn a_point_is_found_at_its_pixel_and_not_beyond_the_reach_or_near_the_jump() {
        let pixels = Pixels::new(&view(), 0.05, &SCALE);
        let p = pixels.cloud.points[pixels.cloud.len() / 2];
        let found = pixels.at(&(p + Vector3::new(0.001, -0.001, 0.0)), 0.01).unwrap();
        assert_eq!(pixels.cloud.points[found], p);
        assert_eq!(pixels.at(&(p * 1.02), 0.01), None, "2 % farther away");
        assert_eq!(pixels.at(&Point3::new(0.0, 0.0, -1.0), 10.0), None, "behind the camera");
        let beside_the_jump = Point3::from(pixels.camera.ray(39.0, 60.0).cast::<f32>());
        assert_eq!(pixels.at(&beside_the_jump, 10.0), None);
    }

    #[test]
    fn halved_pictures_show_the_same_surfaces() {
        let view = view();
        let halved = Pixels::new(&view, 0.05, &PixelScale { halvings: 1, ..SCALE });
        assert_eq!(halved.camera, view.camera.halved());
        let whole = Pixels::new(&view, 0.05, &SCALE);
        let share = halved.cloud.len() as f64 / whole.cloud.len() as f64;
        assert!(share > 0.2 && share < 0.3, "{share}");
        for p in halved.cloud.points.iter().filter(|p| p.z > 1.5) {
            assert!((p.x * 0.3 - p.z + 2.0).abs() < 2e-3, "{p}");
        }
        // What a file of settings may ask for at most.
        Pixels::new(&view, 0.05, &PixelScale { halvings: u32::MAX, ..SCALE });
    }

    #[test]
    fn those_that_ask_lie_in_different_voxels_and_are_no_more_than_allowed() {
        let view = view();
        let scale = PixelScale { spacing_m: 0.05, ..SCALE };
        let pixels = Pixels::new(&view, 0.05, &scale);
        let mut voxels: Vec<u64> =
            pixels.queries.iter().map(|&i| voxel(&pixels.cloud.points[i as usize], 0.05)).collect();
        let count = voxels.len();
        voxels.sort_unstable();
        voxels.dedup();
        assert_eq!(voxels.len(), count);
        assert!(count > 500, "{count}");
        assert_eq!(Pixels::new(&view, 0.05, &PixelScale { points: 100, ..scale }).queries.len(), 100);
    }
}
