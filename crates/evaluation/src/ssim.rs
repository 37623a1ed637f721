//! Structural similarity (Wang et al. 2004), as scikit-image computes it with `gaussian_weights=True, sigma=1.5,
//! use_sample_covariance=False, data_range=1`: the mean over the channels of the mean over those pixels whose whole
//! window lies inside the picture.

use crate::PictureError;
use crate::pictures::check;
use coma_frame::Image;
use rayon::prelude::*;

/// The window reaches so many pixels to each side: scikit-image cuts the Gaussian at 3.5 sigma.
const RADIUS: usize = 5;
const WINDOW: usize = 2 * RADIUS + 1;
const SIGMA: f64 = 1.5;
const C1: f64 = 0.01 * 0.01;
const C2: f64 = 0.03 * 0.03;

/// Similarity of two pictures with colours in 0..1; 1 for equal ones.
///
/// # Errors
/// Pictures of different sizes, smaller than 11x11, or with a value that isn't finite.
pub fn ssim(a: &Image<[f32; 3]>, b: &Image<[f32; 3]>) -> Result<f64, PictureError> {
    check(a, b)?;
    let (width, height) = (a.width(), a.height());
    if width < WINDOW || height < WINDOW {
        return Err(PictureError::TooSmall { width, height, least: WINDOW });
    }
    let rows = height - 2 * RADIUS;
    let kernel = window();
    let mut means = vec![0.0f64; rows];
    // A row's sum is one thread's, and rows are added in order: the same bits, whatever the number of threads.
    means.par_iter_mut().enumerate().for_each(|(y, sum)| {
        *sum = (0..3).map(|channel| row_sum(a, b, channel, y, &kernel)).sum();
    });
    Ok(means.iter().sum::<f64>() / (3 * rows * (width - 2 * RADIUS)) as f64)
}

/// Sum over the row of windows that begins at picture row `y`.
fn row_sum(
    a: &Image<[f32; 3]>,
    b: &Image<[f32; 3]>,
    channel: usize,
    y: usize,
    kernel: &[f64; WINDOW],
) -> f64 {
    // Down the columns first: x, y, xx, yy, xy.
    let mut columns = vec![[0.0f64; 5]; a.width()];
    for (k, weight) in kernel.iter().enumerate() {
        for (column, (a, b)) in columns.iter_mut().zip(a.row(y + k).iter().zip(b.row(y + k))) {
            let (a, b) = (f64::from(a[channel]), f64::from(b[channel]));
            for (sum, value) in column.iter_mut().zip([a, b, a * a, b * b, a * b]) {
                *sum += weight * value;
            }
        }
    }
    columns
        .windows(WINDOW)
        .map(|columns| {
            let mut moments = [0.0f64; 5];
            for (column, weight) in columns.iter().zip(kernel) {
                for (moment, value) in moments.iter_mut().zip(column) {
                    *moment += weight * value;
                }
            }
            let [ux, uy, uxx, uyy, uxy] = moments;
            let (vx, vy, vxy) = (uxx - ux * ux, uyy - uy * uy, uxy - ux * uy);
            // Wang 2004, eq. (13)
            (2.0 * ux * uy + C1) * (2.0 * vxy + C2) / ((ux * ux + uy * uy + C1) * (vx + vy + C2))
        })
        .sum()
}

fn window() -> [f64; WINDOW] {
    let raw: [f64; WINDOW] = std::array::from_fn(|i| {
        let distance = i as f64 - RADIUS as f64;
        (-0.5 * distance * distance / (SIGMA * SIGMA)).exp()
    });
    let sum: f64 = raw.iter().sum();
    raw.map(|weight| weight / sum)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn waves(phase: f32) -> Image<[f32; 3]> {
        Image::from_fn(31, 23, |x, y| {
            std::array::from_fn(|c| 0.5 + 0.4 * (0.7 * x as f32 + 0.5 * y as f32 + c as f32 + phase).sin())
        })
    }

    #[test]
    fn a_picture_is_wholly_similar_to_itself_and_less_so_to_others() {
        assert!((ssim(&waves(0.0), &waves(0.0)).unwrap() - 1.0).abs() < 1e-12);
        let (near, far) = (ssim(&waves(0.0), &waves(0.2)).unwrap(), ssim(&waves(0.0), &waves(3.0)).unwrap());
        assert!(1.0 > near && near > 0.9 && far < 0.0, "{near} {far}");
    }

    #[test]
    fn similarity_is_symmetric() {
        let (ab, ba) = (ssim(&waves(0.0), &waves(0.7)).unwrap(), ssim(&waves(0.7), &waves(0.0)).unwrap());
        assert!((ab - ba).abs() < 1e-12);
    }

    #[test]
    fn pictures_smaller_than_the_window_are_refused() {
        let small = Image::filled(11, 10, [0.0; 3]);
        assert_eq!(ssim(&small, &small), Err(PictureError::TooSmall { width: 11, height: 10, least: 11 }));
        let least = Image::filled(11, 11, [0.2; 3]);
        assert!((ssim(&least, &least).unwrap() - 1.0).abs() < 1e-12);
    }
}
