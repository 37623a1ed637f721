//! Fast Point Feature Histograms (Rusu, Blodow, Beetz: "Fast Point Feature Histograms (FPFH) for 3D
//! Registration", ICRA 2009).

use crate::cloud::PointCloud;
use crate::neighbours::Neighbours;
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

/// Three angles of 11 bins each.
pub const BINS: usize = 33;
/// [`BINS`], filled up with zeros to whole SIMD lanes.
pub const STRIDE: usize = 40;
/// A histogram; each of its three parts sums to 200 (or 0 where the point has no neighbours).
pub type Feature = [f32; STRIDE];

/// One feature per point of a cloud that has normals. Points without a normal get a zero feature.
pub fn features(cloud: &PointCloud, radius_m: f32, neighbours: usize) -> Vec<Feature> {
    let tree = Neighbours::new(&cloud.points);
    let near: Vec<Vec<(usize, f32)>> = cloud
        .points
        .par_iter()
        .map(|p| {
            let mut near = tree.within(p, radius_m, neighbours);
            near.retain(|&(j, d2)| d2 > 0.0 && cloud.normals[j] != Vector3::zeros());
            near
        })
        .collect();
    let simple: Vec<Feature> = (0..cloud.len()).into_par_iter().map(|i| spfh(cloud, i, &near[i])).collect();
    (0..cloud.len())
        .into_par_iter()
        .map(|i| {
            let mut out = [0.0f32; STRIDE];
            if cloud.normals[i] == Vector3::zeros() {
                return out;
            }
            // FPFH(p) = SPFH(p) + 1/k sum_k SPFH(p_k) / w_k; the sum is normalised to 100 per angle, as in
            // PCL and Open3D, so that density does not matter.
            for &(j, d2) in &near[i] {
                for b in 0..BINS {
                    out[b] += simple[j][b] / d2;
                }
            }
            for part in 0..3 {
                let bins = &mut out[part * 11..part * 11 + 11];
                let sum: f32 = bins.iter().sum();
                if sum > 0.0 {
                    bins.iter_mut().for_each(|v| *v *= 100.0 / sum);
                }
            }
            for b in 0..BINS {
                out[b] += simple[i][b];
            }
            out
        })
        .collect()
}

/// Simplified histogram of one point against its neighbours; each part sums to 100.
fn spfh(cloud: &PointCloud, i: usize, near: &[(usize, f32)]) -> Feature {
    let mut out = [0.0f32; STRIDE];
    if cloud.normals[i] == Vector3::zeros() || near.is_empty() {
        return out;
    }
    let share = 100.0 / near.len() as f32;
    for &(j, _) in near {
        let Some(angles) =
            pair_angles(&cloud.points[i], &cloud.normals[i], &cloud.points[j], &cloud.normals[j])
        else {
            continue;
        };
        for (part, unit) in angles.into_iter().enumerate() {
            let bin = ((unit * 11.0) as usize).min(10);
            out[part * 11 + bin] += share;
        }
    }
    out
}

/// The three angles of a pair in its Darboux frame, each mapped to 0..1: theta, alpha, phi.
fn pair_angles(p1: &Point3<f32>, n1: &Vector3<f32>, p2: &Point3<f32>, n2: &Vector3<f32>) -> Option<[f32; 3]> {
    let line = (p2 - p1).try_normalize(1e-12)?;
    // The point whose normal makes the smaller angle with the line is the frame's source.
    let (angle1, angle2) = (n1.dot(&line), n2.dot(&line));
    let (u, other, line, phi) =
        if angle1.abs() < angle2.abs() { (n2, n1, -line, -angle2) } else { (n1, n2, line, angle1) };
    let v = line.cross(u).try_normalize(1e-6)?;
    let w = u.cross(&v);
    let alpha = v.dot(other);
    let theta = w.dot(other).atan2(u.dot(other));
    Some([
        (theta + std::f32::consts::PI) / (2.0 * std::f32::consts::PI),
        (alpha + 1.0) * 0.5,
        (phi + 1.0) * 0.5,
    ])
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Isometry3, Translation3, UnitQuaternion};

    fn bumpy() -> PointCloud {
        let mut cloud = PointCloud::default();
        for i in 0..900 {
            let (x, y) = ((i % 30) as f32 * 0.05, (i / 30) as f32 * 0.05);
            let z = 2.0 + 0.2 * (4.0 * x).sin() * (3.0 * y).cos() + 0.1 * x * y;
            cloud.points.push(Point3::new(x - 0.7, y - 0.7, z));
            cloud.intensity.push(0.5);
        }
        cloud.estimate_surfaces(0.12, 30);
        cloud
    }

    #[test]
    fn a_rigid_motion_leaves_features_as_they_are() {
        let cloud = bumpy();
        let motion = Isometry3::from_parts(
            Translation3::new(0.4f32, -0.2, 0.3),
            UnitQuaternion::from_euler_angles(0.2, 0.3, -0.5),
        );
        let mut moved = cloud.clone();
        moved.points.iter_mut().for_each(|p| *p = motion * *p);
        moved.normals.iter_mut().for_each(|n| *n = motion * *n);
        let (a, b) = (features(&cloud, 0.25, 200), features(&moved, 0.25, 200));
        // Rounding may carry a pair over the edge of a bin.
        let mean: f32 =
            a.iter().zip(&b).map(|(a, b)| (0..BINS).map(|k| (a[k] - b[k]).abs()).sum::<f32>()).sum::<f32>()
                / a.len() as f32;
        assert!(mean < 5.0, "{mean}");
    }

    #[test]
    fn each_angle_s_histogram_sums_to_two_hundred() {
        let f = features(&bumpy(), 0.25, 100);
        for part in 0..3 {
            let sum: f32 = f[450][part * 11..part * 11 + 11].iter().sum();
            assert!((sum - 200.0).abs() < 1.0, "{sum}");
        }
    }
}
