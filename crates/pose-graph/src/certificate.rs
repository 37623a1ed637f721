//! Is a minimum the global one? The certificate of SE-Sync (Rosen et al., IJRR 2019).
//!
//! With the translations eliminated the isotropic objective is `tr(R Q R^T)` over rotations `R = (R_1 ... R_n)`. At a
//! stationary point there are multipliers `L_i = sym((Q R^T)_i R_i)`, and the point is a global minimum if
//! `S = Q - diag(L_i)` has no negative eigenvalue. Three eigenvalues are zero there: those of the rows of `R`.
//!
//! `Q` is dense, but the matrix `M` over rotations and translations that it is the Schur complement of is sparse:
//! `(S + shift)^-1` is one sparse solve, and Lanczos finds its largest eigenvalue within few of them.

use crate::isotropic::{Isotropic, matrix, objective};
use crate::lanczos::{LanczosLimits, largest_eigenvalue};
use crate::solver::{Problem, SolveError};
use crate::sparse::{BlockCholesky, SparseError};
use coma_geometry::Pose;
use nalgebra::{Matrix3, Matrix4, Matrix4x3, SMatrix};

/// The smallest eigenvalue may be below zero by this share of the largest: what rounding and an unfinished descent
/// leave.
pub const TOLERANCE: f64 = 1e-6;

/// What the dual certificate matrix says of a point. It speaks of the isotropic objective with the weights given; for a
/// graph with full information or robust weights that is a surrogate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Certificate {
    /// Smallest eigenvalue of `S`; zero at a certified minimum.
    pub smallest: f64,
    /// Its largest eigenvalue, to a few percent.
    pub largest: f64,
    /// Largest component of `S R^T`, as a share of the largest eigenvalue: zero where the point is stationary. The
    /// certificate means nothing where it is not small.
    pub stationarity: f64,
    /// The isotropic objective, with the translations that are best for the rotations.
    pub objective: f64,
}

impl Certificate {
    /// True if the point is a global minimum of the isotropic objective, within [`TOLERANCE`].
    pub fn holds(&self) -> bool {
        self.smallest >= -TOLERANCE * self.largest && self.stationarity < 1e-3
    }
}

/// One node's rotation transposed above its translation.
type Rows = Matrix4x3<f64>;

/// A term of `M` between two nodes, or of a node with itself.
struct Block {
    row: usize,
    column: usize,
    value: Matrix4<f64>,
}

/// Certifies rotations at `poses`; translations are solved for. `weights` is one per constraint. Fixed nodes hold
/// nothing here: one of them is the frame, which the objective does not depend on.
pub fn certify(problem: &Problem, poses: &[Pose], weights: &[f64]) -> Result<Certificate, SolveError> {
    problem.check(weights)?;
    if poses.len() != problem.nodes {
        return Err(SolveError::Size { what: "poses", found: poses.len(), needed: problem.nodes });
    }
    let n = problem.nodes;
    if problem.constraints.is_empty() {
        return Ok(Certificate { smallest: 0.0, largest: 0.0, stationarity: 0.0, objective: 0.0 });
    }
    let mut blocks = data_matrix(problem, weights);
    let mut translations = Translations::new(n, &blocks)?;
    let mut rows: Vec<Rows> = poses.iter().map(|p| stacked(&matrix(p))).collect();
    translations.fill(&blocks, &mut rows);
    let image = multiply(&blocks, &rows);
    let mut residual = 0.0f64;
    for node in 0..n {
        let rotation = rows[node].fixed_view::<3, 3>(0, 0).transpose();
        let gradient = image[node].fixed_view::<3, 3>(0, 0).into_owned();
        let multiplier = gradient * rotation;
        let multiplier = (multiplier + multiplier.transpose()) * 0.5;
        residual = residual.max((gradient - multiplier * rotation.transpose()).amax());
        let mut value = Matrix4::zeros();
        value.fixed_view_mut::<3, 3>(0, 0).copy_from(&-multiplier);
        blocks.push(Block { row: node, column: node, value });
    }
    let best: Vec<Pose> = poses
        .iter()
        .zip(&rows)
        .map(|(pose, rows)| {
            let mut best = *pose;
            best.translation.vector = rows.row(3).transpose();
            best
        })
        .collect();
    let largest = largest(n, &blocks, &mut translations);
    Ok(Certificate {
        smallest: smallest(n, &blocks, &translations.roots, largest)?,
        largest,
        stationarity: residual / largest,
        objective: objective(&problem.constraints, &best, weights),
    })
}

fn stacked(rotation: &Matrix3<f64>) -> Rows {
    let mut rows = Rows::zeros();
    rows.fixed_view_mut::<3, 3>(0, 0).copy_from(&rotation.transpose());
    rows
}

/// `M`, as blocks that add up: of each pair only one is listed, its transpose is meant too.
fn data_matrix(problem: &Problem, weights: &[f64]) -> Vec<Block> {
    let mut blocks = Vec::with_capacity(3 * problem.constraints.len() + problem.nodes);
    for (c, &weight) in problem.constraints.iter().zip(weights).filter(|(_, w)| **w > 0.0) {
        let Isotropic { kappa, tau } = Isotropic::of(&c.information);
        let (kappa, tau) = (weight * kappa, weight * tau);
        let (rotation, t) = (matrix(&c.from_from_to), c.from_from_to.translation.vector);
        // kappa |R_j^T - R_ij^T R_i^T|^2 + tau |t_j^T - t_i^T - t_ij^T R_i^T|^2.
        let (mut ii, mut jj, mut ij) = (Matrix4::zeros(), Matrix4::zeros(), Matrix4::zeros());
        ii.fixed_view_mut::<3, 3>(0, 0).copy_from(&(Matrix3::identity() * kappa + t * t.transpose() * tau));
        ii.fixed_view_mut::<3, 1>(0, 3).copy_from(&(t * tau));
        ii.fixed_view_mut::<1, 3>(3, 0).copy_from(&(t.transpose() * tau));
        ii[(3, 3)] = tau;
        jj.fixed_view_mut::<3, 3>(0, 0).copy_from(&(Matrix3::identity() * kappa));
        jj[(3, 3)] = tau;
        ij.fixed_view_mut::<3, 3>(0, 0).copy_from(&(-rotation * kappa));
        ij.fixed_view_mut::<3, 1>(0, 3).copy_from(&(-t * tau));
        ij[(3, 3)] = -tau;
        blocks.push(Block { row: c.from, column: c.from, value: ii });
        blocks.push(Block { row: c.to, column: c.to, value: jj });
        blocks.push(Block { row: c.from, column: c.to, value: ij });
    }
    blocks
}

fn multiply<const C: usize>(blocks: &[Block], rows: &[SMatrix<f64, 4, C>]) -> Vec<SMatrix<f64, 4, C>> {
    let mut out = vec![SMatrix::<f64, 4, C>::zeros(); rows.len()];
    for Block { row, column, value } in blocks {
        out[*row] += value * rows[*column];
        if row != column {
            out[*column] += value.transpose() * rows[*row];
        }
    }
    out
}

/// The translations that are best for given rotations: the Laplacian of the graph, factorised.
struct Translations {
    laplacian: BlockCholesky<1>,
    /// One node of each connected part: its translation is zero.
    roots: Vec<usize>,
}

impl Translations {
    fn new(nodes: usize, blocks: &[Block]) -> Result<Self, SparseError> {
        let pairs: Vec<(usize, usize)> = blocks.iter().map(|b| (b.row, b.column)).collect();
        let mut laplacian = BlockCholesky::<1>::new(nodes, &pairs)?;
        for Block { row, column, value } in blocks {
            if let Some(slot) = laplacian.slot(*row, *column) {
                laplacian.add(slot, &SMatrix::<f64, 1, 1>::new(value[(3, 3)]));
            }
        }
        let roots = roots(nodes, &pairs);
        ground(&mut laplacian, &roots, 0);
        laplacian.factorise()?;
        Ok(Translations { laplacian, roots })
    }

    /// Sets each fourth row to what minimises the quadratic form.
    fn fill<const C: usize>(&mut self, blocks: &[Block], rows: &mut [SMatrix<f64, 4, C>]) {
        for node in rows.iter_mut() {
            node.row_mut(3).fill(0.0);
        }
        let image = multiply(blocks, rows);
        for column in 0..C {
            let mut rhs: Vec<f64> = image.iter().map(|m| -m[(3, column)]).collect();
            self.laplacian.solve_in_place(&mut rhs, 1);
            rows.iter_mut().zip(rhs).for_each(|(node, t)| node[(3, column)] = t);
        }
    }
}

/// Holds the translations of some nodes. The quadratic form does not change with a common translation, so that what is
/// left after eliminating the others stays exactly the same.
fn ground<const B: usize>(system: &mut BlockCholesky<B>, roots: &[usize], component: usize) {
    let diagonal = system.diagonal();
    let mut added = vec![0.0; diagonal.len()];
    for &root in roots {
        added[root * B + component] = diagonal[root * B + component].max(1e-12);
    }
    system.add_to_diagonal(&added);
}

/// The first node of each connected part.
fn roots(nodes: usize, pairs: &[(usize, usize)]) -> Vec<usize> {
    let mut neighbours = vec![Vec::new(); nodes];
    for &(a, b) in pairs {
        neighbours[a].push(b);
        neighbours[b].push(a);
    }
    let (mut roots, mut seen) = (Vec::new(), vec![false; nodes]);
    for root in 0..nodes {
        if std::mem::replace(&mut seen[root], true) {
            continue;
        }
        roots.push(root);
        let mut open = vec![root];
        while let Some(node) = open.pop() {
            for &next in &neighbours[node] {
                if !std::mem::replace(&mut seen[next], true) {
                    open.push(next);
                }
            }
        }
    }
    roots
}

fn to_rows(v: &[f64]) -> Vec<SMatrix<f64, 4, 1>> {
    v.chunks_exact(3).map(|x| SMatrix::<f64, 4, 1>::new(x[0], x[1], x[2], 0.0)).collect()
}

fn largest(n: usize, blocks: &[Block], translations: &mut Translations) -> f64 {
    let limits = LanczosLimits { steps: 60, relative: 0.02 };
    largest_eigenvalue(3 * n, &limits, |v| {
        let mut rows = to_rows(v);
        translations.fill(blocks, &mut rows);
        multiply(blocks, &rows).iter().flat_map(|m| [m[0], m[1], m[2]]).collect()
    })
}

fn smallest(n: usize, blocks: &[Block], roots: &[usize], largest: f64) -> Result<f64, SolveError> {
    let pairs: Vec<(usize, usize)> = blocks.iter().map(|b| (b.row, b.column)).collect();
    let mut system = BlockCholesky::<4>::new(n, &pairs)?;
    let mut shift = TOLERANCE * largest.max(1e-12);
    loop {
        system.clear();
        for Block { row, column, value } in blocks {
            if let Some(slot) = system.slot(*row, *column) {
                system.add(slot, value);
            }
        }
        ground(&mut system, roots, 3);
        let added: Vec<f64> = (0..4 * n).map(|k| if k % 4 == 3 { 0.0 } else { shift }).collect();
        system.add_to_diagonal(&added);
        match system.factorise() {
            Ok(()) => break,
            // A negative eigenvalue beyond the shift.
            Err(_) if shift < 100.0 * largest => shift *= 4.0,
            Err(error) => return Err(error.into()),
        }
    }
    let limits = LanczosLimits { steps: 100, relative: 1e-4 };
    let inverse = largest_eigenvalue(3 * n, &limits, |v| {
        let mut x: Vec<f64> = v.chunks_exact(3).flat_map(|x| [x[0], x[1], x[2], 0.0]).collect();
        system.solve_in_place(&mut x, 1);
        x.chunks_exact(4).flat_map(|x| [x[0], x[1], x[2]]).collect()
    });
    Ok(1.0 / inverse - shift)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::solver::{Constraint, Objective, Solver, SolverSettings};
    use coma_geometry::{Matrix6, Tangent, se3};
    use nalgebra::{DMatrix, Vector3};

    /// A ring of measurements without a turn, slightly noisy.
    fn ring(nodes: usize) -> Problem {
        let constraints = (0..nodes)
            .map(|k| {
                let x = k as f64;
                let noise =
                    Tangent::new(0.02 * x.sin(), 0.0, 0.01 * x.cos(), 0.01 * x.cos(), 0.0, 0.02 * x.sin());
                Constraint {
                    from: k,
                    to: (k + 1) % nodes,
                    from_from_to: Pose::translation(0.1, 0.0, 0.0) * se3::exp(&noise),
                    information: Matrix6::identity() * 50.0,
                }
            })
            .collect();
        let fixed = (0..nodes).map(|k| k == 0).collect();
        Problem { nodes, constraints, fixed }
    }

    fn minimum(problem: &Problem, start: &[Pose]) -> (f64, Vec<Pose>) {
        let weights = vec![1.0; problem.constraints.len()];
        let mut solver = Solver::with_objective(problem, &weights, Objective::Isotropic).unwrap();
        let solved = solver.solve(start, &weights, &SolverSettings::default()).unwrap();
        (solved.cost, solved.poses)
    }

    #[test]
    fn the_global_minimum_is_certified_and_a_ring_wound_once_around_is_not() {
        let problem = ring(24);
        let weights = [1.0; 24];
        let (cost, poses) = minimum(&problem, &[Pose::identity(); 24]);
        let certificate = certify(&problem, &poses, &weights).unwrap();
        assert!(certificate.holds(), "{certificate:?}");
        assert!((certificate.objective - cost).abs() < 1e-6 * cost);
        let wound: Vec<Pose> = (0..24)
            .map(|k| {
                se3::exp(&Tangent::from_fn(|i, _| {
                    f64::from(i == 5) * k as f64 * std::f64::consts::TAU / 24.0
                }))
            })
            .collect();
        let (worse, poses) = minimum(&problem, &wound);
        assert!(worse > 2.0 * cost, "{worse} {cost}");
        let certificate = certify(&problem, &poses, &weights).unwrap();
        assert!(certificate.stationarity < 1e-3, "{certificate:?}");
        assert!(
            !certificate.holds() && certificate.smallest < -1e-3 * certificate.largest,
            "{certificate:?}"
        );
    }

    #[test]
    fn eigenvalues_are_those_of_the_dense_matrix() {
        let problem = ring(6);
        let weights = [1.0, 0.5, 1.0, 0.7, 1.0, 1.0];
        // Not a minimum: the matrix is defined there too.
        let poses: Vec<Pose> = (0..6)
            .map(|k| {
                let x = f64::from(k);
                Pose::from_parts(
                    Vector3::zeros().into(),
                    se3::so3_exp(&Vector3::new(0.4 * x, (2.0 * x).sin(), 0.3 - x)),
                )
            })
            .collect();
        let certificate = certify(&problem, &poses, &weights).unwrap();
        let blocks = data_matrix(&problem, &weights);
        let (mut m, mut coupling) = (DMatrix::<f64>::zeros(18, 18), DMatrix::<f64>::zeros(18, 6));
        let mut laplacian = DMatrix::<f64>::zeros(6, 6);
        for Block { row, column, value } in &blocks {
            for (r, c, v) in [(*row, *column, *value), (*column, *row, value.transpose())] {
                if row == column && (r, c, v) != (*row, *column, *value) {
                    continue;
                }
                let mut part = m.view_mut((3 * r, 3 * c), (3, 3));
                part += v.fixed_view::<3, 3>(0, 0);
                let mut part = coupling.view_mut((3 * r, c), (3, 1));
                part += v.fixed_view::<3, 1>(0, 3);
                laplacian[(r, c)] += v[(3, 3)];
                if row == column {
                    break;
                }
            }
        }
        let q = &m - &coupling * laplacian.pseudo_inverse(1e-9).unwrap() * coupling.transpose();
        let rotations = DMatrix::from_fn(18, 3, |r, c| matrix(&poses[r / 3])[(c, r % 3)]);
        let gradient = &q * &rotations;
        let mut s = q.clone();
        for node in 0..6 {
            let l = gradient.view((3 * node, 0), (3, 3)) * matrix(&poses[node]);
            let mut part = s.view_mut((3 * node, 3 * node), (3, 3));
            part -= (&l + l.transpose()) * 0.5;
        }
        let values = s.symmetric_eigenvalues();
        let close = |a: f64, b: f64, share: f64| (a - b).abs() < share * values.amax();
        assert!(close(certificate.smallest, values.min(), 1e-6), "{certificate:?} {values}");
        assert!(close(certificate.largest, values.max(), 0.05), "{certificate:?} {values}");
        let f = (rotations.transpose() * q * &rotations).trace();
        assert!((certificate.objective - f).abs() < 1e-9 * f);
    }
}
