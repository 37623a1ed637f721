//! Generalised ICP (Segal, Haehnel, Thrun: "Generalized-ICP", RSS 2009), plane to plane: both points of a pair are
//! free to slide along their surfaces. Uses no colour: the refiner for cameras whose brightness says nothing.

use crate::icp::{Searchable, Steps, correspondences, depth_weight};
use coma_geometry::{Matrix6, Pose, Tangent, se3};
use nalgebra::{Matrix3, Matrix3x6, Point3, Vector3};

/// Variance along a surface's normal against that along the surface (the paper's epsilon).
const NORMAL_VARIANCE: f64 = 1e-3;

/// A point of the source and its counterpart of the target.
struct Pair {
    source: Point3<f64>,
    target: Point3<f64>,
    source_normal: Vector3<f64>,
    target_normal: Vector3<f64>,
    sigma_m: f64,
}

/// Gauss-Newton at one scale. `None` if correspondences run out or the system is singular beyond damping.
pub fn refine_scale(source: &Searchable, target: &Searchable, initial: &Pose, steps: &Steps) -> Option<Pose> {
    let mut pose = *initial;
    for _ in 0..steps.iterations {
        let pairs = pairs(source, target, &pose, steps.max_correspondence_m);
        if pairs.len() < 12 {
            return None;
        }
        let rotation = *pose.rotation.to_rotation_matrix().matrix();
        let terms: Vec<(Vector3<f64>, Matrix3<f64>)> =
            pairs.iter().filter_map(|p| Some((pose * p.source - p.target, weight(p, &rotation)?))).collect();
        if terms.len() < pairs.len() {
            return None;
        }
        // Cauchy, by the median of the whitened distances.
        let mut lengths: Vec<f64> = terms.iter().map(|(d, m)| (d.transpose() * m * d)[0].sqrt()).collect();
        let middle = lengths.len() / 2;
        let whitened = lengths.clone();
        let spread = (1.4826 * *lengths.select_nth_unstable_by(middle, f64::total_cmp).1).max(1e-6);
        let (mut h, mut g) = (Matrix6::zeros(), Tangent::zeros());
        for ((pair, (offset, weight)), length) in pairs.iter().zip(&terms).zip(whitened) {
            let robust = depth_weight(pair.sigma_m) / (1.0 + (length / (2.0 * spread)).powi(2));
            // d(T exp(xi) s) = R (rho + phi x s)
            let mut jacobian = Matrix3x6::zeros();
            jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation);
            jacobian.fixed_view_mut::<3, 3>(0, 3).copy_from(&(-rotation * se3::skew(&pair.source.coords)));
            let weighted = jacobian.transpose() * weight * robust;
            h += weighted * jacobian;
            g += weighted * offset;
        }
        h += Matrix6::identity() * (1e-6 * h.trace() + 1e-12);
        let step = -h.cholesky()?.solve(&g);
        if !step.iter().all(|v| v.is_finite()) || step.norm() > 1.0 {
            return None;
        }
        pose *= se3::exp(&step);
        pose.rotation.renormalize();
        if steps.settled_by(&step) {
            break;
        }
    }
    Some(pose)
}

/// Both directions, as pairs of source and target.
fn pairs(source: &Searchable, target: &Searchable, pose: &Pose, max_distance_m: f32) -> Vec<Pair> {
    let pair = |i: usize, j: usize| {
        let (s, t) = (source.cloud(), target.cloud());
        let sigma = source.noise().sigma_m(s.points[i].z).hypot(target.noise().sigma_m(t.points[j].z));
        Pair {
            source: s.points[i].cast(),
            target: t.points[j].cast(),
            source_normal: s.normals[i].cast(),
            target_normal: t.normals[j].cast(),
            sigma_m: sigma as f64,
        }
    };
    let forward = correspondences(source, target, pose, max_distance_m);
    let backward = correspondences(target, source, &pose.inverse(), max_distance_m);
    let forward = forward.into_iter().map(|(i, j)| pair(i, j));
    forward.chain(backward.into_iter().map(|(j, i)| pair(i, j))).collect()
}

/// The paper's eq. (2): `(C_target + R C_source R^T)^-1`.
fn weight(pair: &Pair, rotation: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    let plane =
        |normal: &Vector3<f64>| Matrix3::identity() - normal * normal.transpose() * (1.0 - NORMAL_VARIANCE);
    (plane(&pair.target_normal) + plane(&(rotation * pair.source_normal))).try_inverse()
}
