//! Multi-scale coloured ICP: point-to-plane and photometric residuals together (Park, Zhou, Koltun:
//! "Colored Point Cloud Registration Revisited", ICCV 2017), in both directions in one system, so that
//! neither view is preferred.

use crate::cloud::PointCloud;
use crate::neighbours::Neighbours;
use crate::pixels::Pixels;
use crate::settings::{PixelScale, Scale, Settings};
use coma_frame::DepthNoise;
use coma_geometry::{Matrix6, Pose, Tangent, se3};
use nalgebra::{Isometry3, Point3, Vector3};
use rayon::prelude::*;

/// One correspondence, linearised: residuals and their derivatives by the right perturbation of
/// `target_from_source`.
#[derive(Clone, Copy, Debug)]
pub struct Residual {
    /// The point of the pair that belongs to the source, in the source's frame.
    pub source: Point3<f64>,
    /// Distance along the normal, metres.
    pub geometric_m: f64,
    /// Derivative of `geometric_m`.
    pub geometric_row: Tangent,
    /// Difference of intensity after gain and offset.
    pub photometric: f64,
    /// Derivative of `photometric`.
    pub photometric_row: Tangent,
    /// Standard deviation that the sensors promise for `geometric_m`, metres.
    pub sigma_m: f64,
    /// Change of `geometric_m` and of `photometric` if both focal lengths were longer, per unit of their logarithm.
    pub by_focal: (f64, f64),
}

impl Residual {
    /// Leaves the geometric part alone.
    pub(crate) fn forget_brightness(&mut self) {
        self.photometric = 0.0;
        self.by_focal.1 = 0.0;
        self.photometric_row = Tangent::zeros();
    }
}

/// How a point's counterpart is found.
enum Search<'a> {
    /// The nearest one.
    Tree(Neighbours),
    /// The one that is seen in its direction.
    Projection(&'a Pixels),
}

/// A cloud that can be searched.
pub struct Searchable<'a> {
    cloud: &'a PointCloud,
    noise: DepthNoise,
    search: Search<'a>,
    /// Indices of the points that look for a correspondence.
    queries: Vec<u32>,
}

impl<'a> Searchable<'a> {
    /// Builds the tree and picks at most `queries` points, evenly.
    pub fn new(cloud: &'a PointCloud, noise: DepthNoise, queries: usize) -> Self {
        let search = Search::Tree(Neighbours::new(&cloud.points));
        let all: Vec<u32> = (0..cloud.len() as u32).collect();
        Searchable { cloud, noise, search, queries: evenly(&all, queries) }
    }

    /// The same for pixels, which are found by projection.
    pub fn by_projection(pixels: &'a Pixels, noise: DepthNoise) -> Self {
        let queries = pixels.queries.clone();
        Searchable { cloud: &pixels.cloud, noise, search: Search::Projection(pixels), queries }
    }

    /// The cloud itself.
    pub(crate) fn cloud(&self) -> &PointCloud {
        self.cloud
    }

    /// Of the sensor that saw it.
    pub(crate) fn noise(&self) -> DepthNoise {
        self.noise
    }

    /// The counterpart in `into` of point `i`: the nearest one that faces the same way.
    fn partner(
        &self,
        into: &Searchable,
        into_from_self: &Isometry3<f32>,
        i: usize,
        max_m: f32,
    ) -> Option<usize> {
        let point = self.cloud.points[i];
        let reach = max_m.max(3.0 * self.noise.sigma_m(point.z));
        let moved = into_from_self * point;
        let j = match &into.search {
            Search::Tree(tree) => tree.nearest(&moved, reach)?.0,
            Search::Projection(pixels) => pixels.at(&moved, reach)?,
        };
        let own_normal = into_from_self.rotation * self.cloud.normals[i];
        // A normal of zero fails this test too.
        (into.cloud.normals[j].dot(&own_normal) > 0.5).then_some(j)
    }
}

/// At most `count` of them, evenly.
pub(crate) fn evenly(of: &[u32], count: usize) -> Vec<u32> {
    let count = of.len().min(count);
    (0..count).map(|i| of[i * of.len() / count]).collect()
}

/// Queries of `from` with their counterparts in `into`.
pub(crate) fn correspondences(
    from: &Searchable,
    into: &Searchable,
    into_from_from: &Pose,
    max_distance_m: f32,
) -> Vec<(usize, usize)> {
    let pose = into_from_from.cast::<f32>();
    let partner = |&i: &u32| Some((i as usize, from.partner(into, &pose, i as usize, max_distance_m)?));
    from.queries.par_iter().filter_map(partner).collect()
}

/// Linearised residuals of both directions at a pose, source queries first.
pub fn linearise(
    source: &Searchable,
    target: &Searchable,
    pose: &Pose,
    max_distance_m: f32,
) -> Vec<Residual> {
    let forward = half(source, target, pose, max_distance_m);
    let backward = half(target, source, &pose.inverse(), max_distance_m);
    // Gain and offset of target against source, from the moments of the pairs.
    let pairs = forward.iter().map(|p| (p.own, p.other)).chain(backward.iter().map(|p| (p.other, p.own)));
    let (gain, offset) = gain_and_offset(pairs);
    let rotation = *pose.rotation.to_rotation_matrix().matrix();
    let mut out = Vec::with_capacity(forward.len() + backward.len());
    for p in &forward {
        // r = n . (T exp(xi) s - q): dr = m . (rho + phi x s) with m = R^T n.
        let row = |direction: &Vector3<f64>| {
            let m = rotation.transpose() * direction;
            tangent(&m, &p.point.coords.cross(&m))
        };
        out.push(Residual {
            source: p.point,
            geometric_m: p.normal.dot(&p.offset),
            geometric_row: row(&p.normal),
            photometric: (p.other + p.gradient.dot(&p.offset)) - (gain * p.own + offset),
            photometric_row: row(&p.gradient),
            sigma_m: p.sigma_m,
            by_focal: (p.normal.dot(&p.by_focal), p.gradient.dot(&p.by_focal)),
        });
    }
    for p in &backward {
        // r = n . (exp(-xi) T^-1 t - q): dr = -n . (rho + phi x p) with p = T^-1 t.
        let row = |direction: &Vector3<f64>| -tangent(direction, &p.moved.coords.cross(direction));
        // Brought to the target's brightness, so that both directions have one unit.
        out.push(Residual {
            source: p.moved,
            geometric_m: p.normal.dot(&p.offset),
            geometric_row: row(&p.normal),
            photometric: gain * (p.other + p.gradient.dot(&p.offset)) + offset - p.own,
            photometric_row: row(&(p.gradient * gain)),
            sigma_m: p.sigma_m,
            by_focal: (p.normal.dot(&p.by_focal), gain * p.gradient.dot(&p.by_focal)),
        });
    }
    out
}

/// A query, moved, and what it met.
struct Met {
    point: Point3<f64>,
    moved: Point3<f64>,
    offset: Vector3<f64>,
    /// Change of `offset` by the logarithm of both focal lengths.
    by_focal: Vector3<f64>,
    normal: Vector3<f64>,
    gradient: Vector3<f64>,
    own: f64,
    other: f64,
    sigma_m: f64,
}

fn half(from: &Searchable, into: &Searchable, into_from_from: &Pose, max_distance_m: f32) -> Vec<Met> {
    let pose = into_from_from.cast::<f32>();
    from.queries
        .par_iter()
        .filter_map(|&i| {
            let i = i as usize;
            let point = from.cloud.points[i];
            let sigma = from.noise.sigma_m(point.z);
            let j = from.partner(into, &pose, i, max_distance_m)?;
            let normal = into.cloud.normals[j];
            let sigma_into = into.noise.sigma_m(into.cloud.points[j].z);
            let moved = into_from_from * point.cast::<f64>();
            let there = into.cloud.points[j].cast::<f64>();
            // A point lies at depth times pixel over focal length: a longer one draws it towards the axis.
            let inwards = |p: &Point3<f64>| -Vector3::new(p.x, p.y, 0.0);
            Some(Met {
                point: point.cast(),
                moved,
                offset: moved - there,
                by_focal: into_from_from.rotation * inwards(&point.cast()) - inwards(&there),
                normal: normal.cast(),
                gradient: into.cloud.gradients[j].cast(),
                own: from.cloud.intensity[i] as f64,
                other: into.cloud.intensity[j] as f64,
                sigma_m: ((sigma * sigma + sigma_into * sigma_into) as f64).sqrt(),
            })
        })
        .collect()
}

fn tangent(translation: &Vector3<f64>, rotation: &Vector3<f64>) -> Tangent {
    Tangent::new(translation.x, translation.y, translation.z, rotation.x, rotation.y, rotation.z)
}

/// Gain and offset that give the first values the mean and spread of the second; gain within 0.5..2.
fn gain_and_offset(pairs: impl Iterator<Item = (f64, f64)>) -> (f64, f64) {
    let (mut n, mut a, mut b, mut aa, mut bb) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for (x, y) in pairs {
        n += 1.0;
        a += x;
        b += y;
        aa += x * x;
        bb += y * y;
    }
    if n < 2.0 {
        return (1.0, 0.0);
    }
    let (ma, mb) = (a / n, b / n);
    let (va, vb) = ((aa / n - ma * ma).max(1e-6), (bb / n - mb * mb).max(1e-6));
    let gain = (vb / va).sqrt().clamp(0.5, 2.0);
    (gain, mb - gain * ma)
}

/// Robust scales (1.4826 x median of absolute values) of whitened geometric and of photometric residuals.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Scales {
    /// In units of `sigma_m`.
    pub geometric: f64,
    /// In units of intensity.
    pub photometric: f64,
}

impl Scales {
    /// Of a set of residuals, with floors against perfect data.
    pub fn of(residuals: &[Residual]) -> Self {
        let robust = |values: Vec<f64>, floor: f64| (1.4826 * median(values)).max(floor);
        Scales {
            geometric: robust(residuals.iter().map(|r| (r.geometric_m / r.sigma_m).abs()).collect(), 0.02),
            photometric: robust(residuals.iter().map(|r| r.photometric.abs()).collect(), 0.005),
        }
    }

    /// Cauchy weights of a residual's two parts.
    pub fn weights(&self, r: &Residual) -> (f64, f64) {
        let cauchy = |x: f64| 1.0 / (1.0 + x * x / (2.0 * 2.0));
        (cauchy(r.geometric_m / r.sigma_m / self.geometric), cauchy(r.photometric / self.photometric))
    }

    /// Weights of both parts in the sum that the motion minimises (Park 2017, eq. (7): E = (1 - sigma) E_C + sigma E_G).
    /// Surfaces that meet far better than the sensors promise count the more.
    pub fn motion_weights(&self, r: &Residual, settings: &Settings) -> (f64, f64) {
        let (wg, wp) = self.shares(r, settings);
        let better = (self.geometric / ORDINARY_SCALE).min(1.0);
        (wg / (better * better), wp)
    }

    /// The same as if surfaces met as they ordinarily do.
    pub fn shares(&self, r: &Residual, settings: &Settings) -> (f64, f64) {
        let (wg, wp) = self.weights(r);
        let share = settings.geometric_share;
        (wg * share * depth_weight(r.sigma_m), wp * (1.0 - share))
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// Geometric scale from which on `geometric_share` holds: two views of a real depth sensor, averaged to the working
/// size, meet at 0.5 to 0.9 of what the sensor promises.
const ORDINARY_SCALE: f64 = 0.5;

/// Weight of depth by its noise: a point at 1 cm counts in full, noisier ones by variance.
pub fn depth_weight(sigma_m: f64) -> f64 {
    const FULL_WEIGHT_SIGMA_M: f64 = 0.01;
    (FULL_WEIGHT_SIGMA_M / sigma_m).powi(2).min(1.0)
}

/// A voxel scale has settled when a step is below this many voxels (and as many radians per metre).
const SETTLED_VOXELS: f64 = 0.01;
/// A pixel scale has when it is below this, metres; four times that for every halving of the pictures.
const SETTLED_PIXELS_M: f64 = 1e-5;

/// What Gauss-Newton needs to know of a scale.
#[derive(Clone, Copy, Debug)]
pub struct Steps {
    /// Points further apart than this never correspond, metres.
    pub max_correspondence_m: f32,
    /// Most steps.
    pub iterations: usize,
    /// A step shorter than this, metres and radians alike, is the last.
    pub settled: f64,
}

impl Steps {
    /// Whether a step is the last.
    pub(crate) fn settled_by(&self, step: &Tangent) -> bool {
        step.fixed_rows::<3>(0).norm() < self.settled && step.fixed_rows::<3>(3).norm() < self.settled
    }
}

impl From<&Scale> for Steps {
    fn from(scale: &Scale) -> Self {
        let Scale { voxel_m, max_correspondence_m, iterations } = *scale;
        Steps { max_correspondence_m, iterations, settled: SETTLED_VOXELS * voxel_m as f64 }
    }
}

impl From<&PixelScale> for Steps {
    fn from(scale: &PixelScale) -> Self {
        let PixelScale { max_correspondence_m, iterations, .. } = *scale;
        let settled = SETTLED_PIXELS_M * 4f64.powi(scale.bounded_halvings() as i32);
        Steps { max_correspondence_m, iterations, settled }
    }
}

/// Gauss-Newton at one scale. `None` if correspondences run out or the system is singular beyond damping.
pub fn refine_scale(
    source: &Searchable,
    target: &Searchable,
    initial: &Pose,
    steps: &Steps,
    settings: &Settings,
) -> Option<Pose> {
    let mut pose = *initial;
    for _ in 0..steps.iterations {
        let residuals = linearise(source, target, &pose, steps.max_correspondence_m);
        if residuals.len() < 12 {
            return None;
        }
        let scales = Scales::of(&residuals);
        let (mut h, mut g) = (Matrix6::zeros(), Tangent::zeros());
        for r in &residuals {
            let (wg, wp) = scales.motion_weights(r, settings);
            h.syger(wg, &r.geometric_row, &r.geometric_row, 1.0);
            h.syger(wp, &r.photometric_row, &r.photometric_row, 1.0);
            g += r.geometric_row * (wg * r.geometric_m) + r.photometric_row * (wp * r.photometric);
        }
        h.fill_upper_triangle_with_lower_triangle();
        // Damping holds directions that nothing pins; it is far below any that something does.
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
