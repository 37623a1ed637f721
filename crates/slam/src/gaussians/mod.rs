//! The same life with 3D Gaussians in place of surfels, to compare with: frames are tracked, submaps grow and are
//! optimised by the same rules and settings, but through EWA splatting.
//!
//! Gaussians begin fitted to the surface, as surfels do, so that the two are all that differs; they neither follow what
//! later frames measure nor are inherited. A lost camera stays where it was until it sees its map again.

mod optimise;

use crate::agent::SlamSettings;
use crate::mapping::growth::new_pixels;
use crate::mapping::optimise::Target;
use crate::mapping::seed::{SeedGrid, seed};
use crate::mapping::submap::corrected_color;
use crate::tracking::align::{Brightness, align};
use crate::tracking::view::TrackingView;
use crate::tracking::{self, Tracked};
use coma_frame::{RgbdFrame, luminance};
use coma_geometry::{Pose, se3};
use coma_raster::GrowthTest;
use coma_raster::ewa::{self, Gaussian, GaussianCloud, GaussianView};
use coma_surfel::Surfel;
pub use optimise::{GaussianAdam, optimise_once};
use serde::{Deserialize, Serialize};

/// What Gaussians need beside the settings of surfels.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GaussianSettings {
    /// Adam's step for centres, metres.
    pub center_rate_m: f32,
    /// Adam's step for orientations, radians.
    pub rotation_rate_rad: f32,
    /// How thick a Gaussian begins, as a share of its smaller width: it is fitted to the surface as surfels are. 1 is
    /// nearly a ball, as those of 3D Gaussian Splatting begin.
    pub thickness: f32,
}

impl Default for GaussianSettings {
    fn default() -> Self {
        // 3D Gaussian Splatting: 1.6e-4 of the scene's extent, and 1e-3 of a quaternion, for thousands of steps; here
        // there are tens.
        GaussianSettings { center_rate_m: 2e-4, rotation_rate_rad: 0.02, thickness: 0.1 }
    }
}

/// A submap of Gaussians.
#[derive(Clone, Debug, Default)]
pub struct GaussianSubmap {
    /// In the submap's frame, which is its first camera.
    pub gaussians: GaussianCloud,
    /// By odometry.
    pub agent_from_submap: Pose,
}

struct Active {
    submap: GaussianSubmap,
    adam: GaussianAdam,
    keyframes: Vec<Target>,
    mapped_frames: u32,
    moving_frames: u32,
    last_counted: Pose,
    next_keyframe: usize,
}

struct Previous {
    view: TrackingView,
    motion: Pose,
}

/// One agent's tracker and mapper, with Gaussians.
pub struct GaussianAgent {
    settings: SlamSettings,
    own: GaussianSettings,
    closed: Vec<GaussianSubmap>,
    active: Option<Active>,
    previous: Option<Previous>,
    agent_from_camera: Pose,
    brightness: Brightness,
}

/// Where a frame was found.
pub struct Located {
    view: TrackingView,
    /// `None` where there is no map yet, or where the frame was not found in it.
    tracked: Option<Tracked>,
}

impl GaussianAgent {
    /// An agent that has seen nothing.
    pub fn new(settings: SlamSettings, own: GaussianSettings) -> Self {
        GaussianAgent {
            settings,
            own,
            closed: Vec::new(),
            active: None,
            previous: None,
            agent_from_camera: Pose::identity(),
            brightness: Brightness::default(),
        }
    }

    /// Where is the camera? Changes nothing.
    pub fn locate(&self, frame: &RgbdFrame) -> Located {
        let view = TrackingView::from_frame(frame, self.settings.tracking.levels());
        let tracked = self.active.as_ref().and_then(|_| self.track(frame, &view));
        Located { view, tracked }
    }

    fn track(&self, frame: &RgbdFrame, view: &TrackingView) -> Option<Tracked> {
        let settings = &self.settings.tracking;
        let guess = match &self.previous {
            Some(previous) => {
                let moved = tracking::frame_to_frame(&previous.view, view, &previous.motion, settings)
                    .map_or(previous.motion, |found| found.reference_from_camera);
                self.agent_from_camera * moved
            }
            None => self.agent_from_camera,
        };
        let camera_from_agent = guess.inverse();
        let at = |submap: &'_ GaussianSubmap| camera_from_agent * submap.agent_from_submap;
        let recent = self.closed.last();
        let views: Vec<GaussianView<'_>> = recent
            .into_iter()
            .chain(self.active.iter().map(|active| &active.submap))
            .map(|submap| GaussianView { gaussians: &submap.gaussians, camera_from_submap: at(submap) })
            .collect();
        let picture = ewa::render(&views, &frame.camera, &self.settings.render, None);
        let mut depth_m = picture.depth_m;
        for (z, opacity) in depth_m.pixels_mut().iter_mut().zip(picture.opacity.pixels()) {
            if !(*opacity > settings.model_opacity) {
                *z = 0.0;
            }
        }
        let intensity = picture.color.map(|c| luminance(*c));
        let model = TrackingView::build(frame.camera, depth_m, intensity, view.noise, view.levels.len());
        let (model, view) = (settings.aligned(&model), settings.aligned(view));
        let found = align(&model, &view, &Pose::identity(), self.brightness, &settings.frame_to_model)?;
        let mut pose = guess * found.reference_from_camera;
        pose.rotation.renormalize();
        tracking::judged(&guess, &pose, &found, picture.hits, settings).ok()
    }

    /// Keeps the frame's pose and grows the map. `None` for a frame that was lost.
    pub fn take(&mut self, frame: &RgbdFrame, located: Located) -> Option<Pose> {
        let Located { view, tracked } = located;
        let before = self.agent_from_camera;
        match tracked {
            Some(tracked) => {
                self.agent_from_camera = tracked.agent_from_camera;
                self.brightness = tracked.brightness;
            }
            None if self.active.is_some() => {
                self.previous = None;
                return None;
            }
            None => {}
        }
        let motion = before.inv_mul(&self.agent_from_camera);
        self.previous = Some(Previous { view, motion });
        let full = |active: &Active| active.moving_frames >= self.settings.mapping.moving_frames;
        if self.active.as_ref().is_some_and(full) {
            self.close();
        }
        let mut active = self.active.take().unwrap_or_else(|| Active::at(self.agent_from_camera));
        active.map(frame, &self.agent_from_camera, self.brightness, &self.settings, &self.own);
        self.active = Some(active);
        Some(self.agent_from_camera)
    }

    fn close(&mut self) {
        let Some(active) = self.active.take() else { return };
        let GaussianSubmap { gaussians, agent_from_submap } = active.submap;
        let least = self.settings.mapping.prune_opacity;
        let gaussians = gaussians.iter().filter(|g| g.opacity >= least).collect();
        self.closed.push(GaussianSubmap { gaussians, agent_from_submap });
    }

    /// Every submap, the last one closed too.
    pub fn finish(mut self) -> Vec<GaussianSubmap> {
        self.close();
        self.closed
    }
}

impl Active {
    fn at(agent_from_submap: Pose) -> Self {
        Active {
            submap: GaussianSubmap { gaussians: GaussianCloud::default(), agent_from_submap },
            adam: GaussianAdam::default(),
            keyframes: Vec::new(),
            mapped_frames: 0,
            moving_frames: 0,
            last_counted: Pose::identity(),
            next_keyframe: 0,
        }
    }

    fn map(
        &mut self,
        frame: &RgbdFrame,
        agent_from_camera: &Pose,
        brightness: Brightness,
        settings: &SlamSettings,
        own: &GaussianSettings,
    ) {
        let mapping = &settings.mapping;
        let submap_from_camera = self.submap.agent_from_submap.inv_mul(agent_from_camera);
        let color = corrected_color(&frame.color, brightness);
        let views = [GaussianView {
            gaussians: &self.submap.gaussians,
            camera_from_submap: submap_from_camera.inverse(),
        }];
        let test = GrowthTest {
            observed_depth_m: &frame.depth_m,
            noise: frame.noise,
            sigma_factor: mapping.growth_sigma,
            relative: mapping.growth_relative,
        };
        let picture = ewa::render(&views, &frame.camera, &settings.render, Some(&test));
        let new = new_pixels(mapping.growth, &picture, &frame.depth_m, mapping.covered_opacity);
        let grid = SeedGrid::of(&frame.camera, &mapping.seed);
        let wanted = grid.pick(&new);
        let seeds = seed(frame, &submap_from_camera, &mapping.seed, &grid, &wanted, |x, y| color[(x, y)]);
        seeds.iter().for_each(|surfel| self.submap.gaussians.push(thick(surfel, own.thickness)));

        let (moved_m, moved_rad) = se3::distance(&self.last_counted, &submap_from_camera);
        if self.mapped_frames > 0 && (moved_m >= mapping.moved_m || moved_rad >= mapping.moved_rad) {
            self.moving_frames += 1;
            self.last_counted = submap_from_camera;
        }
        let due = self.mapped_frames.is_multiple_of(mapping.keyframe_every.max(1));
        self.mapped_frames += 1;
        if due {
            self.keyframes.push(Target {
                camera: frame.camera,
                submap_from_camera,
                color,
                depth_m: frame.depth_m.clone(),
                noise: frame.noise,
            });
            self.optimise(settings, own);
        }
    }

    fn optimise(&mut self, settings: &SlamSettings, own: &GaussianSettings) {
        let count = self.keyframes.len();
        for step in 0..settings.mapping.steps_per_keyframe {
            // Every other step on the newest keyframe, the rest in turn.
            let pick = if step % 2 == 0 { count - 1 } else { self.next_keyframe % count };
            self.next_keyframe += (step % 2) as usize;
            let (target, gaussians) = (&self.keyframes[pick], &mut self.submap.gaussians);
            let optimise = &settings.mapping.optimise;
            optimise_once(gaussians, &mut self.adam, target, &settings.render, optimise, own);
        }
    }
}

/// A Gaussian in a surfel's place, `thickness` times as thick as the surfel is wide where it is narrowest.
pub fn thick(surfel: &Surfel, thickness: f32) -> Gaussian {
    let [along, across] = surfel.scale_m;
    Gaussian {
        center_m: surfel.center_m,
        rotation_wxyz: surfel.rotation_wxyz,
        scale_m: [along, across, thickness * along.min(across)],
        opacity: surfel.opacity,
        color: surfel.color,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_dataset::Sequence;
    use coma_dataset::sequence::rgbd_frame;
    use coma_dataset::world::{World, WorldSettings};

    #[test]
    fn a_walk_through_the_built_in_world_is_tracked_with_gaussians() {
        let world = WorldSettings { agents: 1, frames: 8, width: 320, height: 240, ..Default::default() };
        let film = World::new(world).unwrap().sequence(0).unwrap();
        let mut agent = GaussianAgent::new(SlamSettings::default(), GaussianSettings::default());
        let mut last = Pose::identity();
        for index in 0..film.len() {
            let frame = rgbd_frame(&film, index).unwrap();
            let located = agent.locate(&frame);
            last = agent.take(&frame, located).expect("every frame is found");
        }
        let truth = film.truth(0).unwrap().inv_mul(&film.truth(7).unwrap());
        let (metres, radians) = se3::distance(&last, &truth);
        let (way, _) = se3::distance(&Pose::identity(), &truth);
        assert!(way > 0.05 && metres < 0.35 * way && radians < 0.006, "{metres} m of {way} m, {radians} rad");
        let submaps = agent.finish();
        assert_eq!(submaps.len(), 1);
        assert!(submaps[0].gaussians.len() > 4000);
    }
}
