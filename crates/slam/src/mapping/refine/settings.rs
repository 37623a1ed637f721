//! Settings of refinement.

use crate::mapping::optimise::OptimiseSettings;
use crate::mapping::seed::SeedSettings;
use coma_raster::RenderSettings;
use serde::{Deserialize, Serialize};

/// How a finished map is refined.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RefineSettings {
    /// Optimiser steps (paper: 3000).
    pub steps: u32,
    /// Of the order of the views.
    pub seed: u64,
    /// Loss and learning rates. `center_rate_m` is the rate within a surfel's plane: colour says where its edge is.
    pub optimise: OptimiseSettings,
    /// Adam's step for centres along the normal, metres: only depth says where a surface is, and colour would push
    /// surfels off it.
    pub normal_rate_m: f32,
    /// Learning rates fall evenly, by factors, to this share of what they were.
    pub last_rate: f32,
    /// A surfel is looked at for splitting in every n-th step.
    pub survey_every: u32,
    /// Surfels are split and dropped after so many steps, again and again ...
    pub grow_every: u32,
    /// ... in this first share of the steps.
    pub grow_share: f32,
    /// A surfel is split whose pixels err by more than this in colour (0..1) ...
    pub split_color: f32,
    /// ... or in depth, metres.
    pub split_depth_m: f32,
    /// Only a surfel whose standard deviation on the screen is larger is split, pixels. One of a grid with spacing 1
    /// pixel has 0.8.
    pub split_px: f32,
    /// At most this share of the surfels is split at once: those with the largest sum of errors.
    pub split_share: f32,
    /// Standard deviation of the renderer's low-pass, pixels. The renderer's own, 0.7, blurs silhouettes: on a clean
    /// sequence 0.4 gained 0.8 dB over it after 300 steps.
    pub low_pass_px: f32,
    /// Fainter surfels are dropped.
    pub prune_opacity: f32,
    /// Pixels with depth that are less opaque get new surfels.
    pub hole_opacity: f32,
    /// How these are made.
    pub seed_holes: SeedSettings,
    /// No more surfels than these: they are what a step's time goes with.
    pub max_surfels: usize,
    /// Views are aligned with the map when they are visited: for cameras that were tracked worse than the map shows
    /// detail ...
    pub poses: bool,
    /// ... from this step on.
    pub poses_from_step: u32,
    /// For cameras that choose their exposure: each picture is first brought to the map's brightness.
    pub exposure: bool,
    /// How strongly that gain is held at 1.
    pub exposure_prior: f32,
}

impl Default for RefineSettings {
    fn default() -> Self {
        RefineSettings {
            steps: 3000,
            seed: 1,
            optimise: OptimiseSettings {
                depth_weight: 2.0,
                center_rate_m: 3e-3,
                rotation_rate_rad: 1.6e-2,
                log_scale_rate: 3e-2,
                logit_opacity_rate: 0.1,
                color_rate: 2e-2,
                depth_cutoff_m: 0.3,
                ..OptimiseSettings::default()
            },
            normal_rate_m: 6e-4,
            last_rate: 0.03,
            survey_every: 2,
            grow_every: 100,
            grow_share: 0.5,
            split_color: 0.008,
            split_depth_m: 0.01,
            split_px: 1.0,
            split_share: 0.1,
            low_pass_px: 0.15,
            prune_opacity: 0.05,
            hole_opacity: 0.7,
            seed_holes: SeedSettings { spacing_px: 1, even_color: 0.0, ..SeedSettings::default() },
            max_surfels: 800_000,
            poses: false,
            poses_from_step: 200,
            exposure: false,
            exposure_prior: 0.1,
        }
    }
}

impl RefineSettings {
    /// How a map that was refined with these is rendered.
    pub fn render(&self) -> RenderSettings {
        RenderSettings { low_pass_px: self.low_pass_px, ..RenderSettings::default() }
    }

    /// The first step in which the map grows no more.
    pub(super) fn grow_until(&self) -> u32 {
        (self.steps as f32 * self.grow_share) as u32
    }

    /// What learning rates are multiplied with.
    pub(super) fn decay(&self, step: u32) -> f32 {
        self.last_rate.powf(step as f32 / self.steps.max(1) as f32)
    }
}
