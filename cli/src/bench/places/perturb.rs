//! The same view, seen otherwise: another exposure, another white balance, nearer, out of focus.

use coma_frame::Image;

/// Number of perturbations.
pub const KINDS: usize = 4;
/// Standard deviation of the blur, pixels, and its reach.
const BLUR_PX: f32 = 3.0;
const BLUR_REACH: isize = 9;

/// Gamma 1.8; gains 1.25, 1 and 0.75; the middle 80 % at the old size; a blur of 3 pixels.
pub fn perturbed(image: &Image<[u8; 3]>, kind: usize) -> Image<[u8; 3]> {
    match kind {
        0 => image.map(|c| c.map(|v| (255.0 * (v as f64 / 255.0).powf(1.8)) as u8)),
        1 => image.map(|c| [(c[0] as f64 * 1.25).min(255.0) as u8, c[1], (c[2] as f64 * 0.75) as u8]),
        2 => zoomed(image),
        _ => blurred(image),
    }
}

/// Without a tenth at every side, bilinear.
fn zoomed(image: &Image<[u8; 3]>) -> Image<[u8; 3]> {
    let (width, height) = (image.width(), image.height());
    let (left, top) = (width / 10, height / 10);
    let (inner_width, inner_height) = (width - 2 * left, height - 2 * top);
    let at = |k: usize, from: usize, to: usize| {
        let position = ((k as f32 + 0.5) * from as f32 / to as f32 - 0.5).clamp(0.0, (from - 1) as f32);
        let low = (position as usize).min(from.saturating_sub(2));
        (low, position - low as f32)
    };
    Image::from_fn(width, height, |x, y| {
        let ((x0, fx), (y0, fy)) = (at(x, inner_width, width), at(y, inner_height, height));
        let pixel = |dx: usize, dy: usize| {
            image[(left + (x0 + dx).min(inner_width - 1), top + (y0 + dy).min(inner_height - 1))]
        };
        let (a, b, c, d) = (pixel(0, 0), pixel(1, 0), pixel(0, 1), pixel(1, 1));
        std::array::from_fn(|k| {
            let upper = a[k] as f32 * (1.0 - fx) + b[k] as f32 * fx;
            let lower = c[k] as f32 * (1.0 - fx) + d[k] as f32 * fx;
            (upper * (1.0 - fy) + lower * fy).round() as u8
        })
    })
}

fn blurred(image: &Image<[u8; 3]>) -> Image<[u8; 3]> {
    let raw: Vec<f32> =
        (-BLUR_REACH..=BLUR_REACH).map(|d| (-0.5 * (d as f32 / BLUR_PX).powi(2)).exp()).collect();
    let sum: f32 = raw.iter().sum();
    let weights: Vec<(isize, f32)> = (-BLUR_REACH..=BLUR_REACH).zip(raw.iter().map(|w| w / sum)).collect();
    let mean = |value: &dyn Fn(isize) -> [f32; 3]| {
        let mut out = [0.0f32; 3];
        for (offset, weight) in &weights {
            let pixel = value(*offset);
            (0..3).for_each(|k| out[k] += weight * pixel[k]);
        }
        out
    };
    let (width, height) = (image.width(), image.height());
    let across: Image<[f32; 3]> = Image::from_fn(width, height, |x, y| {
        mean(&|d| image[(mirrored(x as isize + d, width), y)].map(f32::from))
    });
    let down = Image::from_fn(width, height, |x, y| mean(&|d| across[(x, mirrored(y as isize + d, height))]));
    down.map(|c| c.map(|v| v.round() as u8))
}

/// The pixel that a mirror at the border's pixel shows.
fn mirrored(k: isize, length: usize) -> usize {
    let last = length as isize - 1;
    let inside = if k < 0 {
        -k
    } else if k > last {
        2 * last - k
    } else {
        k
    };
    inside.clamp(0, last) as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plain_picture_keeps_its_colour_when_zoomed_or_blurred() {
        let plain = Image::filled(40, 30, [10, 100, 250]);
        for kind in [2, 3] {
            assert_eq!(perturbed(&plain, kind), plain);
        }
        assert_eq!(perturbed(&plain, 1)[(0, 0)], [12, 100, 187]);
        assert_eq!(perturbed(&plain, 0)[(0, 0)], [0, 47, 246]);
    }

    #[test]
    fn zooming_keeps_the_middle_and_blurring_spreads_an_edge() {
        let ramp = Image::from_fn(100, 50, |x, _| [2 * x as u8; 3]);
        let zoomed = perturbed(&ramp, 2);
        assert_eq!((zoomed[(0, 0)][0], zoomed[(50, 25)][0], zoomed[(99, 0)][0]), (20, 100, 178));
        let edge = Image::from_fn(60, 30, |x, _| if x < 30 { [0; 3] } else { [200; 3] });
        let blurred = perturbed(&edge, 3);
        assert!(blurred[(10, 5)][0] == 0 && blurred[(50, 5)][0] == 200);
        assert!((30..100).contains(&blurred[(28, 5)][0]) && (100..170).contains(&blurred[(31, 5)][0]));
    }
}
