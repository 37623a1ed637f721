//! Refinement of a finished map as a pure job: frames in, better surfels out.
//!
//! A [`Refiner`] says which view it wants next, takes one optimiser step on it (eq. 9 of the CoMA-SLAM paper), splits
//! surfels where pictures ask for more detail and drops those that fade. Its whole state can be written and taken up
//! again to the same bits. Some surfels may be given as fixed: they are rendered and stay as they are, so that an agent
//! refines its own share among those of others.

mod adam;
mod checkpoint;
mod densify;
mod settings;

pub use checkpoint::CheckpointError;
pub use settings::RefineSettings;

use super::optimise::{Target, loss};
use super::seed::{SeedGrid, seed};
use crate::tracking::TrackingSettings;
use crate::tracking::align::Brightness;
use crate::tracking::model::{Model, Part};
use crate::tracking::view::TrackingView;
use adam::Adam;
use coma_frame::{Image, RgbdFrame};
use coma_geometry::Pose;
use coma_raster::{Outputs, RenderSettings, Rendering, SubmapView};
use coma_surfel::SurfelCloud;
use densify::Seen;
use rayon::prelude::*;

/// What a step found before it changed anything.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Step {
    /// Of the view's whole picture.
    pub psnr_db: f64,
    /// Mean over the picture.
    pub ssim: f64,
    /// Mean where both have depth, metres.
    pub depth_l1_m: f64,
    /// Surfels that are refined, after the step.
    pub surfels: usize,
}

/// The job's state.
pub struct Refiner {
    settings: RefineSettings,
    tracking: TrackingSettings,
    render: RenderSettings,
    /// Tells apart jobs with other settings or another map.
    fingerprint: [u8; 32],
    fixed: SurfelCloud,
    surfels: SurfelCloud,
    adam: Adam,
    seen: Vec<Seen>,
    /// `map_from_camera` of each view.
    poses: Vec<Pose>,
    step: u32,
}

impl Refiner {
    /// A job that refines `surfels` among `fixed` ones by views from `map_from_cameras`; all are in the map's frame.
    pub fn new(
        settings: RefineSettings,
        surfels: SurfelCloud,
        fixed: SurfelCloud,
        map_from_cameras: Vec<Pose>,
    ) -> Self {
        let fingerprint = checkpoint::fingerprint(&settings, &surfels, &fixed, &map_from_cameras);
        Refiner {
            tracking: TrackingSettings::default(),
            render: settings.render(),
            settings,
            fingerprint,
            fixed,
            adam: Adam::new(surfels.len()),
            seen: vec![Seen::default(); surfels.len()],
            surfels,
            poses: map_from_cameras,
            step: 0,
        }
    }

    /// Steps that were taken.
    pub fn steps(&self) -> u32 {
        self.step
    }

    /// Steps that are left.
    pub fn steps_left(&self) -> u32 {
        self.settings.steps.saturating_sub(self.step)
    }

    /// The view that the next step needs; `None` when the job is done.
    pub fn wants(&self) -> Option<usize> {
        self.view_of(self.step)
    }

    /// The view that the step after the next one needs, for those who read ahead.
    pub fn wants_then(&self) -> Option<usize> {
        self.view_of(self.step.saturating_add(1))
    }

    /// The refined surfels.
    pub fn surfels(&self) -> &SurfelCloud {
        &self.surfels
    }

    /// Where the views are, `map_from_camera`.
    pub fn poses(&self) -> &[Pose] {
        &self.poses
    }

    /// One step on the view that the job wants.
    pub fn step(&mut self, frame: &RgbdFrame) -> Step {
        let Some(view) = self.wants() else { return Step::default() };
        if self.settings.poses && self.step >= self.settings.poses_from_step {
            self.align(view, frame);
        }
        let rendering = self.rendering(view, frame);
        let mut target = Target {
            camera: frame.camera,
            submap_from_camera: self.poses[view],
            color: frame.color.to_unit(),
            depth_m: frame.depth_m.clone(),
            noise: frame.noise,
        };
        if self.settings.exposure {
            brighten(&mut target.color, &rendering, self.settings.exposure_prior);
        }
        let (loss, pixels) = loss(&rendering, &target, &self.settings.optimise);
        let out = Step {
            psnr_db: psnr_db(&rendering.color, &target.color),
            ssim: loss.ssim,
            depth_l1_m: loss.depth_l1_m,
            surfels: 0,
        };
        let views = self.views(view);
        let gradients = coma_raster::backward(&views, &frame.camera, &self.render, &rendering, &pixels);
        let surveys = self.step < self.settings.grow_until()
            && self.step.is_multiple_of(self.settings.survey_every.max(1));
        let errors = surveys.then(|| {
            let pixels = densify::errors(&rendering, &target, self.settings.optimise.depth_cutoff_m);
            coma_raster::backward(&views, &frame.camera, &self.render, &rendering, &pixels)
        });
        self.adam.step(
            &mut self.surfels,
            &gradients.submaps[0],
            &self.settings,
            self.settings.decay(self.step),
        );
        if let Some(errors) = errors {
            let camera_from_map = self.poses[view].inverse();
            densify::note(&mut self.seen, &self.surfels, &errors.submaps[0], &camera_from_map, &frame.camera);
            self.fill_holes(view, frame, &rendering, &target.color);
        }
        self.step += 1;
        if self.step <= self.settings.grow_until()
            && self.step.is_multiple_of(self.settings.grow_every.max(1))
        {
            self.grow();
        }
        Step { surfels: self.surfels.len(), ..out }
    }

    /// The whole state as bytes.
    pub fn checkpoint(&self) -> Vec<u8> {
        checkpoint::write(self)
    }

    /// Takes up a job where `bytes` left it. The job must be made as it was then.
    pub fn resume(&mut self, bytes: &[u8]) -> Result<(), CheckpointError> {
        checkpoint::read(self, bytes)
    }

    fn view_of(&self, step: u32) -> Option<usize> {
        let count = self.poses.len() as u32;
        (count > 0 && step < self.settings.steps)
            .then(|| shuffled(count, self.settings.seed, step / count)[(step % count) as usize] as usize)
    }

    fn views(&self, view: usize) -> [SubmapView<'_>; 2] {
        let camera_from_submap = self.poses[view].inverse();
        [&self.surfels, &self.fixed].map(|surfels| SubmapView::new(surfels, camera_from_submap))
    }

    fn rendering(&self, view: usize, frame: &RgbdFrame) -> Rendering {
        coma_raster::render_only(&self.views(view), &frame.camera, &self.render, None, Outputs::Optimising)
    }

    /// Aligns a view with the map; where that fails, the pose stays.
    fn align(&mut self, view: usize, frame: &RgbdFrame) {
        let model = Model {
            submaps: vec![
                Part::new(&self.surfels, Pose::identity()),
                Part::new(&self.fixed, Pose::identity()),
            ],
            render: &self.render,
        };
        let levels = self.tracking.levels();
        let seen = TrackingView::from_frame(frame, levels);
        let found = crate::tracking::frame_to_model(
            &model,
            &seen,
            &self.poses[view],
            Brightness::default(),
            &self.tracking,
        );
        if let Ok(found) = found {
            self.poses[view] = found.agent_from_camera;
        }
    }

    /// Surfels for pixels with depth that the map does not cover.
    fn fill_holes(&mut self, view: usize, frame: &RgbdFrame, rendering: &Rendering, color: &Image<[f32; 3]>) {
        let cutoff_m = self.settings.optimise.depth_cutoff_m;
        let settings = &self.settings.seed_holes;
        let grid = SeedGrid::of(&frame.camera, settings);
        let (width, height) = (grid.camera.width as usize, grid.camera.height as usize);
        let wanted = Image::from_fn(width, height, |i, j| {
            let at = grid.pixel(i, j);
            let behind = rendering.depth_m[at] - frame.depth_m[at] > cutoff_m;
            rendering.opacity[at] < self.settings.hole_opacity || behind
        });
        let room = self.settings.max_surfels.saturating_sub(self.surfels.len());
        let new = seed(frame, &self.poses[view], settings, &grid, &wanted, |x, y| color[(x, y)]);
        for surfel in new.into_iter().take(room) {
            self.surfels.push(surfel);
        }
        self.adam.resize(self.surfels.len());
        self.seen.resize(self.surfels.len(), Seen::default());
    }

    /// Splits and drops by what was seen since the last time.
    fn grow(&mut self) {
        let sources = densify::split(&mut self.surfels, &self.seen, &self.settings);
        self.adam.take_over(&sources);
        self.seen = vec![Seen::default(); self.surfels.len()];
    }
}

/// `0..count` in an order of its own for each round (Fisher-Yates, with numbers by SplitMix64).
fn shuffled(count: u32, seed: u64, round: u32) -> Vec<u32> {
    let mut state = seed ^ (u64::from(round) << 32);
    let mut next = || {
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (state ^ (state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    };
    let mut out: Vec<u32> = (0..count).collect();
    for i in (1..out.len()).rev() {
        out.swap(i, (next() % (i as u64 + 1)) as usize);
    }
    out
}

/// Brings a picture to the rendering's brightness, where that is opaque, by one gain: the ratio of their sums pulled
/// towards 1. A fit of one to the other would shrink it a little, step by step.
fn brighten(picture: &mut Image<[f32; 3]>, rendering: &Rendering, prior: f32) {
    let sum = |image: &Image<[f32; 3]>| -> f64 {
        let pixels = image.pixels().iter().zip(rendering.opacity.pixels());
        pixels
            .filter(|(_, opacity)| **opacity > 0.9)
            .flat_map(|(pixel, _)| pixel)
            .map(|v| f64::from(*v))
            .sum()
    };
    let (wanted, has, prior) = (sum(&rendering.color), sum(picture), f64::from(prior));
    let gain = ((wanted + prior * has) / ((1.0 + prior) * has)).clamp(0.5, 2.0);
    if gain.is_finite() {
        for pixel in picture.pixels_mut() {
            *pixel = pixel.map(|v| (v * gain as f32).min(1.0));
        }
    }
}

fn psnr_db(a: &Image<[f32; 3]>, b: &Image<[f32; 3]>) -> f64 {
    // Parts are summed up in their order.
    let sums: Vec<f64> = (a.pixels().par_chunks(4096), b.pixels().par_chunks(4096))
        .into_par_iter()
        .map(|(a, b)| {
            a.iter().flatten().zip(b.iter().flatten()).map(|(a, b)| f64::from((a - b) * (a - b))).sum()
        })
        .collect();
    let mean = sums.iter().sum::<f64>() / (3 * a.pixels().len()).max(1) as f64;
    (-10.0 * mean.log10()).min(120.0)
}

#[cfg(test)]
mod tests;
