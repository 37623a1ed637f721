//! The rigid motion that best maps one set of points onto another.

use crate::Pose;
use nalgebra::{Matrix3, Point3, Rotation3, Translation3, UnitQuaternion, Vector3};

/// Least-squares `target_from_source` over matched points (Kabsch 1976, Umeyama 1991 without scale).
/// `None` with fewer than 3 pairs, unequal lengths, or points that are not finite.
pub fn rigid_alignment(source: &[Point3<f64>], target: &[Point3<f64>]) -> Option<Pose> {
    if source.len() != target.len() || source.len() < 3 {
        return None;
    }
    let n = source.len() as f64;
    let mean = |points: &[Point3<f64>]| points.iter().map(|p| p.coords).sum::<Vector3<f64>>() / n;
    let (source_mean, target_mean) = (mean(source), mean(target));
    let mut cross = Matrix3::zeros();
    for (s, t) in source.iter().zip(target) {
        cross += (t.coords - target_mean) * (s.coords - source_mean).transpose();
    }
    if !cross.iter().all(|x| x.is_finite()) {
        return None;
    }
    let svd = cross.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    // Put a reflection, if any, on the direction of the least singular value.
    let mut sign = Matrix3::identity();
    if (u * v_t).determinant() < 0.0 {
        let least = svd.singular_values.imin();
        sign[(least, least)] = -1.0;
    }
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(u * sign * v_t));
    Some(Pose::from_parts(Translation3::from(target_mean - rotation * source_mean), rotation))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Tangent, se3};

    #[test]
    fn a_known_motion_is_recovered_from_flat_points() {
        let truth = se3::exp(&Tangent::new(0.3, -1.0, 2.0, 0.4, 2.0, -1.0));
        let source: Vec<_> =
            (0..20).map(|i| Point3::new(i as f64 * 0.1, ((i * 7) % 5) as f64, 0.0)).collect();
        let target: Vec<_> = source.iter().map(|p| truth * p).collect();
        let found = rigid_alignment(&source, &target).unwrap();
        let (metres, radians) = se3::distance(&truth, &found);
        assert!(metres < 1e-9 && radians < 1e-9);
    }

    #[test]
    fn two_points_are_too_few() {
        let p = [Point3::origin(), Point3::new(1.0, 0.0, 0.0)];
        assert!(rigid_alignment(&p, &p).is_none());
    }
}
