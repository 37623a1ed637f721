//! An information matrix that can be believed, and whether the shared scene pins the motion at all.
//!
//! The raw Hessian of 10^4 residuals claims a tenth of a millimetre, because neighbouring residuals err
//! together. So: residuals within one small image block count as one sample; directions that the scene hardly
//! pins are inflated; what large blocks disagree about is added (distorted depth, rolling shutter and a lens that
//! is a little off bend each part of the image its own way, and do not average out); and no standard deviation
//! falls below a floor.

use crate::icp::{Residual, Scales};
use crate::settings::Settings;
use coma_geometry::{Intrinsics, Matrix6, Tangent, se3};
use nalgebra::{Matrix3, SymmetricEigen, Vector3};
use std::collections::{BTreeMap, BTreeSet};

/// How well a set of residuals pins each direction of motion.
#[derive(Clone, Debug)]
pub struct Observability {
    /// Eigenvalues over the largest one, in the order of `directions`.
    ratios: nalgebra::Vector6<f64>,
    /// Eigenvectors (columns) in centred coordinates.
    directions: Matrix6,
    /// Centred coordinates of a tangent: `(rho + phi x c, radius phi)`: translation of the points' centre and
    /// the arc that the rotation moves a point at their radius.
    centred_from_tangent: Matrix6,
}

impl Observability {
    /// From linearised residuals; `None` without any, or if they say nothing.
    pub fn new(residuals: &[Residual], settings: &Settings) -> Option<Self> {
        if residuals.is_empty() {
            return None;
        }
        let n = residuals.len() as f64;
        let centre = residuals.iter().map(|r| r.source.coords).sum::<Vector3<f64>>() / n;
        let radius =
            (residuals.iter().map(|r| (r.source.coords - centre).norm_squared()).sum::<f64>() / n).sqrt();
        if !(radius > 1e-3 && radius.is_finite()) {
            return None;
        }
        let scales = Scales::of(residuals);
        let mut h = Matrix6::zeros();
        for r in residuals {
            let (wg, wp) = scales.shares(r, settings);
            h.syger(wg, &r.geometric_row, &r.geometric_row, 1.0);
            h.syger(wp, &r.photometric_row, &r.photometric_row, 1.0);
        }
        h.fill_upper_triangle_with_lower_triangle();
        let mut centred_from_tangent = Matrix6::identity();
        centred_from_tangent.fixed_view_mut::<3, 3>(0, 3).copy_from(&-se3::skew(&centre));
        centred_from_tangent.fixed_view_mut::<3, 3>(3, 3).copy_from(&(Matrix3::identity() * radius));
        let back = centred_from_tangent.try_inverse()?;
        let eigen = SymmetricEigen::new(back.transpose() * h * back);
        let largest = eigen.eigenvalues.max();
        if !(largest > 0.0 && largest.is_finite()) {
            return None;
        }
        Some(Observability {
            ratios: eigen.eigenvalues.map(|v| (v / largest).max(0.0)),
            directions: eigen.eigenvectors,
            centred_from_tangent,
        })
    }

    /// Smallest over largest eigenvalue.
    pub fn ratio(&self) -> f64 {
        self.ratios.min()
    }
}

/// How far the motion would move if both focal lengths were longer, per unit of their logarithm: the Gauss-Newton
/// step that the change of the residuals asks for. `None` if they do not pin the motion.
pub fn focal_sensitivity(residuals: &[Residual], settings: &Settings) -> Option<Tangent> {
    let scales = Scales::of(residuals);
    let (mut h, mut g) = (Matrix6::zeros(), Tangent::zeros());
    for r in residuals {
        let (wg, wp) = scales.motion_weights(r, settings);
        h.syger(wg, &r.geometric_row, &r.geometric_row, 1.0);
        h.syger(wp, &r.photometric_row, &r.photometric_row, 1.0);
        g += r.geometric_row * (wg * r.by_focal.0) + r.photometric_row * (wp * r.by_focal.1);
    }
    h.fill_upper_triangle_with_lower_triangle();
    Some(-h.cholesky()?.solve(&g))
}

/// Information of `target_from_source` (right perturbation) from the residuals of the finest scale, and the
/// number of independent samples it stands for. `None` if the result is not positive definite.
pub fn information(
    residuals: &[Residual],
    observability: &Observability,
    source_camera: &Intrinsics,
    settings: &Settings,
) -> Option<(Matrix6, usize)> {
    let scales = Scales::of(residuals);
    let mut h = Matrix6::zeros();
    let mut blocks = BTreeSet::new();
    let block_px = (source_camera.width as f64 / settings.blocks_across.max(1) as f64).max(1.0);
    for r in residuals {
        let (wg, wp) = scales.weights(r);
        h.syger(wg / (scales.geometric * r.sigma_m).powi(2), &r.geometric_row, &r.geometric_row, 1.0);
        h.syger(wp / scales.photometric.powi(2), &r.photometric_row, &r.photometric_row, 1.0);
        if let Some(pixel) = source_camera.project(&r.source) {
            blocks.insert(((pixel.x / block_px).floor() as i64, (pixel.y / block_px).floor() as i64));
        }
    }
    h.fill_upper_triangle_with_lower_triangle();
    let samples = blocks.len();
    h *= samples as f64 / residuals.len().max(1) as f64;
    // Inflate along weak directions, in centred coordinates: I' = S I S, S = V diag(1 / sqrt(f)) V^T.
    let forth = observability.centred_from_tangent;
    let back = forth.try_inverse()?;
    let shrink = observability.ratios.map(|ratio| (ratio / settings.weak_ratio).clamp(1e-6, 1.0).sqrt());
    let s = observability.directions * Matrix6::from_diagonal(&shrink) * observability.directions.transpose();
    let inflated = forth.transpose() * s * back.transpose() * h * back * s * forth;
    // Added to the covariance: errors that do not average out are independent of the rest.
    let mut covariance = symmetric(&inflated).cholesky()?.inverse();
    let regional = Regional::of(residuals, &scales, source_camera, settings)?;
    for i in 0..3 {
        covariance[(i, i)] += regional.variance_m2 + settings.floor_m.powi(2);
        covariance[(i + 3, i + 3)] += regional.variance_rad2 + settings.floor_rad.powi(2);
    }
    let information = symmetric(&covariance).cholesky()?.inverse();
    Some((symmetric(&information), samples))
}

/// How far the motion would move if it followed one part of the image or another.
struct Regional {
    variance_m2: f64,
    variance_rad2: f64,
}

impl Regional {
    /// The covariance of an estimator whose residuals err together within a block (the cluster-robust "sandwich"
    /// H^-1 (sum over blocks of g g^T) H^-1; Liang & Zeger 1986), with the weights that the motion was found
    /// with. A dozen blocks tell how much, but hardly in which direction: the mean over the axes counts for each.
    fn of(residuals: &[Residual], scales: &Scales, camera: &Intrinsics, settings: &Settings) -> Option<Self> {
        let block_px = (camera.width as f64 / settings.regions_across.max(1) as f64).max(1.0);
        let mut h = Matrix6::zeros();
        let mut gradients: BTreeMap<(i64, i64), Tangent> = BTreeMap::new();
        for r in residuals {
            let (wg, wp) = scales.motion_weights(r, settings);
            h.syger(wg, &r.geometric_row, &r.geometric_row, 1.0);
            h.syger(wp, &r.photometric_row, &r.photometric_row, 1.0);
            if let Some(pixel) = camera.project(&r.source) {
                let block = ((pixel.x / block_px).floor() as i64, (pixel.y / block_px).floor() as i64);
                *gradients.entry(block).or_insert_with(Tangent::zeros) +=
                    r.geometric_row * (wg * r.geometric_m) + r.photometric_row * (wp * r.photometric);
            }
        }
        h.fill_upper_triangle_with_lower_triangle();
        let outer: Matrix6 = gradients.values().map(|g| g * g.transpose()).sum();
        // The six parameters were fitted to the same blocks.
        let blocks = gradients.len() as f64;
        let inverse = h.cholesky()?.inverse();
        let covariance = inverse * outer * inverse * (blocks / (blocks - 6.0).max(1.0));
        let mean = |first: usize| {
            let trace: f64 = (first..first + 3).map(|i| covariance[(i, i)]).sum();
            settings.regional_scale.powi(2) * trace / 3.0
        };
        Some(Regional { variance_m2: mean(0), variance_rad2: mean(3) })
    }
}

fn symmetric(m: &Matrix6) -> Matrix6 {
    (m + m.transpose()) * 0.5
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;

    const CAMERA: Intrinsics =
        Intrinsics { width: 320, height: 240, fx: 262.0, fy: 262.0, cx: 160.0, cy: 120.0 };

    /// Point-to-plane residuals of points on planes with the given normals.
    fn planes(normals: &[Vector3<f64>], per_plane: usize) -> Vec<Residual> {
        let mut out = Vec::new();
        for n in normals {
            for i in 0..per_plane {
                let (x, y) = ((i % 20) as f64 * 0.1 - 1.0, ((i / 20) % 20) as f64 * 0.08 - 0.8);
                let source = Point3::new(x, y, 2.0 + 0.3 * (x * y));
                let cross = source.coords.cross(n);
                out.push(Residual {
                    source,
                    geometric_m: 0.003 * ((i % 7) as f64 - 3.0),
                    geometric_row: coma_geometry::Tangent::new(n.x, n.y, n.z, cross.x, cross.y, cross.z),
                    photometric: 0.0,
                    photometric_row: coma_geometry::Tangent::zeros(),
                    sigma_m: 0.01,
                    by_focal: (0.0, 0.0),
                });
            }
        }
        out
    }

    #[test]
    fn one_plane_and_two_planes_do_not_pin_the_motion_and_three_do() {
        let settings = Settings::default();
        let ratio = |n: &[Vector3<f64>]| Observability::new(&planes(n, 400), &settings).unwrap().ratio();
        assert!(ratio(&[Vector3::z()]) < 1e-9);
        assert!(ratio(&[Vector3::z(), Vector3::x()]) < 1e-9);
        assert!(ratio(&[Vector3::z(), Vector3::x(), Vector3::y()]) > 0.05);
    }

    #[test]
    fn no_standard_deviation_falls_below_the_floor_and_repeating_residuals_adds_nothing() {
        let settings = Settings::default();
        let axes = [Vector3::z(), Vector3::x(), Vector3::y()];
        let of = |residuals: &[Residual]| {
            let seen = Observability::new(residuals, &settings).unwrap();
            information(residuals, &seen, &CAMERA, &settings).unwrap()
        };
        let once = planes(&axes, 400);
        let (a, samples) = of(&once);
        let covariance = a.try_inverse().unwrap();
        for i in 0..3 {
            assert!(
                covariance[(i, i)].sqrt() >= settings.floor_m && covariance[(i, i)].sqrt() < 0.02,
                "{covariance}"
            );
            assert!(covariance[(i + 3, i + 3)].sqrt() >= settings.floor_rad);
        }
        let tenfold: Vec<Residual> = (0..10).flat_map(|_| once.clone()).collect();
        let (b, same_samples) = of(&tenfold);
        assert_eq!(samples, same_samples);
        assert!((a - b).norm() < 1e-6 * a.norm());
    }

    #[test]
    fn a_part_of_the_image_that_pulls_elsewhere_lowers_the_information() {
        let settings = Settings::default();
        let axes = [Vector3::z(), Vector3::x(), Vector3::y()];
        let deviation_m = |residuals: &[Residual]| {
            let seen = Observability::new(residuals, &settings).unwrap();
            let (information, _) = information(residuals, &seen, &CAMERA, &settings).unwrap();
            (information.try_inverse().unwrap().fixed_view::<3, 3>(0, 0).trace() / 3.0).sqrt()
        };
        let even = planes(&axes, 400);
        let mut bent = even.clone();
        // The same spread of residuals, but the left half lies behind and the right half before.
        for r in &mut bent {
            r.geometric_m = r.geometric_m.abs() * r.source.x.signum();
        }
        let (even_m, bent_m) = (deviation_m(&even), deviation_m(&bent));
        assert!(bent_m > 1.5 * even_m, "{even_m} and {bent_m}");
    }
}
