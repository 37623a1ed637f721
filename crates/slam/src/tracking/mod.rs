//! Where is the camera? A guess at constant velocity, then frame-to-frame, then frame-to-model.

pub mod adam;
pub mod align;
pub mod model;
mod rows;
pub mod view;

use adam::AdamSettings;
use align::{AlignSettings, Alignment, Brightness, align};
use coma_frame::RgbdFrame;
use coma_geometry::{Matrix6, Pose, se3};
use serde::{Deserialize, Serialize};
use view::TrackingView;

/// How a frame is brought from its guess to the map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// Gauss-Newton on depth and brightness of one rendering.
    #[default]
    GaussNewton,
    /// Adam through the rasteriser: the paper's eq. 4.
    Adam,
}

/// How the camera is tracked.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrackingSettings {
    /// Pictures are aligned at this resolution: 0 is the frame's own, 1 half of it, and coarser ones before. Half is as
    /// exact as the whole, as depth and colour of four pixels are averaged, at a quarter of the cost.
    pub finest_level: usize,
    /// Small pictures are aligned at a finer resolution than `finest_level`, down to their own, if fewer pixels than this
    /// would be left: what lies near edges is not aligned, and in a picture of few pixels that is most of it.
    pub least_pixels: usize,
    /// Frame against the frame before.
    pub frame_to_frame: AlignSettings,
    /// How a frame is brought from its guess to the map: `gauss-newton` or `adam`.
    pub method: Method,
    /// Frame against the rendered submaps, by Gauss-Newton.
    pub frame_to_model: AlignSettings,
    /// Frame against the rendered submaps, by Adam.
    pub adam: AdamSettings,
    /// Renders and alignments against the model per frame.
    pub model_rounds: u32,
    /// Closed submaps that stay in the model beside the one under work: the last ones of the chain, at least 1. A camera
    /// that comes back to what they show is tracked against it, where new surfels would hold the drift of a round.
    pub closed_submaps: usize,
    /// Memory for closed submaps that stay in the model, megabytes (1e6 bytes). Beyond it the oldest go, whatever
    /// `closed_submaps` allows, but never the last one. What went is in the agent's store, packed.
    pub resident_budget_mb: f64,
    /// The model is trusted where it is more opaque than this (eq. 4).
    pub model_opacity: f32,
    /// Below this share of fitting pixels the frame is mapped at once.
    pub map_at_once_share: f64,
    /// Below this share tracking is degraded.
    pub degraded_share: f64,
    /// With a larger standard deviation in some direction, metres, tracking is degraded: what is seen leaves it open.
    pub degraded_sigma_m: f64,
    /// Below this share the camera is lost.
    pub lost_share: f64,
    /// Of what the map and the frame both show, at least this share fits, or the pose is a false one and the camera is
    /// lost. Right poses reach 0.9 and more on real sensors.
    pub lost_agreement: f64,
    /// A lost camera is found again in its last submap if at least this share of its pixels fit.
    pub relocate_share: f64,
    /// A frame with less depth than this share of its pixels can't be tracked.
    pub min_depth_share: f32,
    /// A camera can't go farther between two frames, metres.
    pub max_step_m: f64,
    /// A camera can't turn farther between two frames, radians.
    pub max_step_rad: f64,
    /// Smallest standard deviation that a pose is given, metres.
    pub floor_m: f64,
    /// Smallest standard deviation that a pose is given, radians.
    pub floor_rad: f64,
}

impl TrackingSettings {
    /// Resolutions that a frame's view needs.
    pub fn levels(&self) -> usize {
        self.finest_level + self.frame_to_frame.steps.len().max(self.frame_to_model.steps.len())
    }

    /// The resolutions of `view` that are aligned.
    pub(crate) fn aligned(&self, view: &TrackingView) -> TrackingView {
        let enough =
            |level: &usize| view.levels.get(*level).is_some_and(|l| l.camera.pixels() >= self.least_pixels);
        view.coarser((1..=self.finest_level).rev().find(enough).unwrap_or(0))
    }
}

impl Tracked {
    /// Standard deviation of the position in its weakest direction, metres.
    pub fn sigma_m(&self) -> f64 {
        self.covariance.fixed_view::<3, 3>(0, 0).into_owned().symmetric_eigenvalues().max().max(0.0).sqrt()
    }
}

impl Default for TrackingSettings {
    fn default() -> Self {
        TrackingSettings {
            finest_level: 1,
            least_pixels: 4_000,
            frame_to_frame: AlignSettings::default(),
            method: Method::default(),
            adam: AdamSettings::default(),
            frame_to_model: AlignSettings {
                steps: vec![4, 8],
                settled: 2e-5,
                max_distance_m: 0.04,
                prior_m: 0.02,
                prior_rad: 0.02,
                ..AlignSettings::default()
            },
            model_rounds: 1,
            closed_submaps: 8,
            resident_budget_mb: 256.0,
            model_opacity: 0.9,
            map_at_once_share: 0.4,
            degraded_share: 0.25,
            degraded_sigma_m: 0.05,
            lost_share: 0.1,
            lost_agreement: 0.5,
            relocate_share: 0.5,
            min_depth_share: 0.05,
            max_step_m: 0.5,
            max_step_rad: 0.6,
            floor_m: 0.0001,
            floor_rad: 0.005f64.to_radians(),
        }
    }
}

/// How well the camera is known.
#[derive(Clone, Debug, PartialEq)]
pub enum State {
    /// As it should be.
    Tracking,
    /// The pose is a guess, or rests on little.
    Degraded(Vec<Reason>),
    /// No pose.
    Lost(Vec<Reason>),
}

/// Why tracking is not as it should be.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Reason {
    /// Too little depth.
    #[error("only {share:.1} % of the pixels have depth, {needed:.1} % are needed")]
    LittleDepth {
        /// Percent.
        share: f32,
        /// Percent.
        needed: f32,
    },
    /// The frame could not be aligned at all.
    #[error("the frame could not be aligned with {with}")]
    NotAligned {
        /// `the frame before` or `the map`.
        with: &'static str,
    },
    /// Few pixels fit the map.
    #[error("only {share:.1} % of the pixels fit the map, {needed:.1} % are needed")]
    FewFit {
        /// Percent.
        share: f64,
        /// Percent.
        needed: f64,
    },
    /// The frame shows other things than the map where it should show the same.
    #[error("only {share:.1} % of what should be seen again fits the map, {needed:.1} % are needed")]
    Contradicts {
        /// Percent.
        share: f64,
        /// Percent.
        needed: f64,
    },
    /// What is seen leaves a direction open.
    #[error("what is seen fixes the position to {metres:.3} m only, {needed:.3} m are needed")]
    Uncertain {
        /// Metres, one standard deviation in the weakest direction.
        metres: f64,
        /// Metres.
        needed: f64,
    },
    /// The camera would have moved too far at once.
    #[error("the camera would have moved {metres:.2} m and {degrees:.1} degrees in one frame")]
    Jump {
        /// Metres.
        metres: f64,
        /// Degrees.
        degrees: f64,
    },
}

/// What tracking made of a frame.
#[derive(Clone, Debug)]
pub struct Tracked {
    /// In the frame of reference of the model that was given.
    pub agent_from_camera: Pose,
    /// Takes the frame's brightness to the model's.
    pub brightness: Brightness,
    /// Perturbed on the right (camera frame).
    pub covariance: Matrix6,
    /// Share of the pixels with depth that fit the model.
    pub share: f64,
    /// Of what the frame and the model both show, the share that fits.
    pub agreement: f64,
    /// How far the frame's depth lies from the map's, in standard deviations of the sensor's noise.
    pub noise_ratio: f64,
    /// Little of the frame is in the map yet.
    pub map_at_once: bool,
    /// Blended hits of the model's renderings.
    pub hits: u64,
}

/// Frame to frame: the motion since the frame before, started from the last motion; and as a second start
/// from rest, where that fits better or the first failed.
pub fn frame_to_frame(
    previous: &TrackingView,
    view: &TrackingView,
    last_motion: &Pose,
    settings: &TrackingSettings,
) -> Option<Alignment> {
    let (previous, view) = (&settings.aligned(previous), &settings.aligned(view));
    let with_velocity = align(previous, view, last_motion, Brightness::default(), &settings.frame_to_frame);
    match with_velocity {
        Some(found) if found.inlier_share() > settings.map_at_once_share => Some(found),
        first => {
            let from_rest =
                align(previous, view, &Pose::identity(), Brightness::default(), &settings.frame_to_frame);
            [first, from_rest].into_iter().flatten().max_by(|a, b| a.inliers.cmp(&b.inliers))
        }
    }
}

/// Frame to model, by the method of the settings.
pub fn against_model(
    model: &model::Model<'_>,
    frame: &RgbdFrame,
    view: &TrackingView,
    guess_agent_from_camera: &Pose,
    brightness: Brightness,
    settings: &TrackingSettings,
) -> Result<Tracked, Vec<Reason>> {
    match settings.method {
        Method::GaussNewton => frame_to_model(model, view, guess_agent_from_camera, brightness, settings),
        Method::Adam => {
            adam::frame_to_model(model, frame, view, guess_agent_from_camera, brightness, settings)
        }
    }
}

/// Frame to model: renders `model` at the guess and aligns the frame with the picture.
pub fn frame_to_model(
    model: &model::Model<'_>,
    view: &TrackingView,
    guess_agent_from_camera: &Pose,
    brightness: Brightness,
    settings: &TrackingSettings,
) -> Result<Tracked, Vec<Reason>> {
    let full = view.levels[0].camera;
    let view = &settings.aligned(view);
    let mut pose = *guess_agent_from_camera;
    let mut brightness = brightness;
    let mut hits = 0;
    let mut last = None;
    for _ in 0..settings.model_rounds.max(1) {
        let picture = model.picture(&pose, &full, view, settings);
        hits += picture.hits;
        let Some(found) = align(&picture.view, view, &Pose::identity(), brightness, &settings.frame_to_model)
        else {
            return Err(vec![Reason::NotAligned { with: "the map" }]);
        };
        pose *= found.reference_from_camera;
        pose.rotation.renormalize();
        brightness = found.brightness;
        last = Some(found);
    }
    let Some(found) = last else { return Err(vec![Reason::NotAligned { with: "the map" }]) };
    judged(guess_agent_from_camera, &pose, &found, hits, settings)
}

/// A pose with its certainty, or why it is none: it went too far from its guess, or fits too little.
pub(crate) fn judged(
    guess_agent_from_camera: &Pose,
    pose: &Pose,
    found: &Alignment,
    hits: u64,
    settings: &TrackingSettings,
) -> Result<Tracked, Vec<Reason>> {
    let (metres, radians) = se3::distance(guess_agent_from_camera, pose);
    if !(metres <= settings.max_step_m && radians <= settings.max_step_rad) {
        return Err(vec![Reason::Jump { metres, degrees: radians.to_degrees() }]);
    }
    let share = found.inlier_share();
    if !(share >= settings.lost_share) {
        return Err(vec![Reason::FewFit { share: share * 100.0, needed: settings.lost_share * 100.0 }]);
    }
    let agreement = found.agreement();
    if !(agreement >= settings.lost_agreement) {
        let needed = settings.lost_agreement * 100.0;
        return Err(vec![Reason::Contradicts { share: agreement * 100.0, needed }]);
    }
    Ok(Tracked {
        agent_from_camera: *pose,
        brightness: found.brightness,
        covariance: found.covariance(settings.floor_m, settings.floor_rad),
        share,
        agreement,
        noise_ratio: found.geometric_scale,
        map_at_once: share < settings.map_at_once_share,
        hits,
    })
}
