//! Surface normals from depth (eq. 7 of the CoMA-SLAM paper).

use crate::Image;
use coma_geometry::Intrinsics;
use rayon::prelude::*;

/// Unit normals in the camera frame, turned towards the camera (z < 0); `[0, 0, 0]` where there is no
/// depth, at the border, or where a neighbour lies across a depth jump of more than `jump` (relative).
/// Central differences over `step` pixels to either side.
pub fn normals_from_depth(
    depth_m: &Image<f32>,
    camera: &Intrinsics,
    jump: f32,
    step: usize,
) -> Image<[f32; 3]> {
    let (width, height) = (depth_m.width(), depth_m.height());
    let mut out = Image::filled(width, height, [0.0f32; 3]);
    out.pixels_mut().par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, out) in row.iter_mut().enumerate() {
            *out = normal_at(depth_m, camera, jump, step, x, y).unwrap_or_default();
        }
    });
    out
}

/// One pixel of [`normals_from_depth`]; `None` where that has zeros.
#[inline]
pub fn normal_at(
    depth_m: &Image<f32>,
    camera: &Intrinsics,
    jump: f32,
    step: usize,
    x: usize,
    y: usize,
) -> Option<[f32; 3]> {
    let (width, height) = (depth_m.width(), depth_m.height());
    if x < step || x + step >= width || y < step || y + step >= height {
        return None;
    }
    let z = depth_m[(x, y)];
    let limit = jump * z;
    let close = |n: f32| n > 0.0 && (n - z).abs() <= limit;
    let (left, right) = (depth_m[(x - step, y)], depth_m[(x + step, y)]);
    let (up, down) = (depth_m[(x, y - step)], depth_m[(x, y + step)]);
    if !(z > 0.0 && close(left) && close(right) && close(up) && close(down)) {
        return None;
    }
    let (fx, fy, cx, cy) = (camera.fx as f32, camera.fy as f32, camera.cx as f32, camera.cy as f32);
    let point = |x: usize, y: usize, z: f32| [(x as f32 - cx) / fx * z, (y as f32 - cy) / fy * z, z];
    let (a, b) = (point(x + step, y, right), point(x - step, y, left));
    let (c, d) = (point(x, y + step, down), point(x, y - step, up));
    let dx = [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
    let dy = [c[0] - d[0], c[1] - d[1], c[2] - d[2]];
    // eq. (7): n = dx x dy, normalised; y points down, so dy x dx faces the camera.
    let n = [dy[1] * dx[2] - dy[2] * dx[1], dy[2] * dx[0] - dy[0] * dx[2], dy[0] * dx[1] - dy[1] * dx[0]];
    let norm = (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]).sqrt();
    // The sign that makes the normal face the viewer.
    let p = point(x, y, z);
    let facing = n[0] * p[0] + n[1] * p[1] + n[2] * p[2];
    let s = if facing > 0.0 { -1.0 } else { 1.0 } / norm;
    (norm > 0.0).then(|| n.map(|v| v * s))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_wall_faces_the_camera_and_a_jump_has_no_normal() {
        let camera = Intrinsics { width: 32, height: 24, fx: 30.0, fy: 30.0, cx: 15.5, cy: 11.5 };
        let depth = Image::from_fn(32, 24, |x, _| if x < 16 { 2.0 } else { 3.0 });
        let normals = normals_from_depth(&depth, &camera, 0.05, 1);
        let n = normals[(5, 5)];
        assert!((n[2] + 1.0).abs() < 1e-5, "{n:?}");
        assert_eq!(normals[(15, 12)], [0.0; 3]);
        assert_eq!(normals[(0, 0)], [0.0; 3]);
    }
}
