//! Two views and how they lie upon each other, as one picture.

use coma_frame::{Image, RgbdFrame};
use coma_geometry::nalgebra::Point3;
use coma_geometry::{Intrinsics, Pose};
use image::{Rgb, RgbImage, imageops};

/// Width of each of the four tiles, pixels.
const TILE: u32 = 480;
/// Both clouds agree where their depths differ by less than this, metres, and 1 % of the depth.
const AGREE_M: f32 = 0.02;
/// Colours of the first cloud, the second, and of both together, for brightness 1.
const FIRST: [f32; 3] = [255.0, 150.0, 40.0];
const SECOND: [f32; 3] = [60.0, 150.0, 255.0];
const BOTH: [f32; 3] = [215.0, 225.0, 215.0];

/// What both cameras saw, and both clouds from the first camera and from above, where the motion is known.
pub fn sheet(from: &RgbdFrame, to: &RgbdFrame, from_from_to: Option<&Pose>) -> RgbImage {
    let height = TILE * from.camera.height / from.camera.width;
    let (left, right) = (picture(&from.color, height), picture(&to.color, height));
    let rows = if from_from_to.is_some() { 2 } else { 1 };
    let mut out = RgbImage::new(2 * TILE, rows * height);
    imageops::replace(&mut out, &left, 0, 0);
    imageops::replace(&mut out, &right, i64::from(TILE), 0);
    if let Some(from_from_to) = from_from_to {
        let first = points(from, &Pose::identity());
        let second = points(to, from_from_to);
        let ahead = Eye::Camera(scaled(&from.camera, TILE, height));
        let above = Eye::above(first.iter().chain(&second), TILE, height);
        for (column, eye) in [ahead, above].iter().enumerate() {
            let (a, b) = (seen(&first, eye, TILE, height), seen(&second, eye, TILE, height));
            imageops::replace(
                &mut out,
                &together(&a, &b),
                column as i64 * i64::from(TILE),
                i64::from(height),
            );
        }
    }
    out
}

fn picture(color: &Image<[u8; 3]>, height: u32) -> RgbImage {
    let whole = RgbImage::from_fn(color.width() as u32, color.height() as u32, |x, y| {
        Rgb(color[(x as usize, y as usize)])
    });
    imageops::resize(&whole, TILE, height, imageops::FilterType::Triangle)
}

/// The same field of view in another size.
fn scaled(camera: &Intrinsics, width: u32, height: u32) -> Intrinsics {
    let (sx, sy) = (width as f64 / camera.width as f64, height as f64 / camera.height as f64);
    Intrinsics {
        width,
        height,
        fx: camera.fx * sx,
        fy: camera.fy * sy,
        cx: (camera.cx + 0.5) * sx - 0.5,
        cy: (camera.cy + 0.5) * sy - 0.5,
    }
}

/// A point in the first camera, and its brightness.
type Point = (Point3<f64>, f32);

fn points(frame: &RgbdFrame, first_from_camera: &Pose) -> Vec<Point> {
    let brightness = frame.color.luminance();
    let (width, height) = (frame.depth_m.width(), frame.depth_m.height());
    let mut out = Vec::new();
    for y in 0..height {
        for x in 0..width {
            let z = frame.depth_m[(x, y)];
            if z > 0.0 {
                let point = frame.camera.back_project(x as f64, y as f64, z as f64);
                out.push((first_from_camera * point, brightness[(x, y)]));
            }
        }
    }
    out
}

/// From where the clouds are looked at.
enum Eye {
    /// The first camera.
    Camera(Intrinsics),
    /// Against the first camera's y axis, in parallel; its z axis points up in the picture.
    Above { pixels_per_m: f64, left_m: f64, far_m: f64, top_m: f64 },
}

impl Eye {
    /// From above, so that all but the outermost hundredth of the points fit.
    fn above<'a>(points: impl Iterator<Item = &'a Point>, width: u32, height: u32) -> Eye {
        let (mut xs, mut ys, mut zs): (Vec<f64>, Vec<f64>, Vec<f64>) = Default::default();
        for (p, _) in points {
            xs.push(p.x);
            ys.push(p.y);
            zs.push(p.z);
        }
        let range = |mut values: Vec<f64>| {
            values.sort_by(f64::total_cmp);
            let at = |share: f64| values.get((values.len() as f64 * share) as usize).copied().unwrap_or(0.0);
            (at(0.005), at(0.995))
        };
        let ((left, right), (top, _), (near, far)) = (range(xs), range(ys), range(zs));
        let wide = (right - left).max(0.1);
        let deep = (far - near).max(0.1);
        let pixels_per_m = 0.95 * (width as f64 / wide).min(height as f64 / deep);
        Eye::Above {
            pixels_per_m,
            left_m: (left + right) / 2.0 - width as f64 / 2.0 / pixels_per_m,
            far_m: (near + far) / 2.0 + height as f64 / 2.0 / pixels_per_m,
            top_m: top - 1.0,
        }
    }

    /// Pixel and distance from the eye.
    fn look(&self, p: &Point3<f64>) -> Option<(f64, f64, f64)> {
        match self {
            Eye::Camera(camera) => {
                camera.project(p).filter(|_| p.z > 0.05).map(|pixel| (pixel.x, pixel.y, p.z))
            }
            Eye::Above { pixels_per_m, left_m, far_m, top_m } => {
                Some(((p.x - left_m) * pixels_per_m, (far_m - p.z) * pixels_per_m, p.y - top_m))
                    .filter(|(_, _, depth)| *depth > 0.0)
            }
        }
    }
}

/// The nearest point of a cloud at each pixel: distance (infinite where none is) and brightness.
fn seen(points: &[Point], eye: &Eye, width: u32, height: u32) -> Image<(f32, f32)> {
    let mut out = Image::filled(width as usize, height as usize, (f32::INFINITY, 0.0));
    for (point, brightness) in points {
        let Some((u, v, depth)) = eye.look(point) else { continue };
        let (u, v) = (u.round(), v.round());
        if u >= 0.0 && v >= 0.0 && u < width as f64 && v < height as f64 {
            let pixel = &mut out[(u as usize, v as usize)];
            if (depth as f32) < pixel.0 {
                *pixel = (depth as f32, *brightness);
            }
        }
    }
    out
}

/// The nearer cloud, or both where they agree; black where there is nothing.
fn together(first: &Image<(f32, f32)>, second: &Image<(f32, f32)>) -> RgbImage {
    RgbImage::from_fn(first.width() as u32, first.height() as u32, |x, y| {
        let (a, b) = (first[(x as usize, y as usize)], second[(x as usize, y as usize)]);
        let (color, brightness) = if a.0.is_infinite() && b.0.is_infinite() {
            return Rgb([0; 3]);
        } else if (a.0 - b.0).abs() <= AGREE_M + 0.01 * a.0.min(b.0) {
            (BOTH, 0.5 * (a.1 + b.1))
        } else if a.0 < b.0 {
            (FIRST, a.1)
        } else {
            (SECOND, b.1)
        };
        // Dark surfaces stay visible.
        Rgb(color.map(|c| (c * (0.35 + 0.65 * brightness)) as u8))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_frame::DepthNoise;
    use coma_geometry::{StampNs, Tangent, se3};

    fn wall(z: f32) -> RgbdFrame {
        let camera = Intrinsics { width: 640, height: 480, fx: 400.0, fy: 400.0, cx: 319.5, cy: 239.5 };
        let (color, depth) = (Image::filled(640, 480, [200; 3]), Image::filled(640, 480, z));
        RgbdFrame::new(0, StampNs(0), camera, DepthNoise::default(), color, depth).unwrap()
    }

    /// Share of the tile's pixels whose colour leans so.
    fn share(sheet: &RgbImage, left: u32, top: u32, leans: fn([u8; 3]) -> bool) -> f64 {
        let (mut some, mut lean) = (0, 0);
        for y in top..sheet.height() {
            for x in left..left + TILE {
                let pixel = sheet.get_pixel(x, y).0;
                some += (pixel != [0; 3]) as usize;
                lean += (pixel != [0; 3] && leans(pixel)) as usize;
            }
        }
        lean as f64 / some.max(1) as f64
    }

    #[test]
    fn clouds_that_agree_are_grey_and_a_nearer_one_shows_its_colour() {
        let ahead = |metres: f64| se3::exp(&Tangent::new(0.0, 0.0, metres, 0.0, 0.0, 0.0));
        let grey = |p: [u8; 3]| p[0].abs_diff(p[2]) < 30;
        let right = sheet(&wall(2.0), &wall(1.5), Some(&ahead(0.5)));
        let height = right.height() / 2;
        // The second camera stands nearer and sees nine sixteenths of what the first does.
        let front = share(&right, 0, height, grey);
        assert!((front - 0.5625).abs() < 0.05, "{front}");
        let wrong = sheet(&wall(2.0), &wall(1.5), Some(&ahead(0.0)));
        assert!(share(&wrong, 0, height, |p| p[2] > p[0] + 50) > 0.9, "the second cloud is nearer");
        assert!(share(&wrong, 0, height, grey) < 0.05);
        assert_eq!(sheet(&wall(2.0), &wall(1.5), None).height(), height);
    }
}
