//! Pose graphs: from pairwise measurements between submaps to one map.
//!
//! Read in this order:
//! * [`graph`]: nodes (submaps), edges (odometry and loops), and what makes an entry unusable.
//! * [`residual`]: the error of one edge (eq. 11) and its Jacobians.
//! * [`sparse`], [`solver`]: Levenberg-Marquardt over a sparse block Cholesky factorisation.
//! * [`initialise`]: starts from a spanning tree or from the chordal relaxation.
//! * [`isotropic`], [`certificate`], [`certified`]: is the minimum the global one?
//! * [`gnc`], [`clique`], [`consistency`]: which loops to believe.
//! * [`chain`], [`relative`]: which trajectories may join, and where they stand to each other (eq. 12).
//! * [`global`]: the canonical solve of everything that is known (eq. 10); [`solution`] is its result.
//! * [`preview`]: what a new measurement does to the last result, at once and provisionally.
//! * [`blocks`]: the same without anyone who holds the whole graph.
//! * [`covariance`]: how sure a pose is. [`g2o`], [`team`]: files.
//!
//! Everything is `f64` and a function of its arguments: the same entries in any order, on any number of threads, give the
//! same bits.

#![allow(
    clippy::neg_cmp_op_on_partial_ord,
    reason = "guards are positive, so that NaN falls on the safe side"
)]

pub mod blocks;
pub mod certificate;
pub mod certified;
pub mod chain;
pub mod clique;
pub mod consistency;
pub mod covariance;
mod detour;
pub mod g2o;
pub mod global;
pub mod gnc;
pub mod graph;
pub mod initialise;
pub mod isotropic;
mod lanczos;
mod polish;
pub mod preview;
pub mod relative;
pub mod residual;
mod sets;
pub mod solution;
pub mod solver;
pub mod sparse;
pub mod team;
pub mod uncertain;

pub use global::{GlobalSettings, solve};
pub use graph::{Edge, EdgeKey, EdgeKind, GraphEntries, NodeInfo};
pub use solution::{Component, Generation, LoopVerdict, LoopWeight, Solution};
pub use solver::{Constraint, Objective, Problem, SolveError, Solved, SolverSettings};
