//! Half-resolution copies of images, aligned with [`Intrinsics::halved`](coma_geometry::Intrinsics::halved).

use crate::Image;

/// Mean of each 2x2 block. An odd last row or column is dropped.
pub fn halve(image: &Image<f32>) -> Image<f32> {
    Image::from_fn(image.width() / 2, image.height() / 2, |x, y| {
        let (x, y) = (2 * x, 2 * y);
        0.25 * (image[(x, y)] + image[(x + 1, y)] + image[(x, y + 1)] + image[(x + 1, y + 1)])
    })
}

/// Depth of each 2x2 block: the mean of the measurements within `jump` (relative) of the nearest one, so
/// that no depth is invented across an edge; 0 where the block has none.
pub fn halve_depth(depth_m: &Image<f32>, jump: f32) -> Image<f32> {
    Image::from_fn(depth_m.width() / 2, depth_m.height() / 2, |x, y| {
        let (x, y) = (2 * x, 2 * y);
        let block = [depth_m[(x, y)], depth_m[(x + 1, y)], depth_m[(x, y + 1)], depth_m[(x + 1, y + 1)]];
        let nearest = block.iter().copied().filter(|z| *z > 0.0).fold(f32::INFINITY, f32::min);
        if !nearest.is_finite() {
            return 0.0;
        }
        let limit = nearest * (1.0 + jump);
        let near = block.iter().filter(|z| **z > 0.0 && **z <= limit);
        let (sum, count) = near.fold((0.0, 0.0), |(s, n), z| (s + z, n + 1.0));
        sum / count
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_depth_is_invented_across_an_edge() {
        let depth = Image::from_pixels(2, 2, vec![1.0, 1.01, 3.0, 0.0]).unwrap();
        assert!((halve_depth(&depth, 0.05)[(0, 0)] - 1.005).abs() < 1e-6);
        assert_eq!(halve_depth(&Image::filled(2, 2, 0.0), 0.05)[(0, 0)], 0.0);
    }
}
