//! The map as a picture to align with.

use super::TrackingSettings;
use super::view::TrackingView;
use coma_frame::Image;
use coma_geometry::{Intrinsics, Pose};
use coma_raster::{Outputs, RenderSettings, Rendering, SubmapView};
use coma_surfel::SurfelCloud;

/// One submap of a model.
#[derive(Clone, Copy, Debug)]
pub struct Part<'a> {
    /// In the submap's frame.
    pub surfels: &'a SurfelCloud,
    /// As it was measured, one for each; without it that of their colour.
    pub intensity: Option<&'a [f32]>,
    /// Where the submap lies.
    pub agent_from_submap: Pose,
}

impl<'a> Part<'a> {
    /// With the intensity of the surfels' colours.
    pub fn new(surfels: &'a SurfelCloud, agent_from_submap: Pose) -> Self {
        Part { surfels, intensity: None, agent_from_submap }
    }

    /// As a camera sees it.
    pub fn seen(&self, camera_from_agent: &Pose) -> SubmapView<'a> {
        SubmapView {
            surfels: self.surfels,
            camera_from_submap: camera_from_agent * self.agent_from_submap,
            intensity: self.intensity,
        }
    }
}

/// The submaps that are tracked against, in the agent's frame.
pub struct Model<'a> {
    /// In any order.
    pub submaps: Vec<Part<'a>>,
    /// How they are rendered.
    pub render: &'a RenderSettings,
}

/// A rendered model.
pub struct ModelPicture {
    /// To align with.
    pub view: TrackingView,
    /// Blended hits.
    pub hits: u64,
}

impl Model<'_> {
    /// Renders the model at the resolution of `like` for a camera at `agent_from_camera`; `full` is the camera at the
    /// sensor's own resolution.
    pub fn picture(
        &self,
        agent_from_camera: &Pose,
        full: &Intrinsics,
        like: &TrackingView,
        settings: &TrackingSettings,
    ) -> ModelPicture {
        let camera_from_agent = agent_from_camera.inverse();
        let views: Vec<SubmapView> = self.submaps.iter().map(|part| part.seen(&camera_from_agent)).collect();
        let camera = &like.levels[0].camera;
        let render = self.render.resized(camera.fx / full.fx);
        let rendering = coma_raster::render_only(&views, camera, &render, None, Outputs::Tracking);
        let depth_m = trusted_depth(&rendering, settings);
        let intensity = rendering.surface_intensity;
        let view = TrackingView::build(*camera, depth_m, intensity, like.noise, like.levels.len());
        ModelPicture { view, hits: rendering.hits }
    }
}

/// Depth of the front surface; none where the model is not opaque. Expected depth lies nearer than the surfaces that it
/// blends, by a millimetre or two: every submap would inherit that from the one before, and the camera would drift
/// backwards.
fn trusted_depth(rendering: &Rendering, settings: &TrackingSettings) -> Image<f32> {
    let mut out = rendering.surface_depth_m.clone();
    for (z, opacity) in out.pixels_mut().iter_mut().zip(rendering.opacity.pixels()) {
        if !(*opacity > settings.model_opacity) {
            *z = 0.0;
        }
    }
    out
}
