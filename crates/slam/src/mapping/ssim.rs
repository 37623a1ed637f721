//! Structural similarity and its gradient (Wang et al. 2004; Gaussian window 11, sigma 1.5, as in 3D
//! Gaussian Splatting).

use coma_frame::Image;
use multiversion::multiversion;
use rayon::prelude::*;

const RADIUS: usize = 5;
const TAPS: usize = 2 * RADIUS + 1;
const C1: f32 = 0.01 * 0.01;
const C2: f32 = 0.03 * 0.03;
/// Rows that one task works on.
const BAND: usize = 32;

fn window() -> [f32; TAPS] {
    let raw: [f32; TAPS] = std::array::from_fn(|i| {
        let d = i as f32 - RADIUS as f32;
        (-d * d / (2.0 * 1.5 * 1.5)).exp()
    });
    let sum: f32 = raw.iter().sum();
    raw.map(|v| v / sum)
}

/// Three channels, `[channel][height * width]`.
type Planes = [Vec<f32>; 3];

fn planes(image: &Image<[f32; 3]>) -> Planes {
    let mut out: Planes = std::array::from_fn(|_| vec![0.0; image.pixels().len()]);
    let size = (BAND * image.width()).max(1);
    let [red, green, blue] = &mut out;
    (red.par_chunks_mut(size), green.par_chunks_mut(size), blue.par_chunks_mut(size))
        .into_par_iter()
        .zip(image.pixels().par_chunks(size))
        .for_each(|((red, green, blue), pixels)| {
            for (i, [r, g, b]) in pixels.iter().enumerate() {
                (red[i], green[i], blue[i]) = (*r, *g, *b);
            }
        });
    out
}

/// Mean SSIM of two images and its derivative by every pixel of `a`.
pub fn ssim_and_gradient(a: &Image<[f32; 3]>, b: &Image<[f32; 3]>) -> (f64, Image<[f32; 3]>) {
    let (width, height) = (a.width(), a.height());
    let mut gradient = Image::filled(width, height, [0.0f32; 3]);
    if width == 0 || height == 0 {
        return (0.0, gradient);
    }
    let count = (3 * width * height) as f32;
    let (a, b) = (planes(a), planes(b));
    let slopes: [Slopes; 3] = std::array::from_fn(|c| Slopes::of(&a[c], &b[c], width));
    let total: f64 = slopes.iter().flat_map(|s| &s.row_sums).sum();
    let rows = gradient.pixels_mut().par_chunks_mut(BAND * width).enumerate();
    rows.for_each(|(band, out)| {
        for c in 0..3 {
            let [by_mean, by_squares, by_product] = &slopes[c].by;
            let source = |row: usize, plane: usize, out: &mut [f32]| {
                out.copy_from_slice(
                    &[by_mean, by_squares, by_product][plane][row * width..(row + 1) * width],
                );
            };
            let mut blur = Blur::<3, _>::new(width, height, band * BAND, source);
            for (i, out) in out.chunks_mut(width).enumerate() {
                let at = (band * BAND + i) * width..(band * BAND + i + 1) * width;
                let [by_mean, by_squares, by_product] = blur.next();
                let (x, y) = (&a[c][at.clone()], &b[c][at]);
                for (k, out) in out.iter_mut().enumerate() {
                    out[c] = (by_mean[k] + 2.0 * x[k] * by_squares[k] + y[k] * by_product[k]) / count;
                }
            }
        }
    });
    (total / count as f64, gradient)
}

/// Of one channel: SSIM summed by rows, and its derivatives by the windows' means of `x`, of `x^2` and of `x y`.
struct Slopes {
    row_sums: Vec<f64>,
    by: [Vec<f32>; 3],
}

impl Slopes {
    fn of(x: &[f32], y: &[f32], width: usize) -> Self {
        let height = x.len() / width;
        let mut row_sums = vec![0.0; height];
        let mut by: [Vec<f32>; 3] = std::array::from_fn(|_| vec![0.0; x.len()]);
        let [by_mean, by_squares, by_product] = &mut by;
        let size = BAND * width;
        (
            row_sums.par_chunks_mut(BAND),
            by_mean.par_chunks_mut(size),
            by_squares.par_chunks_mut(size),
            by_product.par_chunks_mut(size),
        )
            .into_par_iter()
            .enumerate()
            .for_each(|(band, (row_sums, by_mean, by_squares, by_product))| {
                // Variances are only needed as a sum, so that their squares are blurred together.
                let source = |row: usize, plane: usize, out: &mut [f32]| {
                    let (x, y) = (&x[row * width..(row + 1) * width], &y[row * width..(row + 1) * width]);
                    moment(plane, x, y, out);
                };
                let mut blur = Blur::<4, _>::new(width, height, band * BAND, source);
                for (i, sum) in row_sums.iter_mut().enumerate() {
                    let at = i * width..(i + 1) * width;
                    let by = [&mut by_mean[at.clone()], &mut by_squares[at.clone()], &mut by_product[at]];
                    *sum = similarity(blur.next(), by);
                }
            });
        Slopes { row_sums, by }
    }
}

/// What is blurred: `x`, `y`, `x^2 + y^2`, `x y`.
#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn moment(plane: usize, x: &[f32], y: &[f32], out: &mut [f32]) {
    let n = out.len();
    let (x, y) = (&x[..n], &y[..n]);
    match plane {
        0 => out.copy_from_slice(x),
        1 => out.copy_from_slice(y),
        2 => (0..n).for_each(|i| out[i] = x[i] * x[i] + y[i] * y[i]),
        _ => (0..n).for_each(|i| out[i] = x[i] * y[i]),
    }
}

/// SSIM of a row, summed, and its derivatives, from the blurred moments.
#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn similarity(moments: &[Vec<f32>; 4], by: [&mut [f32]; 3]) -> f64 {
    const LANES: usize = 16;
    let [mean_x, mean_y, squares, products] = moments;
    let [by_mean, by_squares, by_product] = by;
    let n = by_mean.len();
    let (mean_x, mean_y, squares, products) = (&mean_x[..n], &mean_y[..n], &squares[..n], &products[..n]);
    let (by_squares, by_product) = (&mut by_squares[..n], &mut by_product[..n]);
    // Lane by lane, so that the sum vectorises.
    let mut sums = [0.0f32; LANES];
    let mut at = |i: usize| {
        let (mx, my) = (mean_x[i], mean_y[i]);
        let (mxy, mm) = (mx * my, mx * mx + my * my);
        let (variances, covariance) = (squares[i] - mm, products[i] - mxy);
        let (a1, a2) = (2.0 * mxy + C1, 2.0 * covariance + C2);
        let (b1, b2) = (mm + C1, variances + C2);
        let inverse = 1.0 / (b1 * b2);
        let s = a1 * a2 * inverse;
        // By the mean, variance and covariance of the window; these depend on the mean too.
        let by_variance = -s * inverse * b1;
        let by_covariance = 2.0 * a1 * inverse;
        by_mean[i] = 2.0 * my * a2 * inverse
            - 2.0 * mx * s * inverse * b2
            - 2.0 * mx * by_variance
            - my * by_covariance;
        by_squares[i] = by_variance;
        by_product[i] = by_covariance;
        s
    };
    for first in (0..n - n % LANES).step_by(LANES) {
        for lane in 0..LANES {
            sums[lane] += at(first + lane);
        }
    }
    for i in n - n % LANES..n {
        sums[i % LANES] += at(i);
    }
    sums.iter().map(|v| *v as f64).sum()
}

/// A separable Gaussian blur of `N` planes, row after row, with zeros outside; it is its own adjoint.
struct Blur<const N: usize, Source> {
    window: [f32; TAPS],
    width: usize,
    height: usize,
    /// Writes a row of a plane: row, plane, out.
    source: Source,
    /// The next row that comes out.
    row: usize,
    /// Rows blurred along, each at its number modulo the taps.
    along: [[Vec<f32>; N]; TAPS],
    /// A row with zeros on both sides.
    padded: Vec<f32>,
    out: [Vec<f32>; N],
}

impl<const N: usize, Source: Fn(usize, usize, &mut [f32])> Blur<N, Source> {
    /// Rows come out from `row` on.
    fn new(width: usize, height: usize, row: usize, source: Source) -> Self {
        let line = || vec![0.0; width];
        let mut out = Blur {
            window: window(),
            width,
            height,
            source,
            row,
            along: std::array::from_fn(|_| std::array::from_fn(|_| line())),
            padded: vec![0.0; width + 2 * RADIUS],
            out: std::array::from_fn(|_| line()),
        };
        (row.saturating_sub(RADIUS)..row + RADIUS).for_each(|row| out.take(row));
        out
    }

    /// Blurs one row along.
    fn take(&mut self, row: usize) {
        for plane in 0..N {
            let out = &mut self.along[row % TAPS][plane];
            if row < self.height {
                (self.source)(row, plane, &mut self.padded[RADIUS..RADIUS + self.width]);
                let padded = &self.padded;
                weigh(&self.window, std::array::from_fn(|k| &padded[k..]), out);
            } else {
                out.fill(0.0);
            }
        }
    }

    /// The next blurred row of every plane.
    fn next(&mut self) -> &[Vec<f32>; N] {
        self.take(self.row + RADIUS);
        for plane in 0..N {
            // Row `row + k - RADIUS`; rows above the first are still zero.
            let tap = |k: usize| &self.along[(self.row + k + TAPS - RADIUS) % TAPS][plane][..];
            weigh(&self.window, std::array::from_fn(tap), &mut self.out[plane]);
        }
        self.row += 1;
        &self.out
    }
}

/// `out[i]` is the sum of the taps' `i`-th values by the window's weights.
#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn weigh(window: &[f32; TAPS], taps: [&[f32]; TAPS], out: &mut [f32]) {
    let n = out.len();
    let [a, b, c, d, e, f, g, h, i, j, k] = taps;
    let (a, b, c, d, e, f) = (&a[..n], &b[..n], &c[..n], &d[..n], &e[..n], &f[..n]);
    let (g, h, i, j, k) = (&g[..n], &h[..n], &i[..n], &j[..n], &k[..n]);
    // The window is symmetric.
    let [w5, w4, w3, w2, w1, w0, ..] = *window;
    for x in 0..n {
        let inner = w0 * f[x] + w1 * (e[x] + g[x]) + w2 * (d[x] + h[x]);
        out[x] = inner + (w3 * (c[x] + i[x]) + w4 * (b[x] + j[x]) + w5 * (a[x] + k[x]));
    }
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

    /// The definition, in double precision: every window of every pixel by itself.
    fn by_definition(a: &Image<[f32; 3]>, b: &Image<[f32; 3]>) -> f64 {
        let w = window().map(f64::from);
        let mut total = 0.0;
        for (y, x, c) in (0..14).flat_map(|y| (0..20).flat_map(move |x| (0..3).map(move |c| (y, x, c)))) {
            let mut m = [0.0f64; 5];
            for (j, i) in (0..TAPS).flat_map(|j| (0..TAPS).map(move |i| (j, i))) {
                let at = |image: &Image<[f32; 3]>| {
                    let (u, v) = ((x + i).wrapping_sub(RADIUS), (y + j).wrapping_sub(RADIUS));
                    image.get(u, v).map_or(0.0, |p| p[c] as f64)
                };
                let (p, q) = (at(a), at(b));
                for (m, v) in m.iter_mut().zip([p, q, p * p, q * q, p * q]) {
                    *m += w[i] * w[j] * v;
                }
            }
            let [mx, my, xx, yy, xy] = m;
            let (c1, c2) = (C1 as f64, C2 as f64);
            total += (2.0 * mx * my + c1) * (2.0 * (xy - mx * my) + c2)
                / ((mx * mx + my * my + c1) * (xx - mx * mx + yy - my * my + c2));
        }
        total / (3.0 * 20.0 * 14.0)
    }

    #[test]
    fn it_is_what_the_definition_says() {
        let (a, b) = pictures();
        let (found, truth) = (ssim_and_gradient(&a, &b).0, by_definition(&a, &b));
        assert!((found - truth).abs() < 1e-5, "{found} {truth}");
        // And the comparison sees a single pixel.
        let mut moved = a.clone();
        moved[(9, 6)][1] += 0.1;
        assert!((ssim_and_gradient(&moved, &b).0 - truth).abs() > 1e-4);
    }

    #[test]
    fn the_same_bits_come_from_any_number_of_threads() {
        let picture = |k: f32| {
            Image::from_fn(70, 131, |x, y| {
                std::array::from_fn(|c| 0.5 + 0.4 * ((x as f32 * 0.7 + y as f32 * k + c as f32).sin()))
            })
        };
        let (a, b) = (picture(0.5), picture(0.8));
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| ssim_and_gradient(&a, &b))
        };
        let one = run(1);
        assert!(one == run(2) && one == run(3));
    }
}
