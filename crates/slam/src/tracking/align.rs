//! Dense RGB-D alignment by Gauss-Newton: projective point-to-plane and photometric residuals, robust
//! weights, and a brightness gain beside them.
//!
//! Park, Zhou, Koltun, "Colored point cloud registration revisited" (2017) for the joint objective;
//! Kerl, Sturm, Cremers, "Dense visual SLAM for RGB-D cameras" (2013) for weights by residual scale.

use super::rows::{self, Matches, Weights};
use super::view::{Level, TrackingView};
use coma_frame::DepthNoise;
use coma_geometry::{Matrix6, Pose, Tangent, se3};
use nalgebra::Vector3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// How two pictures are aligned.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AlignSettings {
    /// Gauss-Newton steps per level, from coarse to fine; as many levels as numbers.
    pub steps: Vec<usize>,
    /// A step shorter than this, metres and radians alike, is the last of its level.
    pub settled: f64,
    /// Only every n-th pixel of the finest level is used, in both directions.
    pub finest_stride: usize,
    /// Points farther apart than this many sigma(z) plus `max_distance_m` are no match.
    pub max_distance_sigma: f32,
    /// See `max_distance_sigma`; doubled at every coarser level.
    pub max_distance_m: f32,
    /// Weight of a photometric residual against a geometric one, each in units of its own scale.
    pub photometric_weight: f32,
    /// Smallest photometric scale, intensity 0..1: sensor noise and rounding.
    pub min_photometric_scale: f32,
    /// Smallest geometric scale, in units of sigma(z): what a clean sensor's depth is good to. A larger one lets bent
    /// surfaces and edges, where discs are a poor picture, count as much as walls.
    pub min_geometric_scale: f32,
    /// Residuals in units of their scale follow a t-distribution with so many degrees of freedom: the fewer, the less
    /// those count that don't fit.
    pub freedom: f32,
    /// How far the motion may be from the initial guess, metres (one standard deviation): holds directions
    /// that the pictures say nothing of.
    pub prior_m: f64,
    /// See `prior_m`, radians.
    pub prior_rad: f64,
}

impl Default for AlignSettings {
    fn default() -> Self {
        AlignSettings {
            steps: vec![8, 6],
            settled: 2e-4,
            finest_stride: 1,
            max_distance_sigma: 8.0,
            max_distance_m: 0.06,
            photometric_weight: 1.2,
            min_photometric_scale: 0.008,
            min_geometric_scale: 0.02,
            freedom: 5.0,
            prior_m: 0.05,
            prior_rad: 0.05,
        }
    }
}

/// Brightness of the reference as a function of the picture's: `gain * intensity`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Brightness {
    /// Factor.
    pub gain: f64,
}

impl Brightness {
    /// Nearer to 1 by this share of the distance.
    pub fn relaxed(self, share: f64) -> Brightness {
        Brightness { gain: self.gain + share * (1.0 - self.gain) }
    }
}

impl Default for Brightness {
    fn default() -> Self {
        Brightness { gain: 1.0 }
    }
}

/// What an alignment found, on its finest level.
#[derive(Clone, Debug)]
pub struct Alignment {
    /// The motion.
    pub reference_from_camera: Pose,
    /// Brightness change.
    pub brightness: Brightness,
    /// Gauss-Newton Hessian of the pose in units of the residuals' scales, perturbed on the right, of
    /// correlated pixels: see [`Alignment::covariance`].
    pub hessian: Matrix6,
    /// Pixels with depth that were looked at.
    pub pixels: usize,
    /// Those that should be seen in the reference: it has a surface in their direction.
    pub overlap: usize,
    /// Those that found a partner.
    pub matched: usize,
    /// Those whose point-to-plane residual is within 3 scales or 1 % of the depth.
    pub inliers: usize,
    /// Those of them that look like their partner.
    pub alike: usize,
    /// Robust scale of the geometric residuals, in units of sigma(z), however small.
    pub geometric_scale: f64,
    /// Robust scale of the photometric residuals.
    pub photometric_scale: f64,
    /// Median size of the geometric residuals, metres.
    pub median_distance_m: f64,
}

impl Alignment {
    /// Share of the pixels with depth that fit.
    pub fn inlier_share(&self) -> f64 {
        self.inliers as f64 / self.pixels.max(1) as f64
    }

    /// Share of what both see that fits and looks alike. Low where a motion is a false one, however much of the picture is new.
    pub fn agreement(&self) -> f64 {
        self.alike as f64 / self.overlap.max(1) as f64
    }

    /// Covariance of the motion, perturbed on the right: the inverse Hessian with one effective sample per
    /// [`CORRELATED_PIXELS`] residuals, and a floor.
    pub fn covariance(&self, floor_m: f64, floor_rad: f64) -> Matrix6 {
        let mut information = self.hessian / CORRELATED_PIXELS;
        for i in 0..6 {
            information[(i, i)] += 1e-6;
        }
        let mut covariance = information.try_inverse().unwrap_or_else(|| Matrix6::identity() * 1e6);
        for i in 0..6 {
            let floor = if i < 3 { floor_m } else { floor_rad };
            covariance[(i, i)] += floor * floor;
        }
        (covariance + covariance.transpose()) * 0.5
    }
}

/// Aligns `view` to `reference`, from coarse to fine. `None` where too few pixels match to say anything.
pub fn align(
    reference: &TrackingView,
    view: &TrackingView,
    initial_reference_from_camera: &Pose,
    initial_brightness: Brightness,
    settings: &AlignSettings,
) -> Option<Alignment> {
    let mut pose = *initial_reference_from_camera;
    let mut brightness = initial_brightness;
    let mut scales = Scales { geometric: 2.0, photometric: 0.1 };
    let levels = settings.steps.len().min(reference.levels.len()).min(view.levels.len());
    let mut last = None;
    for (i, steps) in settings.steps[settings.steps.len() - levels..].iter().enumerate() {
        let level = levels - 1 - i;
        let stride = if level == 0 { settings.finest_stride.max(1) } else { 1 };
        let problem = Problem {
            reference: &reference.levels[level],
            view: &view.levels[level],
            reference_noise: reference.noise,
            noise: view.noise,
            stride,
            max_distance_m: settings.max_distance_m * (1 << level) as f32,
            settings,
        };
        for step in 0..*steps {
            let system = problem.linearise(&pose, brightness, scales);
            if system.matched < 60 {
                return None;
            }
            scales = system.scales(settings);
            let delta = system.solve(&pose, initial_reference_from_camera, settings)?;
            // The system perturbs the reference's side: reference_from_camera <- exp(delta) * pose.
            pose = se3::exp(&delta) * pose;
            pose.rotation.renormalize();
            brightness.gain = system.gain().unwrap_or(brightness.gain);
            if !(delta.norm() < 10.0) {
                return None;
            }
            if step > 0 && delta.norm() < settings.settled {
                break;
            }
        }
        last = Some(problem);
    }
    let system = last?.linearise(&pose, brightness, scales);
    let scales = system.scales(settings);
    let to_right = se3::adjoint(&pose);
    Some(Alignment {
        reference_from_camera: pose,
        brightness,
        hessian: to_right.transpose() * system.hessian * to_right,
        pixels: system.pixels,
        overlap: system.overlap,
        matched: system.matched,
        inliers: system.inliers,
        alike: system.alike,
        geometric_scale: system.geometric.deviation(),
        photometric_scale: scales.photometric,
        median_distance_m: system.median_distance_m(),
    })
}

#[derive(Clone, Copy)]
struct Scales {
    geometric: f64,
    photometric: f64,
}

struct Problem<'a> {
    reference: &'a Level,
    view: &'a Level,
    reference_noise: DepthNoise,
    noise: DepthNoise,
    stride: usize,
    max_distance_m: f32,
    settings: &'a AlignSettings,
}

/// Bins of a histogram over sizes that span many powers of two: 16 of them.
const BINS: usize = 128;
/// A number's bits from here on are its bin: the exponent and three bits of the mantissa, 8 bins in a factor of two.
const BIN_SHIFT: u32 = 20;
/// Bits of the smallest size that has a bin of its own, `2^-12`.
const SMALLEST_BITS: u32 = (127 - 12) << 23;

/// Counts sizes in bins whose widths grow with them, from `2^-12` on; its median is exact to a bin and needs no order.
#[derive(Clone, Copy)]
struct Histogram([u32; BINS]);

impl Histogram {
    #[inline]
    fn add(&mut self, size: f32) {
        let bin = size.abs().to_bits().saturating_sub(SMALLEST_BITS) >> BIN_SHIFT;
        self.0[(bin as usize).min(BINS - 1)] += 1;
    }

    fn median(&self) -> f64 {
        let half = self.0.iter().sum::<u32>() / 2;
        let mut seen = 0;
        for (bin, count) in self.0.iter().enumerate() {
            if seen + count > half {
                // Linear inside the bin.
                let begin = |bin: usize| f32::from_bits(SMALLEST_BITS + ((bin as u32) << BIN_SHIFT)) as f64;
                let inside = (half - seen) as f64 / (*count).max(1) as f64;
                return begin(bin) + (begin(bin + 1) - begin(bin)) * inside;
            }
            seen += count;
        }
        0.0
    }

    /// Standard deviation, if the sizes were those of normal residuals.
    fn deviation(&self) -> f64 {
        1.4826 * self.median()
    }
}

/// Normal equations and counts; sums run over rows in a fixed order.
#[derive(Clone)]
struct System {
    hessian: Matrix6,
    gradient: Tangent,
    /// Sum over the matched pixels.
    own_brightness: f64,
    /// Sum over their partners.
    reference_brightness: f64,
    pixels: usize,
    overlap: usize,
    matched: usize,
    inliers: usize,
    alike: usize,
    geometric: Histogram,
    photometric: Histogram,
    distance: Histogram,
}

/// Pixels that err together: residuals of one 16x16 block are about one effective sample; a stride thins it.
pub const CORRELATED_PIXELS: f64 = 64.0;

/// A point within this share of its depth fits, however sure the sensor is of it.
const FITS_RELATIVE: f32 = 0.01;

/// A point looks like its partner if their intensities, 0..1, differ by less.
const FITS_INTENSITY: f32 = 0.15;

/// Rows that one task sums up: fixed, so that sums do not depend on the number of threads.
const ROWS_PER_TASK: usize = 16;

impl Problem<'_> {
    fn linearise(&self, pose: &Pose, brightness: Brightness, scales: Scales) -> System {
        let height = self.view.depth_m.height();
        let rows: Vec<usize> = (0..height).step_by(self.stride).collect();
        let parts: Vec<System> = rows
            .par_chunks(ROWS_PER_TASK)
            .map(|rows| {
                let mut system = System::zero();
                let mut matches = Matches::default();
                for y in rows {
                    matches.clear();
                    self.match_row(*y, pose, brightness, &mut matches, &mut system);
                    system.add_row(&mut matches, scales, self.settings);
                }
                system
            })
            .collect();
        parts.into_iter().fold(System::zero(), System::plus)
    }

    /// Finds the partners of a row's pixels.
    fn match_row(
        &self,
        y: usize,
        pose: &Pose,
        brightness: Brightness,
        matches: &mut Matches,
        out: &mut System,
    ) {
        let camera = &self.view.camera;
        let (inv_fx, inv_fy) = (1.0 / camera.fx as f32, 1.0 / camera.fy as f32);
        let (cx, cy) = (camera.cx as f32, camera.cy as f32);
        let target = self.reference;
        let (rfx, rfy) = (target.camera.fx as f32, target.camera.fy as f32);
        let (rcx, rcy) = (target.camera.cx as f32, target.camera.cy as f32);
        let (inv_rfx, inv_rfy) = (1.0 / rfx, 1.0 / rfy);
        let rotation = pose.rotation.to_rotation_matrix().matrix().cast::<f32>();
        let translation: Vector3<f32> = pose.translation.vector.cast();
        let gain = brightness.gain as f32;
        let (max_u, max_v) = (target.depth_m.width() as f32 - 2.0, target.depth_m.height() as f32 - 2.0);
        let (depth, intensity) = (self.view.depth_m.row(y), self.view.intensity.row(y));
        let normals = self.view.normal.row(y);
        let ray_y = (y as f32 - cy) * inv_fy;
        let reference = &target.intensity;
        for x in (0..depth.len()).step_by(self.stride) {
            let z = depth[x];
            if !(z > 0.0) {
                continue;
            }
            out.pixels += 1;
            let point = Vector3::new((x as f32 - cx) * inv_fx * z, ray_y * z, z);
            let p = rotation * point + translation;
            if !(p.z > 0.05) {
                continue;
            }
            let inv_z = 1.0 / p.z;
            let (u, v) = (rfx * p.x * inv_z + rcx, rfy * p.y * inv_z + rcy);
            if !(u >= 1.0 && v >= 1.0 && u < max_u && v < max_v) {
                continue;
            }
            let nearest = ((u + 0.5) as usize, (v + 0.5) as usize);
            let (z_ref, n) = (target.depth_m[nearest], target.normal[nearest]);
            if !(z_ref > 0.0) || n == [0.0; 3] {
                continue;
            }
            out.overlap += 1;
            let n = Vector3::from(n);
            let q = Vector3::new(
                (nearest.0 as f32 - rcx) * inv_rfx * z_ref,
                (nearest.1 as f32 - rcy) * inv_rfy * z_ref,
                z_ref,
            );
            let own = self.noise.sigma_m(z);
            let other = self.reference_noise.sigma_m(z_ref);
            let sigma = (own * own + other * other).sqrt();
            let limit = self.settings.max_distance_sigma * sigma + self.max_distance_m;
            let gap = p - q;
            if gap.norm_squared() > limit * limit {
                continue;
            }
            let own_normal = Vector3::from(normals[x]);
            if own_normal != Vector3::zeros() && (rotation * own_normal).dot(&n) < 0.5 {
                continue;
            }
            // Point to plane.
            let inv_sigma = 1.0 / sigma;
            let distance = n.dot(&gap);
            // Photometric: reference(warped) - gain * own.
            let (iu, iv) = (u as usize, v as usize);
            let (fu, fv) = (u - iu as f32, v - iv as f32);
            let top = reference[(iu, iv)] * (1.0 - fu) + reference[(iu + 1, iv)] * fu;
            let bottom = reference[(iu, iv + 1)] * (1.0 - fu) + reference[(iu + 1, iv + 1)] * fu;
            let warped = top * (1.0 - fv) + bottom * fv;
            // Central differences; `nearest` has a neighbour on every side.
            let (x_ref, y_ref) = nearest;
            let gu = 0.5 * (reference[(x_ref + 1, y_ref)] - reference[(x_ref - 1, y_ref)]) * rfx * inv_z;
            let gv = 0.5 * (reference[(x_ref, y_ref + 1)] - reference[(x_ref, y_ref - 1)]) * rfy * inv_z;
            for (column, value) in matches.point.iter_mut().zip([p.x, p.y, p.z]) {
                column.push(value);
            }
            for (column, value) in matches.normal.iter_mut().zip([n.x, n.y, n.z]) {
                column.push(value);
            }
            for (column, value) in matches.slope.iter_mut().zip([gu, gv, -(gu * p.x + gv * p.y) * inv_z]) {
                column.push(value);
            }
            matches.inv_sigma.push(inv_sigma);
            matches.distance.push(distance * inv_sigma);
            matches.difference.push(warped - gain * intensity[x]);
            out.own_brightness += intensity[x] as f64;
            out.reference_brightness += warped as f64;
        }
    }
}

impl System {
    /// Adds a row's sums and counts.
    fn add_row(&mut self, matches: &mut Matches, scales: Scales, settings: &AlignSettings) {
        self.matched += matches.len();
        let weights = Weights {
            inv_geometric: 1.0 / scales.geometric as f32,
            inv_photometric: 1.0 / scales.photometric as f32,
            photometric: settings.photometric_weight * settings.photometric_weight,
            freedom: settings.freedom,
        };
        for i in 0..matches.len() {
            let distance = matches.distance[i].abs();
            self.geometric.add(distance);
            self.distance.add(distance / matches.inv_sigma[i]);
            self.photometric.add(matches.difference[i].abs());
            let close = distance < FITS_RELATIVE * matches.point[2][i].abs() * matches.inv_sigma[i];
            let fits = close || distance * weights.inv_geometric < 3.0;
            self.inliers += fits as usize;
            self.alike += (fits && matches.difference[i].abs() < FITS_INTENSITY) as usize;
        }
        let sums = rows::sum(matches, &weights);
        let mut k = 0;
        for a in 0..6 {
            self.gradient[a] += sums.gradient[a] as f64;
            for b in a..6 {
                self.hessian[(a, b)] += sums.hessian[k] as f64;
                if a != b {
                    self.hessian[(b, a)] += sums.hessian[k] as f64;
                }
                k += 1;
            }
        }
    }

    fn zero() -> Self {
        let empty = Histogram([0; BINS]);
        System {
            hessian: Matrix6::zeros(),
            gradient: Tangent::zeros(),
            own_brightness: 0.0,
            reference_brightness: 0.0,
            pixels: 0,
            overlap: 0,
            matched: 0,
            inliers: 0,
            alike: 0,
            geometric: empty,
            photometric: empty,
            distance: empty,
        }
    }

    fn plus(mut self, other: System) -> System {
        self.hessian += other.hessian;
        self.gradient += other.gradient;
        self.own_brightness += other.own_brightness;
        self.reference_brightness += other.reference_brightness;
        self.pixels += other.pixels;
        self.overlap += other.overlap;
        self.matched += other.matched;
        self.inliers += other.inliers;
        self.alike += other.alike;
        for (mine, theirs) in [
            (&mut self.geometric, &other.geometric),
            (&mut self.photometric, &other.photometric),
            (&mut self.distance, &other.distance),
        ] {
            mine.0.iter_mut().zip(theirs.0).for_each(|(a, b)| *a += b);
        }
        self
    }

    fn scales(&self, settings: &AlignSettings) -> Scales {
        Scales {
            geometric: self.geometric.deviation().max(settings.min_geometric_scale as f64),
            photometric: self.photometric.deviation().max(settings.min_photometric_scale as f64),
        }
    }

    fn median_distance_m(&self) -> f64 {
        self.distance.median()
    }

    /// The Gauss-Newton step.
    fn solve(&self, pose: &Pose, initial: &Pose, settings: &AlignSettings) -> Option<Tangent> {
        let (mut hessian, mut gradient) = (self.hessian, self.gradient);
        // The prior counts as CORRELATED_PIXELS residuals, as one effective sample of the pictures does.
        let from_initial = se3::log(&(pose * initial.inverse()));
        for axis in 0..6 {
            let sigma = if axis < 3 { settings.prior_m } else { settings.prior_rad };
            let weight = CORRELATED_PIXELS / (sigma * sigma);
            hessian[(axis, axis)] += weight;
            gradient[axis] += weight * from_initial[axis];
        }
        for i in 0..6 {
            hessian[(i, i)] += 1e-9 * hessian[(i, i)] + 1e-6;
        }
        let step = hessian.cholesky()?.solve(&-gradient);
        step.iter().all(|v| v.is_finite()).then_some(step)
    }

    /// The gain that makes the matched pixels as bright as their partners on average. Least squares would be drawn
    /// towards 0 by whatever blurs the reference, a little more with every submap.
    fn gain(&self) -> Option<f64> {
        let gain = self.reference_brightness / self.own_brightness;
        (self.own_brightness > 1e-3 * self.matched as f64 && gain.is_finite()).then(|| gain.clamp(0.2, 5.0))
    }
}

#[cfg(test)]
#[path = "align_tests.rs"]
mod tests;
