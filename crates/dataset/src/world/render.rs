//! Pictures of the scene: one ray per pixel for depth, four for colour.

use super::light::LightMap;
use super::scene::{Hit, Scene, V3};
use coma_frame::Image;
use coma_geometry::{Intrinsics, Pose};
use rayon::prelude::*;

/// A picture without sensor errors.
#[derive(Clone, Debug)]
pub struct CleanPicture {
    /// Linear RGB, `[height, width]`.
    pub color: Image<[f32; 3]>,
    /// Metres along z at the pixel's centre, `[height, width]`; 0 where nothing was hit.
    pub depth_m: Image<f32>,
    /// Cosine between ray and surface normal, `[height, width]`.
    pub facing: Image<f32>,
}

#[derive(Clone, Copy)]
struct Sample {
    /// Object and face; `u32::MAX` where nothing was hit.
    surface: u32,
    hit: Option<Hit>,
    facing: f32,
}

/// Where in a pixel colour is sampled.
const OFFSETS: [(f64, f64); 4] = [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)];

/// Ray-traces one picture.
pub fn render(
    scene: &Scene,
    light: &LightMap,
    camera: &Intrinsics,
    world_from_camera: &Pose,
) -> CleanPicture {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let origin: V3 = world_from_camera.translation.vector.cast();
    let rotation = world_from_camera.rotation;
    // Rays have z = 1 in the camera, so a hit's distance along the ray is its depth.
    let ray = |u: f64, v: f64| -> V3 { (rotation * camera.ray(u, v)).cast() };

    let mut samples = vec![Sample { surface: u32::MAX, hit: None, facing: 0.0 }; width * height];
    samples.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, sample) in row.iter_mut().enumerate() {
            let direction = ray(x as f64, y as f64);
            let Some(hit) = scene.trace(&origin, &direction) else { continue };
            let object = &scene.objects[hit.object as usize];
            let point = object.surface_point(&(origin + direction * hit.t));
            let normal = object.turned_out(&point.normal);
            *sample = Sample {
                surface: hit.object * 8 + point.face as u32,
                hit: Some(hit),
                facing: -normal.dot(&direction) / direction.norm(),
            };
        }
    });

    let mut color = vec![[0.0f32; 3]; width * height];
    color.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, out) in row.iter_mut().enumerate() {
            let here = &samples[y * width + x];
            let same = |x: usize, y: usize| samples[y * width + x].surface == here.surface;
            let inside = x > 0 && y > 0 && x + 1 < width && y + 1 < height;
            // Away from edges all four rays meet the surface that the centre met.
            let uniform = inside
                && same(x - 1, y)
                && same(x + 1, y)
                && same(x, y - 1)
                && same(x, y + 1)
                && here.hit.is_some();
            let mut sum = [0.0f32; 3];
            // Light varies over decimetres: one look-up serves a pixel that shows one surface.
            let mut shared_brightness = None;
            for (du, dv) in OFFSETS {
                let direction = ray(x as f64 + du, y as f64 + dv);
                let known = here.hit.filter(|_| uniform).and_then(|hit| {
                    let t = scene.objects[hit.object as usize].entry(&origin, &direction)?;
                    Some(Hit { t, ..hit })
                });
                let Some(hit) = known.or_else(|| scene.trace(&origin, &direction)) else { continue };
                let object = &scene.objects[hit.object as usize];
                let point = object.surface_point(&(origin + direction * hit.t));
                let footprint_m = hit.t / camera.fx as f32 * 0.6 / here.facing.max(0.25);
                let reflectance = object.material.reflectance(&point, object.seed, footprint_m);
                let look_up = || light.at(hit.object, object, &point);
                let brightness =
                    if uniform { *shared_brightness.get_or_insert_with(look_up) } else { look_up() };
                for c in 0..3 {
                    sum[c] += 0.25 * brightness * reflectance[c];
                }
            }
            *out = sum;
        }
    });
    let image =
        |value: &dyn Fn(&Sample) -> f32| Image::from_fn(width, height, |x, y| value(&samples[y * width + x]));
    CleanPicture {
        depth_m: image(&|s| s.hit.map_or(0.0, |hit| hit.t)),
        facing: image(&|s| s.facing),
        color: Image::from_pixels(width, height, color).expect("one colour per pixel"),
    }
}
