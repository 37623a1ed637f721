//! Front-to-back blending of one tile (eq. 3), 16 pixels at a time.

use crate::exp::exp_neg;
use crate::project::Projected;
use crate::settings::ObservedTile;
use crate::{ALPHA_MAX, LANES, RenderSettings, TILE};
use coma_geometry::Intrinsics;
use multiversion::multiversion;

/// Sums over the blend, one lane per pixel.
pub(crate) struct TileImages {
    pub color: [[f32; LANES]; 3],
    pub depth: [f32; LANES],
    pub depth_squared: [f32; LANES],
    pub median: [f32; LANES],
    pub opacity: [f32; LANES],
    pub normal: [[f32; LANES]; 3],
    /// Over 0 where a surfel lies near the observed depth.
    pub near: [f32; LANES],
    pub hits: u64,
}

/// What one surfel does to 16 pixels of a row.
pub(crate) struct RowHits {
    pub alpha: [f32; TILE],
    pub depth: [f32; TILE],
}

/// The rows of a tile (`y0..`) that a surfel touches.
#[inline(always)]
pub(crate) fn rows(p: &Projected, y0: f32) -> std::ops::Range<usize> {
    let first = (p.bounds[1] - y0 as i32).max(0) as usize;
    let last = (p.bounds[3] - y0 as i32 + 1).clamp(0, TILE as i32) as usize;
    first..last
}

/// Alpha (0 below the least) and depth of a surfel along one row of a tile.
#[inline(always)]
pub(crate) fn row_hits(
    p: &Projected,
    x0: f32,
    y: f32,
    camera: &CameraF32,
    settings: &RenderSettings,
) -> RowHits {
    let mut out = RowHits { alpha: [0.0; TILE], depth: [0.0; TILE] };
    let dy = (y - camera.cy) * camera.inv_fy;
    let base = |v: &[f32; 3]| v[1] * dy + v[2];
    let (au, bu, nu) = (base(&p.a), base(&p.b), base(&p.n));
    let low_pass = 1.0 / (settings.low_pass_px * settings.low_pass_px);
    let py = (y - p.pixel[1]) * (y - p.pixel[1]);
    for lane in 0..TILE {
        let x = x0 + lane as f32;
        let dx = (x - camera.cx) * camera.inv_fx;
        let inv = 1.0 / (p.n[0] * dx + nu);
        let u = (p.a[0] * dx + au) * inv;
        let v = (p.b[0] * dx + bu) * inv;
        let z = p.k * inv;
        let on_plane = u * u + v * v;
        let on_screen = ((x - p.pixel[0]) * (x - p.pixel[0]) + py) * low_pass;
        // NaN and infinities of a ray along the plane fall to the low-pass.
        let plane_wins = (on_plane <= on_screen) & (z > settings.near_m);
        let rho = if plane_wins { on_plane } else { on_screen };
        let depth = if plane_wins { z } else { p.z };
        let alpha = (p.opacity * exp_neg(0.5 * rho.min(160.0))).min(ALPHA_MAX);
        out.alpha[lane] = if alpha >= settings.alpha_min { alpha } else { 0.0 };
        out.depth[lane] = depth;
    }
    out
}

/// The camera in single precision.
#[derive(Clone, Copy)]
pub(crate) struct CameraF32 {
    pub inv_fx: f32,
    pub inv_fy: f32,
    pub cx: f32,
    pub cy: f32,
}

impl From<&Intrinsics> for CameraF32 {
    fn from(c: &Intrinsics) -> Self {
        CameraF32 {
            inv_fx: (1.0 / c.fx) as f32,
            inv_fy: (1.0 / c.fy) as f32,
            cx: c.cx as f32,
            cy: c.cy as f32,
        }
    }
}

/// Blends a tile whose first pixel is `origin`.
#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(crate) fn blend_tile(
    projected: &[Projected],
    list: &[u32],
    origin: [f32; 2],
    camera: &Intrinsics,
    settings: &RenderSettings,
    observed: Option<&ObservedTile>,
) -> TileImages {
    let camera = CameraF32::from(camera);
    let mut out = TileImages {
        color: [[0.0; LANES]; 3],
        depth: [0.0; LANES],
        depth_squared: [0.0; LANES],
        median: [0.0; LANES],
        opacity: [0.0; LANES],
        normal: [[0.0; LANES]; 3],
        near: [0.0; LANES],
        hits: 0,
    };
    let mut passing = [1.0f32; LANES];
    for (count, surfel) in list.iter().enumerate() {
        if count % 16 == 0 && passing.iter().all(|t| *t <= settings.transmittance_min) {
            break;
        }
        let p = &projected[*surfel as usize];
        // The normal that faces the camera: its plane's offset is negative.
        let facing = if p.k > 0.0 { -1.0 } else { 1.0 };
        for row in rows(p, origin[1]) {
            let hits = row_hits(p, origin[0], origin[1] + row as f32, &camera, settings);
            let base = row * TILE;
            let mut counted = 0u32;
            for lane in 0..TILE {
                let i = base + lane;
                let t = passing[i];
                let alpha = if t > settings.transmittance_min { hits.alpha[lane] } else { 0.0 };
                let depth = hits.depth[lane];
                let weight = alpha * t;
                let after = t * (1.0 - alpha);
                counted += (alpha > 0.0) as u32;
                for c in 0..3 {
                    out.color[c][i] += weight * p.color[c];
                    out.normal[c][i] += weight * facing * p.n[c];
                }
                out.depth[i] += weight * depth;
                out.depth_squared[i] += weight * depth * depth;
                out.median[i] = if (t > 0.5) & (after <= 0.5) { depth } else { out.median[i] };
                passing[i] = after;
            }
            out.hits += counted as u64;
            if let Some(observed) = observed {
                for lane in 0..TILE {
                    let i = base + lane;
                    let close = (hits.depth[lane] - observed.depth[i]).abs() <= observed.tolerance[i];
                    let seen = (hits.alpha[lane] > 0.0) & (passing[i] < 1.0);
                    out.near[i] = if close & seen { 1.0 } else { out.near[i] };
                }
            }
        }
    }
    for i in 0..LANES {
        out.opacity[i] = 1.0 - passing[i];
    }
    out
}
