//! The submap under work: surfels in its own frame, its keyframes, and how they grow.

use super::optimise::{Adam, Loss, OptimiseSettings, Target, optimise_once};
use super::seed::{SeedSettings, seed};
use crate::tracking::align::Brightness;
use coma_frame::{Image, RgbdFrame};
use coma_geometry::{Pose, SubmapId, se3};
use coma_raster::{GrowthTest, RenderSettings, SubmapView};
use coma_surfel::SurfelCloud;
use serde::{Deserialize, Serialize};

/// How submaps are filled and closed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MappingSettings {
    /// How pixels become surfels.
    pub seed: SeedSettings,
    /// How surfels are optimised.
    pub optimise: OptimiseSettings,
    /// A mapping keyframe every so many mapped frames (paper: N_opt = 5).
    pub keyframe_every: u32,
    /// Optimiser steps in a frame's work budget, spent at keyframes.
    pub steps_per_keyframe: u32,
    /// A submap closes after so many moving frames (paper: theta_sub = 20).
    pub moving_frames: u32,
    /// A frame moved if it saw at least this share of new pixels since the last that counted ...
    pub moved_new_share: f32,
    /// ... or went so far, metres ...
    pub moved_m: f64,
    /// ... or turned so far, radians.
    pub moved_rad: f64,
    /// Eq. 5: a blended surfel within so many sigma(z) of the observed depth is the same surface ...
    pub growth_sigma: f32,
    /// ... or within this share of the depth.
    pub growth_relative: f32,
    /// Eq. 5: a pixel less opaque than this is not covered.
    pub covered_opacity: f32,
    /// Surfels less opaque than this are dropped when a submap closes.
    pub prune_opacity: f32,
}

impl Default for MappingSettings {
    fn default() -> Self {
        MappingSettings {
            seed: SeedSettings::default(),
            optimise: OptimiseSettings::default(),
            keyframe_every: 5,
            steps_per_keyframe: 6,
            moving_frames: 20,
            moved_new_share: 0.02,
            moved_m: 0.02,
            moved_rad: 1f64.to_radians(),
            growth_sigma: 3.0,
            growth_relative: 0.01,
            covered_opacity: 0.98,
            prune_opacity: 0.1,
        }
    }
}

/// A submap that frames are still added to.
pub struct ActiveSubmap {
    /// Its name.
    pub id: SubmapId,
    /// Submaps of one chain are tied by tracking.
    pub chain: u32,
    /// By odometry.
    pub agent_from_submap: Pose,
    /// In the submap's frame, which is its anchor's camera.
    pub surfels: SurfelCloud,
    /// Grows whenever surfels change.
    pub revision: u64,
    adam: Adam,
    keyframes: Vec<Target>,
    mapped_frames: u32,
    moving_frames: u32,
    last_counted: Pose,
    next_keyframe: usize,
}

/// What a frame did to the submap.
#[derive(Clone, Copy, Debug, Default)]
pub struct MappedFrame {
    /// Surfels that were added.
    pub added: usize,
    /// Share of the pixels with depth that the submap did not know, 0..1.
    pub new_share: f32,
    /// Optimiser steps that were taken.
    pub steps: u32,
    /// Blended hits of all renderings.
    pub hits: u64,
    /// Of the last optimiser step.
    pub loss: Option<Loss>,
}

impl ActiveSubmap {
    /// A submap without surfels; map its anchor next.
    pub fn open(id: SubmapId, chain: u32, agent_from_submap: Pose) -> Self {
        ActiveSubmap {
            id,
            chain,
            agent_from_submap,
            surfels: SurfelCloud::default(),
            revision: 0,
            adam: Adam::default(),
            keyframes: Vec::new(),
            mapped_frames: 0,
            moving_frames: 0,
            last_counted: Pose::identity(),
            next_keyframe: 0,
        }
    }

    /// True once enough moving frames were seen.
    pub fn is_full(&self, settings: &MappingSettings) -> bool {
        self.moving_frames >= settings.moving_frames
    }

    /// Grows the submap by what a tracked frame shows (eq. 5) and, at keyframes, optimises it (eq. 9) with at
    /// most `step_budget` steps.
    pub fn map(
        &mut self,
        frame: &RgbdFrame,
        submap_from_camera: &Pose,
        brightness: Brightness,
        urgent: bool,
        step_budget: u32,
        settings: &MappingSettings,
        render_settings: &RenderSettings,
    ) -> MappedFrame {
        let mut out = MappedFrame::default();
        let color = corrected_color(&frame.color, brightness);
        let views = [SubmapView { surfels: &self.surfels, camera_from_submap: submap_from_camera.inverse() }];
        let test = GrowthTest {
            observed_depth_m: &frame.depth_m,
            noise: frame.noise,
            sigma_factor: settings.growth_sigma,
            relative: settings.growth_relative,
        };
        let rendering = coma_raster::render(&views, &frame.camera, render_settings, Some(&test));
        out.hits += rendering.hits;
        // Eq. 5: no surfel near the observed depth, or the pixel is not covered.
        let is_new = |x: usize, y: usize| {
            let known = rendering.near_surface.as_ref().is_some_and(|near| near[(x, y)]);
            !known || rendering.opacity[(x, y)] < settings.covered_opacity
        };
        let new_surfels = seed(frame, submap_from_camera, &settings.seed, is_new, |x, y| color[(x, y)]);
        out.added = new_surfels.len();
        out.new_share = new_share(&frame.depth_m, is_new);
        new_surfels.into_iter().for_each(|s| self.surfels.push(s));
        self.adam.resize(self.surfels.len());

        let (moved_m, moved_rad) = se3::distance(&self.last_counted, submap_from_camera);
        let first = self.mapped_frames == 0;
        if !first
            && (out.new_share >= settings.moved_new_share
                || moved_m >= settings.moved_m
                || moved_rad >= settings.moved_rad)
        {
            self.moving_frames += 1;
            self.last_counted = *submap_from_camera;
        }
        let due = self.mapped_frames.is_multiple_of(settings.keyframe_every.max(1));
        self.mapped_frames += 1;
        if due || urgent {
            self.add_keyframe(frame, color, submap_from_camera);
            self.optimise(step_budget, settings, render_settings, &mut out);
        }
        if out.added > 0 || out.steps > 0 {
            self.revision += 1;
        }
        out
    }

    fn add_keyframe(&mut self, frame: &RgbdFrame, color: Image<[f32; 3]>, submap_from_camera: &Pose) {
        // A camera that stands still replaces its last keyframe; the list is bounded by the moving frames.
        if let Some(last) = self.keyframes.last().filter(|_| self.keyframes.len() > 1) {
            let (metres, radians) = se3::distance(&last.submap_from_camera, submap_from_camera);
            if metres < 0.005 && radians < 0.005 {
                self.keyframes.pop();
            }
        }
        self.keyframes.push(Target {
            camera: frame.camera,
            submap_from_camera: *submap_from_camera,
            color,
            depth_m: frame.depth_m.clone(),
            noise: frame.noise,
        });
    }

    fn optimise(
        &mut self,
        step_budget: u32,
        settings: &MappingSettings,
        render_settings: &RenderSettings,
        out: &mut MappedFrame,
    ) {
        let count = self.keyframes.len();
        for step in 0..settings.steps_per_keyframe.min(step_budget) {
            // Every other step on the newest keyframe, the rest in turn.
            let pick = if step % 2 == 0 { count - 1 } else { self.next_keyframe % count };
            self.next_keyframe += (step % 2) as usize;
            let target = &self.keyframes[pick];
            let (loss, hits) =
                optimise_once(&mut self.surfels, &mut self.adam, target, render_settings, &settings.optimise);
            out.hits += hits;
            out.steps += 1;
            out.loss = Some(loss);
        }
    }

    /// The finished submap's surfels, pruned.
    pub fn close(mut self, settings: &MappingSettings) -> SurfelCloud {
        let keep: Vec<bool> = self.surfels.opacity.iter().map(|o| *o >= settings.prune_opacity).collect();
        self.surfels.retain(&keep);
        self.surfels
    }
}

/// Colour at the session's brightness, 0..1.
pub fn corrected_color(color: &Image<[u8; 3]>, brightness: Brightness) -> Image<[f32; 3]> {
    let table: [f32; 256] =
        std::array::from_fn(|v| (brightness.gain as f32 * v as f32 / 255.0).clamp(0.0, 1.0));
    color.map(|c| c.map(|v| table[v as usize]))
}

fn new_share(depth_m: &Image<f32>, is_new: impl Fn(usize, usize) -> bool) -> f32 {
    let (mut seen, mut new) = (0u32, 0u32);
    for y in (0..depth_m.height()).step_by(4) {
        for x in (0..depth_m.width()).step_by(4) {
            if depth_m[(x, y)] > 0.0 {
                seen += 1;
                new += is_new(x, y) as u32;
            }
        }
    }
    new as f32 / seen.max(1) as f32
}
