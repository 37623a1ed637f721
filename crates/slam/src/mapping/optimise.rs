//! Optimisation of a submap's surfels over its keyframes (eq. 9 of the CoMA-SLAM paper):
//! `0.8 L1 + 0.2 (1 - SSIM)` on colour and L1 on depth, by Adam through the rasteriser.

use super::ssim::ssim_and_gradient;
use coma_frame::{DepthNoise, Image};
use coma_geometry::{Intrinsics, Pose};
use coma_raster::{Outputs, PixelGradients, RenderSettings, Rendering, SubmapView, SurfelGradients};
use coma_surfel::SurfelCloud;
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::sync::LazyLock;

/// Weights and learning rates.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OptimiseSettings {
    /// Share of 1 - SSIM in the colour loss (3D Gaussian Splatting: 0.2).
    pub ssim_weight: f32,
    /// Weight of depth (metres) against colour (0..1). The paper takes 0.01 for poses.
    pub depth_weight: f32,
    /// Depth that differs by more is another surface, metres.
    pub depth_cutoff_m: f32,
    /// Adam's step for centres, metres.
    pub center_rate_m: f32,
    /// Adam's step for orientations, radians.
    pub rotation_rate_rad: f32,
    /// Adam's step for the logarithm of scales.
    pub log_scale_rate: f32,
    /// Adam's step for the logit of opacity.
    pub logit_opacity_rate: f32,
    /// Adam's step for colour.
    pub color_rate: f32,
}

impl Default for OptimiseSettings {
    fn default() -> Self {
        OptimiseSettings {
            ssim_weight: 0.2,
            depth_weight: 0.2,
            depth_cutoff_m: 0.1,
            center_rate_m: 0.0,
            rotation_rate_rad: 0.0,
            log_scale_rate: 5e-3,
            logit_opacity_rate: 0.03,
            color_rate: 8e-3,
        }
    }
}

/// What a keyframe asks of the surfels.
#[derive(Clone, Debug)]
pub struct Target {
    /// Its camera.
    pub camera: Intrinsics,
    /// Where it was.
    pub submap_from_camera: Pose,
    /// Colour at the session's brightness, 0..1.
    pub color: Image<[f32; 3]>,
    /// Metres, 0 = none.
    pub depth_m: Image<f32>,
    /// How wrong the depth is.
    pub noise: DepthNoise,
}

/// Loss of one rendering.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Loss {
    /// Mean absolute colour error.
    pub color_l1: f64,
    /// Mean SSIM.
    pub ssim: f64,
    /// Mean absolute depth error where both have depth, metres.
    pub depth_l1_m: f64,
}

/// Pixels or surfels of one task.
const PART: usize = 4096;

/// What a loss looks at. `[height, width]`
#[derive(Clone, Copy, Debug)]
pub struct Rendered<'a> {
    /// 0..1.
    pub color: &'a Image<[f32; 3]>,
    /// Expected depth, metres.
    pub depth_m: &'a Image<f32>,
    /// A, 0..1.
    pub opacity: &'a Image<f32>,
}

impl<'a> From<&'a Rendering> for Rendered<'a> {
    fn from(r: &'a Rendering) -> Self {
        Rendered { color: &r.color, depth_m: &r.depth_m, opacity: &r.opacity }
    }
}

/// Eq. 9 and its derivative by every pixel.
pub fn loss<'a>(
    rendered: impl Into<Rendered<'a>>,
    target: &Target,
    settings: &OptimiseSettings,
) -> (Loss, PixelGradients) {
    let rendering = rendered.into();
    let (width, height) = (target.color.width(), target.color.height());
    let pixels = (width * height) as f32;
    let (ssim, ssim_gradient) = ssim_and_gradient(rendering.color, &target.color);
    let l1_step = (1.0 - settings.ssim_weight) / (3.0 * pixels);
    let mut color = ssim_gradient;
    let mut depth = Image::filled(width, height, 0.0f32);
    let reference_sigma = target.noise.sigma_m(1.0);
    // Parts are summed up in their order.
    let sums: Vec<(f64, f64, usize)> = (
        color.pixels_mut().par_chunks_mut(PART),
        rendering.color.pixels().par_chunks(PART),
        target.color.pixels().par_chunks(PART),
        depth.pixels_mut().par_chunks_mut(PART),
        rendering.depth_m.pixels().par_chunks(PART),
        target.depth_m.pixels().par_chunks(PART),
        rendering.opacity.pixels().par_chunks(PART),
    )
        .into_par_iter()
        .map(|(by_color, color, wanted_color, by_depth, depth, wanted_depth, opacity)| {
            let mut l1 = 0.0f64;
            for (g, (c, t)) in by_color.iter_mut().zip(color.iter().zip(wanted_color)) {
                for k in 0..3 {
                    let r = c[k] - t[k];
                    l1 += r.abs() as f64;
                    // Smoothed at the size of one grey level, so that a perfect pixel stays where it is.
                    g[k] = l1_step * (r / 0.004).clamp(-1.0, 1.0) - settings.ssim_weight * g[k];
                }
            }
            let (mut depth_sum, mut depth_count) = (0.0f64, 0usize);
            for (i, (found, wanted)) in depth.iter().zip(wanted_depth).enumerate() {
                if !(*wanted > 0.0 && *found > 0.0 && opacity[i] > 0.5) {
                    continue;
                }
                let r = found - wanted;
                if r.abs() > settings.depth_cutoff_m {
                    continue;
                }
                depth_sum += r.abs() as f64;
                depth_count += 1;
                // Quadratic within the noise, linear beyond; far pixels count less, as they err more.
                let sigma = target.noise.sigma_m(*wanted);
                let weight = settings.depth_weight * reference_sigma / sigma / pixels;
                by_depth[i] = weight * r / (r * r + sigma * sigma).sqrt();
            }
            (l1, depth_sum, depth_count)
        })
        .collect();
    let depth_count: usize = sums.iter().map(|s| s.2).sum();
    let loss = Loss {
        color_l1: sums.iter().map(|s| s.0).sum::<f64>() / (3.0 * pixels) as f64,
        ssim,
        depth_l1_m: sums.iter().map(|s| s.1).sum::<f64>() / depth_count.max(1) as f64,
    };
    let opacity = Image::filled(width, height, 0.0f32);
    (loss, PixelGradients { color, depth_m: depth, opacity })
}

/// Parameters of one surfel as Adam sees them: centre 3, rotation 3, log-scale 2, logit-opacity 1, colour 3.
const PARAMETERS: usize = 12;

/// Adam's moments, one row per surfel (Kingma & Ba 2014).
#[derive(Clone, Debug, Default)]
pub struct Adam {
    first: Vec<[f32; PARAMETERS]>,
    second: Vec<[f32; PARAMETERS]>,
    steps: Vec<u32>,
}

impl Adam {
    /// Rows for surfels that were added since.
    pub fn resize(&mut self, surfels: usize) {
        self.first.resize(surfels, [0.0; PARAMETERS]);
        self.second.resize(surfels, [0.0; PARAMETERS]);
        self.steps.resize(surfels, 0);
    }

    /// Drops the rows of surfels that were pruned.
    pub fn retain(&mut self, keep: &[bool]) {
        fn column<T>(values: &mut Vec<T>, keep: &[bool]) {
            let mut i = 0;
            values.retain(|_| {
                i += 1;
                keep[i - 1]
            });
        }
        column(&mut self.first, keep);
        column(&mut self.second, keep);
        column(&mut self.steps, keep);
    }

    /// One step. Surfels without any gradient (not seen) stay as they are.
    pub fn step(
        &mut self,
        surfels: &mut SurfelCloud,
        gradients: &SurfelGradients,
        settings: &OptimiseSettings,
    ) {
        self.resize(surfels.len());
        let rates: [f32; PARAMETERS] = std::array::from_fn(|k| match k {
            0..3 => settings.center_rate_m,
            3..6 => settings.rotation_rate_rad,
            6..8 => settings.log_scale_rate,
            8 => settings.logit_opacity_rate,
            _ => settings.color_rate,
        });
        (
            surfels.center_m.par_chunks_mut(PART),
            surfels.rotation_wxyz.par_chunks_mut(PART),
            surfels.scale_m.par_chunks_mut(PART),
            surfels.opacity.par_chunks_mut(PART),
            surfels.color.par_chunks_mut(PART),
            self.first.par_chunks_mut(PART),
            self.second.par_chunks_mut(PART),
            self.steps.par_chunks_mut(PART),
        )
            .into_par_iter()
            .enumerate()
            .for_each(|(part, (center, rotation, scale, opacity, color, first, second, steps))| {
                for i in 0..center.len() {
                    let Some(g) = gradient(gradients, part * PART + i, scale[i], opacity[i]) else {
                        continue;
                    };
                    steps[i] = steps[i].saturating_add(1);
                    let change = moments(&mut first[i], &mut second[i], &g, steps[i], &rates);
                    apply(
                        Surfel {
                            center: &mut center[i],
                            rotation_wxyz: &mut rotation[i],
                            scale: &mut scale[i],
                            opacity: &mut opacity[i],
                            color: &mut color[i],
                        },
                        &change,
                    );
                }
            });
    }
}

/// By the parameters as Adam sees them; `None` without any, or where it is not finite.
fn gradient(
    gradients: &SurfelGradients,
    index: usize,
    scale: [f32; 2],
    opacity: f32,
) -> Option<[f32; PARAMETERS]> {
    let (c, r) = (gradients.center_m[index], gradients.rotation[index]);
    let (s, k) = (gradients.scale_m[index], gradients.color[index]);
    // By the chain rule: d/d log s = s d/ds, d/d logit o = o (1 - o) d/do.
    let by_logit = gradients.opacity[index] * opacity * (1.0 - opacity);
    let g =
        [c[0], c[1], c[2], r[0], r[1], r[2], s[0] * scale[0], s[1] * scale[1], by_logit, k[0], k[1], k[2]];
    (g.iter().any(|v| *v != 0.0) && g.iter().all(|v| v.is_finite())).then_some(g)
}

/// Decay of the first moment.
const BETA1: f32 = 0.9;
/// Decay of the second moment.
const BETA2: f32 = 0.99;

/// `1 - beta^t`, by `t`: how much of a moment that began at zero is there. Later it is all there.
static CORRECTIONS: LazyLock<Vec<[f32; 2]>> =
    LazyLock::new(|| (0..10_001).map(|t| [1.0 - BETA1.powi(t), 1.0 - BETA2.powi(t)]).collect());

/// Moves the moments and returns by how much the parameters change.
pub(crate) fn moments<const N: usize>(
    first: &mut [f32; N],
    second: &mut [f32; N],
    g: &[f32; N],
    step: u32,
    rates: &[f32; N],
) -> [f32; N] {
    let [correct1, correct2] = CORRECTIONS[step.min(10_000) as usize];
    let mut change = [0.0f32; N];
    for k in 0..N {
        first[k] = BETA1 * first[k] + (1.0 - BETA1) * g[k];
        second[k] = BETA2 * second[k] + (1.0 - BETA2) * g[k] * g[k];
        change[k] = -rates[k] * (first[k] / correct1) / ((second[k] / correct2).sqrt() + 1e-12);
    }
    change
}

/// One surfel of a cloud.
struct Surfel<'a> {
    center: &'a mut [f32; 3],
    rotation_wxyz: &'a mut [f32; 4],
    scale: &'a mut [f32; 2],
    opacity: &'a mut f32,
    color: &'a mut [f32; 3],
}

fn apply(surfel: Surfel<'_>, change: &[f32; PARAMETERS]) {
    for k in 0..3 {
        surfel.center[k] += change[k];
        surfel.color[k] = (surfel.color[k] + change[9 + k]).clamp(0.0, 1.0);
    }
    let [w, x, y, z] = *surfel.rotation_wxyz;
    let turned = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z))
        * UnitQuaternion::from_scaled_axis(Vector3::new(change[3], change[4], change[5]));
    *surfel.rotation_wxyz = [turned.w, turned.i, turned.j, turned.k];
    for k in 0..2 {
        surfel.scale[k] = (surfel.scale[k] * change[6 + k].exp()).clamp(1e-4, 0.5);
    }
    let o = surfel.opacity.clamp(1e-4, 0.9999);
    let logit = (o / (1.0 - o)).ln() + change[8];
    *surfel.opacity = (1.0 / (1.0 + (-logit).exp())).clamp(1e-4, 0.9999);
}

/// One optimiser step on one keyframe.
pub fn optimise_once(
    surfels: &mut SurfelCloud,
    adam: &mut Adam,
    target: &Target,
    render_settings: &RenderSettings,
    settings: &OptimiseSettings,
) -> (Loss, u64) {
    let camera_from_submap = target.submap_from_camera.inverse();
    let views = [SubmapView::new(surfels, camera_from_submap)];
    let rendering =
        coma_raster::render_only(&views, &target.camera, render_settings, None, Outputs::Optimising);
    let (loss, pixels) = loss(&rendering, target, settings);
    let gradients = coma_raster::backward(&views, &target.camera, render_settings, &rendering, &pixels);
    let hits = rendering.hits;
    adam.step(surfels, &gradients.submaps[0], settings);
    (loss, hits)
}
