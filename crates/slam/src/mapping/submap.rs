//! The submap under work: surfels in its own frame, its keyframes, and how they grow.

use super::fuse::{FuseSettings, Measured, fuse};
use super::growth::{GrowthRule, new_pixels};
use super::inherit::{InheritSettings, Inheritance, inherit};
use super::optimise::{Adam, Loss, OptimiseSettings, Target, optimise_once};
use super::seed::{SeedGrid, SeedSettings, seed};
use crate::tracking::align::Brightness;
use crate::tracking::view::TrackingView;
use coma_frame::{Image, RgbdFrame, luminance};
use coma_geometry::{Pose, SubmapId, se3};
use coma_raster::{GrowthTest, Outputs, RenderSettings, SubmapView};
use coma_surfel::SurfelCloud;
use nalgebra::Point3;
use serde::{Deserialize, Serialize};

/// How submaps are filled and closed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MappingSettings {
    /// How pixels become surfels.
    pub seed: SeedSettings,
    /// How surfels follow what later frames measure.
    pub fuse: FuseSettings,
    /// What a new submap takes over from the one before.
    pub inherit: InheritSettings,
    /// How surfels are optimised.
    pub optimise: OptimiseSettings,
    /// Share of its distance from 1 that a frame's gain loses before the frame colours the map. Errors of a gain are small
    /// but of one sign, and the next frames inherit them: without this, a map grows darker or brighter for as long as its
    /// agent lives. A camera whose exposure has changed for good colours the map its own way after some hundred frames.
    pub gain_relaxation: f64,
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
    /// A camera that stood still for so many frames has nothing to add until it moves again: a map that followed its
    /// noise would wander, and the camera with it.
    pub rest_after_frames: u32,
    /// Where the map grows: `adaptive` or `usual`.
    pub growth: GrowthRule,
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
            fuse: FuseSettings::default(),
            inherit: InheritSettings::default(),
            optimise: OptimiseSettings::default(),
            gain_relaxation: 0.005,
            keyframe_every: 5,
            steps_per_keyframe: 6,
            moving_frames: 20,
            moved_new_share: 0.02,
            moved_m: 0.02,
            moved_rad: 1f64.to_radians(),
            rest_after_frames: 5,
            growth: GrowthRule::Adaptive,
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
    /// Of the surfels, one for each.
    pub measured: Measured,
    adam: Adam,
    keyframes: Vec<Target>,
    mapped_frames: u32,
    moving_frames: u32,
    /// Frames since the last that moved.
    still_frames: u32,
    last_counted: Pose,
    steps_taken: usize,
    /// Optimiser steps that are due until the next keyframe.
    owed_steps: u32,
}

/// What a frame did to the submap.
#[derive(Clone, Copy, Debug, Default)]
pub struct MappedFrame {
    /// Surfels that were added.
    pub added: usize,
    /// Share of the pixels with depth that the submap did not know and that can become surfels, 0..1.
    pub new_share: f32,
    /// Optimiser steps that were taken.
    pub steps: u32,
    /// Blended hits of all renderings.
    pub hits: u64,
    /// Of the last optimiser step.
    pub loss: Option<Loss>,
}

impl ActiveSubmap {
    /// A submap with what it inherits; map its anchor next.
    pub fn open(id: SubmapId, chain: u32, agent_from_submap: Pose, inherited: Inheritance) -> Self {
        let Inheritance { surfels, measured, .. } = inherited;
        ActiveSubmap {
            id,
            chain,
            agent_from_submap,
            surfels,
            measured,
            revision: 0,
            adam: Adam::default(),
            keyframes: Vec::new(),
            mapped_frames: 0,
            moving_frames: 0,
            still_frames: 0,
            last_counted: Pose::identity(),
            steps_taken: 0,
            owed_steps: 0,
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
        view: &TrackingView,
        submap_from_camera: &Pose,
        brightness: Brightness,
        urgent: bool,
        step_budget: u32,
        settings: &MappingSettings,
        render_settings: &RenderSettings,
    ) -> MappedFrame {
        let mut out = MappedFrame::default();
        let brightness = brightness.relaxed(settings.gain_relaxation);
        let color = corrected_color(&frame.color, brightness);
        let camera_from_submap = submap_from_camera.inverse();
        let at_rest = self.still_frames >= settings.rest_after_frames.max(1);
        if settings.fuse.enabled && !at_rest {
            fuse(
                &mut self.surfels,
                &mut self.measured,
                view,
                brightness,
                &camera_from_submap,
                &settings.fuse,
            );
        }
        // At the resolution of the seeds: one look at each pixel that may become a surfel.
        let grid = SeedGrid::of(&frame.camera, &settings.seed);
        let depth_m = grid.pick(&frame.depth_m);
        let views = [SubmapView::new(&self.surfels, camera_from_submap)];
        let test = GrowthTest {
            observed_depth_m: &depth_m,
            noise: frame.noise,
            sigma_factor: settings.growth_sigma,
            relative: settings.growth_relative,
        };
        let coarse = render_settings.resized(grid.camera.fx / frame.camera.fx);
        let rendering =
            coma_raster::render_only(&views, &grid.camera, &coarse, Some(&test), Outputs::Optimising);
        out.hits += rendering.hits;
        let wanted = new_pixels(settings.growth, &rendering, &depth_m, settings.covered_opacity);
        let new_surfels =
            seed(frame, submap_from_camera, &settings.seed, &grid, &wanted, |x, y| color[(x, y)]);
        let measured = depth_m.pixels().iter().filter(|z| **z > 0.0).count();
        out.new_share = new_surfels.len() as f32 / measured.max(1) as f32;
        let moved = self.note_motion(submap_from_camera, out.new_share, settings);
        if at_rest && !moved {
            return out;
        }
        out.added = new_surfels.len();
        for surfel in new_surfels {
            let depth_m = (camera_from_submap * Point3::from(surfel.center_m).cast::<f64>()).z as f32;
            let sigma = frame.noise.sigma_m(depth_m);
            self.measured.push(sigma * sigma, luminance(surfel.color));
            self.surfels.push(surfel);
        }
        self.adam.resize(self.surfels.len());
        let due = self.mapped_frames.is_multiple_of(settings.keyframe_every.max(1));
        self.mapped_frames += 1;
        if due || urgent {
            self.add_keyframe(frame, color, submap_from_camera);
            // What a small budget left undone lapses.
            self.owed_steps =
                (self.owed_steps + settings.steps_per_keyframe).min(2 * settings.steps_per_keyframe);
        }
        // Spread over the frames until the next keyframe, so that no frame takes much longer than the others.
        let every = settings.keyframe_every.max(1);
        let left = every - (self.mapped_frames - 1) % every;
        let steps = self.owed_steps.div_ceil(left).min(step_budget);
        self.owed_steps -= steps;
        self.optimise(steps, settings, render_settings, &mut out);
        if out.added > 0 || out.steps > 0 {
            self.revision += 1;
        }
        out
    }

    /// Has the camera moved since the last frame that counted? The anchor counts as the first.
    fn note_motion(&mut self, submap_from_camera: &Pose, new_share: f32, settings: &MappingSettings) -> bool {
        let (moved_m, moved_rad) = se3::distance(&self.last_counted, submap_from_camera);
        let moved = self.mapped_frames > 0
            && (new_share >= settings.moved_new_share
                || moved_m >= settings.moved_m
                || moved_rad >= settings.moved_rad);
        if moved {
            self.moving_frames += 1;
            self.still_frames = 0;
            self.last_counted = *submap_from_camera;
        } else {
            self.still_frames += 1;
        }
        moved
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
        steps: u32,
        settings: &MappingSettings,
        render_settings: &RenderSettings,
        out: &mut MappedFrame,
    ) {
        let count = self.keyframes.len();
        for _ in 0..steps {
            // Every other step on the newest keyframe, the rest in turn.
            let newest = self.steps_taken.is_multiple_of(2);
            let pick = if newest { count - 1 } else { self.steps_taken / 2 % count };
            self.steps_taken += 1;
            let target = &self.keyframes[pick];
            let (loss, hits) =
                optimise_once(&mut self.surfels, &mut self.adam, target, render_settings, &settings.optimise);
            out.hits += hits;
            out.steps += 1;
            out.loss = Some(loss);
        }
    }

    /// What a submap whose anchor is at `submap_from_anchor` and sees `view` takes over from this one.
    pub fn bequeath(
        &self,
        submap_from_anchor: &Pose,
        view: &TrackingView,
        settings: &MappingSettings,
    ) -> Inheritance {
        let seed_px = settings.seed.spacing_px.max(1) as f32 * settings.seed.scale_in_spacings;
        let anchor_from_submap = submap_from_anchor.inverse();
        inherit(&self.surfels, &self.measured, &anchor_from_submap, view, seed_px, &settings.inherit)
    }

    /// The finished submap's surfels, pruned.
    pub fn close(mut self, settings: &MappingSettings) -> SurfelCloud {
        let keep = self.opaque(settings);
        self.surfels.retain(&keep);
        self.surfels
    }

    /// What of the finished submap is left to track against beside one that took over `taken`: surfels and their
    /// measured intensity.
    pub fn rest(&self, taken: &[bool], settings: &MappingSettings) -> (SurfelCloud, Vec<f32>) {
        let mut keep = self.opaque(settings);
        for (keep, taken) in keep.iter_mut().zip(taken) {
            *keep &= !taken;
        }
        let mut surfels = self.surfels.clone();
        surfels.retain(&keep);
        let measured = self.measured.intensity.iter().zip(keep);
        (surfels, measured.filter_map(|(intensity, keep)| keep.then_some(*intensity)).collect())
    }

    fn opaque(&self, settings: &MappingSettings) -> Vec<bool> {
        self.surfels.opacity.iter().map(|o| *o >= settings.prune_opacity).collect()
    }
}

/// Colour at the session's brightness, 0..1.
pub fn corrected_color(color: &Image<[u8; 3]>, brightness: Brightness) -> Image<[f32; 3]> {
    let table: [f32; 256] =
        std::array::from_fn(|v| (brightness.gain as f32 * v as f32 / 255.0).clamp(0.0, 1.0));
    color.map(|c| c.map(|v| table[v as usize]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_geometry::{AgentId, Epoch};
    use coma_surfel::Surfel;

    #[test]
    fn what_the_next_submap_took_over_and_what_is_faint_is_not_tracked_against_again() {
        let surfel = |opacity, x| Surfel {
            center_m: [x, 0.0, 2.0],
            rotation_wxyz: [0.0, 1.0, 0.0, 0.0],
            scale_m: [0.01; 2],
            opacity,
            color: [0.5; 3],
        };
        let surfels: SurfelCloud =
            [surfel(0.9, 1.0), surfel(0.01, 2.0), surfel(0.9, 3.0)].into_iter().collect();
        let measured = Measured { variance_m2: vec![1e-4; 3], intensity: vec![0.1, 0.2, 0.3] };
        let id = SubmapId { agent: AgentId::new("a").unwrap(), epoch: Epoch(0), number: 0 };
        let inherited = Inheritance { surfels, measured, taken: Vec::new() };
        let submap = ActiveSubmap::open(id, 0, Pose::identity(), inherited);
        let settings = MappingSettings::default();
        let x = |cloud: &SurfelCloud| cloud.center_m.iter().map(|c| c[0]).collect::<Vec<_>>();
        let (rest, intensity) = submap.rest(&[true, false, false], &settings);
        assert_eq!((x(&rest), intensity), (vec![3.0], vec![0.3]));
        let (all, intensity) = submap.rest(&[], &settings);
        assert_eq!((x(&all), intensity), (vec![1.0, 3.0], vec![0.1, 0.3]));
        assert_eq!(x(&submap.close(&settings)), [1.0, 3.0]);
    }
}
