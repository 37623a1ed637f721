//! Detail of a picture: edges and texture, without exposure and shading. Broad brightness still correlates where a
//! motion is wrong by twenty pixels; detail does not.

use coma_frame::Image;

/// Half the side of the window whose mean counts as broad brightness, as a share of the image's width (8 of 320 pixels).
const WINDOW: f32 = 1.0 / 40.0;
/// Deviations of intensity far below this are noise.
const NOISE: f32 = 0.02;

/// Intensity less its mean over a window, over its standard deviation there: within some -3..3, and near 0 where
/// there is nothing to see.
pub fn detail(intensity: &Image<f32>) -> Image<f32> {
    let (width, height) = (intensity.width(), intensity.height());
    let radius = ((width as f32 * WINDOW).round() as usize).max(1);
    // Sums of values and of squares over everything above and to the left.
    let stride = width + 1;
    let mut sums = vec![(0.0f64, 0.0f64); stride * (height + 1)];
    for y in 0..height {
        let mut row = (0.0, 0.0);
        for (x, &value) in intensity.row(y).iter().enumerate() {
            row.0 += value as f64;
            row.1 += (value as f64).powi(2);
            let above = sums[y * stride + x + 1];
            sums[(y + 1) * stride + x + 1] = (above.0 + row.0, above.1 + row.1);
        }
    }
    Image::from_fn(width, height, |x, y| {
        let (x0, x1) = (x.saturating_sub(radius), (x + radius + 1).min(width));
        let (y0, y1) = (y.saturating_sub(radius), (y + radius + 1).min(height));
        let at = |x: usize, y: usize| sums[y * stride + x];
        let (a, b, c, d) = (at(x1, y1), at(x0, y1), at(x1, y0), at(x0, y0));
        let count = ((x1 - x0) * (y1 - y0)) as f64;
        let mean = (a.0 - b.0 - c.0 + d.0) / count;
        let variance = ((a.1 - b.1 - c.1 + d.1) / count - mean * mean).max(0.0);
        (intensity[(x, y)] - mean as f32) / (variance.sqrt() as f32 + NOISE)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Stripes, four pixels wide.
    fn stripes() -> Image<f32> {
        Image::from_fn(320, 240, |x, _| if (x / 4) % 2 == 0 { 0.3 } else { 0.6 })
    }

    fn difference(a: &Image<f32>, b: &Image<f32>) -> f32 {
        a.pixels().iter().zip(b.pixels()).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    }

    #[test]
    fn exposure_and_shading_leave_detail_as_it_is_and_a_shift_does_not() {
        let plain = detail(&stripes());
        let shaded = Image::from_fn(320, 240, |x, y| 0.9 * stripes()[(x, y)] + 0.0003 * y as f32);
        assert!(difference(&plain, &detail(&shaded)) < 0.1);
        let shifted = Image::from_fn(320, 240, |x, y| stripes()[((x + 4) % 320, y)]);
        assert!(difference(&plain, &detail(&shifted)) > 1.0);
    }

    #[test]
    fn where_there_is_nothing_to_see_detail_is_next_to_nothing() {
        let noisy = Image::from_fn(64, 48, |x, y| 0.5 + 0.001 * ((x * 7 + y * 13) % 5) as f32);
        assert!(detail(&noisy).pixels().iter().all(|v| v.abs() < 0.15));
    }
}
