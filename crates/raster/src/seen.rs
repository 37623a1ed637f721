//! What of a large map a camera may see: less to render, and less memory for it.

use crate::RenderSettings;
use coma_geometry::{Intrinsics, Pose};
use coma_surfel::SurfelCloud;
use nalgebra::{Point3, Vector3};

/// The surfels that may be in the picture, in their order; it is the same with and without the others.
pub fn seen(
    surfels: &SurfelCloud,
    camera_from_submap: &Pose,
    camera: &Intrinsics,
    settings: &RenderSettings,
) -> SurfelCloud {
    // Standard deviations within which a disc has any weight.
    let sigmas = (2.0 * (1.0 / f64::from(settings.alpha_min)).ln()).max(0.0).sqrt();
    let margin_px = sigmas * f64::from(settings.low_pass_px) + 1.0;
    let sides = sides(camera, margin_px);
    let in_picture = |index: &usize| {
        let [x, y, z] = surfels.center_m[*index].map(f64::from);
        let center = camera_from_submap * Point3::new(x, y, z);
        let [a, b] = surfels.scale_m[*index].map(f64::from);
        // Rounding of single precision, in which surfels are projected, moves a disc by less than this.
        let radius_m = sigmas * a.max(b) * 1.01 + 1e-4 * (1.0 + center.coords.norm());
        sides.iter().all(|side| side.dot(&center.coords) >= -radius_m)
    };
    let indices: Vec<usize> = (0..surfels.len()).filter(in_picture).collect();
    let mut out = SurfelCloud::with_capacity(indices.len());
    indices.into_iter().for_each(|index| out.push(surfels.get(index)));
    out
}

/// Planes through the camera's centre that hold the picture and a margin, by their unit normals, which point inwards;
/// and the picture's own plane.
fn sides(camera: &Intrinsics, margin_px: f64) -> [Vector3<f64>; 5] {
    let Intrinsics { fx, fy, cx, cy, width, height } = *camera;
    let (right, below) = (f64::from(width) - cx + margin_px, f64::from(height) - cy + margin_px);
    [
        Vector3::new(fx, 0.0, cx + margin_px).normalize(),
        Vector3::new(-fx, 0.0, right).normalize(),
        Vector3::new(0.0, fy, cy + margin_px).normalize(),
        Vector3::new(0.0, -fy, below).normalize(),
        Vector3::z(),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{SubmapView, render, scene};
    use coma_geometry::{Tangent, se3};

    #[test]
    fn the_picture_is_the_same_without_what_is_not_seen() {
        let camera = scene::camera(64, 48);
        let settings = RenderSettings::default();
        // Surfels from 5 cm to 4 m away, large and small, in front of cameras that look in all directions.
        let mut map = SurfelCloud::default();
        let turned = |k: u64| {
            se3::exp(&Tangent::new(0.1 * k as f64, 0.0, -0.05 * k as f64, 0.3 * k as f64, k as f64, 0.5))
        };
        for k in 0..6 {
            for (hits, scale) in [(4.0, 1.0), (0.5, 1.0), (2.0, 0.05)] {
                let mut part = scene::scattered(&camera, 150, hits, k);
                part.center_m.iter_mut().flatten().for_each(|v| *v *= scale);
                part.scale_m.iter_mut().flatten().for_each(|v| *v *= scale);
                part.iter().for_each(|surfel| map.push(surfel.moved(&turned(k))));
            }
        }
        for k in 0..6 {
            let camera_from_map = turned(k).inverse() * Pose::translation(0.2, 0.0, 0.0);
            let part = seen(&map, &camera_from_map, &camera, &settings);
            assert!(part.len() < map.len() * 2 / 3 && part.len() > 150, "{} of {}", part.len(), map.len());
            let all = render(&[SubmapView::new(&map, camera_from_map)], &camera, &settings, None);
            let less = render(&[SubmapView::new(&part, camera_from_map)], &camera, &settings, None);
            assert!(all.hits > 1000);
            assert_eq!((all.hits, &all.color, &all.depth_m), (less.hits, &less.color, &less.depth_m));
            assert_eq!((&all.opacity, &all.normal), (&less.opacity, &less.normal));
        }
    }
}
