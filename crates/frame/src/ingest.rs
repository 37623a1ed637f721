//! Making a sensor's raw pictures into frames: depth registered to colour, lenses undone.

use crate::Image;
use coma_geometry::{Distortion, Intrinsics, Pose};
use nalgebra::Point3;

/// Depth (metres, 0 = none) as seen from the colour camera: every measurement is carried over through
/// `color_from_depth`, splatted on the pixels that its own pixel covers there, the nearest wins.
pub fn register_depth_to_color(
    depth_m: &Image<f32>,
    depth_camera: &Intrinsics,
    depth_distortion: &Distortion,
    color_camera: &Intrinsics,
    color_from_depth: &Pose,
) -> Image<f32> {
    let (width, height) = (color_camera.width as usize, color_camera.height as usize);
    let mut out = Image::filled(width, height, 0.0f32);
    // Half a depth pixel's footprint in colour pixels.
    let half_x = 0.5 * color_camera.fx / depth_camera.fx;
    let half_y = 0.5 * color_camera.fy / depth_camera.fy;
    let undistorted = undistorted_rays(depth_camera, depth_distortion);
    for y in 0..depth_m.height() {
        for x in 0..depth_m.width() {
            let z = depth_m[(x, y)] as f64;
            if !(z > 0.0) {
                continue;
            }
            let (rx, ry) = undistorted[(x, y)];
            let point = color_from_depth * Point3::new(rx * z, ry * z, z);
            let Some(pixel) = color_camera.project(&point) else { continue };
            let shrink = z / point.z;
            // The pixel centres inside the footprint, or the one next to its centre.
            let range = |centre: f64, half: f64, side: usize| {
                let mut first = (centre - half * shrink).ceil();
                let mut last = (centre + half * shrink).ceil() - 1.0;
                if last < first {
                    (first, last) = (centre.round(), centre.round());
                }
                (first.max(0.0) as i64, last.min(side as f64 - 1.0) as i64)
            };
            let (x0, x1) = range(pixel.x, half_x, width);
            let (y0, y1) = range(pixel.y, half_y, height);
            for v in y0..=y1 {
                for u in x0..=x1 {
                    let slot = &mut out[(u as usize, v as usize)];
                    if *slot == 0.0 || (point.z as f32) < *slot {
                        *slot = point.z as f32;
                    }
                }
            }
        }
    }
    out
}

/// The normalised ray (x, y at z = 1) of every pixel of a distorted camera, by fixed-point iteration.
fn undistorted_rays(camera: &Intrinsics, distortion: &Distortion) -> Image<(f64, f64)> {
    Image::from_fn(camera.width as usize, camera.height as usize, |x, y| {
        let ray = camera.ray(x as f64, y as f64);
        if distortion.is_none() {
            return (ray.x, ray.y);
        }
        let (mut ux, mut uy) = (ray.x, ray.y);
        for _ in 0..10 {
            let (dx, dy) = distortion.distort(ux, uy);
            ux += ray.x - dx;
            uy += ray.y - dy;
        }
        (ux, uy)
    })
}

/// A colour image as an ideal pinhole camera of the same intrinsics would see it (bilinear; black
/// outside).
pub fn undistort_color(
    color: &Image<[u8; 3]>,
    camera: &Intrinsics,
    distortion: &Distortion,
) -> Image<[u8; 3]> {
    if distortion.is_none() {
        return color.clone();
    }
    Image::from_fn(color.width(), color.height(), |x, y| {
        let (u, v) = distorted_pixel(camera, distortion, x, y);
        let (x0, y0) = (u.floor(), v.floor());
        if !(x0 >= 0.0 && y0 >= 0.0 && x0 + 1.0 < color.width() as f64 && y0 + 1.0 < color.height() as f64) {
            return [0; 3];
        }
        let (fx, fy) = (u - x0, v - y0);
        let (x0, y0) = (x0 as usize, y0 as usize);
        std::array::from_fn(|c| {
            let at = |x, y| color[(x, y)][c] as f64;
            let top = at(x0, y0) * (1.0 - fx) + at(x0 + 1, y0) * fx;
            let bottom = at(x0, y0 + 1) * (1.0 - fx) + at(x0 + 1, y0 + 1) * fx;
            (top * (1.0 - fy) + bottom * fy + 0.5) as u8
        })
    })
}

/// Depth (already registered to the distorted colour image) as the ideal pinhole would see it (nearest).
pub fn undistort_depth(depth_m: &Image<f32>, camera: &Intrinsics, distortion: &Distortion) -> Image<f32> {
    if distortion.is_none() {
        return depth_m.clone();
    }
    Image::from_fn(depth_m.width(), depth_m.height(), |x, y| {
        let (u, v) = distorted_pixel(camera, distortion, x, y);
        let (u, v) = (u.round(), v.round());
        if u >= 0.0 && v >= 0.0 { depth_m.get(u as usize, v as usize).copied().unwrap_or(0.0) } else { 0.0 }
    })
}

fn distorted_pixel(camera: &Intrinsics, distortion: &Distortion, x: usize, y: usize) -> (f64, f64) {
    let ray = camera.ray(x as f64, y as f64);
    let (dx, dy) = distortion.distort(ray.x, ray.y);
    (dx * camera.fx + camera.cx, dy * camera.fy + camera.cy)
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Intrinsics = Intrinsics { width: 64, height: 48, fx: 60.0, fy: 60.0, cx: 31.5, cy: 23.5 };

    #[test]
    fn an_identity_extrinsic_leaves_depth_as_it_is() {
        let depth = Image::from_fn(64, 48, |x, y| if (x + y) % 7 == 0 { 0.0 } else { 1.0 + x as f32 * 0.01 });
        let out =
            register_depth_to_color(&depth, &CAMERA, &Distortion::default(), &CAMERA, &Pose::identity());
        assert_eq!(out, depth);
    }

    #[test]
    fn a_shifted_depth_camera_is_carried_over() {
        // 0.1 m to the right at 2 m with fx = 60 is 3 pixels.
        let depth = Image::filled(64, 48, 2.0f32);
        let color_from_depth = Pose::translation(0.1, 0.0, 0.0);
        let out =
            register_depth_to_color(&depth, &CAMERA, &Distortion::default(), &CAMERA, &color_from_depth);
        assert_eq!(out[(2, 20)], 0.0);
        assert_eq!(out[(3, 20)], 2.0);
        assert_eq!(out[(63, 47)], 2.0);
    }

    #[test]
    fn the_nearest_surface_wins() {
        let mut depth = Image::filled(64, 48, 0.0f32);
        depth[(10, 10)] = 2.0; // lands on 13
        depth[(7, 10)] = 1.0; // lands on 13 too: 6 pixels at 1 m
        let out = register_depth_to_color(
            &depth,
            &CAMERA,
            &Distortion::default(),
            &CAMERA,
            &Pose::translation(0.1, 0.0, 0.0),
        );
        assert_eq!(out[(13, 10)], 1.0);
    }

    #[test]
    fn undistorting_moves_a_distorted_line_back() {
        let distortion = Distortion { k1: -0.2, k2: 0.05, p1: 0.001, p2: -0.002, k3: 0.0 };
        // Paint, in the distorted image, the ideal column x = 50.
        let mut color = Image::filled(64, 48, [0u8; 3]);
        for i in 0..4800 {
            let ray = CAMERA.ray(50.0, i as f64 * 0.01);
            let (x, y) = distortion.distort(ray.x, ray.y);
            let (u, v) = (x * CAMERA.fx + CAMERA.cx, y * CAMERA.fy + CAMERA.cy);
            if u >= 0.0 && v >= 0.0 && (u.round() as usize) < 64 && (v.round() as usize) < 48 {
                color[(u.round() as usize, v.round() as usize)] = [255; 3];
            }
        }
        let out = undistort_color(&color, &CAMERA, &distortion);
        for y in 4..44 {
            let brightest = (40..60).max_by_key(|x| out[(*x, y)][0]).unwrap();
            assert!((brightest as i64 - 50).abs() <= 1, "row {y}: {brightest}");
        }
    }
}
