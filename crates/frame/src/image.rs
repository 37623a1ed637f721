//! A plain image: row-major pixels, `[height, width]`.

/// A row-major image.
#[derive(Clone, Debug, PartialEq)]
pub struct Image<T> {
    width: usize,
    height: usize,
    /// `[height, width]`
    pixels: Vec<T>,
}

impl<T: Clone> Image<T> {
    /// An image of one value.
    pub fn filled(width: usize, height: usize, value: T) -> Self {
        Image { width, height, pixels: vec![value; width * height] }
    }
}

impl<T> Image<T> {
    /// An image from its rows; `None` unless there are `width * height` pixels.
    pub fn from_pixels(width: usize, height: usize, pixels: Vec<T>) -> Option<Self> {
        (width.checked_mul(height) == Some(pixels.len())).then_some(Image { width, height, pixels })
    }

    /// An image computed pixel by pixel, `value(x, y)`.
    pub fn from_fn(width: usize, height: usize, mut value: impl FnMut(usize, usize) -> T) -> Self {
        let mut pixels = Vec::with_capacity(width * height);
        for y in 0..height {
            for x in 0..width {
                pixels.push(value(x, y));
            }
        }
        Image { width, height, pixels }
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// All pixels, row by row.
    pub fn pixels(&self) -> &[T] {
        &self.pixels
    }

    /// All pixels, row by row.
    pub fn pixels_mut(&mut self) -> &mut [T] {
        &mut self.pixels
    }

    /// The pixels, without the image.
    pub fn into_pixels(self) -> Vec<T> {
        self.pixels
    }

    /// One row.
    pub fn row(&self, y: usize) -> &[T] {
        &self.pixels[y * self.width..(y + 1) * self.width]
    }

    /// One pixel, or `None` outside.
    pub fn get(&self, x: usize, y: usize) -> Option<&T> {
        (x < self.width && y < self.height).then(|| &self.pixels[y * self.width + x])
    }

    /// Applies a function to every pixel.
    pub fn map<U>(&self, f: impl FnMut(&T) -> U) -> Image<U> {
        Image { width: self.width, height: self.height, pixels: self.pixels.iter().map(f).collect() }
    }
}

impl<T> std::ops::Index<(usize, usize)> for Image<T> {
    type Output = T;
    /// `image[(x, y)]`
    fn index(&self, (x, y): (usize, usize)) -> &T {
        debug_assert!(x < self.width);
        &self.pixels[y * self.width + x]
    }
}

impl<T> std::ops::IndexMut<(usize, usize)> for Image<T> {
    fn index_mut(&mut self, (x, y): (usize, usize)) -> &mut T {
        debug_assert!(x < self.width);
        &mut self.pixels[y * self.width + x]
    }
}

/// Intensity of a colour (ITU-R BT.601), in the colour's own scale.
#[inline]
pub fn luminance(color: [f32; 3]) -> f32 {
    0.299 * color[0] + 0.587 * color[1] + 0.114 * color[2]
}

impl Image<[u8; 3]> {
    /// Luminance in 0..1 (Rec. 601 weights).
    pub fn luminance(&self) -> Image<f32> {
        self.map(|c| luminance(c.map(f32::from)) / 255.0)
    }

    /// Colour in 0..1.
    pub fn to_unit(&self) -> Image<[f32; 3]> {
        self.map(|c| c.map(|v| v as f32 / 255.0))
    }
}

impl Image<[f32; 3]> {
    /// Colour clamped to 0..1 and rounded to bytes.
    pub fn to_bytes(&self) -> Image<[u8; 3]> {
        self.map(|c| c.map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_are_row_by_row_and_an_index_is_x_then_y() {
        let image = Image::from_pixels(3, 2, vec![0, 1, 2, 3, 4, 5]).unwrap();
        assert_eq!(image[(2, 0)], 2);
        assert_eq!(image[(0, 1)], 3);
        assert_eq!(image.row(1), [3, 4, 5]);
        assert!(image.get(0, 2).is_none());
        assert!(Image::from_pixels(3, 2, vec![0; 5]).is_none());
    }

    #[test]
    fn unit_colour_runs_from_zero_to_one_and_goes_back_to_the_same_bytes() {
        let bytes = Image::from_fn(16, 16, |x, y| [(16 * y + x) as u8, 0, 255]);
        let unit = bytes.to_unit();
        assert_eq!(unit[(0, 0)], [0.0, 0.0, 1.0]);
        assert_eq!(unit.to_bytes(), bytes);
        let beyond = Image::filled(1, 1, [-0.5f32, 1.5, f32::NAN]);
        assert_eq!(beyond.to_bytes()[(0, 0)], [0, 255, 0]);
    }

    #[test]
    fn luminance_is_rec_601_from_zero_to_one() {
        let of = |color| Image::filled(1, 1, color).luminance()[(0, 0)];
        for (color, expected) in
            [([255, 255, 255], 1.0), ([255, 0, 0], 0.299), ([0, 255, 0], 0.587), ([0, 0, 255], 0.114)]
        {
            assert!((of(color) - expected).abs() < 1e-6, "{color:?}");
        }
    }
}
