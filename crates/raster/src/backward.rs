//! From derivatives by pixels to derivatives by surfel parameters and by the camera's pose.
//!
//! Per tile the blend is walked front to back once more; what lies behind a hit is the pixel's total minus
//! what was blended so far. Sums per (tile, surfel) are added up per surfel in the order of tiles, so that
//! the result does not depend on the number of threads.

use crate::blend::{CameraF32, row_hits, rows};
use crate::project::{Projected, in_camera};
use crate::{ALPHA_MAX, LANES, RenderSettings, Rendering, SubmapView, TILE};
use coma_frame::Image;
use coma_geometry::{Intrinsics, Tangent};
use multiversion::multiversion;
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

/// Derivatives of a loss by what [`crate::render`] returned. `[height, width]`
#[derive(Clone, Debug)]
pub struct PixelGradients {
    /// By colour.
    pub color: Image<[f32; 3]>,
    /// By expected depth D / A.
    pub depth_m: Image<f32>,
    /// By opacity.
    pub opacity: Image<f32>,
}

/// Derivatives by the parameters of one submap's surfels, in its frame.
#[derive(Clone, Debug, Default)]
pub struct SurfelGradients {
    /// By the centre. `[n, 3]`
    pub center_m: Vec<[f32; 3]>,
    /// By a rotation vector that turns the surfel about its own axes: `R * exp(w)`. `[n, 3]`
    pub rotation: Vec<[f32; 3]>,
    /// By the two scales. `[n, 2]`
    pub scale_m: Vec<[f32; 2]>,
    /// By opacity. `[n]`
    pub opacity: Vec<f32>,
    /// By colour. `[n, 3]`
    pub color: Vec<[f32; 3]>,
}

/// Derivatives of a loss by everything that was rendered.
#[derive(Clone, Debug)]
pub struct Gradients {
    /// One per submap.
    pub submaps: Vec<SurfelGradients>,
    /// By the camera's pose, perturbed on the right: `map_from_camera * exp(xi)`, that is every
    /// `camera_from_submap` becomes `exp(-xi) * camera_from_submap`.
    pub pose: Tangent,
}

/// Sums of one surfel: by a (3), b (3), n (3), k, pixel (2), centre depth, opacity, colour (3).
const SUMS: usize = 17;
type Sums = [f32; SUMS];

/// Derivatives of a loss whose derivatives by pixels are `pixels`, at what `rendering` was rendered from.
///
/// # Panics
/// If `submaps` and `camera` are not those that `rendering` was made of.
pub fn backward(
    submaps: &[SubmapView<'_>],
    camera: &Intrinsics,
    settings: &RenderSettings,
    rendering: &Rendering,
    pixels: &PixelGradients,
) -> Gradients {
    let state = &rendering.state;
    let per_tile: Vec<Vec<Sums>> = (0..state.tiles.count())
        .into_par_iter()
        .map(|tile| {
            let (x0, y0) = state.tiles.origin(tile);
            let lanes = TileLoss::gather(rendering, pixels, x0, y0);
            let list = state.tiles.list(tile);
            let mut sums = vec![[0.0f32; SUMS]; list.len()];
            tile_backward(
                &state.projected,
                list,
                [x0 as f32, y0 as f32],
                camera,
                settings,
                &lanes,
                &mut sums,
            );
            sums
        })
        .collect();
    let mut totals = vec![[0.0f32; SUMS]; state.projected.len()];
    for (tile, sums) in per_tile.iter().enumerate() {
        for (surfel, sum) in state.tiles.list(tile).iter().zip(sums) {
            totals[*surfel as usize].iter_mut().zip(sum).for_each(|(t, s)| *t += s);
        }
    }
    to_parameters(submaps, camera, &state.projected, &totals)
}

/// What the loss says of a tile's pixels, and the totals of the blend.
struct TileLoss {
    color: [[f32; LANES]; 3],
    /// By D, that is by the unnormalised depth sum.
    depth: [f32; LANES],
    /// By A.
    opacity: [f32; LANES],
    /// Sum over all hits of weight * q, where q is the loss's derivative by the weight.
    total: [f32; LANES],
    /// 1 inside the image.
    inside: [f32; LANES],
}

impl TileLoss {
    fn gather(rendering: &Rendering, pixels: &PixelGradients, x0: usize, y0: usize) -> Self {
        let zero = [0.0f32; LANES];
        let mut out = TileLoss { color: [zero; 3], depth: zero, opacity: zero, total: zero, inside: zero };
        for lane in 0..LANES {
            let (x, y) = (x0 + lane % TILE, y0 + lane / TILE);
            let (Some(by_color), true) = (pixels.color.get(x, y), y < rendering.color.height()) else {
                continue;
            };
            let a = rendering.opacity[(x, y)];
            let depth = rendering.depth_m[(x, y)];
            // E = D / A: by D it is g / A, by A it is -g E / A.
            let by_expected = pixels.depth_m[(x, y)];
            let by_d = if a > 1e-6 { by_expected / a } else { 0.0 };
            let by_a = pixels.opacity[(x, y)] - by_d * depth;
            let color = rendering.color[(x, y)];
            for c in 0..3 {
                out.color[c][lane] = by_color[c];
                out.total[lane] += by_color[c] * color[c];
            }
            out.depth[lane] = by_d;
            out.opacity[lane] = by_a;
            out.total[lane] += by_d * depth * a + by_a * a;
            out.inside[lane] = 1.0;
        }
        out
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+fma", "x86_64+avx2+fma", "aarch64+neon"))]
fn tile_backward(
    projected: &[Projected],
    list: &[u32],
    origin: [f32; 2],
    camera: &Intrinsics,
    settings: &RenderSettings,
    loss: &TileLoss,
    sums: &mut [Sums],
) {
    let camera = CameraF32::from(camera);
    let low_pass = 1.0 / (settings.low_pass_px * settings.low_pass_px);
    let mut passing = [1.0f32; LANES];
    let mut blended = [0.0f32; LANES];
    for (count, surfel) in list.iter().enumerate() {
        if count % 16 == 0 && passing.iter().all(|t| *t <= settings.transmittance_min) {
            break;
        }
        let p = &projected[*surfel as usize];
        let mut lanes = [[0.0f32; TILE]; SUMS];
        for row in rows(p, origin[1]) {
            let y = origin[1] + row as f32;
            let hits = row_hits(p, origin[0], y, &camera, settings);
            let dy = (y - camera.cy) * camera.inv_fy;
            for lane in 0..TILE {
                let i = row * TILE + lane;
                let t = passing[i];
                let live = (t > settings.transmittance_min) & (hits.alpha[lane] > 0.0);
                let alpha = if live { hits.alpha[lane] } else { 0.0 };
                let depth = hits.depth[lane];
                let weight = alpha * t;
                // The loss's derivative by this hit's weight.
                let q = loss.color[0][i] * p.color[0]
                    + loss.color[1][i] * p.color[1]
                    + loss.color[2][i] * p.color[2]
                    + loss.depth[i] * depth
                    + loss.opacity[i];
                blended[i] += weight * q;
                let behind = loss.total[i] - blended[i];
                passing[i] = t * (1.0 - alpha);
                let by_alpha = t * q - behind / (1.0 - alpha);
                // A clamped alpha does not move.
                let by_alpha = if live & (alpha < ALPHA_MAX) { by_alpha * loss.inside[i] } else { 0.0 };
                let weight = weight * loss.inside[i];
                let by_depth = weight * loss.depth[i];

                let x = origin[0] + lane as f32;
                let dx = (x - camera.cx) * camera.inv_fx;
                let inv = 1.0 / (p.n[0] * dx + p.n[1] * dy + p.n[2]);
                let u = (p.a[0] * dx + p.a[1] * dy + p.a[2]) * inv;
                let v = (p.b[0] * dx + p.b[1] * dy + p.b[2]) * inv;
                let z = p.k * inv;
                let (ex, ey) = (x - p.pixel[0], y - p.pixel[1]);
                let on_plane = u * u + v * v;
                let on_screen = (ex * ex + ey * ey) * low_pass;
                let plane_wins = (on_plane <= on_screen) & (z > settings.near_m);
                // alpha = o exp(-rho / 2): by rho it is -alpha / 2.
                let by_rho = -0.5 * alpha * by_alpha;
                let (by_plane, by_screen) = if plane_wins { (by_rho, 0.0) } else { (0.0, by_rho) };
                let (plane_depth, centre_depth) = if plane_wins { (by_depth, 0.0) } else { (0.0, by_depth) };
                // Kept finite where the plane does not count.
                let (u, v, z, inv) = if plane_wins { (u, v, z, inv) } else { (0.0, 0.0, 0.0, 0.0) };
                let by_u = 2.0 * u * by_plane * inv;
                let by_v = 2.0 * v * by_plane * inv;
                let by_n = -(by_u * u + by_v * v + plane_depth * z * inv);
                lanes[0][lane] += by_u * dx;
                lanes[1][lane] += by_u * dy;
                lanes[2][lane] += by_u;
                lanes[3][lane] += by_v * dx;
                lanes[4][lane] += by_v * dy;
                lanes[5][lane] += by_v;
                lanes[6][lane] += by_n * dx;
                lanes[7][lane] += by_n * dy;
                lanes[8][lane] += by_n;
                lanes[9][lane] += plane_depth * inv;
                lanes[10][lane] -= 2.0 * ex * low_pass * by_screen;
                lanes[11][lane] -= 2.0 * ey * low_pass * by_screen;
                lanes[12][lane] += centre_depth;
                lanes[13][lane] += alpha * by_alpha;
                lanes[14][lane] += weight * loss.color[0][i];
                lanes[15][lane] += weight * loss.color[1][i];
                lanes[16][lane] += weight * loss.color[2][i];
            }
        }
        for (sum, lanes) in sums[count].iter_mut().zip(&lanes) {
            *sum = lanes.iter().sum();
        }
        // By opacity: alpha is proportional to it.
        sums[count][13] /= p.opacity;
    }
}

/// The chain rule from what is projected back to the surfels' own parameters.
fn to_parameters(
    submaps: &[SubmapView<'_>],
    camera: &Intrinsics,
    projected: &[Projected],
    totals: &[Sums],
) -> Gradients {
    let mut out: Vec<SurfelGradients> = submaps
        .iter()
        .map(|view| {
            let n = view.surfels.len();
            SurfelGradients {
                center_m: vec![[0.0; 3]; n],
                rotation: vec![[0.0; 3]; n],
                scale_m: vec![[0.0; 2]; n],
                opacity: vec![0.0; n],
                color: vec![[0.0; 3]; n],
            }
        })
        .collect();
    let submap_from_camera: Vec<Matrix3<f32>> = submaps
        .iter()
        .map(|v| v.camera_from_submap.rotation.inverse().to_rotation_matrix().matrix().cast::<f32>())
        .collect();
    let (fx, fy) = (camera.fx as f32, camera.fy as f32);
    let mut pose = Tangent::zeros();
    for (p, g) in projected.iter().zip(totals) {
        let view = &submaps[p.submap as usize];
        let s = in_camera(view, p.index as usize);
        let (e1, e2, n): (Vector3<f32>, Vector3<f32>, Vector3<f32>) =
            (s.axes.column(0).into(), s.axes.column(1).into(), s.axes.column(2).into());
        let c = s.center;
        let (ga, gb) = (Vector3::new(g[0], g[1], g[2]), Vector3::new(g[3], g[4], g[5]));
        let mut by_n = Vector3::new(g[6], g[7], g[8]);
        let mut by_k = g[9];
        // a = (e1 k - n (e1 . c)) / s1, b likewise.
        let (qa, qb) = (ga / s.scale[0], gb / s.scale[1]);
        let mut by_center = Vector3::zeros();
        let mut axis = |e: &Vector3<f32>, q: &Vector3<f32>| {
            let along = q.dot(&n);
            by_k += q.dot(e);
            by_n -= q * e.dot(&c);
            by_center -= e * along;
            q * p.k - c * along
        };
        let by_e1 = axis(&e1, &qa);
        let by_e2 = axis(&e2, &qb);
        let by_scale = [
            -(ga[0] * p.a[0] + ga[1] * p.a[1] + ga[2] * p.a[2]) / s.scale[0],
            -(gb[0] * p.b[0] + gb[1] * p.b[1] + gb[2] * p.b[2]) / s.scale[1],
        ];
        // k = n . c
        by_n += c * by_k;
        by_center += n * by_k;
        // Centre pixel and depth.
        by_center.x += g[10] * fx / c.z;
        by_center.y += g[11] * fy / c.z;
        by_center.z += g[12] - (g[10] * fx * c.x + g[11] * fy * c.y) / (c.z * c.z);
        // Turning the disc about its own axes by w: d e1 = e2 w3 - n w2, d e2 = n w1 - e1 w3, d n = e1 w2 - e2 w1.
        let by_rotation =
            [by_e2.dot(&n) - by_n.dot(&e2), by_n.dot(&e1) - by_e1.dot(&n), by_e1.dot(&e2) - by_e2.dot(&e1)];
        // The pose moves everything by exp(-xi): d c = -(rho + phi x c), d e = -phi x e.
        let turn = c.cross(&by_center) + e1.cross(&by_e1) + e2.cross(&by_e2) + n.cross(&by_n);
        for axis in 0..3 {
            pose[axis] -= by_center[axis] as f64;
            pose[3 + axis] -= turn[axis] as f64;
        }
        let own = &mut out[p.submap as usize];
        let i = p.index as usize;
        own.center_m[i] = (submap_from_camera[p.submap as usize] * by_center).into();
        own.rotation[i] = by_rotation;
        own.scale_m[i] = by_scale;
        own.opacity[i] = g[13];
        own.color[i] = [g[14], g[15], g[16]];
    }
    Gradients { submaps: out, pose }
}
