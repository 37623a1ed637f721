//! The last part of a robust solve: weights under the robust cost itself, until nothing changes.
//!
//! What is left out is judged by what taking it in would cost, not by the error that leaving it out has caused; what is
//! in use by what the others say without it. Both need a solve for each question, so that the cheap bounds of
//! [`crate::detour`] decide first who is asked about at all.
//!
//! Once that is settled, loops within a chain that are out are asked about under their wider limit
//! ([`RobustSettings::within_chain`]): true loops hold the graph by then, so that few places are left where a false one
//! fits.

use crate::detour::Detours;
use crate::gnc::{Kernel, RobustSettings, Trust, connected, final_weight};
use crate::sets::Sets;
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

/// Where a solve stands.
pub(crate) struct State<'a> {
    /// Has a place for the constraints `in_pattern`.
    pub solver: Solver<'a>,
    pub in_pattern: Vec<bool>,
    pub solved: Solved,
    /// One per constraint.
    pub weights: Vec<f64>,
    /// Linear solves so far.
    pub iterations: u32,
    /// Rounds of reweighting so far.
    pub rounds: u32,
}

impl<'a> Polish<'a> {
    /// Changes weights and poses until nothing changes any more.
    pub fn settle(&self, state: &mut State<'a>) -> Result<(), SolveError> {
        let strict = vec![self.robust.limit(false); self.trust.len()];
        self.rounds(state, &strict, true)?;
        let within = self.within_chains();
        let limits: Vec<f64> = within.iter().map(|within| self.robust.limit(*within)).collect();
        let mut doubts = limits.iter().zip(&strict).zip(&state.weights);
        if doubts.any(|((wide, strict), weight)| wide > strict && !(*weight > 0.0)) {
            self.rounds(state, &limits, false)?;
        }
        Ok(())
    }

    /// Which constraints have both ends in one chain: those that are fully trusted hold it together.
    fn within_chains(&self) -> Vec<bool> {
        let mut chains = Sets::new(self.problem.nodes);
        for (c, _) in self.problem.constraints.iter().zip(self.trust).filter(|(_, t)| **t == Trust::Full) {
            chains.join(c.from, c.to);
        }
        self.problem.constraints.iter().map(|c| chains.same(c.from, c.to)).collect()
    }

    /// Rounds under `limits`, the largest squared error of each constraint that is believed; at first all that is out
    /// may come back `together`.
    fn rounds(&self, state: &mut State<'a>, limits: &[f64], together: bool) -> Result<(), SolveError> {
        // Rounds on the way need no full precision.
        let near = SolverSettings { relative_decrease: 1e-6, ..*self.settings };
        for round in 0..ROUNDS {
            let first = together && round == 0;
            let next = self.next(&mut state.solver, &state.solved, &state.weights, limits, first)?;
            if !changed(&next, &state.weights) || !connected(self.problem, &next) {
                // The first round only asks about all together; the next ones ask one by one.
                if first {
                    continue;
                }
                break;
            }
            state.rounds += 1;
            state.weights = next;
            // What is left out needs no place in the system until it is taken in.
            if state.weights.iter().zip(&state.in_pattern).any(|(w, inside)| *w > 0.0 && !inside) {
                state.in_pattern = state.weights.iter().map(|w| *w > 0.0).collect();
                state.solver = Solver::with_pattern(self.problem, &state.weights, &state.in_pattern)?;
            }
            state.solved = state.solver.solve(&state.solved.poses, &state.weights, &near)?;
            state.iterations += state.solved.iterations;
        }
        Ok(())
    }

    fn next(
        &self,
        solver: &mut Solver,
        solved: &Solved,
        weights: &[f64],
        limits: &[f64],
        first: bool,
    ) -> Result<Vec<f64>, SolveError> {
        let kernel = self.robust.kernel;
        let truncated = kernel == Kernel::TruncatedLeastSquares;
        let error = |k: usize| self.problem.constraints[k].squared_error(&solved.poses);
        let questioned: Vec<usize> =
            (0..self.trust.len()).filter(|&k| self.trust[k] != Trust::Full).collect();
        let mut next = weights.to_vec();
        for &k in &questioned {
            next[k] = final_weight(kernel, limits[k], error(k));
        }
        let out: Vec<usize> = questioned.iter().copied().filter(|&k| !(weights[k] > 0.0)).collect();
        if first && truncated {
            for &k in out.iter().filter(|&&k| error(k) <= TOGETHER * limits[k]) {
                next[k] = 1.0;
            }
            return Ok(next);
        }
        let detours = Detours::new(self.problem, &solved.poses, weights);
        let may_fit = |k: &usize| !truncated || detours.least_error_outside(*k) <= limits[*k];
        let asked: Vec<usize> = out.into_iter().filter(may_fit).collect();
        for (&k, innovation) in asked.iter().zip(solver.innovations(&solved.poses, weights, &asked)?) {
            next[k] = next[k].max(final_weight(kernel, limits[k], innovation));
        }
        if truncated && !changed(&next, weights) {
            // A loop in use bends the graph towards itself: ask what the others say without it, and part with the
            // one that they contradict most.
            let mut strained: Vec<(f64, usize)> = questioned
                .iter()
                .filter(|&&k| weights[k] > 0.0 && error(k) > STRAINED * limits[k])
                .map(|&k| (detours.most_error_inside(k) / limits[k], k))
                .filter(|(times, _)| *times > PARTING)
                .collect();
            strained.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
            strained.truncate(MOST_ASKED);
            let asked: Vec<usize> = strained.into_iter().map(|(_, k)| k).collect();
            let without = solver.innovations(&solved.poses, weights, &asked)?;
            let times = asked.iter().zip(without).map(|(&k, squared)| (squared / limits[k], k));
            let worst = times.max_by(|(a, _), (b, _)| a.total_cmp(b));
            if let Some((_, k)) = worst.filter(|(times, _)| *times > PARTING) {
                next[k] = 0.0;
            }
        }
        Ok(next)
    }
}

fn changed(next: &[f64], weights: &[f64]) -> bool {
    next.iter().zip(weights).any(|(a, b)| (a - b).abs() > 1e-3)
}
