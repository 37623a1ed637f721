//! A solve that knows whether it is right: the certificate is asked, and where it says no, the solve starts again
//! elsewhere.

use crate::certificate::{Certificate, certify};
use crate::initialise::chordal;
use crate::solver::{Objective, Problem, SolveError, Solved, Solver, SolverSettings};
use coma_geometry::Pose;

/// Where a descent began.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Start {
    /// At the poses given.
    Given,
    /// At the chordal relaxation's.
    Chordal,
}

/// One descent and what the certificate says of its end.
#[derive(Clone, Debug, PartialEq)]
pub struct Attempt {
    /// Where it began.
    pub start: Start,
    /// Eq. 10 minimised from there.
    pub solved: Solved,
    /// SE-Sync's objective minimised from where that ended.
    pub isotropic: Solved,
    /// Of the latter: the certificate of the surrogate speaks for the basin that both lie in.
    pub certificate: Certificate,
}

/// Minimises eq. 10 and SE-Sync's objective from `given`, and from the chordal start if the certificate does not hold.
/// The last attempt is the result; it is the given start's if the chordal one's is no better.
pub fn solve(
    problem: &Problem,
    given: &[Pose],
    weights: &[f64],
    settings: &SolverSettings,
) -> Result<Vec<Attempt>, SolveError> {
    let first = attempt(problem, Start::Given, given, weights, settings)?;
    if first.certificate.holds() {
        return Ok(vec![first]);
    }
    let start = chordal(problem, given, weights)?;
    let second = attempt(problem, Start::Chordal, &start, weights, settings)?;
    let better = second.certificate.holds() || second.isotropic.cost < first.isotropic.cost;
    Ok(if better { vec![first, second] } else { vec![second, first] })
}

/// One descent from `poses`.
pub fn attempt(
    problem: &Problem,
    start: Start,
    poses: &[Pose],
    weights: &[f64],
    settings: &SolverSettings,
) -> Result<Attempt, SolveError> {
    let solved = problem.solve(poses, weights, settings)?;
    let isotropic = Solver::with_objective(problem, weights, Objective::Isotropic)?.solve(
        &solved.poses,
        weights,
        settings,
    )?;
    let certificate = certify(problem, &isotropic.poses, weights)?;
    Ok(Attempt { start, solved, isotropic, certificate })
}
