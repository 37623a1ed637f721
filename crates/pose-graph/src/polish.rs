//! The last part of a robust solve: weights under the robust cost itself, until nothing changes.
//!
//! What is left out is judged by what taking it in would cost, not by the error that leaving it out has caused; what is
//! in use by what the others say without it. Both need a solve for each question, so that the cheap bounds of
//! [`crate::detour`] decide first who is asked about at all.

use crate::detour::Detours;
use crate::gnc::{Kernel, RobustSettings, Trust, connected, final_weight};
use crate::solver::{Problem, SolveError, Solved, Solver, SolverSettings};

/// Most rounds; a few settle it.
const ROUNDS: u32 = 20;
/// A loop in use is asked about only if its squared error is above this share of the limit,
const STRAINED: f64 = 0.25;
/// and only so many of which the worst is to be feared: each asks for a solve.
const MOST_ASKED: usize = 32;
/// A loop in use is given up when the others contradict it by this many times the limit: what is in must fail more
/// clearly than what is out must fit, or true loops that lean on each other would be lost to the order of asking.
const PARTING: f64 = 2.0;
/// Loops that are off by no more than this many times the limit are once taken back together: each may fail only for
/// want of the others.
const TOGETHER: f64 = 5.0;

/// What there is to settle.
pub(crate) struct Polish<'a> {
    pub problem: &'a Problem,
    pub trust: &'a [Trust],
    pub robust: &'a RobustSettings,
    pub settings: &'a SolverSettings,
}

/// What it took.
#[derive(Default)]
pub(crate) struct Effort {
    pub iterations: u32,
    pub rounds: u32,
}

impl<'a> Polish<'a> {
    /// Changes weights and poses until nothing changes any more. `solver` has a place for the constraints `in_pattern`.
    pub fn settle(
        &self,
        solver: &mut Solver<'a>,
        mut in_pattern: Vec<bool>,
        solved: &mut Solved,
        mut weights: Vec<f64>,
    ) -> Result<(Vec<f64>, Effort), SolveError> {
        let mut effort = Effort::default();
        // Rounds on the way need no full precision.
        let near = SolverSettings { relative_decrease: 1e-6, ..*self.settings };
        for round in 0..ROUNDS {
            let next = self.next(solver, solved, &weights, round == 0)?;
            if !changed(&next, &weights) || !connected(self.problem, &next) {
                // The first round only asks about all together; the next ones ask one by one.
                if round == 0 {
                    continue;
                }
                break;
            }
            effort.rounds += 1;
            weights = next;
            // What is left out needs no place in the system until it is taken in.
            if weights.iter().zip(&in_pattern).any(|(w, inside)| *w > 0.0 && !inside) {
                in_pattern = weights.iter().map(|w| *w > 0.0).collect();
                *solver = Solver::with_pattern(self.problem, &weights, &in_pattern)?;
            }
            *solved = solver.solve(&solved.poses, &weights, &near)?;
            effort.iterations += solved.iterations;
        }
        Ok((weights, effort))
    }

    fn next(
        &self,
        solver: &mut Solver,
        solved: &Solved,
        weights: &[f64],
        first: bool,
    ) -> Result<Vec<f64>, SolveError> {
        let (kernel, limit) = (self.robust.kernel, self.robust.squared_error_6dof);
        let truncated = kernel == Kernel::TruncatedLeastSquares;
        let error = |k: usize| self.problem.constraints[k].squared_error(&solved.poses);
        let questioned: Vec<usize> =
            (0..self.trust.len()).filter(|&k| self.trust[k] != Trust::Full).collect();
        let mut next = weights.to_vec();
        for &k in &questioned {
            next[k] = final_weight(kernel, limit, error(k));
        }
        let out: Vec<usize> = questioned.iter().copied().filter(|&k| !(weights[k] > 0.0)).collect();
        if first && truncated {
            for &k in out.iter().filter(|&&k| error(k) <= TOGETHER * limit) {
                next[k] = 1.0;
            }
            return Ok(next);
        }
        let detours = Detours::new(self.problem, &solved.poses, weights);
        let may_fit = |k: &usize| !truncated || detours.least_error_outside(*k) <= limit;
        let asked: Vec<usize> = out.into_iter().filter(may_fit).collect();
        for (&k, innovation) in asked.iter().zip(solver.innovations(&solved.poses, weights, &asked)?) {
            next[k] = next[k].max(final_weight(kernel, limit, innovation));
        }
        if truncated && !changed(&next, weights) {
            // A loop in use bends the graph towards itself: ask what the others say without it, and part with the
            // one that they contradict most.
            let mut strained: Vec<(f64, usize)> = questioned
                .iter()
                .filter(|&&k| weights[k] > 0.0 && error(k) > STRAINED * limit)
                .map(|&k| (detours.most_error_inside(k), k))
                .filter(|(most, _)| *most > PARTING * limit)
                .collect();
            strained.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
            strained.truncate(MOST_ASKED);
            let asked: Vec<usize> = strained.into_iter().map(|(_, k)| k).collect();
            let without = solver.innovations(&solved.poses, weights, &asked)?;
            let worst = asked.iter().zip(without).max_by(|(_, a), (_, b)| a.total_cmp(b));
            if let Some((&k, _)) = worst.filter(|(_, squared)| *squared > PARTING * limit) {
                next[k] = 0.0;
            }
        }
        Ok(next)
    }
}

fn changed(next: &[f64], weights: &[f64]) -> bool {
    next.iter().zip(weights).any(|(a, b)| (a - b).abs() > 1e-3)
}
