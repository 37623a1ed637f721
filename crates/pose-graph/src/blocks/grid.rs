//! A coarse grid over the map, whose points move and take what is around them along.

use coma_geometry::{Matrix6, Pose, Tangent};
use nalgebra::{UnitQuaternion, Vector3};

/// Most points of a grid.
pub const MOST_POINTS: usize = 4096;
/// Largest magnitude of a number that is believed.
pub(super) const MOST: f64 = 1e30;

/// Points in a regular grid, in the map's frame; along an axis that the map hardly extends in there is one layer.
///
/// Each point has a motion of six numbers, a displacement and a turn. What lies between takes the mean of those around it,
/// weighed by how near they are; a turn displaces what is off its point by half the lever arm along the grid (linked
/// interpolation, as for plates), so that neither a rigid motion nor an even bend costs any shear.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Grid {
    /// Its first point, metres.
    pub origin: Vector3<f64>,
    /// Between two points, metres.
    pub spacing_m: f64,
    /// Along each axis; x varies fastest.
    pub points: [u32; 3],
}

impl Grid {
    /// The finest grid of at most so many points over a box.
    pub(super) fn over(low: &Vector3<f64>, high: &Vector3<f64>, most: usize) -> Self {
        let extent = high - low;
        let points = |spacing_m: f64| {
            [0, 1, 2].map(|axis| match extent[axis] / spacing_m {
                steps if steps >= 1.0 => steps.round().min(MOST_POINTS as f64) as u32 + 1,
                _ => 1,
            })
        };
        let count = |spacing_m: f64| points(spacing_m).iter().map(|n| *n as usize).product::<usize>();
        let mut spacing_m = 2.0 * extent.max();
        if !(spacing_m > 0.0 && extent.iter().all(|x| x.abs() <= MOST)) {
            return Grid::default();
        }
        while count(0.9 * spacing_m) <= most.min(MOST_POINTS) {
            spacing_m *= 0.9;
        }
        let points = points(spacing_m);
        let half = Vector3::from_fn(|axis, _| 0.5 * spacing_m * f64::from(points[axis] - 1));
        Grid { origin: (low + high) * 0.5 - half, spacing_m, points }
    }

    /// How many points.
    pub fn len(&self) -> usize {
        self.points.iter().map(|n| *n as usize).product()
    }

    /// True of a grid without points, which moves nothing.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// True if it can be computed with.
    pub fn is_sound(&self) -> bool {
        let few = self.points.iter().try_fold(1_u64, |all, n| all.checked_mul(u64::from(*n)));
        let placed = self.origin.iter().all(|x| x.abs() <= MOST);
        few.is_some_and(|n| n <= MOST_POINTS as u64)
            && (self.is_empty() || placed && self.spacing_m > 0.0 && self.spacing_m <= MOST)
    }

    /// The points around a place, and the motion there (displacement, turn; in the map's frame) for each one's.
    pub(super) fn around(&self, place: &Vector3<f64>) -> Vec<(u32, Matrix6)> {
        if self.is_empty() {
            return Vec::new();
        }
        let mut around = vec![(0, 1.0, Vector3::zeros())];
        for axis in [2, 1, 0] {
            let count = self.points[axis];
            let along = place[axis] - self.origin[axis];
            // Where there is but one layer it carries what is off it stiffly.
            let arm = if count == 1 { 1.0 } else { 0.5 };
            let first = ((along / self.spacing_m).max(0.0) as u32).min(count.saturating_sub(2));
            let share = (along / self.spacing_m - f64::from(first)).clamp(-0.5, 1.5);
            let sides: &[(u32, f64)] = if count == 1 { &[(0, 1.0)] } else { &[(0, 1.0 - share), (1, share)] };
            let split = |(index, weight, lever): (u32, f64, Vector3<f64>)| {
                sides.iter().map(move |(side, part)| {
                    let mut lever = lever;
                    lever[axis] = arm * (along - self.spacing_m * f64::from(first + side));
                    (index * count + first + side, weight * part, lever)
                })
            };
            around = around.into_iter().flat_map(split).collect();
        }
        let motion = |(index, weight, lever): (u32, f64, Vector3<f64>)| {
            let mut motion = Matrix6::identity();
            // turn x lever
            motion.fixed_view_mut::<3, 3>(0, 3).copy_from(&-lever.cross_matrix());
            (index, motion * weight)
        };
        around.into_iter().map(motion).collect()
    }

    /// The points that come next along each axis, and the way there.
    pub(super) fn next_to(&self, point: u32) -> impl Iterator<Item = (u32, Vector3<f64>)> + '_ {
        let strides = [1, self.points[0], self.points[0] * self.points[1]];
        (0..3).filter_map(move |axis| {
            let along = point / strides[axis] % self.points[axis].max(1);
            let mut way = Vector3::zeros();
            way[axis] = self.spacing_m;
            (along + 1 < self.points[axis]).then_some((point + strides[axis], way))
        })
    }

    /// Where a pose is moved to when the grid's points move so.
    pub(super) fn moved(&self, motions: &[Tangent], map_from_node: &Pose) -> Pose {
        let mut motion = Tangent::zeros();
        for (point, here) in self.around(&map_from_node.translation.vector) {
            motion += motions.get(point as usize).map_or_else(Tangent::zeros, |m| here * m);
        }
        let mut moved = *map_from_node;
        moved.translation.vector += motion.fixed_rows::<3>(0);
        moved.rotation = UnitQuaternion::from_scaled_axis(motion.fixed_rows::<3>(3)) * moved.rotation;
        moved.rotation.renormalize();
        moved
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_geometry::se3;

    fn place(x: f64, y: f64, z: f64) -> Vector3<f64> {
        Vector3::new(x, y, z)
    }

    /// Where the points of a grid lie.
    fn points(grid: &Grid) -> Vec<Vector3<f64>> {
        let [x, y, _] = grid.points;
        let at = |k: u32| place(f64::from(k % x), f64::from(k / x % y), f64::from(k / (x * y)));
        (0..grid.len() as u32).map(|k| grid.origin + at(k) * grid.spacing_m).collect()
    }

    #[test]
    fn a_grid_is_as_fine_as_it_may_be_and_flat_where_the_map_is() {
        let flat = Grid::over(&place(0.0, 0.0, 1.0), &place(20.0, 10.0, 1.5), 50);
        assert!(flat.points[2] == 1 && flat.points[0] > flat.points[1], "{flat:?}");
        assert!((40..=50).contains(&flat.len()), "{flat:?}");
        let cube = Grid::over(&Vector3::zeros(), &Vector3::repeat(8.0), 130);
        assert_eq!(cube.points, [5, 5, 5]);
        assert!(Grid::over(&place(1.0, 1.0, 1.0), &place(1.0, 1.0, 1.0), 9).is_empty());
        assert!(Grid::over(&place(f64::NAN, 0.0, 0.0), &place(1.0, 1.0, 1.0), 9).is_sound());
    }

    #[test]
    fn rigid_motions_and_even_bends_are_kept() {
        for high in [place(9.0, 9.0, 0.4), place(9.0, 9.0, 9.0)] {
            let grid = Grid::over(&Vector3::zeros(), &high, 64);
            let (shift, turn) = (place(0.1, -0.2, 0.3), place(1e-4, 2e-4, -3e-4));
            let bend = 1e-4;
            for (shift, turn, bend) in [(shift, turn, 0.0), (shift * 0.0, turn * 0.0, bend)] {
                // Bent upwards along x: z rises as its square, and what is there turns with it.
                let at = |p: &Vector3<f64>| {
                    let moved = shift + turn.cross(p) + place(-bend * p.x * p.z, 0.0, 0.5 * bend * p.x * p.x);
                    (moved, turn + place(0.0, -bend * p.x, 0.0))
                };
                let motion = |p: &Vector3<f64>| {
                    let (u, w) = at(p);
                    Tangent::new(u.x, u.y, u.z, w.x, w.y, w.z)
                };
                let motions: Vec<Tangent> = points(&grid).iter().map(motion).collect();
                for p in [place(1.0, 2.0, 0.3), place(8.7, 0.1, 0.1), place(4.4, 5.6, 0.2)] {
                    let pose = Pose::translation(p.x, p.y, p.z) * se3::exp(&Tangent::repeat(0.1));
                    let here = pose.translation.vector;
                    let (moved, turned) = at(&here);
                    let found = grid.moved(&motions, &pose);
                    assert!((found.translation.vector - here - moved).norm() < 1e-9, "{grid:?} {p}");
                    let by = (found.rotation * pose.rotation.inverse()).scaled_axis();
                    assert!((by - turned).norm() < 1e-9, "{grid:?} {p}");
                }
            }
        }
    }
}
