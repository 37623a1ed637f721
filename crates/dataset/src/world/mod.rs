//! The built-in world: furnished rooms and a corridor, ray-traced, with exact poses and depth.
//!
//! Nothing is downloaded: geometry, textures, light and walks are computed from a seed. The same
//! settings give the same bytes.

pub mod light;
pub mod material;
pub mod noise;
pub mod render;
pub mod rooms;
pub mod scene;
pub mod sensor;
pub mod tour;

use crate::{Calibration, ColorBytes, DatasetError, DepthBytes, RawFrame, Sequence};
use coma_frame::DepthNoise;
use coma_geometry::{Distortion, Intrinsics, Pose, StampNs};
use light::LightMap;
use scene::Scene;
pub use sensor::SensorNoise;
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use tour::{MAX_AGENTS, Tour};

/// What to build and how to film it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WorldSettings {
    /// Textures, small things, hand shake, noise.
    pub seed: u64,
    /// Number of agents, 1 to 8. An agent's walk doesn't depend on how many others there are.
    pub agents: usize,
    /// Frames of each agent. Walks are closed, 400 to 700 frames a round, and go on round after round.
    pub frames: usize,
    /// Image width, pixels. The field of view, 63 degrees across, stays the same.
    pub width: u32,
    /// Image height, pixels.
    pub height: u32,
    /// Frames per second, for stamps only.
    pub frames_per_second: f64,
    /// `None` films with an ideal camera.
    pub noise: Option<SensorNoise>,
}

impl Default for WorldSettings {
    fn default() -> Self {
        WorldSettings {
            seed: 1,
            agents: 2,
            frames: 200,
            width: 320,
            height: 240,
            frames_per_second: 30.0,
            noise: None,
        }
    }
}

/// Depth codes per metre of the built-in camera.
const DEPTH_UNITS_PER_METRE: f64 = 5000.0;

/// The rooms, lit and ready to be filmed.
#[derive(Clone, Debug)]
pub struct World {
    settings: WorldSettings,
    camera: Intrinsics,
    stage: Arc<(Scene, LightMap)>,
}

impl World {
    /// Builds and lights the rooms; errors name the setting at fault.
    pub fn new(settings: WorldSettings) -> Result<Self, DatasetError> {
        let refuse = |field: &'static str, value: f64, needed: &'static str| {
            Err(DatasetError::Setting { field, value, needed })
        };
        if !(1..=MAX_AGENTS).contains(&settings.agents) {
            return refuse("agents", settings.agents as f64, "1 to 8");
        }
        if !(1..=1_000_000).contains(&settings.frames) {
            return refuse("frames", settings.frames as f64, "1 to 1000000");
        }
        let fps = settings.frames_per_second;
        if !(0.1..=1000.0).contains(&fps) {
            return refuse("frames_per_second", fps, "0.1 to 1000");
        }
        let (width, height) = (settings.width as f64, settings.height as f64);
        let focal = 0.8125 * width;
        let camera = Intrinsics {
            width: settings.width,
            height: settings.height,
            fx: focal,
            fy: focal,
            cx: (width - 1.0) / 2.0,
            cy: (height - 1.0) / 2.0,
        };
        let camera = match camera.validated() {
            Ok(camera) => camera,
            Err(e) => return refuse(e.field, e.value, e.needed),
        };
        let (objects, sources) = rooms::furnished_rooms(settings.seed);
        let scene = Scene::new(objects);
        let light = LightMap::new(&scene, &sources);
        Ok(World { settings, camera, stage: Arc::new((scene, light)) })
    }

    /// What it was built from.
    pub fn settings(&self) -> &WorldSettings {
        &self.settings
    }

    /// Everything solid.
    pub fn scene(&self) -> &Scene {
        &self.stage.0
    }

    /// The film of one agent; `None` if there is no such agent.
    pub fn sequence(&self, agent: usize) -> Option<WorldSequence> {
        (agent < self.settings.agents).then(|| {
            let fps = self.settings.frames_per_second;
            let noise = match &self.settings.noise {
                Some(noise) => noise.depth,
                // Rounding to codes is all that is wrong with an ideal camera's depth.
                None => DepthNoise { base_m: 1e-4, quadratic_per_m: 0.0 },
            };
            let calibration = Calibration {
                color: self.camera,
                depth: self.camera,
                color_distortion: Distortion::default(),
                depth_distortion: Distortion::default(),
                color_from_depth: Pose::identity(),
                depth_units_per_metre: DEPTH_UNITS_PER_METRE,
                depth_min_m: 0.05,
                depth_max_m: 13.0,
                noise,
                frames_per_second: fps,
            };
            let stamps = (0..self.settings.frames).map(|i| format!("{:.6}", i as f64 / fps)).collect();
            let tour = Tour::new(agent, self.settings.seed);
            WorldSequence { world: self.clone(), agent, tour, calibration, stamps }
        })
    }
}

/// One agent's film: frames are rendered when they are asked for.
#[derive(Clone, Debug)]
pub struct WorldSequence {
    world: World,
    agent: usize,
    tour: Tour,
    calibration: Calibration,
    stamps: Vec<String>,
}

impl Sequence for WorldSequence {
    fn calibration(&self) -> &Calibration {
        &self.calibration
    }

    fn len(&self) -> usize {
        self.stamps.len()
    }

    fn stamp_text(&self, index: usize) -> &str {
        &self.stamps[index]
    }

    fn stamp(&self, index: usize) -> StampNs {
        coma_geometry::tum::stamp(&self.stamps[index]).expect("stamps are written by World::sequence")
    }

    fn frame(&self, index: usize) -> Result<RawFrame, DatasetError> {
        if index >= self.len() {
            return Err(DatasetError::NoSuchFrame { index, len: self.len() });
        }
        let (scene, light) = &*self.world.stage;
        let picture =
            render::render(scene, light, &self.calibration.color, &self.tour.world_from_camera(index));
        let seed = noise::hash(self.world.settings.seed as u32, 1000 + self.agent as u32);
        let (color, depth) = sensor::expose(
            &picture,
            self.world.settings.noise.as_ref(),
            index,
            seed,
            DEPTH_UNITS_PER_METRE as f32,
        );
        Ok(RawFrame { color: ColorBytes::Rgb8(color), depth: DepthBytes::Raw16(depth) })
    }

    fn truth(&self, index: usize) -> Option<Pose> {
        (index < self.len()).then(|| self.tour.world_from_camera(index))
    }
}
