//! Pose graphs: from pairwise measurements between submaps to one map.
//!
//! Read in this order:
//! * [`residual`]: the error of one edge (eq. 11) and its Jacobians.
//! * [`sparse`], [`solver`]: Levenberg-Marquardt over a sparse block Cholesky factorisation.
//! * [`initialise`]: starts from a spanning tree or from the chordal relaxation.
//! * [`covariance`]: how sure a pose is. [`g2o`]: files.
//!
//! Everything is `f64`, single-threaded, and a function of its arguments: the same entries in any order
//! give the same bits.

pub mod covariance;
pub mod g2o;
pub mod initialise;
pub mod residual;
pub mod solver;
pub mod sparse;

pub use solver::{Constraint, Problem, SolveError, Solved, SolverSettings};
