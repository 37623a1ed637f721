//! Made-up scenes from a seed, to measure with.

use coma_geometry::Intrinsics;
use coma_surfel::{Surfel, SurfelCloud};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

/// Numbers from a seed (a linear congruential generator: the same on every machine).
struct Random(u64);

impl Random {
    fn between(&mut self, a: f32, b: f32) -> f32 {
        self.0 = self.0.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        a + (b - a) * ((self.0 >> 40) as f32 / (1u64 << 24) as f32)
    }
}

/// A camera with a view of about 60 degrees.
pub fn camera(width: u32, height: u32) -> Intrinsics {
    let f = 0.85 * width as f64;
    let (cx, cy) = ((width as f64 - 1.0) / 2.0, (height as f64 - 1.0) / 2.0);
    Intrinsics { width, height, fx: f, fy: f, cx, cy }
}

/// `count` surfels all over the picture, 1 to 4 m away, turned any way up to 70 degrees, of any opacity from 0.1
/// to 0.9, and so large that about `hits` of them meet a pixel before it is done.
pub fn scattered(camera: &Intrinsics, count: usize, hits: f32, seed: u64) -> SurfelCloud {
    let mut random = Random(seed);
    // A disc of standard deviation s covers 2 pi s^2 ln(o / alpha_min) pixels, less where it is inclined; the
    // factor makes up for that, for the low-pass and for pixels that are done.
    let area_px = 1.05 * hits * camera.pixels() as f32 / count.max(1) as f32;
    let spread_px = (area_px / (2.0 * std::f32::consts::PI * 4.7)).sqrt();
    (0..count)
        .map(|_| {
            let (x, y) =
                (random.between(0.0, camera.width as f32), random.between(0.0, camera.height as f32));
            let z = random.between(1.0, 4.0);
            let (tilt, turn) = (random.between(0.0, 1.22), random.between(0.0, std::f32::consts::TAU));
            let lean = UnitQuaternion::from_scaled_axis(Vector3::new(turn.cos(), turn.sin(), 0.0) * tilt);
            let roll =
                UnitQuaternion::from_scaled_axis(Vector3::z() * random.between(0.0, std::f32::consts::PI));
            let size = spread_px * z / camera.fx as f32;
            let center: Vector3<f32> = camera.ray(x as f64, y as f64).cast() * z;
            surfel(
                center,
                lean * roll,
                [size * random.between(0.8, 1.6), size * random.between(0.8, 1.6)],
                random.between(0.1, 0.9),
                [random.between(0.0, 1.0), random.between(0.0, 1.0), random.between(0.0, 1.0)],
            )
        })
        .collect()
}

/// What mapping makes of a smooth surface: one surfel for every second pixel in both directions, at the depth of
/// a wavy wall 2 to 3 m away, overlapping and nearly opaque.
pub fn surface(camera: &Intrinsics, seed: u64) -> SurfelCloud {
    let mut random = Random(seed);
    let depth = |x: f64, y: f64| {
        let (u, v) = (x / camera.width as f64, y / camera.height as f64);
        2.5 + 0.3 * (9.0 * u).sin() + 0.2 * (7.0 * v + 2.0 * u).cos()
    };
    let point = |x: f64, y: f64| camera.ray(x, y) * depth(x, y);
    let mut out = SurfelCloud::default();
    for y in (1..camera.height).step_by(2) {
        for x in (1..camera.width).step_by(2) {
            let (x, y) = (x as f64, y as f64);
            let center = point(x, y);
            let right = (point(x + 1.0, y) - center).normalize();
            let normal = right.cross(&(point(x, y + 1.0) - center)).normalize();
            let axes = Matrix3::from_columns(&[right, normal.cross(&right), normal]);
            let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes));
            let size = (1.6 * center.z / camera.fx) as f32;
            let shade = random.between(0.2, 0.8);
            let scale = [size * random.between(0.9, 1.1), size * random.between(0.9, 1.1)];
            out.push(surfel(center.cast(), rotation.cast(), scale, 0.95, [shade, shade, 1.0 - shade]));
        }
    }
    out
}

fn surfel(
    center: Vector3<f32>,
    rotation: UnitQuaternion<f32>,
    scale_m: [f32; 2],
    opacity: f32,
    color: [f32; 3],
) -> Surfel {
    let rotation_wxyz = [rotation.w, rotation.i, rotation.j, rotation.k];
    Surfel { center_m: center.into(), rotation_wxyz, scale_m, opacity, color }
}
