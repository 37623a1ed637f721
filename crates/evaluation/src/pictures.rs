//! Rendered views against recorded ones. Colours are 0..1, depth is metres with 0 for no measurement.

use crate::stats::mean;
use coma_frame::Image;
use serde::{Deserialize, Serialize};

/// What a picture without any error counts as in a mean, where its true PSNR, infinity, would drown all others.
/// One byte of a megapixel that is off by one is 113 dB.
pub const EQUAL_PICTURES_DB: f64 = 120.0;

/// Why two pictures cannot be compared.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PictureError {
    /// Their sizes differ, or there are no pixels.
    #[error("{field} is {width}x{height}, which is not {expected_width}x{expected_height} with pixels")]
    Size {
        /// Which picture.
        field: &'static str,
        /// Found.
        width: usize,
        /// Found.
        height: usize,
        /// The size of the picture that it is compared with.
        expected_width: usize,
        /// The size of the picture that it is compared with.
        expected_height: usize,
    },
    /// The similarity's window doesn't fit.
    #[error("a picture of {width}x{height} is smaller than {least}x{least}")]
    TooSmall {
        /// Found.
        width: usize,
        /// Found.
        height: usize,
        /// Least side.
        least: usize,
    },
    /// A colour is NaN or infinite.
    #[error("pixel ({x}, {y}) of the {field} picture is not finite")]
    NotFinite {
        /// `rendered` or `recorded`.
        field: &'static str,
        /// Column.
        x: usize,
        /// Row.
        y: usize,
    },
}

fn same_size<A, B>(field: &'static str, found: &Image<A>, expected: &Image<B>) -> Result<(), PictureError> {
    let size = (found.width(), found.height());
    if size == (expected.width(), expected.height()) && !found.pixels().is_empty() {
        return Ok(());
    }
    Err(PictureError::Size {
        field,
        width: size.0,
        height: size.1,
        expected_width: expected.width(),
        expected_height: expected.height(),
    })
}

/// Both pictures have pixels, one size, and numbers.
pub(crate) fn check(rendered: &Image<[f32; 3]>, recorded: &Image<[f32; 3]>) -> Result<(), PictureError> {
    same_size("rendered colour", rendered, recorded)?;
    for (field, picture) in [("rendered", rendered), ("recorded", recorded)] {
        let bad = picture.pixels().iter().position(|color| !color.iter().all(|value| value.is_finite()));
        if let Some(index) = bad {
            let (x, y) = (index % picture.width(), index / picture.width());
            return Err(PictureError::NotFinite { field, x, y });
        }
    }
    Ok(())
}

/// Peak signal-to-noise ratio over the whole picture, decibels; infinite for equal pictures.
///
/// # Errors
/// Pictures of different sizes, without pixels, or with a value that isn't finite.
pub fn psnr_db(rendered: &Image<[f32; 3]>, recorded: &Image<[f32; 3]>) -> Result<f64, PictureError> {
    check(rendered, recorded)?;
    let pixels = rendered.pixels().iter().zip(recorded.pixels());
    Ok(decibels(pixels).expect("a checked picture has pixels"))
}

/// The same over the pixels with a depth measurement only: what the map can have seen. `None` if there is no such
/// pixel.
///
/// # Errors
/// As [`psnr_db`]; depth of another size.
pub fn psnr_where_db(
    rendered: &Image<[f32; 3]>,
    recorded: &Image<[f32; 3]>,
    recorded_depth_m: &Image<f32>,
) -> Result<Option<f64>, PictureError> {
    check(rendered, recorded)?;
    same_size("recorded depth", recorded_depth_m, recorded)?;
    let pixels = rendered.pixels().iter().zip(recorded.pixels()).zip(recorded_depth_m.pixels());
    Ok(decibels(pixels.filter(|(_, depth_m)| measured(**depth_m)).map(|(colors, _)| colors)))
}

fn decibels<'a>(pixels: impl Iterator<Item = (&'a [f32; 3], &'a [f32; 3])>) -> Option<f64> {
    let (mut sum, mut count) = (0.0f64, 0usize);
    for (a, b) in pixels {
        for (a, b) in a.iter().zip(b) {
            sum += (f64::from(*a) - f64::from(*b)).powi(2);
        }
        count += 3;
    }
    (count > 0).then(|| -10.0 * (sum / count as f64).log10())
}

fn measured(depth_m: f32) -> bool {
    depth_m > 0.0 && depth_m.is_finite()
}

/// Mean absolute difference of depth.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DepthL1 {
    /// Metres.
    pub mean_m: f64,
    /// Pixels with depth in both pictures, over which the mean is taken.
    pub pixels: usize,
}

/// Over the pixels that have depth in both pictures; `None` if there is none.
///
/// # Errors
/// Pictures of different sizes, or without pixels.
pub fn depth_l1(rendered_m: &Image<f32>, recorded_m: &Image<f32>) -> Result<Option<DepthL1>, PictureError> {
    same_size("rendered depth", rendered_m, recorded_m)?;
    let both = rendered_m.pixels().iter().zip(recorded_m.pixels());
    let (mut sum_m, mut pixels) = (0.0f64, 0usize);
    for (rendered, recorded) in both.filter(|(a, b)| measured(**a) && measured(**b)) {
        sum_m += (f64::from(*rendered) - f64::from(*recorded)).abs();
        pixels += 1;
    }
    Ok((pixels > 0).then(|| DepthL1 { mean_m: sum_m / pixels as f64, pixels }))
}

/// A picture with its depth.
#[derive(Clone, Copy, Debug)]
pub struct View<'a> {
    /// 0..1, `[height, width]`
    pub color: &'a Image<[f32; 3]>,
    /// Metres, `[height, width]`; 0 = none.
    pub depth_m: &'a Image<f32>,
}

/// The scores of one rendered view.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct FrameScore {
    /// Whole picture, at most [`EQUAL_PICTURES_DB`].
    pub psnr_db: f64,
    /// Where the recorded view has depth, at most [`EQUAL_PICTURES_DB`].
    pub psnr_where_depth_db: Option<f64>,
    /// Whole picture but for a border of 5 pixels.
    pub ssim: f64,
    /// Measured elsewhere, by a model; `None` without one.
    pub lpips: Option<f64>,
    /// Where both views have depth.
    pub depth_l1: Option<DepthL1>,
}

/// Compares a rendered view with the recorded one; LPIPS is handed in.
///
/// # Errors
/// Pictures of different sizes, smaller than 11x11, or with a colour that isn't finite.
pub fn score_frame(rendered: View, recorded: View, lpips: Option<f64>) -> Result<FrameScore, PictureError> {
    let masked_db = psnr_where_db(rendered.color, recorded.color, recorded.depth_m)?;
    Ok(FrameScore {
        psnr_db: psnr_db(rendered.color, recorded.color)?.min(EQUAL_PICTURES_DB),
        psnr_where_depth_db: masked_db.map(|db| db.min(EQUAL_PICTURES_DB)),
        ssim: crate::ssim(rendered.color, recorded.color)?,
        lpips: lpips.filter(|distance| distance.is_finite()),
        depth_l1: depth_l1(rendered.depth_m, recorded.depth_m)?,
    })
}

/// Means over views; each view weighs the same.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PictureScores {
    /// Views compared.
    pub frames: usize,
    /// Whole pictures.
    pub psnr_db: f64,
    /// Where the recorded views have depth; over the views that have some.
    pub psnr_where_depth_db: Option<f64>,
    /// Whole pictures but for a border.
    pub ssim: f64,
    /// Only if it was measured in every view.
    pub lpips: Option<f64>,
    /// Mean over the views of each view's mean, metres; over the views with depth in both pictures.
    pub depth_l1_m: Option<f64>,
    /// Pixels behind it, of all views.
    pub depth_pixels: usize,
}

impl PictureScores {
    /// `None` without views.
    pub fn of(frames: &[FrameScore]) -> Option<Self> {
        let over = |value: &dyn Fn(&FrameScore) -> Option<f64>| {
            mean(&frames.iter().filter_map(value).collect::<Vec<f64>>())
        };
        let lpips: Option<Vec<f64>> = frames.iter().map(|frame| frame.lpips).collect();
        Some(PictureScores {
            frames: frames.len(),
            psnr_db: over(&|frame| Some(frame.psnr_db))?,
            psnr_where_depth_db: over(&|frame| frame.psnr_where_depth_db),
            ssim: over(&|frame| Some(frame.ssim))?,
            lpips: lpips.and_then(|values| mean(&values)),
            depth_l1_m: over(&|frame| frame.depth_l1.map(|l1| l1.mean_m)),
            depth_pixels: frames.iter().filter_map(|frame| frame.depth_l1).map(|l1| l1.pixels).sum(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grey(value: f32) -> Image<[f32; 3]> {
        Image::filled(16, 12, [value; 3])
    }

    #[test]
    fn a_difference_of_a_tenth_is_twenty_decibels_and_none_is_infinite() {
        assert!((psnr_db(&grey(0.4), &grey(0.5)).unwrap() - 20.0).abs() < 1e-5);
        assert_eq!(psnr_db(&grey(0.4), &grey(0.4)).unwrap(), f64::INFINITY);
    }

    #[test]
    fn the_masked_ratio_looks_only_where_depth_was_recorded() {
        let mut rendered = grey(0.5);
        rendered[(0, 0)] = [1.0; 3];
        let mut depth_m = Image::filled(16, 12, 2.0);
        assert!(psnr_where_db(&rendered, &grey(0.5), &depth_m).unwrap().unwrap().is_finite());
        depth_m[(0, 0)] = 0.0;
        assert_eq!(psnr_where_db(&rendered, &grey(0.5), &depth_m).unwrap(), Some(f64::INFINITY));
        assert_eq!(psnr_where_db(&rendered, &grey(0.5), &Image::filled(16, 12, 0.0)).unwrap(), None);
    }

    #[test]
    fn depth_is_compared_where_both_have_some() {
        let mut rendered = Image::filled(16, 12, 2.5f32);
        let mut recorded = Image::filled(16, 12, 2.0f32);
        rendered[(0, 0)] = 0.0;
        recorded[(1, 0)] = f32::NAN;
        let l1 = depth_l1(&rendered, &recorded).unwrap().unwrap();
        assert_eq!(l1, DepthL1 { mean_m: 0.5, pixels: 16 * 12 - 2 });
        assert_eq!(depth_l1(&Image::filled(16, 12, 0.0), &recorded).unwrap(), None);
    }

    #[test]
    fn what_cannot_be_compared_is_named() {
        let other = Image::filled(16, 11, [0.5; 3]);
        assert!(psnr_db(&other, &grey(0.5)).unwrap_err().to_string().contains("rendered colour is 16x11"));
        let mut bad = grey(0.5);
        bad[(3, 2)][1] = f32::NAN;
        assert_eq!(psnr_db(&grey(0.5), &bad), Err(PictureError::NotFinite { field: "recorded", x: 3, y: 2 }));
        let empty = Image::from_pixels(0, 0, Vec::new()).unwrap();
        assert!(psnr_db(&empty, &empty).is_err());
    }

    #[test]
    fn means_leave_out_views_without_depth_and_lpips_that_was_not_measured_everywhere() {
        let depth_m = Image::filled(16, 12, 2.0);
        let none_m = Image::filled(16, 12, 0.0);
        let recorded = grey(0.5);
        let score = |value: f32, depth_m: &Image<f32>, lpips| {
            let color = grey(value);
            let view = View { color: &color, depth_m };
            score_frame(view, View { color: &recorded, depth_m }, lpips).unwrap()
        };
        let frames = [score(0.5, &depth_m, Some(0.0)), score(0.4, &none_m, Some(0.2))];
        let scores = PictureScores::of(&frames).unwrap();
        assert!((scores.psnr_db - 70.0).abs() < 1e-4, "equal pictures count as 120 dB: {scores:?}");
        assert_eq!(scores.psnr_where_depth_db, Some(EQUAL_PICTURES_DB));
        assert_eq!((scores.depth_l1_m, scores.depth_pixels), (Some(0.0), 16 * 12));
        assert_eq!(scores.lpips, Some(0.1));
        let partly = [frames[0], FrameScore { lpips: None, ..frames[1] }];
        assert_eq!(PictureScores::of(&partly).unwrap().lpips, None);
        assert_eq!(PictureScores::of(&[]), None);
    }
}
