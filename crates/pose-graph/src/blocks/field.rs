//! Smooth motions of all blocks together: the slow part of a block-by-block solve in few numbers.
//!
//! What descent block by block is slow at is smooth in space: the whole map bends, or one side of it shifts against the
//! other. So the points of a coarse [`Grid`] over the map get a motion each, and every node moves as the points around it
//! say. Each block says what its measurements are worth for these motions ([`Part`]); parts add up, and the sum over all
//! blocks gives the [`Field`] that lowers the cost most.

use super::grid::{Grid, MOST};
use super::{Block, BlockId, NodeId};
use crate::residual::linearise;
use crate::sparse::BlockCholesky;
use coma_geometry::{Matrix6, Pose, Tangent};
use nalgebra::{Matrix3, SMatrix, Vector3};
use std::collections::BTreeMap;

/// The largest turn of a point in one round, radians: what is linearised holds no farther.
const MOST_RAD: f64 = 1.0;
/// So many nodes for each point of a grid, at least.
const NODES_PER_POINT: usize = 8;
/// Damping as a share of the diagonal: parts are summed in single precision.
const DAMPING: f64 = 1e-6;
/// How stiffly points that are side by side hang together, as a share of the mean diagonal: one with hardly a node around
/// it goes along.
const STIFFNESS: f64 = 1e-3;

/// What a block sees: poses in the map's frame, and one weight per measurement.
pub(super) struct Sight<'a> {
    pub own: &'a BTreeMap<NodeId, Pose>,
    pub known: &'a BTreeMap<NodeId, Pose>,
    pub weights: &'a [f64],
}

impl Sight<'_> {
    fn pose(&self, node: NodeId) -> Option<&Pose> {
        self.own.get(&node).or_else(|| self.known.get(&node))
    }
}

/// What the measurements of some blocks are worth for the motions of a grid's points:
/// `gradient . m + m . hessian m / 2`.
#[derive(Clone, Debug, PartialEq)]
pub struct Part {
    /// Whose, ascending.
    pub blocks: Vec<BlockId>,
    /// Others that these have measurements to, ascending: the whole is known when there are none.
    pub open: Vec<BlockId>,
    /// Of these blocks.
    pub nodes: u32,
    /// The box that holds them, metres in the map's frame.
    pub low: Vector3<f64>,
    /// Its other corner.
    pub high: Vector3<f64>,
    /// Largest squared error of a doubted measurement that they decide on.
    pub largest_squared: f64,
    /// By point.
    pub gradient: BTreeMap<u32, Tangent>,
    /// By two points, the smaller one first.
    pub hessian: BTreeMap<(u32, u32), SMatrix<f32, 6, 6>>,
}

impl Part {
    /// A block's own. `None` while some of its nodes or its neighbours' have not found their place.
    pub(super) fn new(block: &Block, sight: &Sight<'_>, grid: &Grid, largest_squared: f64) -> Option<Self> {
        let mut part = Part {
            blocks: vec![block.id],
            open: block.neighbours.values().copied().collect(),
            nodes: block.nodes.len() as u32,
            low: Vector3::repeat(MOST),
            high: Vector3::repeat(-MOST),
            largest_squared,
            gradient: BTreeMap::new(),
            hessian: BTreeMap::new(),
        };
        part.open.sort_unstable();
        part.open.dedup();
        for node in &block.nodes {
            let place = sight.pose(*node)?.translation.vector;
            (part.low, part.high) = (part.low.inf(&place), part.high.sup(&place));
        }
        // How a node moves, in its own frame, with each point around it.
        let mut around: BTreeMap<NodeId, Vec<(u32, Matrix6)>> = BTreeMap::new();
        let mut hessian: BTreeMap<(u32, u32), Matrix6> = BTreeMap::new();
        for (edge, weight) in block.edges.iter().zip(sight.weights) {
            let c = &edge.constraint;
            let ends = [c.from as NodeId, c.to as NodeId];
            let (from_pose, to_pose) = (sight.pose(ends[0])?, sight.pose(ends[1])?);
            let at = linearise(from_pose, to_pose, &c.from_from_to);
            let information = c.information * *weight;
            for (node, pose) in ends.iter().zip([from_pose, to_pose]) {
                around.entry(*node).or_insert_with(|| {
                    if block.fixed.contains(node) {
                        return Vec::new();
                    }
                    let turned = into_frame_of(pose);
                    let points = grid.around(&pose.translation.vector).into_iter();
                    points.map(|(point, motion)| (point, turned * motion)).collect()
                });
            }
            let ends = [(ends[0], at.wrt_i), (ends[1], at.wrt_j)];
            let mine =
                ends.iter().find_map(|(node, _)| block.neighbours.get(node)).is_none_or(|b| block.id < *b);
            if mine && *weight > 0.0 {
                let towards = towards(&ends, &around);
                for (point, wrt_point) in &towards {
                    *part.gradient.entry(*point).or_insert_with(Tangent::zeros) +=
                        wrt_point.transpose() * (information * at.error);
                }
                add(&mut hessian, &towards, &information);
            }
        }
        part.hessian = hessian.into_iter().map(|(points, block)| (points, block.map(|x| x as f32))).collect();
        Some(part)
    }

    /// The sum with others'. `None` if one block is in two of them.
    pub(super) fn sum<'a>(&self, others: impl Iterator<Item = &'a Part>) -> Option<Part> {
        let mut sum = self.clone();
        for other in others {
            sum.blocks.extend(&other.blocks);
            sum.open.extend(&other.open);
            sum.nodes = sum.nodes.saturating_add(other.nodes);
            (sum.low, sum.high) = (sum.low.inf(&other.low), sum.high.sup(&other.high));
            sum.largest_squared = sum.largest_squared.max(other.largest_squared);
            for (point, gradient) in &other.gradient {
                *sum.gradient.entry(*point).or_insert_with(Tangent::zeros) += gradient;
            }
            for (points, block) in &other.hessian {
                *sum.hessian.entry(*points).or_insert_with(SMatrix::zeros) += block;
            }
        }
        sum.blocks.sort_unstable();
        let distinct = sum.blocks.windows(2).all(|pair| pair[0] < pair[1]);
        sum.open.sort_unstable();
        sum.open.dedup();
        sum.open.retain(|block| sum.blocks.binary_search(block).is_err());
        distinct.then_some(sum)
    }

    /// How the points of the grid move that this sum over all blocks speaks of, and the next grid. None moves where that
    /// has no answer.
    pub(super) fn field(&self, grid: &Grid, most_points: usize) -> Field {
        let mut motions = vec![Tangent::zeros(); grid.len()];
        for (point, motion) in self.minimum(grid).unwrap_or_default() {
            if let Some(slot) = motions.get_mut(point as usize) {
                *slot = motion;
            }
        }
        let farthest = motions.iter().map(|m| m.fixed_rows::<3>(3).norm()).fold(0.0, f64::max);
        if farthest > MOST_RAD {
            motions.iter_mut().for_each(|m| *m *= MOST_RAD / farthest);
        }
        let most = most_points.min(self.nodes as usize / NODES_PER_POINT);
        Field {
            motions,
            largest_squared: self.largest_squared,
            next: Grid::over(&self.low, &self.high, most),
        }
    }

    fn minimum(&self, grid: &Grid) -> Option<Vec<(u32, Tangent)>> {
        let points: Vec<u32> = self.hessian.keys().filter(|(a, b)| a == b).map(|(a, _)| *a).collect();
        let index = |point: &u32| points.binary_search(point).ok();
        let adjacent: Vec<(usize, usize, Vector3<f64>)> = points
            .iter()
            .flat_map(|point| grid.next_to(*point).map(move |(next, way)| (*point, next, way)))
            .filter_map(|(a, b, way)| Some((index(&a)?, index(&b)?, way)))
            .collect();
        let measured = self.hessian.keys().filter_map(|(a, b)| index(a).zip(index(b)));
        let pairs: Vec<(usize, usize)> = measured.chain(adjacent.iter().map(|(a, b, _)| (*a, *b))).collect();
        let mut system = BlockCholesky::<6>::new(points.len(), &pairs).ok()?;
        for ((a, b), block) in &self.hessian {
            system.add(system.slot(index(a)?, index(b)?)?, &block.map(f64::from));
        }
        let diagonal = system.diagonal();
        let mean = |first: usize| {
            let of_point = |point: &[f64]| point[first] + point[first + 1] + point[first + 2];
            diagonal.chunks_exact(6).map(of_point).sum::<f64>() / (3 * points.len()) as f64
        };
        let (shift, turn) = (STIFFNESS * mean(0), STIFFNESS * mean(3));
        let stiffness = Matrix6::from_diagonal(&Tangent::new(shift, shift, shift, turn, turn, turn));
        for (a, b, way) in adjacent {
            // As one rigid body: what is at b follows from a's motion.
            let mut carried = Matrix6::identity();
            carried.fixed_view_mut::<3, 3>(0, 3).copy_from(&-way.cross_matrix());
            system.add(system.slot(a, a)?, &(carried.transpose() * stiffness * carried));
            system.add(system.slot(a, b)?, &-(carried.transpose() * stiffness));
            system.add(system.slot(b, b)?, &stiffness);
        }
        let damping: Vec<f64> = diagonal.iter().map(|d| DAMPING * d).collect();
        system.add_to_diagonal(&damping);
        system.factorise().ok()?;
        let mut rhs = vec![0.0; 6 * points.len()];
        for (k, gradient) in self.gradient.iter().filter_map(|(point, g)| Some((index(point)?, g))) {
            rhs[6 * k..][..6].copy_from_slice((-gradient).as_slice());
        }
        system.solve_in_place(&mut rhs, 1);
        let found = points.into_iter().zip(rhs.chunks_exact(6).map(Tangent::from_column_slice));
        rhs.iter().all(|x| x.is_finite()).then(|| found.collect())
    }

    /// Size as plain numbers: 4 bytes a block, a point and each of a hessian's 36 numbers, 8 for all others.
    pub fn bytes(&self) -> usize {
        let lists =
            4 + 4 * self.blocks.len() + 4 + 4 * self.open.len() + 4 + self.gradient.len() * (4 + 6 * 8);
        lists + 4 + 6 * 8 + 8 + 4 + self.hessian.len() * (2 * 4 + 36 * 4)
    }

    /// True if it can be computed with.
    pub fn is_sound(&self) -> bool {
        let finite = |x: &f64| x.abs() <= MOST;
        let single = |x: &f32| f64::from(x.abs()) <= MOST;
        finite(&self.largest_squared)
            && self.low.iter().chain(&self.high).all(finite)
            && self.gradient.values().all(|g| g.iter().all(finite))
            && self.hessian.iter().all(|((a, b), h)| a <= b && h.iter().all(single))
    }
}

/// How all move in one round.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Field {
    /// Of each point of the round's grid: displacement in metres and turn in radians, in the map's frame.
    pub motions: Vec<Tangent>,
    /// Largest squared error of a doubted measurement, of all blocks, before the round.
    pub largest_squared: f64,
    /// The grid of the next round.
    pub next: Grid,
}

impl Field {
    /// Size as plain numbers.
    pub fn bytes(&self) -> usize {
        4 + self.motions.len() * 6 * 8 + 8 + 4 * 8 + 3 * 4
    }

    /// True if it can be computed with.
    pub fn is_sound(&self) -> bool {
        let finite = |x: &f64| x.abs() <= MOST;
        finite(&self.largest_squared)
            && self.motions.iter().all(|m| m.iter().all(finite))
            && self.next.is_sound()
    }
}

/// Turns a displacement and a turn in the map's frame into a node's.
fn into_frame_of(map_from_node: &Pose) -> Matrix6 {
    let node_from_map: Matrix3<f64> = map_from_node.rotation.inverse().to_rotation_matrix().into_inner();
    let mut turned = Matrix6::zeros();
    turned.fixed_view_mut::<3, 3>(0, 0).copy_from(&node_from_map);
    turned.fixed_view_mut::<3, 3>(3, 3).copy_from(&node_from_map);
    turned
}

/// How an error changes with the points' motions, from how it changes with its nodes'.
fn towards(
    ends: &[(NodeId, Matrix6)],
    around: &BTreeMap<NodeId, Vec<(u32, Matrix6)>>,
) -> BTreeMap<u32, Matrix6> {
    let mut out = BTreeMap::new();
    for (node, wrt_node) in ends {
        for (point, motion) in around.get(node).into_iter().flatten() {
            *out.entry(*point).or_insert_with(Matrix6::zeros) += wrt_node * motion;
        }
    }
    out
}

fn add(hessian: &mut BTreeMap<(u32, u32), Matrix6>, towards: &BTreeMap<u32, Matrix6>, information: &Matrix6) {
    for (a, wrt_a) in towards {
        let weighted = wrt_a.transpose() * information;
        for (b, wrt_b) in towards.range(a..) {
            *hessian.entry((*a, *b)).or_insert_with(Matrix6::zeros) += weighted * wrt_b;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn part(blocks: &[BlockId], open: &[BlockId], point: u32) -> Part {
        Part {
            blocks: blocks.to_vec(),
            open: open.to_vec(),
            nodes: 10,
            low: Vector3::repeat(f64::from(point)),
            high: Vector3::repeat(f64::from(point) + 1.0),
            largest_squared: f64::from(point),
            gradient: BTreeMap::from([(point, Tangent::repeat(1.0))]),
            hessian: BTreeMap::from([((point, point), SMatrix::identity())]),
        }
    }

    #[test]
    fn parts_add_up_and_none_counts_twice() {
        let (one, two) = (part(&[1], &[0, 2], 3), part(&[0, 4], &[1, 2], 3));
        let sum = one.sum([&two].into_iter()).unwrap();
        assert_eq!((sum.blocks.as_slice(), sum.open.as_slice(), sum.nodes), (&[0, 1, 4][..], &[2][..], 20));
        assert_eq!(sum.gradient[&3], Tangent::repeat(2.0));
        assert_eq!(sum.hessian[&(3, 3)], SMatrix::<f32, 6, 6>::identity() * 2.0);
        let far = one.sum([&part(&[2], &[1], 7)].into_iter()).unwrap();
        assert!(
            far.low.x == 3.0 && far.high.x == 8.0 && far.largest_squared == 7.0 && far.gradient.len() == 2
        );
        assert!(sum.sum([&part(&[4], &[], 1)].into_iter()).is_none());
    }

    #[test]
    fn a_point_that_hardly_a_node_is_near_goes_along_with_the_others() {
        let grid = Grid { origin: Vector3::zeros(), spacing_m: 1.0, points: [3, 1, 1] };
        let mut part = part(&[0], &[], 0);
        for (point, worth) in [(0, 1.0), (1, 1.0), (2, 1e-12_f32)] {
            // The two that are seen are drawn sideways; what little the third says, it says loudly.
            let pull = Tangent::new(0.0, -0.5, 0.0, 0.0, 0.0, 0.0);
            part.gradient.insert(point, if point == 2 { pull * 1e-9 } else { pull });
            part.hessian.insert((point, point), SMatrix::identity() * worth);
        }
        let field = part.field(&grid, 9);
        for motion in &field.motions {
            assert!((motion - Tangent::new(0.0, 0.5, 0.0, 0.0, 0.0, 0.0)).norm() < 0.01, "{motion}");
        }
    }
}
