//! What a real camera does to a clean picture.

use super::noise::{hash, normal, unit};
use super::render::CleanPicture;
use coma_frame::{DepthNoise, Image};
use serde::{Deserialize, Serialize};

/// Errors of a hand-held RGB-D camera.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SensorNoise {
    /// Standard deviation of depth, and the steps (one deviation wide) in which it is measured.
    pub depth: DepthNoise,
    /// Share of pixels beside a depth jump that have no depth. Kinect: more than half.
    pub edge_dropout: f32,
    /// Surfaces seen more edge-on than this cosine have no depth. Kinect: about 0.17 (80 degrees).
    pub grazing_cosine: f32,
    /// No depth beyond, metres. Kinect: 5 to 8.
    pub max_depth_m: f32,
    /// Standard deviation of colour, in units of 1/255.
    pub color_sigma: f32,
    /// How far automatic exposure wanders, as a share of brightness.
    pub exposure_drift: f32,
}

impl Default for SensorNoise {
    fn default() -> Self {
        SensorNoise {
            depth: DepthNoise::default(),
            edge_dropout: 0.6,
            grazing_cosine: 0.17,
            max_depth_m: 8.0,
            color_sigma: 1.5,
            exposure_drift: 0.05,
        }
    }
}

/// A depth step to a neighbour of more than this share is a jump.
const JUMP: f32 = 0.04;
/// Brightness of a picture before exposure drift.
const EXPOSURE: f32 = 0.92;
const GAMMA_STEPS: usize = 4096;

/// Turns a clean picture into sRGB bytes and depth codes. `seed` differs for every frame.
pub fn expose(
    picture: &CleanPicture,
    noise: Option<&SensorNoise>,
    frame: usize,
    seed: u32,
    depth_units_per_metre: f32,
) -> (Image<[u8; 3]>, Image<u16>) {
    let (width, height) = (picture.depth_m.width(), picture.depth_m.height());
    let seed = hash(seed, frame as u32);
    let drift = |n: &SensorNoise| {
        // Exposure 1 in the first frame, then two slow waves.
        let t = frame as f32;
        1.0 + n.exposure_drift * (0.7 * (t / 41.0).sin() + 0.3 * (t / 17.0).sin())
    };
    let gain = EXPOSURE * noise.map_or(1.0, drift);
    // Display gamma by table: 1/4096 steps are finer than a byte's everywhere above the darkest codes.
    let gamma: Vec<f32> =
        (0..=GAMMA_STEPS).map(|i| 255.0 * (i as f32 / GAMMA_STEPS as f32).powf(1.0 / 2.2)).collect();
    let color = Image::from_fn(width, height, |x, y| {
        let pixel = (y * width + x) as u32;
        let linear = picture.color[(x, y)];
        std::array::from_fn(|c| {
            let clean = gamma[((linear[c] * gain).clamp(0.0, 1.0) * GAMMA_STEPS as f32 + 0.5) as usize];
            let error = noise.map_or(0.0, |n| n.color_sigma * normal(pixel, seed ^ (c as u32 + 1)));
            (clean + error).round().clamp(0.0, 255.0) as u8
        })
    });
    let depth = Image::from_fn(width, height, |x, y| {
        let mut z = picture.depth_m[(x, y)];
        if let Some(n) = noise {
            let pixel = (y * width + x) as u32;
            let jump = [(-1i64, 0i64), (1, 0), (0, -1), (0, 1)].iter().any(|(dx, dy)| {
                let neighbour = picture.depth_m.get((x as i64 + dx) as usize, (y as i64 + dy) as usize);
                neighbour.is_some_and(|other| (other - z).abs() > JUMP * z)
            });
            let dropped = jump && unit(pixel, seed ^ 0x51) < n.edge_dropout;
            if dropped || picture.facing[(x, y)] < n.grazing_cosine || z > n.max_depth_m {
                return 0;
            }
            let sigma = n.depth.sigma_m(z);
            z += sigma * normal(pixel, seed ^ 0x77);
            // A disparity sensor measures in steps that grow like its error.
            z = (z / sigma).round() * sigma;
        }
        let code = (z * depth_units_per_metre).round();
        if (1.0..65535.0).contains(&code) { code as u16 } else { 0 }
    });
    (color, depth)
}
