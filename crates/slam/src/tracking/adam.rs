//! The paper's way from a guess to a pose (eq. 4 of the CoMA-SLAM paper): Adam on the pose, through the rasteriser.
//!
//! ```text
//! min  M_depth M_opacity (L1(C_rendered, C) + lambda_d L1(D_rendered, D))
//! ```
//!
//! Tens of renderings where [`super::frame_to_model`] needs one: it is here so that both can be compared.

use super::align::{AlignSettings, Brightness, align};
use super::model::Model;
use super::view::TrackingView;
use super::{Reason, Tracked, TrackingSettings, judged};
use crate::mapping::submap::corrected_color;
use coma_frame::{Image, RgbdFrame};
use coma_geometry::{Pose, Tangent, se3};
use coma_raster::{Outputs, PixelGradients, Rendering, SubmapView};
use serde::{Deserialize, Serialize};

/// Steps, rates and masks of eq. 4.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AdamSettings {
    /// Steps per frame. The paper doesn't say; others take 60 on clean and 200 on recorded data.
    pub steps: u32,
    /// Learning rate of the rotation, radians (paper: 2e-4). No step is longer, so 60 of them reach 0.7 degrees.
    pub rotation_rate_rad: f64,
    /// Learning rate of the translation, metres (paper: 2e-3).
    pub translation_rate_m: f64,
    /// lambda_d: weight of depth (metres) against colour (0..1).
    pub depth_weight: f32,
    /// M_opacity: pixels more opaque than this count.
    pub min_opacity: f32,
    /// M_depth: pixels count whose depth is off by less than so many times the median.
    pub depth_medians: f32,
}

impl Default for AdamSettings {
    fn default() -> Self {
        AdamSettings {
            steps: 60,
            rotation_rate_rad: 2e-4,
            translation_rate_m: 2e-3,
            depth_weight: 0.01,
            min_opacity: 0.98,
            depth_medians: 50.0,
        }
    }
}

/// What the camera saw, at the model's brightness.
#[derive(Clone, Copy, Debug)]
pub struct Observed<'a> {
    /// 0..1. `[height, width]`
    pub color: &'a Image<[f32; 3]>,
    /// Metres, 0 = none. `[height, width]`
    pub depth_m: &'a Image<f32>,
}

/// Value of eq. 4, its derivatives by pixels, and the pixels that count.
#[derive(Clone, Debug)]
pub struct PoseLoss {
    /// Mean over the pixels that count; infinite without any.
    pub value: f64,
    /// By what was rendered; masks stay as they are.
    pub by_pixel: PixelGradients,
    /// M_depth M_opacity. `[height, width]`
    pub mask: Image<bool>,
}

/// Eq. 4 at a rendering.
pub fn pose_loss(rendering: &Rendering, observed: Observed<'_>, settings: &AdamSettings) -> PoseLoss {
    let (width, height) = (observed.color.width(), observed.color.height());
    let mask = mask(rendering, observed.depth_m, settings);
    let count = mask.pixels().iter().filter(|counts| **counts).count();
    let mut by_pixel = PixelGradients {
        color: Image::filled(width, height, [0.0; 3]),
        depth_m: Image::filled(width, height, 0.0),
        opacity: Image::filled(width, height, 0.0),
    };
    let (by_channel, by_depth) = (1.0 / (3.0 * count as f32), settings.depth_weight / count as f32);
    let mut sum = 0.0f64;
    for i in (0..mask.pixels().len()).filter(|i| mask.pixels()[*i]) {
        for c in 0..3 {
            let off = rendering.color.pixels()[i][c] - observed.color.pixels()[i][c];
            sum += f64::from(off.abs()) / 3.0;
            by_pixel.color.pixels_mut()[i][c] = sign(off) * by_channel;
        }
        let off_m = rendering.depth_m.pixels()[i] - observed.depth_m.pixels()[i];
        sum += f64::from(settings.depth_weight * off_m.abs());
        by_pixel.depth_m.pixels_mut()[i] = sign(off_m) * by_depth;
    }
    let value = if count > 0 { sum / count as f64 } else { f64::INFINITY };
    PoseLoss { value, by_pixel, mask }
}

/// M_depth M_opacity.
fn mask(rendering: &Rendering, observed_depth_m: &Image<f32>, settings: &AdamSettings) -> Image<bool> {
    let off_m = |i: usize| {
        let (rendered, observed) = (rendering.depth_m.pixels()[i], observed_depth_m.pixels()[i]);
        let opaque = rendering.opacity.pixels()[i] > settings.min_opacity;
        (opaque && observed > 0.0).then(|| (rendered - observed).abs())
    };
    let mut errors_m: Vec<f32> = (0..observed_depth_m.pixels().len()).filter_map(off_m).collect();
    let median_m = median(&mut errors_m);
    let width = observed_depth_m.width();
    Image::from_fn(width, observed_depth_m.height(), |x, y| {
        off_m(y * width + x).is_some_and(|off_m| off_m <= settings.depth_medians * median_m)
    })
}

/// The middle one, or 0 without any; `values` lose their order.
pub(crate) fn median(values: &mut [f32]) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}

fn sign(value: f32) -> f32 {
    if value > 0.0 {
        1.0
    } else if value < 0.0 {
        -1.0
    } else {
        0.0
    }
}

/// What Adam found.
#[derive(Clone, Copy, Debug)]
pub struct Refined {
    /// The pose with the least loss of all that were tried.
    pub agent_from_camera: Pose,
    /// Its loss.
    pub loss: f64,
    /// Blended hits of all renderings.
    pub hits: u64,
}

/// Refines a guess. `None` where no pixel counts.
pub fn refine(
    model: &Model<'_>,
    frame: &RgbdFrame,
    guess_agent_from_camera: &Pose,
    brightness: Brightness,
    settings: &AdamSettings,
) -> Option<Refined> {
    let color = corrected_color(&frame.color, brightness);
    let observed = Observed { color: &color, depth_m: &frame.depth_m };
    let mut pose = *guess_agent_from_camera;
    let mut adam = PoseAdam::default();
    let mut best = Refined { agent_from_camera: pose, loss: f64::INFINITY, hits: 0 };
    for step in 0..=settings.steps {
        let camera_from_agent = pose.inverse();
        let views: Vec<SubmapView<'_>> =
            model.submaps.iter().map(|part| part.seen(&camera_from_agent)).collect();
        let rendering =
            coma_raster::render_only(&views, &frame.camera, model.render, None, Outputs::Optimising);
        best.hits += rendering.hits;
        let loss = pose_loss(&rendering, observed, settings);
        if loss.value < best.loss {
            best.loss = loss.value;
            best.agent_from_camera = pose;
        }
        // The last rendering only judges the last step.
        if step == settings.steps || !loss.value.is_finite() {
            break;
        }
        let by_pose =
            coma_raster::backward(&views, &frame.camera, model.render, &rendering, &loss.by_pixel).pose;
        if !by_pose.iter().all(|g| g.is_finite()) {
            break;
        }
        pose *= se3::exp(&adam.step(&by_pose, settings));
        pose.rotation.renormalize();
    }
    best.loss.is_finite().then_some(best)
}

/// Adam's moments of a pose that is perturbed on the right (Kingma and Ba 2014, with their decays).
#[derive(Clone, Debug, Default)]
struct PoseAdam {
    first: Tangent,
    second: Tangent,
    steps: i32,
}

impl PoseAdam {
    /// The perturbation that a derivative asks for.
    fn step(&mut self, by_pose: &Tangent, settings: &AdamSettings) -> Tangent {
        const BETA1: f64 = 0.9;
        const BETA2: f64 = 0.999;
        self.steps += 1;
        self.first = self.first * BETA1 + by_pose * (1.0 - BETA1);
        self.second = self.second * BETA2 + by_pose.component_mul(by_pose) * (1.0 - BETA2);
        let (whole1, whole2) = (1.0 - BETA1.powi(self.steps), 1.0 - BETA2.powi(self.steps));
        Tangent::from_fn(|k, _| {
            let rate = if k < 3 { settings.translation_rate_m } else { settings.rotation_rate_rad };
            -rate * (self.first[k] / whole1) / ((self.second[k] / whole2).sqrt() + 1e-8)
        })
    }
}

/// As [`super::frame_to_model`], by eq. 4. Brightness stays as it was; covariance and fit are those of one alignment's
/// equations at the pose that was found.
pub fn frame_to_model(
    model: &Model<'_>,
    frame: &RgbdFrame,
    view: &TrackingView,
    guess_agent_from_camera: &Pose,
    brightness: Brightness,
    settings: &TrackingSettings,
) -> Result<Tracked, Vec<Reason>> {
    let not_aligned = || vec![Reason::NotAligned { with: "the map" }];
    let refined =
        refine(model, frame, guess_agent_from_camera, brightness, &settings.adam).ok_or_else(not_aligned)?;
    let pose = refined.agent_from_camera;
    let view = &settings.aligned(view);
    let picture = model.picture(&pose, &frame.camera, view, settings);
    let still = AlignSettings { steps: vec![0], ..settings.frame_to_model.clone() };
    let found = align(&picture.view, view, &Pose::identity(), brightness, &still).ok_or_else(not_aligned)?;
    judged(guess_agent_from_camera, &pose, &found, refined.hits + picture.hits, settings)
}

#[cfg(test)]
#[path = "adam_tests.rs"]
mod adam_tests;
