//! Point clouds: from images, averaged over voxels, with normals and intensity gradients.

use crate::neighbours::Neighbours;
use coma_frame::Image;
use coma_geometry::Intrinsics;
use nalgebra::{Matrix3, Point3, Vector3};
use rayon::prelude::*;

/// Points in the camera's frame, metres, with what is known at each. All vectors are parallel.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointCloud {
    /// Metres.
    pub points: Vec<Point3<f32>>,
    /// Unit, towards the camera; zero where the neighbourhood has no plane. Empty until estimated.
    pub normals: Vec<Vector3<f32>>,
    /// Luminance, 0..1.
    pub intensity: Vec<f32>,
    /// Change of intensity per metre along the surface (Park 2017, eq. 10). Empty until estimated.
    pub gradients: Vec<Vector3<f32>>,
}

impl PointCloud {
    /// Number of points.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// True without points.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// Every measured pixel that is not at a depth jump (relative, against its four neighbours), row by row.
    /// Images and camera have one size.
    pub fn from_images(depth_m: &Image<f32>, intensity: &Image<f32>, camera: &Intrinsics, jump: f32) -> Self {
        let mut cloud = PointCloud::default();
        let (width, height) = (depth_m.width(), depth_m.height());
        for y in 0..height {
            for x in 0..width {
                let z = depth_m[(x, y)];
                if !(z > 0.0 && z.is_finite()) {
                    continue;
                }
                let neighbours = [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)];
                let limit = jump * z;
                let smooth = neighbours.iter().all(|&(nx, ny)| match depth_m.get(nx, ny) {
                    Some(n) if *n > 0.0 => (n - z).abs() <= limit,
                    _ => true,
                });
                if smooth {
                    let p = camera.back_project(x as f64, y as f64, z as f64);
                    cloud.points.push(p.cast::<f32>());
                    cloud.intensity.push(intensity[(x, y)]);
                }
            }
        }
        cloud
    }

    /// One point per occupied voxel: the mean of its points and intensities, in the order of the voxels
    /// (z, then y, then x). Normals and gradients are not carried over.
    pub fn voxel_downsample(&self, voxel_m: f32) -> PointCloud {
        let mut order: Vec<(u64, u32)> =
            self.points.iter().enumerate().map(|(i, p)| (voxel(p, voxel_m), i as u32)).collect();
        order.sort_unstable();
        let mut out = PointCloud::default();
        for voxel in order.chunk_by(|a, b| a.0 == b.0) {
            let (mut sum, mut intensity) = (Vector3::<f64>::zeros(), 0.0f64);
            for &(_, i) in voxel {
                sum += self.points[i as usize].coords.cast::<f64>();
                intensity += self.intensity[i as usize] as f64;
            }
            let n = voxel.len() as f64;
            out.points.push(Point3::from((sum / n).cast::<f32>()));
            out.intensity.push((intensity / n) as f32);
        }
        out
    }

    /// Estimates normals (least principal direction of up to `count` neighbours within `radius_m`) and
    /// intensity gradients along the surface. The camera is at the origin.
    pub fn estimate_surfaces(&mut self, radius_m: f32, count: usize) {
        let tree = Neighbours::new(&self.points);
        let (points, intensity) = (&self.points, &self.intensity);
        let surfaces: Vec<(Vector3<f32>, Vector3<f32>)> = (0..points.len())
            .into_par_iter()
            .map(|i| {
                let near = tree.within(&points[i], radius_m, count);
                surface(points, intensity, i, &near)
            })
            .collect();
        (self.normals, self.gradients) = surfaces.into_iter().unzip();
    }
}

/// The voxel that holds a point, as one number: in the order of z, then y, then x.
pub(crate) fn voxel(point: &Point3<f32>, voxel_m: f32) -> u64 {
    let cell = |v: f32| ((v / voxel_m).floor() as i64 + (1 << 20)).clamp(0, (1 << 21) - 1) as u64;
    cell(point.z) << 42 | cell(point.y) << 21 | cell(point.x)
}

/// Normal and intensity gradient of point `i` from its neighbours; zeros where they span no plane.
fn surface(
    points: &[Point3<f32>],
    intensity: &[f32],
    i: usize,
    near: &[(usize, f32)],
) -> (Vector3<f32>, Vector3<f32>) {
    let none = (Vector3::zeros(), Vector3::zeros());
    if near.len() < 5 {
        return none;
    }
    let n = near.len() as f32;
    // Relative to the point itself, so that f32 suffices.
    let mean = near.iter().map(|&(j, _)| points[j] - points[i]).sum::<Vector3<f32>>() / n;
    let mut covariance = Matrix3::<f32>::zeros();
    for &(j, _) in near {
        let d = points[j] - points[i] - mean;
        covariance.syger(1.0, &d, &d, 1.0);
    }
    covariance.fill_upper_triangle_with_lower_triangle();
    let Some(normal) = least_direction(&covariance) else { return none };
    let normal = if normal.dot(&points[i].coords) > 0.0 { -normal } else { normal };
    // Park 2017, eq. (10): least squares over the tangent plane, with the constraint d . n = 0.
    let mut a = Matrix3::<f32>::zeros();
    let mut b = Vector3::<f32>::zeros();
    let mut spread = 0.0;
    for &(j, _) in near {
        let d = points[j] - points[i];
        let u = d - normal * normal.dot(&d);
        a.syger(1.0, &u, &u, 1.0);
        b += u * (intensity[j] - intensity[i]);
        spread += u.norm_squared();
    }
    a.fill_upper_triangle_with_lower_triangle();
    a += normal * normal.transpose() * spread + Matrix3::identity() * (1e-3 * spread);
    let gradient = a.cholesky().map(|c| c.solve(&b)).unwrap_or_else(Vector3::zeros);
    (normal, gradient - normal * normal.dot(&gradient))
}

/// Unit eigenvector of the least eigenvalue of a symmetric, positive semidefinite matrix; `None` where the
/// points form a line or one point. Closed form (Smith 1961) in f64.
fn least_direction(covariance: &Matrix3<f32>) -> Option<Vector3<f32>> {
    let m = covariance.cast::<f64>();
    let trace = m.trace();
    if !(trace > 0.0 && trace.is_finite()) {
        return None;
    }
    let q = trace / 3.0;
    let b = m - Matrix3::identity() * q;
    let p = ((b * b).trace() / 6.0).sqrt();
    if !(p > 1e-9 * q) {
        return None;
    }
    let half_det = ((b / p).determinant() / 2.0).clamp(-1.0, 1.0);
    let angle = half_det.acos() / 3.0;
    let least = q + 2.0 * p * (angle + 2.0 * std::f64::consts::FRAC_PI_3).cos();
    let greatest = q + 2.0 * p * angle.cos();
    let middle = trace - least - greatest;
    if !(middle > 0.01 * greatest) {
        return None;
    }
    let s = m - Matrix3::identity() * least;
    let rows = [s.row(0).transpose(), s.row(1).transpose(), s.row(2).transpose()];
    let crosses = [rows[0].cross(&rows[1]), rows[1].cross(&rows[2]), rows[2].cross(&rows[0])];
    let best = crosses
        .iter()
        .copied()
        .fold(Vector3::zeros(), |a: Vector3<f64>, c| if c.norm_squared() > a.norm_squared() { c } else { a });
    best.try_normalize(1e-300).map(|v| v.cast::<f32>())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A tilted plane, z = 2 + 0.3 x, whose intensity grows by 0.5 per metre along x in the image plane.
    fn tilted() -> PointCloud {
        let mut cloud = PointCloud::default();
        for i in 0..2500 {
            let (x, y) = ((i % 50) as f32 * 0.02 - 0.5, (i / 50) as f32 * 0.02 - 0.5);
            cloud.points.push(Point3::new(x, y, 2.0 + 0.3 * x));
            cloud.intensity.push(0.5 + 0.5 * x);
        }
        cloud
    }

    #[test]
    fn normals_face_the_camera_and_gradients_lie_in_the_surface() {
        let mut cloud = tilted();
        cloud.estimate_surfaces(0.06, 30);
        let expected = Vector3::new(0.3f32, 0.0, -1.0).normalize();
        // Per metre along the surface: 0.5 per metre of x, which is sqrt(1.09) of surface.
        let along = Vector3::new(1.0f32, 0.0, 0.3).normalize() * (0.5 / 1.09f32.sqrt());
        let i = 25 * 50 + 25;
        assert!((cloud.normals[i] - expected).norm() < 1e-3, "{:?}", cloud.normals[i]);
        assert!((cloud.gradients[i] - along).norm() < 0.01, "{:?}", cloud.gradients[i]);
    }

    #[test]
    fn a_voxel_holds_the_mean_of_its_points_and_the_order_of_input_does_not_matter() {
        let cloud = tilted();
        let mut reversed = cloud.clone();
        reversed.points.reverse();
        reversed.intensity.reverse();
        let (a, b) = (cloud.voxel_downsample(0.1), reversed.voxel_downsample(0.1));
        assert!(a.len() > 90 && a.len() < 200, "{}", a.len());
        assert_eq!(a.len(), b.len());
        assert!(a.points.iter().zip(&b.points).all(|(p, q)| (p - q).norm() < 1e-5));
        let one = PointCloud {
            points: vec![Point3::new(0.01, 0.01, 1.01), Point3::new(0.03, 0.03, 1.03)],
            intensity: vec![0.2, 0.4],
            ..Default::default()
        };
        let mean = one.voxel_downsample(0.1);
        assert!((mean.points[0] - Point3::new(0.02, 0.02, 1.02)).norm() < 1e-6);
        assert!((mean.intensity[0] - 0.3).abs() < 1e-6);
    }

    #[test]
    fn points_on_a_line_have_no_normal() {
        let mut line = PointCloud {
            points: (0..50).map(|i| Point3::new(i as f32 * 0.01, 0.0, 1.0)).collect(),
            intensity: vec![0.0; 50],
            ..Default::default()
        };
        line.estimate_surfaces(0.1, 30);
        assert!(line.normals.iter().all(|n| *n == Vector3::zeros()));
    }
}
