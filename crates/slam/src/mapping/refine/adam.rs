//! Adam on surfels whose centres move in axes of their own (Kingma and Ba 2014).

use super::RefineSettings;
use coma_raster::SurfelGradients;
use coma_surfel::SurfelCloud;
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use rayon::prelude::*;

/// In the plane 2, along the normal 1, rotation 3, log-scale 2, logit of opacity 1, colour 3.
pub(super) const PARAMETERS: usize = 12;
/// Surfels of one task.
const PART: usize = 4096;
/// Decay of the first moment.
const BETA1: f32 = 0.9;
/// Decay of the second moment.
const BETA2: f32 = 0.99;
/// After so many steps a moment that began at zero is all there.
const SETTLED: u32 = 4000;

/// Moments, one row for each surfel.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Adam {
    pub first: Vec<[f32; PARAMETERS]>,
    pub second: Vec<[f32; PARAMETERS]>,
    pub steps: Vec<u32>,
}

impl Adam {
    pub fn new(surfels: usize) -> Self {
        let mut out = Adam::default();
        out.resize(surfels);
        out
    }

    /// Rows for surfels that were added since.
    pub fn resize(&mut self, surfels: usize) {
        self.first.resize(surfels, [0.0; PARAMETERS]);
        self.second.resize(surfels, [0.0; PARAMETERS]);
        self.steps.resize(surfels, 0);
    }

    /// Rows after surfels were split and dropped: each is that of its source, or new without one.
    pub fn take_over(&mut self, sources: &[Option<u32>]) {
        fn column<T: Copy>(values: &[T], sources: &[Option<u32>], new: T) -> Vec<T> {
            sources.iter().map(|s| s.map_or(new, |s| values[s as usize])).collect()
        }
        self.first = column(&self.first, sources, [0.0; PARAMETERS]);
        self.second = column(&self.second, sources, [0.0; PARAMETERS]);
        self.steps = column(&self.steps, sources, 0);
    }

    /// One step with rates times `decay`. Surfels without any gradient (not seen) stay as they are.
    pub fn step(
        &mut self,
        surfels: &mut SurfelCloud,
        gradients: &SurfelGradients,
        settings: &RefineSettings,
        decay: f32,
    ) {
        let optimise = &settings.optimise;
        let rates: [f32; PARAMETERS] = std::array::from_fn(|k| {
            decay
                * match k {
                    0..2 => optimise.center_rate_m,
                    2 => settings.normal_rate_m,
                    3..6 => optimise.rotation_rate_rad,
                    6..8 => optimise.log_scale_rate,
                    8 => optimise.logit_opacity_rate,
                    _ => optimise.color_rate,
                }
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
                    let [w, x, y, z] = rotation[i];
                    let axes = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
                    let at = part * PART + i;
                    let Some(g) = gradient(gradients, at, &axes, scale[i], opacity[i]) else { continue };
                    steps[i] = (steps[i] + 1).min(SETTLED);
                    let change = moments(&mut first[i], &mut second[i], &g, steps[i], &rates);
                    let by = axes * Vector3::new(change[0], change[1], change[2]);
                    for k in 0..3 {
                        center[i][k] += by[k];
                        color[i][k] = (color[i][k] + change[9 + k]).clamp(0.0, 1.0);
                    }
                    let turn = Vector3::new(change[3], change[4], change[5]);
                    let q = axes * UnitQuaternion::from_scaled_axis(turn);
                    rotation[i] = [q.w, q.i, q.j, q.k];
                    for k in 0..2 {
                        scale[i][k] = (scale[i][k] * change[6 + k].exp()).clamp(1e-4, 0.5);
                    }
                    let o = opacity[i].clamp(1e-4, 0.9999);
                    let logit = (o / (1.0 - o)).ln() + change[8];
                    opacity[i] = (1.0 / (1.0 + (-logit).exp())).clamp(1e-4, 0.9999);
                }
            });
    }
}

/// By the parameters as Adam sees them; `None` without any, or where it is not finite.
fn gradient(
    gradients: &SurfelGradients,
    index: usize,
    axes: &UnitQuaternion<f32>,
    scale: [f32; 2],
    opacity: f32,
) -> Option<[f32; PARAMETERS]> {
    let c = axes.inverse() * Vector3::from(gradients.center_m[index]);
    let (r, s, k) = (gradients.rotation[index], gradients.scale_m[index], gradients.color[index]);
    // By the chain rule: d/d log s = s d/ds, d/d logit o = o (1 - o) d/do.
    let by_logit = gradients.opacity[index] * opacity * (1.0 - opacity);
    let g = [c.x, c.y, c.z, r[0], r[1], r[2], s[0] * scale[0], s[1] * scale[1], by_logit, k[0], k[1], k[2]];
    (g.iter().any(|v| *v != 0.0) && g.iter().all(|v| v.is_finite())).then_some(g)
}

/// Moves the moments and returns by how much the parameters change.
fn moments(
    first: &mut [f32; PARAMETERS],
    second: &mut [f32; PARAMETERS],
    g: &[f32; PARAMETERS],
    step: u32,
    rates: &[f32; PARAMETERS],
) -> [f32; PARAMETERS] {
    let (correct1, correct2) = (1.0 - BETA1.powi(step as i32), 1.0 - BETA2.powi(step as i32));
    let mut change = [0.0f32; PARAMETERS];
    for k in 0..PARAMETERS {
        first[k] = BETA1 * first[k] + (1.0 - BETA1) * g[k];
        second[k] = BETA2 * second[k] + (1.0 - BETA2) * g[k] * g[k];
        change[k] = -rates[k] * (first[k] / correct1) / ((second[k] / correct2).sqrt() + 1e-12);
    }
    change
}
