//! What one side of a registration knows, and its copy at working size.

use crate::cloud::PointCloud;
use crate::outcome::{Reason, Side};
use crate::settings::Settings;
use coma_frame::{DepthNoise, Image, RgbdFrame, pyramid};
use coma_geometry::{Intrinsics, camera::MAX_IMAGE_SIDE};

/// One RGB-D view: the evidence that agents exchange about an anchor.
#[derive(Clone, Debug)]
pub struct View {
    /// Metres along z, `[height, width]` of `camera`; 0 (or anything not finite and positive) = no measurement.
    pub depth_m: Image<f32>,
    /// Luminance 0..1 of the same field of view; any size.
    pub intensity: Image<f32>,
    /// The camera of `depth_m`.
    pub camera: Intrinsics,
    /// How wrong the depth is.
    pub noise: DepthNoise,
}

impl View {
    /// The view of a frame, in full resolution.
    pub fn from_frame(frame: &RgbdFrame) -> Self {
        View {
            depth_m: frame.depth_m.clone(),
            intensity: frame.color.luminance(),
            camera: frame.camera,
            noise: frame.noise,
        }
    }
}

/// A view at working size with its clouds. Prepare an anchor once, register it often.
#[derive(Clone, Debug)]
pub struct Prepared {
    /// Depth at working size; 0 = none.
    pub depth_m: Image<f32>,
    /// Intensity at the same size.
    pub intensity: Image<f32>,
    /// The camera of both.
    pub camera: Intrinsics,
    /// How wrong the depth is.
    pub noise: DepthNoise,
    /// One cloud per scale of the settings, coarse to fine.
    pub clouds: Vec<PointCloud>,
    /// One feature per point of `clouds[0]`.
    pub features: Vec<crate::fpfh::Feature>,
    /// Detail of `intensity`.
    pub(crate) detail: Image<f32>,
    /// Points of `depth_m` on a grid, for scoring and verification: pixel x, y and depth.
    pub(crate) grid: Vec<(u16, u16, f32)>,
}

/// Columns of the grid of points that scores and verification look at.
const GRID_COLUMNS: usize = 80;

impl Prepared {
    /// Reduces, back-projects, downsamples and describes a view. `side` is named by the reasons.
    pub fn new(view: &View, settings: &Settings, side: Side) -> Result<Self, Reason> {
        let (depth_m, intensity, camera) = reduce(view, settings, side)?;
        let base = PointCloud::from_images(&depth_m, &intensity, &camera, settings.depth_jump);
        let needed = settings.min_correspondences;
        if base.len() < needed {
            return Err(Reason::TooFewPoints { side, found: base.len(), needed });
        }
        // Fine to coarse, each from the one before.
        let mut clouds: Vec<PointCloud> = Vec::new();
        for scale in settings.scales.iter().rev() {
            let mut cloud = clouds.last().unwrap_or(&base).voxel_downsample(scale.voxel_m);
            cloud.estimate_surfaces(2.0 * scale.voxel_m, 30);
            clouds.push(cloud);
        }
        clouds.reverse();
        let Some(coarsest) = clouds.first() else {
            return Err(Reason::InvalidView { side, detail: "the settings name no scale".into() });
        };
        if coarsest.len() < settings.min_matches.max(4) {
            return Err(Reason::TooFewPoints {
                side,
                found: coarsest.len(),
                needed: settings.min_matches.max(4),
            });
        }
        let radius_m = settings.feature_radius_voxels * settings.scales[0].voxel_m;
        let features = crate::fpfh::features(coarsest, radius_m, settings.feature_neighbours);
        let step = (depth_m.width() / GRID_COLUMNS).max(1);
        let mut grid = Vec::new();
        for y in (step / 2..depth_m.height()).step_by(step) {
            for x in (step / 2..depth_m.width()).step_by(step) {
                let z = depth_m[(x, y)];
                if z > 0.0 {
                    grid.push((x as u16, y as u16, z));
                }
            }
        }
        let detail = crate::detail::detail(&intensity);
        Ok(Prepared { depth_m, intensity, camera, noise: view.noise, clouds, features, detail, grid })
    }
}

/// Checks a view and halves it until it has the working width.
fn reduce(
    view: &View,
    settings: &Settings,
    side: Side,
) -> Result<(Image<f32>, Image<f32>, Intrinsics), Reason> {
    let invalid = |detail: String| Reason::InvalidView { side, detail };
    let mut camera = view.camera.validated().map_err(|e| invalid(e.to_string()))?;
    let (width, height) = (view.depth_m.width(), view.depth_m.height());
    if width != camera.width as usize || height != camera.height as usize {
        let (cw, ch) = (camera.width, camera.height);
        return Err(invalid(format!("depth is {width}x{height}, but the camera is {cw}x{ch}")));
    }
    let (iw, ih) = (view.intensity.width(), view.intensity.height());
    let limit = 1..=MAX_IMAGE_SIDE as usize;
    if !limit.contains(&iw) || !limit.contains(&ih) {
        return Err(invalid(format!("intensity is {iw}x{ih}")));
    }
    let sigma = (view.noise.base_m, view.noise.quadratic_per_m);
    if !(sigma.0 >= 0.0 && sigma.0 < 1.0 && sigma.1 >= 0.0 && sigma.1 < 1.0) {
        return Err(invalid(format!("depth noise is {} m + {} per m", sigma.0, sigma.1)));
    }
    let mut depth_m = view.depth_m.map(|z| if *z > 0.0 && *z <= settings.max_depth_m { *z } else { 0.0 });
    let mut intensity = view.intensity.map(|v| if v.is_finite() { v.clamp(0.0, 1.0) } else { 0.0 });
    while depth_m.width() > settings.working_width.max(16) && depth_m.height() >= 16 {
        if intensity.width() >= depth_m.width() && intensity.height() >= 2 {
            intensity = pyramid::halve(&intensity);
        }
        depth_m = pyramid::halve_depth(&depth_m, settings.depth_jump);
        camera = camera.halved();
    }
    if intensity.width() != depth_m.width() || intensity.height() != depth_m.height() {
        intensity = resample(&intensity, depth_m.width(), depth_m.height());
    }
    Ok((depth_m, intensity, camera))
}

/// The image at another size, bilinear; both cover the same field of view.
fn resample(image: &Image<f32>, width: usize, height: usize) -> Image<f32> {
    let (sx, sy) = (image.width() as f32 / width as f32, image.height() as f32 / height as f32);
    Image::from_fn(width, height, |x, y| {
        bilinear(image, (x as f32 + 0.5) * sx - 0.5, (y as f32 + 0.5) * sy - 0.5)
    })
}

/// The image at `(u, v)`, clamped to its border.
pub(crate) fn bilinear(image: &Image<f32>, u: f32, v: f32) -> f32 {
    let u = u.clamp(0.0, (image.width() - 1) as f32);
    let v = v.clamp(0.0, (image.height() - 1) as f32);
    let (x, y) = (u as usize, v as usize);
    let (x1, y1) = ((x + 1).min(image.width() - 1), (y + 1).min(image.height() - 1));
    let (a, b) = (u - x as f32, v - y as f32);
    let top = image[(x, y)] * (1.0 - a) + image[(x1, y)] * a;
    let bottom = image[(x, y1)] * (1.0 - a) + image[(x1, y1)] * a;
    top * (1.0 - b) + bottom * b
}
