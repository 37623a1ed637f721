//! The descriptor that needs no download: gradient orientations and colours, 221 bytes.
//!
//! Two parts, each a unit vector:
//! * *structure*: histograms of gradient orientation (Dalal & Triggs 2005) of log luminance over 3x4 cells
//!   with bilinear shares, each cell normalised: exposure and gamma cancel.
//! * *colour*: a joint histogram of the three channels, each on a log scale and standardised over the image:
//!   white balance and exposure cancel. It has no layout, so it survives another viewpoint.

use crate::descriptor::Space;
use crate::encoder::{EncodeError, Encoder, Thresholds};
use coma_frame::{Image, luminance};

const CELLS_X: usize = 4;
const CELLS_Y: usize = 3;
const ORIENTATIONS: usize = 8;
const LEVELS: usize = 5;
const STRUCTURE: usize = CELLS_X * CELLS_Y * ORIENTATIONS;
const COLOR: usize = LEVELS * LEVELS * LEVELS;
/// Weight of the colour part against the structure part; calibrated on a real kitchen.
const COLOR_WEIGHT: f32 = 0.5;
/// Added to 0..255 before the logarithm: dark pixels are mostly noise.
const LOG_OFFSET: f32 = 8.0;
/// A channel's values within this many standard deviations spread over the levels.
const COLOR_SPAN: f32 = 2.2;

/// The builtin encoder, `builtin/1`.
#[derive(Clone, Debug)]
pub struct Builtin {
    space: Space,
}

impl Default for Builtin {
    fn default() -> Self {
        Builtin { space: Space::try_from("builtin/1".to_owned()).expect("a valid name") }
    }
}

impl Encoder for Builtin {
    fn space(&self) -> &Space {
        &self.space
    }

    fn dimension(&self) -> usize {
        STRUCTURE + COLOR
    }

    /// On a real kitchen they pass 97 % of the pairs that share 40 %, and a fifth of those that share less than 10 %:
    /// recall first, registration decides.
    fn thresholds(&self) -> Thresholds {
        Thresholds { theta_sim: 0.92, theta_multi: 0.93 }
    }

    /// Depth is not used: appearance alone is the same for sensors of any range.
    fn encode(&self, color: &Image<[u8; 3]>, _depth_m: Option<&Image<f32>>) -> Result<Vec<f32>, EncodeError> {
        let (width, height) = (color.width(), color.height());
        if width < 16 || height < 16 {
            return Err(EncodeError::Size { width, height });
        }
        let small = resize(color, 128, 96);
        let mut out = unit(structure(&small));
        out.extend(unit(colors(&small)).into_iter().map(|v| v * COLOR_WEIGHT));
        Ok(out)
    }
}

fn unit(mut values: Vec<f32>) -> Vec<f32> {
    let norm = values.iter().map(|v| v * v).sum::<f32>().sqrt();
    if norm > 0.0 {
        values.iter_mut().for_each(|v| *v /= norm);
    }
    values
}

/// Mean over the area that each output pixel covers; channels in 0..255.
fn resize(image: &Image<[u8; 3]>, width: usize, height: usize) -> Image<[f32; 3]> {
    let rows: Image<[f32; 3]> = {
        let shares = shares(image.width(), width);
        Image::from_fn(width, image.height(), |x, y| weighted(&shares[x], |i| image[(i, y)].map(f32::from)))
    };
    let shares = shares(image.height(), height);
    Image::from_fn(width, height, |x, y| weighted(&shares[y], |i| rows[(x, i)]))
}

fn weighted(shares: &[(usize, f32)], value: impl Fn(usize) -> [f32; 3]) -> [f32; 3] {
    let mut sum = [0.0; 3];
    for &(i, w) in shares {
        let v = value(i);
        for c in 0..3 {
            sum[c] += w * v[c];
        }
    }
    sum
}

/// For each output cell the input cells that it covers and their shares, which sum to 1.
fn shares(from: usize, to: usize) -> Vec<Vec<(usize, f32)>> {
    let ratio = from as f64 / to as f64;
    (0..to)
        .map(|o| {
            let (low, high) = (o as f64 * ratio, (o + 1) as f64 * ratio);
            (low as usize..(high.ceil() as usize).min(from))
                .map(|i| (i, (((i + 1) as f64).min(high) - (i as f64).max(low)).max(0.0)))
                .map(|(i, share)| (i, (share / ratio) as f32))
                .collect()
        })
        .collect()
}

/// Two bins and their shares for a position in units of bins, whose centres lie at whole numbers.
fn split(position: f32) -> [(isize, f32); 2] {
    let low = position.floor();
    [(low as isize, 1.0 - (position - low)), (low as isize + 1, position - low)]
}

fn structure(image: &Image<[f32; 3]>) -> Vec<f32> {
    let (width, height) = (image.width(), image.height());
    let log = image.map(|c| (luminance(*c) + LOG_OFFSET).ln());
    let mut bins = vec![0.0f32; STRUCTURE];
    for y in 1..height - 1 {
        for x in 1..width - 1 {
            let gx = log[(x + 1, y)] - log[(x - 1, y)];
            let gy = log[(x, y + 1)] - log[(x, y - 1)];
            let magnitude = gx.hypot(gy);
            let turn = gy.atan2(gx) / std::f32::consts::PI;
            let orientation = (turn - turn.floor()) * ORIENTATIONS as f32 - 0.5;
            let cell_x = (x as f32 + 0.5) / width as f32 * CELLS_X as f32 - 0.5;
            let cell_y = (y as f32 + 0.5) / height as f32 * CELLS_Y as f32 - 0.5;
            for (cy, wy) in split(cell_y) {
                for (cx, wx) in split(cell_x) {
                    if cy < 0 || cx < 0 || cy >= CELLS_Y as isize || cx >= CELLS_X as isize {
                        continue;
                    }
                    let cell = cy as usize * CELLS_X + cx as usize;
                    for (o, wo) in split(orientation) {
                        let o = o.rem_euclid(ORIENTATIONS as isize) as usize;
                        bins[cell * ORIENTATIONS + o] += magnitude * wy * wx * wo;
                    }
                }
            }
        }
    }
    // Square roots: one strong edge does not outvote the rest (Hellinger kernel).
    for cell in bins.chunks_mut(ORIENTATIONS) {
        cell.iter_mut().for_each(|v| *v = v.sqrt());
        let norm = cell.iter().map(|v| v * v).sum::<f32>().sqrt() + 1e-6;
        cell.iter_mut().for_each(|v| *v /= norm);
    }
    bins
}

fn colors(image: &Image<[f32; 3]>) -> Vec<f32> {
    let log = image.map(|c| c.map(|v| (v + LOG_OFFSET).ln()));
    let n = log.pixels().len() as f64;
    let mut mean = [0.0f64; 3];
    let mut deviation = [0.0f64; 3];
    for c in 0..3 {
        mean[c] = log.pixels().iter().map(|p| p[c] as f64).sum::<f64>() / n;
        let variance = log.pixels().iter().map(|p| (p[c] as f64 - mean[c]).powi(2)).sum::<f64>() / n;
        deviation[c] = variance.sqrt() + 1e-3;
    }
    let mut bins = vec![0.0f32; COLOR];
    for pixel in log.pixels() {
        let level = |c: usize| {
            let standard = (pixel[c] - mean[c] as f32) / deviation[c] as f32;
            let position = (standard / (2.0 * COLOR_SPAN) + 0.5) * LEVELS as f32 - 0.5;
            split(position.clamp(0.0, LEVELS as f32 - 1.001))
        };
        let (r, g, b) = (level(0), level(1), level(2));
        for (i, wi) in r {
            for (j, wj) in g {
                for (k, wk) in b {
                    bins[(i as usize * LEVELS + j as usize) * LEVELS + k as usize] += wi * wj * wk;
                }
            }
        }
    }
    bins.into_iter().map(|v| (v / n as f32).sqrt()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::descriptor::similarity;

    /// Stripes and discs whose directions, places and colours follow from the seed.
    fn picture(seed: usize) -> Image<[u8; 3]> {
        let angle = seed as f32 * 0.9;
        Image::from_fn(320, 240, |x, y| {
            let (x, y) = (x as f32, y as f32);
            let stripe = ((x * angle.cos() + y * angle.sin()) / 25.0).sin() > 0.3;
            let disc = (x - 60.0 * seed as f32).hypot(y - 120.0) < 70.0;
            match (stripe, disc, seed % 2) {
                (_, true, 0) => [200, 60, 40],
                (_, true, _) => [40, 80, 190],
                (true, ..) => [150, 140, 90],
                (false, ..) => [60, 90, 70],
            }
        })
    }

    #[test]
    fn exposure_and_white_balance_hardly_matter_and_another_scene_does() {
        let encoder = Builtin::default();
        let of = |image: &Image<[u8; 3]>| encoder.describe(image, None).unwrap();
        let scene = picture(1);
        let darker = scene.map(|c| c.map(|v| (255.0 * (v as f32 / 255.0).powf(1.6)) as u8));
        let warmer = scene.map(|c| [c[0], (c[1] as f32 * 0.9) as u8, (c[2] as f32 * 0.75) as u8]);
        let base = of(&scene);
        let other = similarity(&base, &of(&picture(2))).unwrap();
        for changed in [darker, warmer] {
            let same = similarity(&base, &of(&changed)).unwrap();
            assert!(same > 0.95 && same > other + 0.05, "{same} against {other}");
        }
        assert!(base.values().len() <= 256);
        assert_eq!(base.values().len(), encoder.dimension());
    }

    #[test]
    fn resolution_hardly_matters() {
        let encoder = Builtin::default();
        let of = |image: &Image<[u8; 3]>| encoder.describe(image, None).unwrap();
        let half = {
            let small = resize(&picture(1), 160, 120);
            small.map(|c| c.map(|v| v.round() as u8))
        };
        assert!(similarity(&of(&picture(1)), &of(&half)).unwrap() > 0.99);
    }

    #[test]
    fn a_plain_image_has_a_descriptor_and_a_tiny_one_does_not() {
        let encoder = Builtin::default();
        assert!(encoder.describe(&Image::filled(64, 48, [90, 90, 90]), None).is_ok());
        let tiny = encoder.describe(&Image::filled(8, 8, [0, 0, 0]), None);
        assert_eq!(tiny, Err(EncodeError::Size { width: 8, height: 8 }));
    }
}
