//! From a colour image to a model's input.

use coma_frame::Image;

/// One contribution to a destination pixel: source index and weight.
type Tap = (usize, f32);

/// Resizes to `width` x `height` as OpenCV's `INTER_AREA` does: every destination pixel is the mean of the source
/// area that it covers, rounded to whole values; where the image must grow in either direction, linear between
/// the neighbours of that area. An image without pixels becomes black.
pub fn resize_area(image: &Image<[u8; 3]>, width: usize, height: usize) -> Image<[u8; 3]> {
    if image.pixels().is_empty() {
        return Image::filled(width, height, [0; 3]);
    }
    let shrinks = width <= image.width() && height <= image.height();
    let (scale_x, scale_y) = (scale(image.width(), width), scale(image.height(), height));
    let halves = |value: f32| value.round_ties_even();
    // Exactly two by two: OpenCV rounds halves up.
    let up = |value: f32| (value + 0.5).floor();
    let twice = scale_x == 2.0 && scale_y == 2.0;
    let taps = if shrinks { area_taps } else { linear_taps };
    let columns = taps(image.width(), width);
    let rows = taps(image.height(), height);
    let mut out = Image::filled(width, height, [0u8; 3]);
    let mut sums = vec![[0f32; 3]; width];
    for (y, row_taps) in rows.iter().enumerate() {
        sums.fill([0.0; 3]);
        for (source_y, weight_y) in row_taps {
            let row = image.row(*source_y);
            for (sum, column_taps) in sums.iter_mut().zip(&columns) {
                let mut across = [0f32; 3];
                for (source_x, weight_x) in column_taps {
                    for c in 0..3 {
                        across[c] += row[*source_x][c] as f32 * weight_x;
                    }
                }
                for c in 0..3 {
                    sum[c] += across[c] * weight_y;
                }
            }
        }
        for (x, sum) in sums.iter().enumerate() {
            out[(x, y)] = sum.map(|v| if twice { up(v) } else { halves(v) }.clamp(0.0, 255.0) as u8);
        }
    }
    out
}

/// Source pixels per destination pixel, by the same divisions as OpenCV's.
fn scale(source: usize, destination: usize) -> f64 {
    1.0 / (destination as f64 / source as f64)
}

/// The source pixels under each destination pixel, weighted by the share that is covered.
fn area_taps(source: usize, destination: usize) -> Vec<Vec<Tap>> {
    const NEGLIGIBLE: f64 = 1e-3;
    let scale = scale(source, destination);
    let taps_of = |k: usize| {
        let start = k as f64 * scale;
        let end = start + scale;
        let covered = scale.min(source as f64 - start);
        let last = (end.floor() as usize).min(source - 1);
        let first = (start.ceil() as usize).min(last);
        let mut taps = Vec::new();
        if first as f64 - start > NEGLIGIBLE {
            taps.push((first - 1, ((first as f64 - start) / covered) as f32));
        }
        taps.extend((first..last).map(|s| (s, (1.0 / covered) as f32)));
        if end - last as f64 > NEGLIGIBLE {
            taps.push((last, ((end - last as f64).min(1.0).min(covered) / covered) as f32));
        }
        taps
    };
    (0..destination).map(taps_of).collect()
}

/// The two source pixels about each destination pixel where the image grows.
fn linear_taps(source: usize, destination: usize) -> Vec<Vec<Tap>> {
    let scale = scale(source, destination);
    let taps_of = |k: usize| {
        let at = (k as f64 * scale).floor();
        let fraction = (k + 1) as f64 - (at + 1.0) / scale;
        let fraction = if fraction <= 0.0 { 0.0 } else { (fraction - fraction.floor()) as f32 };
        let at = (at as usize).min(source - 1);
        vec![(at, 1.0 - fraction), ((at + 1).min(source - 1), fraction)]
    };
    (0..destination).map(taps_of).collect()
}

/// `(value / 255 - mean) / std` by channel, as planes `[3, height, width]`.
pub fn normalised_planes(image: &Image<[u8; 3]>, mean: [f32; 3], std: [f32; 3]) -> Vec<f32> {
    let mut planes = Vec::with_capacity(3 * image.pixels().len());
    for c in 0..3 {
        planes.extend(image.pixels().iter().map(|pixel| (pixel[c] as f32 / 255.0 - mean[c]) / std[c]));
    }
    planes
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grey(width: usize, height: usize, values: &[u8]) -> Image<[u8; 3]> {
        Image::from_pixels(width, height, values.iter().map(|v| [*v; 3]).collect()).unwrap()
    }

    fn values(image: &Image<[u8; 3]>) -> Vec<u8> {
        image.pixels().iter().map(|pixel| pixel[0]).collect()
    }

    #[test]
    fn whole_cells_are_averaged() {
        assert_eq!(values(&resize_area(&grey(4, 2, &[0, 10, 20, 30, 40, 50, 60, 70]), 2, 1)), [25, 45]);
        // A half rounds up at two by two, to even elsewhere.
        assert_eq!(values(&resize_area(&grey(2, 2, &[0, 1, 0, 1]), 1, 1)), [1]);
        assert_eq!(values(&resize_area(&grey(2, 1, &[0, 1]), 1, 1)), [0]);
    }

    #[test]
    fn parts_of_cells_count_by_their_share() {
        // Three pixels to two: 1 and a half each.
        assert_eq!(values(&resize_area(&grey(3, 1, &[30, 60, 90]), 2, 1)), [40, 80]);
    }

    #[test]
    fn weights_of_every_pixel_sum_to_one() {
        for (source, destination) in [(640, 224), (480, 224), (7, 3), (5, 5), (1, 1), (225, 224)] {
            for taps in area_taps(source, destination) {
                let sum: f32 = taps.iter().map(|(_, weight)| weight).sum();
                assert!((sum - 1.0).abs() < 1e-5, "{source} to {destination}: {sum}");
            }
        }
    }

    #[test]
    fn a_constant_image_stays_constant_at_any_size() {
        for (width, height) in [(3, 3), (17, 2), (1, 1), (40, 40), (5, 40)] {
            let out = resize_area(&grey(16, 16, &[77; 256]), width, height);
            assert!(values(&out).iter().all(|v| *v == 77));
        }
        assert_eq!(resize_area(&grey(0, 0, &[]), 2, 1), grey(2, 1, &[0, 0]));
    }

    #[test]
    fn planes_are_channel_by_channel() {
        let image = Image::from_pixels(2, 1, vec![[0, 51, 255], [255, 102, 0]]).unwrap();
        let planes = normalised_planes(&image, [0.0, 0.2, 0.5], [1.0, 0.2, 0.5]);
        let expected = [0.0, 1.0, 0.0, 1.0, 1.0, -1.0];
        assert!(planes.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{planes:?}");
    }
}
