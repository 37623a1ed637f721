//! The chain rule from what is projected back to the surfels' own parameters.

use crate::SubmapView;
use crate::backward::{Gradients, SurfelGradients};
use crate::forward::RenderState;
use crate::gradient::{Named, Sums};
use crate::project::{CameraFromSubmap, InCamera, Projected};
use coma_geometry::{Intrinsics, Tangent};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

/// Surfels of one task.
const CHUNK: usize = 2048;

/// `totals` is by rank.
pub(crate) fn to_parameters(
    submaps: &[SubmapView<'_>],
    camera: &Intrinsics,
    state: &RenderState,
    totals: &[Sums],
) -> Gradients {
    let surfels = submaps.iter().map(|view| view.surfels.len()).sum::<usize>();
    assert_eq!(surfels, state.projected.len(), "the submaps are those that were rendered");
    let mut ranks = vec![HIDDEN; state.projected.len()];
    for (rank, slot) in state.order.iter().enumerate() {
        ranks[*slot as usize] = rank as u32;
    }
    let mut pose = Tangent::zeros();
    let mut first_slot = 0;
    let mut out = Vec::with_capacity(submaps.len());
    for view in submaps {
        let slots = first_slot..first_slot + view.surfels.len();
        first_slot = slots.end;
        let part = Submap {
            view,
            camera,
            camera_from_submap: CameraFromSubmap::from(view),
            submap_from_camera: *view
                .camera_from_submap
                .rotation
                .inverse()
                .cast::<f32>()
                .to_rotation_matrix()
                .matrix(),
            projected: &state.projected[slots.clone()],
            ranks: &ranks[slots],
            totals,
        };
        let (gradients, turn) = part.gradients();
        pose += turn;
        out.push(gradients);
    }
    Gradients { submaps: out, pose }
}

/// The rank of a surfel that is not visible.
const HIDDEN: u32 = u32::MAX;

struct Submap<'a> {
    view: &'a SubmapView<'a>,
    camera: &'a Intrinsics,
    camera_from_submap: CameraFromSubmap,
    submap_from_camera: Matrix3<f32>,
    projected: &'a [Projected],
    ranks: &'a [u32],
    totals: &'a [Sums],
}

impl Submap<'_> {
    /// Of the surfels, and their share of the pose's: chunks are added up in their order.
    fn gradients(&self) -> (SurfelGradients, Tangent) {
        let n = self.ranks.len();
        let mut out = SurfelGradients {
            center_m: vec![[0.0; 3]; n],
            rotation: vec![[0.0; 3]; n],
            scale_m: vec![[0.0; 2]; n],
            opacity: vec![0.0; n],
            color: vec![[0.0; 3]; n],
        };
        let poses: Vec<Tangent> = (
            out.center_m.par_chunks_mut(CHUNK),
            out.rotation.par_chunks_mut(CHUNK),
            out.scale_m.par_chunks_mut(CHUNK),
            out.opacity.par_chunks_mut(CHUNK),
            out.color.par_chunks_mut(CHUNK),
        )
            .into_par_iter()
            .enumerate()
            .map(|(chunk, (center, rotation, scale, opacity, color))| {
                let mut pose = Tangent::zeros();
                let ranks = &self.ranks[chunk * CHUNK..];
                // Fetched in a loop of its own: its cache misses overlap.
                let fetch = |rank: &u32| self.totals.get(*rank as usize).copied();
                let totals: Vec<Option<Sums>> = ranks[..center.len()].iter().map(fetch).collect();
                for (i, sums) in totals.iter().enumerate() {
                    let Some(sums) = sums else { continue };
                    let sums = sums.named(&self.projected[chunk * CHUNK + i]);
                    let one = self.one(chunk * CHUNK + i, &sums);
                    center[i] = (self.submap_from_camera * one.center).into();
                    rotation[i] = one.rotation;
                    scale[i] = one.scale;
                    opacity[i] = sums.opacity;
                    color[i] = sums.color;
                    for axis in 0..3 {
                        // The pose moves everything by exp(-xi): d c = -(rho + phi x c), d e = -phi x e.
                        pose[axis] -= one.center[axis] as f64;
                        pose[3 + axis] -= one.turn[axis] as f64;
                    }
                }
                pose
            })
            .collect();
        (out, poses.iter().sum())
    }

    fn one(&self, index: usize, g: &Named) -> OneSurfel {
        let p = &self.projected[index];
        let s = InCamera::of(self.view, &self.camera_from_submap, index);
        let (fx, fy) = (self.camera.fx as f32, self.camera.fy as f32);
        let (e1, e2, n): (Vector3<f32>, Vector3<f32>, Vector3<f32>) =
            (s.axes.column(0).into(), s.axes.column(1).into(), s.axes.column(2).into());
        let c = s.center;
        let mut by_n = Vector3::from(g.n);
        let mut by_k = g.k;
        // a = (e1 k - n (e1 . c)) / s1, b likewise.
        let (qa, qb) = (Vector3::from(g.a) / s.scale[0], Vector3::from(g.b) / s.scale[1]);
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
        let scale = [-qa.dot(&Vector3::from(p.a)), -qb.dot(&Vector3::from(p.b))];
        // k = n . c
        by_n += c * by_k;
        by_center += n * by_k;
        // Centre pixel and depth.
        let (px, py) = (g.pixel[0] * fx / c.z, g.pixel[1] * fy / c.z);
        by_center += Vector3::new(px, py, g.z - (px * c.x + py * c.y) / c.z);
        // Turning the disc about its own axes by w: d e1 = e2 w3 - n w2, d e2 = n w1 - e1 w3, d n = e1 w2 - e2 w1.
        let rotation =
            [by_e2.dot(&n) - by_n.dot(&e2), by_n.dot(&e1) - by_e1.dot(&n), by_e1.dot(&e2) - by_e2.dot(&e1)];
        let turn = c.cross(&by_center) + e1.cross(&by_e1) + e2.cross(&by_e2) + n.cross(&by_n);
        OneSurfel { center: by_center, rotation, scale, turn }
    }
}

/// Derivatives of one surfel.
struct OneSurfel {
    /// By the centre, in the camera.
    center: Vector3<f32>,
    rotation: [f32; 3],
    scale: [f32; 2],
    /// By a rotation of everything about the camera.
    turn: Vector3<f32>,
}
