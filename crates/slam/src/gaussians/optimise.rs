//! Eq. 9 on Gaussians: the losses and Adam are those of surfels, with a third scale.

use super::GaussianSettings;
use crate::mapping::optimise::{Loss, OptimiseSettings, Rendered, Target, loss, moments};
use coma_raster::RenderSettings;
use coma_raster::ewa::{self, GaussianCloud, GaussianGradients, GaussianView, Picture};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

/// Parameters of one Gaussian as Adam sees them: centre 3, rotation 3, log-scale 3, logit-opacity 1, colour 3.
const PARAMETERS: usize = 13;

/// Adam's moments, one row per Gaussian.
#[derive(Clone, Debug, Default)]
pub struct GaussianAdam {
    first: Vec<[f32; PARAMETERS]>,
    second: Vec<[f32; PARAMETERS]>,
    steps: Vec<u32>,
}

impl GaussianAdam {
    fn step(
        &mut self,
        gaussians: &mut GaussianCloud,
        gradients: &GaussianGradients,
        settings: &OptimiseSettings,
        own: &GaussianSettings,
    ) {
        let count = gaussians.len();
        self.first.resize(count, [0.0; PARAMETERS]);
        self.second.resize(count, [0.0; PARAMETERS]);
        self.steps.resize(count, 0);
        let rates: [f32; PARAMETERS] = std::array::from_fn(|k| match k {
            0..3 => own.center_rate_m,
            3..6 => own.rotation_rate_rad,
            6..9 => settings.log_scale_rate,
            9 => settings.logit_opacity_rate,
            _ => settings.color_rate,
        });
        for i in 0..count {
            let Some(g) = gradient(gaussians, gradients, i) else { continue };
            self.steps[i] = self.steps[i].saturating_add(1);
            let change = moments(&mut self.first[i], &mut self.second[i], &g, self.steps[i], &rates);
            apply(gaussians, i, &change);
        }
    }
}

/// By the parameters as Adam sees them; `None` without any, or where it is not finite.
fn gradient(gaussians: &GaussianCloud, gradients: &GaussianGradients, i: usize) -> Option<[f32; PARAMETERS]> {
    let (scale, opacity) = (gaussians.scale_m[i], gaussians.opacity[i]);
    let g: [f32; PARAMETERS] = std::array::from_fn(|k| match k {
        0..3 => gradients.center_m[i][k],
        3..6 => gradients.rotation[i][k - 3],
        // By the chain rule: d/d log s = s d/ds, d/d logit o = o (1 - o) d/do.
        6..9 => gradients.scale_m[i][k - 6] * scale[k - 6],
        9 => gradients.opacity[i] * opacity * (1.0 - opacity),
        _ => gradients.color[i][k - 10],
    });
    (g.iter().any(|v| *v != 0.0) && g.iter().all(|v| v.is_finite())).then_some(g)
}

fn apply(gaussians: &mut GaussianCloud, i: usize, change: &[f32; PARAMETERS]) {
    for k in 0..3 {
        gaussians.center_m[i][k] += change[k];
        let scale = &mut gaussians.scale_m[i][k];
        *scale = (*scale * change[6 + k].exp()).clamp(1e-4, 0.5);
        let color = &mut gaussians.color[i][k];
        *color = (*color + change[10 + k]).clamp(0.0, 1.0);
    }
    let [w, x, y, z] = gaussians.rotation_wxyz[i];
    let turned = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z))
        * UnitQuaternion::from_scaled_axis(Vector3::new(change[3], change[4], change[5]));
    gaussians.rotation_wxyz[i] = [turned.w, turned.i, turned.j, turned.k];
    let o = gaussians.opacity[i].clamp(1e-4, 0.9999);
    let logit = (o / (1.0 - o)).ln() + change[9];
    gaussians.opacity[i] = (1.0 / (1.0 + (-logit).exp())).clamp(1e-4, 0.9999);
}

impl<'a> From<&'a Picture> for Rendered<'a> {
    fn from(p: &'a Picture) -> Self {
        Rendered { color: &p.color, depth_m: &p.depth_m, opacity: &p.opacity }
    }
}

/// One optimiser step on one keyframe.
pub fn optimise_once(
    gaussians: &mut GaussianCloud,
    adam: &mut GaussianAdam,
    target: &Target,
    render_settings: &RenderSettings,
    settings: &OptimiseSettings,
    own: &GaussianSettings,
) -> Loss {
    let camera_from_submap = target.submap_from_camera.inverse();
    let views = [GaussianView { gaussians, camera_from_submap }];
    let picture = ewa::render(&views, &target.camera, render_settings, None);
    let (loss, pixels) = loss(&picture, target, settings);
    let gradients = ewa::backward(&views, &target.camera, render_settings, &picture, &pixels);
    adam.step(gaussians, &gradients, settings, own);
    loss
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_frame::{DepthNoise, Image};
    use coma_geometry::{Intrinsics, Pose};
    use coma_raster::ewa::Gaussian;

    #[test]
    fn steps_bring_a_wall_of_balls_nearer_to_its_picture() {
        let camera = Intrinsics { width: 40, height: 30, fx: 36.0, fy: 36.0, cx: 19.5, cy: 14.5 };
        let ball = |i: usize| Gaussian {
            center_m: [-1.1 + 0.1 * (i % 23) as f32, -0.85 + 0.1 * (i / 23) as f32, 2.0],
            rotation_wxyz: [1.0, 0.0, 0.0, 0.0],
            scale_m: [0.06; 3],
            opacity: 0.9,
            color: [0.5; 3],
        };
        let mut gaussians: GaussianCloud = (0..23 * 18).map(ball).collect();
        let wave = |x: usize, y: usize| 0.5 + 0.3 * (0.4 * x as f32 + 0.2 * y as f32).sin();
        let target = Target {
            camera,
            submap_from_camera: Pose::identity(),
            color: Image::from_fn(40, 30, |x, y| [wave(x, y), 0.4, wave(y, x)]),
            depth_m: Image::filled(40, 30, 2.01),
            noise: DepthNoise { base_m: 0.001, quadratic_per_m: 0.0 },
        };
        let (mut adam, own) = (GaussianAdam::default(), GaussianSettings::default());
        let (render, settings) = (RenderSettings::default(), OptimiseSettings::default());
        let mut step = || optimise_once(&mut gaussians, &mut adam, &target, &render, &settings, &own);
        let first = step();
        let last = (0..60).map(|_| step()).last().unwrap();
        assert!(last.color_l1 < 0.3 * first.color_l1, "{first:?} {last:?}");
        assert!(last.depth_l1_m < 0.7 * first.depth_l1_m && last.ssim > first.ssim, "{first:?} {last:?}");
    }
}
