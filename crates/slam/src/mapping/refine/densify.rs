//! Where does a map need more surfels, and which can go? Surfels whose pixels err are split down to the pixels' size.

use super::RefineSettings;
use crate::mapping::optimise::Target;
use coma_frame::Image;
use coma_geometry::{Intrinsics, Pose};
use coma_raster::{PixelGradients, Rendering, SurfelGradients};
use coma_surfel::{Surfel, SurfelCloud};
use nalgebra::{Point3, Vector3};

/// What views said of a surfel since the map last grew: sums over its pixels, weighted as they were blended.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Seen {
    /// Of weights.
    pub weight: f32,
    /// Of errors of colour.
    pub color: f32,
    /// Of errors of depth, metres.
    pub depth_m: f32,
    /// Largest standard deviations on the screen, pixels.
    pub px: [f32; 2],
}

/// Each pixel's errors in place of derivatives by its colour. A surfel's derivative by its own colour is the sum of its
/// pixels' by the weights of the blend, so that [`coma_raster::backward`] makes of them each surfel's share of the errors.
pub(super) fn errors(rendering: &Rendering, target: &Target, cutoff_m: f32) -> PixelGradients {
    let (width, height) = (target.color.width(), target.color.height());
    let color = Image::from_fn(width, height, |x, y| {
        let (c, t) = (rendering.color[(x, y)], target.color[(x, y)]);
        let color = (0..3).map(|k| (c[k] - t[k]).abs()).sum::<f32>() / 3.0;
        let (found, wanted) = (rendering.depth_m[(x, y)], target.depth_m[(x, y)]);
        let depth = if wanted > 0.0 && found > 0.0 { (found - wanted).abs() } else { 0.0 };
        [color, 1.0, depth.min(cutoff_m)]
    });
    let none = || Image::filled(width, height, 0.0f32);
    PixelGradients { color, depth_m: none(), opacity: none() }
}

/// Adds what [`errors`] became to what was seen of each surfel.
pub(super) fn note(
    seen: &mut [Seen],
    surfels: &SurfelCloud,
    errors: &SurfelGradients,
    camera_from_map: &Pose,
    camera: &Intrinsics,
) {
    let rotation = camera_from_map.rotation.to_rotation_matrix().matrix().cast::<f32>();
    let f = (0.5 * (camera.fx + camera.fy)) as f32;
    for (i, (seen, [color, weight, depth_m])) in seen.iter_mut().zip(&errors.color).enumerate() {
        if !(*weight > 0.0) {
            continue;
        }
        seen.weight += weight;
        seen.color += color;
        seen.depth_m += depth_m;
        let surfel = surfels.get(i);
        let p = (camera_from_map * Point3::from(surfel.center_m).cast::<f64>()).cast::<f32>();
        if !(p.z > 0.05) {
            continue;
        }
        let axes = rotation * surfel.rotation();
        for k in 0..2 {
            // How far the tip of an axis lies from the centre on the screen.
            let e: Vector3<f32> = axes.column(k).into();
            let across = Vector3::new(e.x - e.z * p.x / p.z, e.y - e.z * p.y / p.z, 0.0).norm();
            seen.px[k] = seen.px[k].max(f / p.z * across * surfel.scale_m[k]);
        }
    }
}

/// Neighbours of a grid are 1 / 0.8 standard deviations apart, so a half's centre lies a quarter of that off.
const HALF_OFFSET: f32 = 0.25 / 0.8;

/// Splits and drops; returns which surfel each was before, `None` where it is new. The order is kept.
pub(super) fn split(surfels: &mut SurfelCloud, seen: &[Seen], settings: &RefineSettings) -> Vec<Option<u32>> {
    let chosen = chosen(surfels, seen, settings);
    let mut out = SurfelCloud::default();
    let mut sources = Vec::with_capacity(surfels.len());
    for (i, (surfel, halved)) in surfels.iter().zip(chosen).enumerate() {
        if !(surfel.opacity >= settings.prune_opacity) {
            continue;
        }
        if halved == [false, false] {
            out.push(surfel);
            sources.push(Some(i as u32));
            continue;
        }
        let parts = parts(&surfel, halved);
        sources.extend(parts.iter().map(|_| None));
        parts.into_iter().for_each(|part| out.push(part));
    }
    *surfels = out;
    sources
}

/// Along which axes each surfel is halved: those whose pixels err, with the largest sums of errors first, as far as
/// there is room.
fn chosen(surfels: &SurfelCloud, seen: &[Seen], settings: &RefineSettings) -> Vec<[bool; 2]> {
    // Both kinds of error in units of what is let pass.
    let error = |s: &Seen| (s.color / settings.split_color).max(s.depth_m / settings.split_depth_m);
    let halved = |s: &Seen| s.px.map(|px| error(s) > s.weight && px > settings.split_px);
    let mut asking: Vec<(f32, usize)> = seen
        .iter()
        .enumerate()
        .filter(|(_, s)| halved(s) != [false; 2])
        .map(|(i, s)| (error(s), i))
        .collect();
    asking.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    let most = (settings.split_share * surfels.len() as f32).ceil() as usize;
    // One becomes four at most.
    let room = settings.max_surfels.saturating_sub(surfels.len()) / 3;
    let mut out = vec![[false; 2]; surfels.len()];
    for (_, i) in asking.into_iter().take(most.min(room)) {
        out[i] = halved(&seen[i]);
    }
    out
}

/// Two or four surfels in place of one, halved along the axes that are marked.
fn parts(surfel: &Surfel, halved: [bool; 2]) -> Vec<Surfel> {
    let axes = surfel.rotation();
    let signs = |k: usize| if halved[k] { &[-1.0f32, 1.0][..] } else { &[0.0][..] };
    let mut scale_m = surfel.scale_m;
    for k in 0..2 {
        if halved[k] {
            scale_m[k] *= 0.5;
        }
    }
    let mut out = Vec::new();
    for u in signs(0) {
        for v in signs(1) {
            let [s, t] = surfel.scale_m.map(|s| s * HALF_OFFSET);
            let off = axes.column(0) * (u * s) + axes.column(1) * (v * t);
            let center = Vector3::from(surfel.center_m) + off;
            out.push(Surfel { center_m: center.into(), scale_m, ..*surfel });
        }
    }
    out
}
