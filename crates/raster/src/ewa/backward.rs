//! From derivatives by pixels to derivatives by the Gaussians' parameters and by the camera's pose.

use super::GaussianView;
use super::forward::{Picture, alpha, extent};
use super::project::{InCamera, jacobian};
use crate::{ALPHA_MAX, PixelGradients, RenderSettings};
use coma_geometry::{Intrinsics, Tangent};
use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};
use rayon::prelude::*;

/// Derivatives by everything that was rendered; columns run over all views, one after the other.
#[derive(Clone, Debug, Default)]
pub struct GaussianGradients {
    /// By the centre, in the submap's frame. `[n, 3]`
    pub center_m: Vec<[f32; 3]>,
    /// By a rotation vector that turns the Gaussian about its own axes: `R * exp(w)`. `[n, 3]`
    pub rotation: Vec<[f32; 3]>,
    /// By the three scales. `[n, 3]`
    pub scale_m: Vec<[f32; 3]>,
    /// By opacity. `[n]`
    pub opacity: Vec<f32>,
    /// By colour. `[n, 3]`
    pub color: Vec<[f32; 3]>,
    /// By the camera's pose, perturbed on the right, as [`crate::Gradients::pose`].
    pub pose: Tangent,
}

/// By what was projected.
#[derive(Clone, Copy, Debug, Default)]
struct BySplat {
    pixel: Vector2<f32>,
    conic: Matrix2<f32>,
    z: f32,
    opacity: f32,
    color: [f32; 3],
}

/// Derivatives of a loss whose derivatives by pixels are `pixels`, at what `picture` was rendered from.
pub fn backward(
    views: &[GaussianView<'_>],
    camera: &Intrinsics,
    settings: &RenderSettings,
    picture: &Picture,
    pixels: &PixelGradients,
) -> GaussianGradients {
    let by_tile: Vec<Vec<BySplat>> = picture
        .tiles
        .par_iter()
        .enumerate()
        .map(|(tile, list)| one_tile(tile, list, picture, camera, settings, pixels))
        .collect();
    // Tiles are added up in their order.
    let mut by_splat = vec![BySplat::default(); picture.splats.len()];
    for (list, sums) in picture.tiles.iter().zip(&by_tile) {
        for (index, sum) in list.iter().zip(sums) {
            let total = &mut by_splat[*index as usize];
            total.pixel += sum.pixel;
            total.conic += sum.conic;
            total.z += sum.z;
            total.opacity += sum.opacity;
            (0..3).for_each(|c| total.color[c] += sum.color[c]);
        }
    }
    to_parameters(views, camera, picture, &by_splat)
}

fn one_tile(
    tile: usize,
    list: &[u32],
    picture: &Picture,
    camera: &Intrinsics,
    settings: &RenderSettings,
    pixels: &PixelGradients,
) -> Vec<BySplat> {
    let mut sums = vec![BySplat::default(); list.len()];
    let ([x0, x1], [y0, y1]) = extent(tile, camera);
    for (y, x) in (y0..y1).flat_map(|y| (x0..x1).map(move |x| (y, x))) {
        let opacity = picture.opacity[(x, y)];
        let (depth, color) = (picture.depth_m[(x, y)], picture.color[(x, y)]);
        let by_color = pixels.color[(x, y)];
        // E = D / A: by D it is g / A, by A it is -g E / A.
        let by_d = if opacity > 1e-6 { pixels.depth_m[(x, y)] / opacity } else { 0.0 };
        let by_a = pixels.opacity[(x, y)] - by_d * depth;
        // Sum over all hits of weight * (the loss's derivative by the weight); less what was blended so far.
        let mut behind = by_d * depth * opacity + by_a * opacity;
        (0..3).for_each(|c| behind += by_color[c] * color[c]);
        let mut passing = 1.0f32;
        for (sum, index) in sums.iter_mut().zip(list) {
            if !(passing > settings.transmittance_min) {
                break;
            }
            let splat = &picture.splats[*index as usize];
            let (alpha, d) = alpha(splat, x, y);
            if !(alpha >= settings.alpha_min) {
                continue;
            }
            let weight = alpha * passing;
            let q = by_d * splat.z + by_a + (0..3).map(|c| by_color[c] * splat.color[c]).sum::<f32>();
            behind -= weight * q;
            sum.z += weight * by_d;
            (0..3).for_each(|c| sum.color[c] += weight * by_color[c]);
            // A clamped alpha does not move.
            if alpha < ALPHA_MAX {
                let by_alpha = passing * q - behind / (1.0 - alpha);
                sum.opacity += by_alpha * alpha / splat.opacity;
                // alpha = o exp(-q / 2), q = d^T conic d, d = pixel - centre.
                let by_q = -0.5 * alpha * by_alpha;
                sum.pixel -= splat.conic * d * (2.0 * by_q);
                sum.conic += d * d.transpose() * by_q;
            }
            passing *= 1.0 - alpha;
        }
    }
    sums
}

fn to_parameters(
    views: &[GaussianView<'_>],
    camera: &Intrinsics,
    picture: &Picture,
    by_splat: &[BySplat],
) -> GaussianGradients {
    let n: usize = views.iter().map(|view| view.gaussians.len()).sum();
    let mut out = GaussianGradients {
        center_m: vec![[0.0; 3]; n],
        rotation: vec![[0.0; 3]; n],
        scale_m: vec![[0.0; 3]; n],
        opacity: vec![0.0; n],
        color: vec![[0.0; 3]; n],
        pose: Tangent::zeros(),
    };
    let mut firsts = Vec::with_capacity(views.len());
    let mut first = 0;
    for view in views {
        firsts.push(first);
        first += view.gaussians.len();
    }
    for (splat, by) in picture.splats.iter().zip(by_splat) {
        let slot = splat.slot as usize;
        let view = firsts.partition_point(|first| *first <= slot) - 1;
        let one = one(&InCamera::of(&views[view], slot - firsts[view]), camera, &splat.conic, by);
        let submap_from_camera = views[view].camera_from_submap.rotation.inverse().cast::<f32>();
        out.center_m[slot] = (submap_from_camera * one.center).into();
        out.rotation[slot] = one.rotation;
        out.scale_m[slot] = one.scale;
        out.opacity[slot] = by.opacity;
        out.color[slot] = by.color;
        // A camera that moves by xi sees everything move by exp(-xi).
        for k in 0..3 {
            out.pose[k] -= f64::from(one.center[k]);
            out.pose[3 + k] -= f64::from(one.turn[k]);
        }
    }
    out
}

/// Derivatives of one Gaussian.
struct One {
    /// By the centre, in the camera.
    center: Vector3<f32>,
    rotation: [f32; 3],
    scale: [f32; 3],
    /// By a rotation of everything about the camera.
    turn: Vector3<f32>,
}

fn one(g: &InCamera, camera: &Intrinsics, conic: &Matrix2<f32>, by: &BySplat) -> One {
    let (fx, fy) = (camera.fx as f32, camera.fy as f32);
    let c = g.center;
    let j = jacobian(&c, camera);
    // conic = cov^-1: by cov it is -conic G conic.
    let by_cov = -(conic * by.conic * conic);
    // cov = J M J^T, with M the covariance in the camera.
    let covariance = g.covariance();
    let by_covariance: Matrix3<f32> = j.transpose() * by_cov * j;
    let by_j = by_cov * j * covariance * 2.0;
    // M = L L^T, the columns of L are axes times scales.
    let by_spread = by_covariance * g.spread() * 2.0;
    let axis = |k: usize| -> Vector3<f32> { g.axes.column(k).into() };
    let by_column = |k: usize| -> Vector3<f32> { by_spread.column(k).into() };
    let by_axis: [Vector3<f32>; 3] = std::array::from_fn(|k| by_column(k) * g.scale[k]);
    let scale: [f32; 3] = std::array::from_fn(|k| by_column(k).dot(&axis(k)));
    // Centre: by its pixel, its depth, and by J.
    let inv = 1.0 / c.z;
    let (px, py) = (by.pixel.x * fx * inv, by.pixel.y * fy * inv);
    let mut center = Vector3::new(px, py, by.z - (px * c.x + py * c.y) * inv);
    let inv2 = inv * inv;
    center.x -= by_j[(0, 2)] * fx * inv2;
    center.y -= by_j[(1, 2)] * fy * inv2;
    center.z += 2.0 * inv2 * inv * (by_j[(0, 2)] * fx * c.x + by_j[(1, 2)] * fy * c.y)
        - inv2 * (by_j[(0, 0)] * fx + by_j[(1, 1)] * fy);
    let [e1, e2, e3] = [axis(0), axis(1), axis(2)];
    let [by_e1, by_e2, by_e3] = by_axis;
    // Turning about its own axes by w: d e1 = e2 w3 - e3 w2, d e2 = e3 w1 - e1 w3, d e3 = e1 w2 - e2 w1.
    let rotation =
        [by_e2.dot(&e3) - by_e3.dot(&e2), by_e3.dot(&e1) - by_e1.dot(&e3), by_e1.dot(&e2) - by_e2.dot(&e1)];
    let turn = c.cross(&center) + e1.cross(&by_e1) + e2.cross(&by_e2) + e3.cross(&by_e3);
    One { center, rotation, scale, turn }
}
