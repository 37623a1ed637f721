//! Structural similarity and its gradient (Wang et al. 2004; Gaussian window 11, sigma 1.5, as in 3D
//! Gaussian Splatting).

use coma_frame::Image;
use rayon::prelude::*;

const RADIUS: usize = 5;
const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;

fn window() -> [f32; 2 * RADIUS + 1] {
    let raw: [f32; 2 * RADIUS + 1] = std::array::from_fn(|i| {
        let d = i as f32 - RADIUS as f32;
        (-d * d / (2.0 * 1.5 * 1.5)).exp()
    });
    let sum: f32 = raw.iter().sum();
    raw.map(|v| v / sum)
}

/// Separable Gaussian blur with zeros outside; it is its own adjoint.
fn blur(plane: &[f32], width: usize, height: usize, kernel: &[f32; 2 * RADIUS + 1]) -> Vec<f32> {
    let mut rows = vec![0.0f32; plane.len()];
    rows.par_chunks_mut(width).zip(plane.par_chunks(width)).for_each(|(out, row)| {
        for (k, weight) in kernel.iter().enumerate() {
            // out[x] += weight * row[x + k - RADIUS], where that exists.
            let (from, to) = if k < RADIUS { (0, RADIUS - k) } else { (k - RADIUS, 0) };
            if from.max(to) >= width {
                continue;
            }
            let length = width - from.max(to);
            for (o, i) in out[to..to + length].iter_mut().zip(&row[from..from + length]) {
                *o += weight * i;
            }
        }
    });
    let mut out = vec![0.0f32; plane.len()];
    out.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
        for (k, weight) in kernel.iter().enumerate() {
            let Some(source) = (y + k).checked_sub(RADIUS).filter(|s| *s < height) else { continue };
            for (o, i) in out.iter_mut().zip(&rows[source * width..(source + 1) * width]) {
                *o += weight * i;
            }
        }
    });
    out
}

/// Mean SSIM of two images and its derivative by every pixel of `a`.
pub fn ssim_and_gradient(a: &Image<[f32; 3]>, b: &Image<[f32; 3]>) -> (f64, Image<[f32; 3]>) {
    let (width, height) = (a.width(), a.height());
    let kernel = window();
    let count = (3 * width * height) as f32;
    let mut gradient = Image::filled(width, height, [0.0f32; 3]);
    let mut total = 0.0f64;
    for channel in 0..3 {
        let x: Vec<f32> = a.pixels().iter().map(|p| p[channel]).collect();
        let y: Vec<f32> = b.pixels().iter().map(|p| p[channel]).collect();
        let product = |u: &[f32], v: &[f32]| -> Vec<f32> { u.iter().zip(v).map(|(u, v)| u * v).collect() };
        let smooth = |plane: &[f32]| blur(plane, width, height, &kernel);
        let (mu_x, mu_y) = (smooth(&x), smooth(&y));
        let (xx, yy, xy) = (smooth(&product(&x, &x)), smooth(&product(&y, &y)), smooth(&product(&x, &y)));
        let (mut by_mu, mut by_xx, mut by_xy) =
            (vec![0.0f32; x.len()], vec![0.0f32; x.len()], vec![0.0f32; x.len()]);
        for i in 0..x.len() {
            let (mx, my) = (mu_x[i], mu_y[i]);
            let (vx, vy, c) = (xx[i] - mx * mx, yy[i] - my * my, xy[i] - mx * my);
            let (a1, a2) = (2.0 * mx * my + C1, 2.0 * c + C2);
            let (b1, b2) = (mx * mx + my * my + C1, vx + vy + C2);
            let inverse = 1.0 / (b1 * b2);
            let s = a1 * a2 * inverse;
            total += s as f64;
            // By the mean, variance and covariance of the window; these depend on mu_x too.
            let by_variance = -s / b2;
            let by_covariance = 2.0 * a1 * inverse;
            by_mu[i] =
                2.0 * my * a2 * inverse - 2.0 * mx * s / b1 - 2.0 * mx * by_variance - my * by_covariance;
            by_xx[i] = by_variance;
            by_xy[i] = by_covariance;
        }
        let (by_mu, by_xx, by_xy) = (smooth(&by_mu), smooth(&by_xx), smooth(&by_xy));
        for (i, g) in gradient.pixels_mut().iter_mut().enumerate() {
            g[channel] = (by_mu[i] + 2.0 * x[i] * by_xx[i] + y[i] * by_xy[i]) / count;
        }
    }
    (total / count as f64, gradient)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pictures() -> (Image<[f32; 3]>, Image<[f32; 3]>) {
        let f = |x: usize, y: usize, k: f32| {
            std::array::from_fn(|c| 0.5 + 0.4 * ((x as f32 * 0.7 + y as f32 * k + c as f32).sin()))
        };
        (Image::from_fn(20, 14, |x, y| f(x, y, 0.5)), Image::from_fn(20, 14, |x, y| f(x, y, 0.8)))
    }

    #[test]
    fn equal_pictures_are_wholly_similar() {
        let (a, _) = pictures();
        assert!((ssim_and_gradient(&a, &a).0 - 1.0).abs() < 1e-5);
    }

    #[test]
    fn the_gradient_agrees_with_differences() {
        let (a, b) = pictures();
        let (_, gradient) = ssim_and_gradient(&a, &b);
        for (x, y, c) in [(0, 0, 0), (5, 7, 1), (19, 13, 2), (10, 3, 0), (2, 12, 1)] {
            let moved = |step: f32| {
                let mut m = a.clone();
                m[(x, y)][c] += step;
                ssim_and_gradient(&m, &b).0
            };
            let step = 4e-3;
            let difference = (moved(step) - moved(-step)) / (2.0 * step as f64);
            let found = gradient[(x, y)][c] as f64;
            assert!((difference - found).abs() < 0.02 * found.abs() + 2e-6, "{difference} {found}");
        }
    }
}
