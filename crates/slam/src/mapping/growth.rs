//! Where does the map grow? By eq. 5 in the blending pass, or by the rule that others use, to compare with.

use crate::tracking::adam::median;
use coma_frame::Image;
use coma_raster::Rendering;
use coma_raster::ewa::Picture;
use serde::{Deserialize, Serialize};

/// Which pixels become surfels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum GrowthRule {
    /// Adaptive growing (eq. 5): no surfel, blended or hidden, lies near the observed depth, or the pixel is not
    /// covered.
    #[default]
    Adaptive,
    /// The pixel is not covered, or the observation lies in front of the rendering by more than 50 times the median
    /// depth error (Keetha et al. 2024, "SplaTAM").
    Usual,
}

/// Depth errors of so many medians are a new surface, by the usual rule.
const DEPTH_MEDIANS: f32 = 50.0;

/// What the map shows of a frame, with the growth test on the frame's depth. `[height, width]`
#[derive(Clone, Copy, Debug)]
pub struct Known<'a> {
    /// Expected depth, metres.
    pub depth_m: &'a Image<f32>,
    /// A, 0..1.
    pub opacity: &'a Image<f32>,
    /// Something lies near the observed depth.
    pub near_surface: Option<&'a Image<bool>>,
}

impl<'a> From<&'a Rendering> for Known<'a> {
    fn from(r: &'a Rendering) -> Self {
        Known { depth_m: &r.depth_m, opacity: &r.opacity, near_surface: r.near_surface.as_ref() }
    }
}

impl<'a> From<&'a Picture> for Known<'a> {
    fn from(p: &'a Picture) -> Self {
        Known { depth_m: &p.depth_m, opacity: &p.opacity, near_surface: p.near_surface.as_ref() }
    }
}

/// The pixels of one frame at which the map grows. `known` is what the map shows, with the growth test on
/// `observed_depth_m`.
pub fn new_pixels<'a>(
    rule: GrowthRule,
    known: impl Into<Known<'a>>,
    observed_depth_m: &Image<f32>,
    covered_opacity: f32,
) -> Image<bool> {
    let Known { depth_m, opacity, near_surface } = known.into();
    let in_front_m = match rule {
        GrowthRule::Adaptive => f32::INFINITY,
        GrowthRule::Usual => DEPTH_MEDIANS * median_error_m(depth_m, observed_depth_m),
    };
    Image::from_fn(observed_depth_m.width(), observed_depth_m.height(), |x, y| {
        let covered = opacity[(x, y)] >= covered_opacity;
        !covered
            || match rule {
                // Eq. 5: no surfel near the observed depth.
                GrowthRule::Adaptive => !near_surface.is_some_and(|near| near[(x, y)]),
                GrowthRule::Usual => depth_m[(x, y)] - observed_depth_m[(x, y)] > in_front_m,
            }
    })
}

/// Of the pixels with depth in both.
fn median_error_m(rendered_m: &Image<f32>, observed_m: &Image<f32>) -> f32 {
    let both = rendered_m.pixels().iter().zip(observed_m.pixels());
    let mut errors: Vec<f32> =
        both.filter(|(r, o)| **r > 0.0 && **o > 0.0).map(|(r, o)| (r - o).abs()).collect();
    median(&mut errors)
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_frame::DepthNoise;
    use coma_geometry::{Intrinsics, Pose};
    use coma_raster::{GrowthTest, RenderSettings, SubmapView, render};
    use coma_surfel::{Surfel, SurfelCloud};

    const CAMERA: Intrinsics = Intrinsics { width: 32, height: 24, fx: 30.0, fy: 30.0, cx: 15.5, cy: 11.5 };

    /// A wall 2 m away over the left half of the picture.
    fn half_a_wall() -> SurfelCloud {
        let disc = |x: f32, y: f32| Surfel {
            center_m: [x, y, 2.0],
            rotation_wxyz: [1.0, 0.0, 0.0, 0.0],
            scale_m: [0.1; 2],
            opacity: 0.95,
            color: [0.5; 3],
        };
        let at = |i: usize| -1.2 + 0.1 * i as f32;
        (0..13).flat_map(|i| (0..25).map(move |j| disc(at(i), at(j)))).collect()
    }

    fn new(rule: GrowthRule, observed_depth_m: &Image<f32>, pixels: &[(usize, usize)]) -> Vec<bool> {
        let cloud = half_a_wall();
        let views = [SubmapView::new(&cloud, Pose::identity())];
        let noise = DepthNoise { base_m: 0.001, quadratic_per_m: 0.0 };
        let test = GrowthTest { observed_depth_m, noise, sigma_factor: 3.0, relative: 0.01 };
        let rendering = render(&views, &CAMERA, &RenderSettings::default(), Some(&test));
        let new = new_pixels(rule, &rendering, observed_depth_m, 0.98);
        pixels.iter().map(|pixel| new[*pixel]).collect()
    }

    #[test]
    fn both_rules_grow_where_the_map_shows_nothing_and_neither_where_it_fits() {
        let seen = Image::filled(32, 24, 2.0);
        for rule in [GrowthRule::Adaptive, GrowthRule::Usual] {
            assert_eq!(new(rule, &seen, &[(5, 12), (28, 12)]), [false, true], "{rule:?}");
        }
    }

    #[test]
    fn a_surface_behind_the_map_is_new_to_the_adaptive_rule_alone() {
        // Near, then 0.5 m in front, then 0.5 m behind.
        let mut seen = Image::filled(32, 24, 2.001);
        (seen[(4, 12)], seen[(6, 12)]) = (1.5, 2.5);
        let pixels = [(5, 12), (4, 12), (6, 12)];
        assert_eq!(new(GrowthRule::Adaptive, &seen, &pixels), [false, true, true]);
        assert_eq!(new(GrowthRule::Usual, &seen, &pixels), [false, true, false]);
    }

    #[test]
    fn the_usual_rule_waits_for_fifty_medians() {
        // Everything is 2 cm off: what is 0.5 m in front is not yet 50 times that.
        let mut seen = Image::filled(32, 24, 2.02);
        seen[(4, 12)] = 1.5;
        assert_eq!(new(GrowthRule::Usual, &seen, &[(4, 12)]), [false]);
    }
}
