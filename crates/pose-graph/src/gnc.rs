//! Graduated non-convexity (Yang, Antonante, Tzoumas, Carlone, RA-L 2020): least squares that ends up
//! ignoring measurements which do not fit, without a good start.

use crate::polish::{Polish, State};
use crate::solver::{Problem, SolveError, Solved, Solver, SolverSettings};
use coma_geometry::Pose;
use serde::{Deserialize, Serialize};

/// The robust cost that is approached.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Kernel {
    /// `min(r^2, c^2)`: a measurement counts fully or not at all.
    #[default]
    TruncatedLeastSquares,
    /// `c^2 r^2 / (c^2 + r^2)`: weights fall smoothly.
    GemanMcClure,
}

/// Which residuals are believed, and how slowly to decide.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RobustSettings {
    /// The robust cost.
    pub kernel: Kernel,
    /// Largest squared Mahalanobis error of a true measurement with 6 degrees of freedom: the 0.999 quantile of
    /// chi-square.
    pub squared_error_6dof: f64,
    /// The same with 3 degrees of freedom.
    pub squared_error_3dof: f64,
    /// Once the graph is settled, a loop within a chain is believed up to so many times `squared_error_6dof`, where
    /// loops count fully or not at all. A real sensor errs alike whenever it looks at one place, so that odometry and
    /// loops are off by more than each of them can tell; 4 is twice the standard deviation. 1: no more than others.
    pub within_chain: f64,
    /// Factor by which the cost gets less convex in each round. 1.4 in the paper.
    pub convexity_step: f64,
    /// Most rounds.
    pub max_rounds: u32,
}

impl Default for RobustSettings {
    fn default() -> Self {
        RobustSettings {
            kernel: Kernel::TruncatedLeastSquares,
            squared_error_6dof: 22.458,
            squared_error_3dof: 16.266,
            within_chain: 4.0,
            convexity_step: 1.4,
            max_rounds: 60,
        }
    }
}

impl RobustSettings {
    /// Largest squared error of a loop that is believed in the end, 6 degrees of freedom.
    pub fn limit(&self, within_chain: bool) -> f64 {
        match self.kernel {
            Kernel::TruncatedLeastSquares if within_chain => {
                self.squared_error_6dof * self.within_chain.max(1.0)
            }
            _ => self.squared_error_6dof,
        }
    }
}

/// The state of one run: how convex the cost still is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Schedule {
    kernel: Kernel,
    limit: f64,
    step: f64,
    mu: f64,
}

impl Schedule {
    /// Starts where the cost is convex for residuals up to `largest` (squared). `limit` is the squared error up to
    /// which a measurement is believed. `None` if nothing is in doubt.
    pub fn new(kernel: Kernel, limit: f64, convexity_step: f64, largest: f64) -> Option<Self> {
        let mu = match kernel {
            Kernel::TruncatedLeastSquares if !(2.0 * largest > limit) => return None,
            Kernel::TruncatedLeastSquares => (limit / (2.0 * largest - limit)).max(1e-12),
            Kernel::GemanMcClure => (2.0 * largest / limit).clamp(1.0, 1e12),
        };
        Some(Schedule { kernel, limit, step: convexity_step.max(1.01), mu })
    }

    /// The weight (0 to 1) of a measurement with this squared residual.
    pub fn weight(&self, squared: f64) -> f64 {
        let (c2, mu) = (self.limit, self.mu);
        if !squared.is_finite() {
            return 0.0;
        }
        match self.kernel {
            Kernel::TruncatedLeastSquares => {
                if squared <= mu / (mu + 1.0) * c2 {
                    1.0
                } else if squared >= (mu + 1.0) / mu * c2 {
                    0.0
                } else {
                    ((c2 * mu * (mu + 1.0) / squared).sqrt() - mu).clamp(0.0, 1.0)
                }
            }
            Kernel::GemanMcClure => {
                let w = mu * c2 / (squared + mu * c2);
                w * w
            }
        }
    }

    /// Makes the cost less convex. False if it is the robust one already.
    pub fn advance(&mut self) -> bool {
        match self.kernel {
            Kernel::TruncatedLeastSquares => {
                self.mu *= self.step;
                self.mu < 1e6
            }
            Kernel::GemanMcClure => {
                let more = self.mu > 1.0;
                self.mu = (self.mu / self.step).max(1.0);
                more
            }
        }
    }
}

/// The weight under the robust cost itself.
pub fn final_weight(kernel: Kernel, limit: f64, squared: f64) -> f64 {
    match kernel {
        Kernel::TruncatedLeastSquares => f64::from(u8::from(squared <= limit)),
        Kernel::GemanMcClure => Schedule { kernel, limit, step: 1.4, mu: 1.0 }.weight(squared),
    }
}

/// Whether a constraint may be doubted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trust {
    /// Weight 1, always.
    Full,
    /// Weighted by its residual from the start.
    Doubted,
    /// Weight 0 until the end, then by its residual: something speaks against it, or nothing for it.
    Suspended,
}

/// Weights that change by less than this, all together, do not move the graph,
const UNCHANGED: f64 = 0.5;
/// nor do those that change by less than this on average.
const UNCHANGED_EACH: f64 = 1e-3;

/// A solution with the weights that it was reached with.
#[derive(Clone, Debug, PartialEq)]
pub struct RobustSolved {
    /// The last solve; its iterations are summed over all rounds.
    pub solved: Solved,
    /// One weight per constraint, 0 to 1.
    pub weights: Vec<f64>,
    /// Rounds of reweighting.
    pub rounds: u32,
}

/// Solves with robust weights. `trust` is one per constraint; the fully trusted constraints must hold every
/// node (odometry does, and so do starts with the doubted ones where chains are joined by loops alone).
pub fn solve(
    problem: &Problem,
    start: &[Pose],
    trust: &[Trust],
    robust: &RobustSettings,
    settings: &SolverSettings,
) -> Result<RobustSolved, SolveError> {
    let initial = |t: &Trust| if *t == Trust::Suspended { 0.0 } else { 1.0 };
    let mut weights: Vec<f64> = trust.iter().map(initial).collect();
    // What is suspended gets a place in the system when it gets a weight.
    let in_pattern: Vec<bool> = trust.iter().map(|t| *t != Trust::Suspended).collect();
    let mut solver = Solver::with_pattern(problem, &weights, &in_pattern)?;
    // Rounds on the way need no precision.
    let rough = SolverSettings { relative_decrease: 1e-2, max_iterations: 10, ..*settings };
    let mut solved = solver.solve(start, &weights, &rough)?;
    // From there on steps start near a minimum: damping would only slow them down along what is known least.
    let settings = &SolverSettings { initial_damping: 1e-4 * settings.initial_damping, ..*settings };
    let rough = SolverSettings { initial_damping: settings.initial_damping, ..rough };
    let initial_cost = solved.initial_cost;
    let mut iterations = solved.iterations;
    let mut rounds = 0;
    let limit = robust.squared_error_6dof;
    let squared = |poses: &[Pose], k: usize| problem.constraints[k].squared_error(poses);
    let doubted: Vec<usize> = (0..trust.len()).filter(|&k| trust[k] == Trust::Doubted).collect();
    let largest = doubted.iter().map(|&k| squared(&solved.poses, k)).fold(0.0, f64::max);
    if let Some(mut schedule) = Schedule::new(robust.kernel, limit, robust.convexity_step, largest) {
        while rounds < robust.max_rounds {
            rounds += 1;
            let mut next = weights.clone();
            for &k in &doubted {
                next[k] = schedule.weight(squared(&solved.poses, k));
            }
            // Never let go of the last loop that holds a chain.
            if !connected(problem, &next) {
                break;
            }
            let change: f64 = next.iter().zip(&weights).map(|(a, b)| (a - b).abs()).sum();
            weights = next;
            // Where next to nothing changes the next round may as well ask the same poses.
            if rounds == 1 || change > UNCHANGED.min(UNCHANGED_EACH * doubted.len() as f64) {
                solved = solver.solve(&solved.poses, &weights, &rough)?;
                iterations += solved.iterations;
            }
            let decided = robust.kernel == Kernel::TruncatedLeastSquares
                && doubted.iter().all(|&k| weights[k] == 0.0 || weights[k] == 1.0);
            if decided || !schedule.advance() {
                break;
            }
        }
    }
    let polish = Polish { problem, trust, robust, settings };
    let mut state = State { solver, in_pattern, solved, weights, iterations, rounds };
    polish.settle(&mut state)?;
    let State { mut solver, solved, weights, iterations, rounds, .. } = state;
    let last = solver.solve(&solved.poses, &weights, settings)?;
    let solved = Solved { initial_cost, iterations: iterations + last.iterations, ..last };
    Ok(RobustSolved { solved, weights, rounds })
}

pub(crate) fn connected(problem: &Problem, weights: &[f64]) -> bool {
    problem.check(weights).is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::solver::Constraint;
    use coma_geometry::{Matrix6, Tangent, se3};

    /// A corridor walked there and back, with one true and two false loops.
    fn corridor() -> (Problem, Vec<Trust>, Vec<Pose>) {
        let mut truth = vec![Pose::identity()];
        for k in 0..19 {
            let turn = if k == 9 { std::f64::consts::PI - 0.01 } else { 0.01 };
            let step = se3::exp(&Tangent::new(0.0, 0.0, 0.0, 0.0, 0.0, turn))
                * se3::exp(&Tangent::new(1.0, 0.0, 0.0, 0.0, 0.0, 0.0));
            truth.push(truth[k] * step);
        }
        let edge = |from: usize, to: usize, error: Tangent, information: f64| Constraint {
            from,
            to,
            from_from_to: truth[from].inverse() * truth[to] * se3::exp(&error),
            information: Matrix6::identity() * information,
        };
        let drift = Tangent::new(0.004, -0.003, 0.002, 0.001, -0.001, 0.002);
        let mut constraints: Vec<Constraint> = (0..19).map(|k| edge(k, k + 1, drift, 1e4)).collect();
        let mut trust = vec![Trust::Full; 19];
        for (from, to, error) in [
            (0, 19, Tangent::zeros()),
            (3, 15, Tangent::zeros()),
            (5, 14, Tangent::new(3.0, 2.0, 0.0, 0.0, 1.0, 0.0)),
            (2, 17, Tangent::new(-1.0, 0.0, 2.0, 0.4, 0.0, 2.0)),
        ] {
            constraints.push(edge(from, to, error, 1e4));
            trust.push(Trust::Doubted);
        }
        let mut fixed = vec![false; 20];
        fixed[0] = true;
        (Problem { nodes: 20, constraints, fixed }, trust, truth)
    }

    #[test]
    fn false_loops_end_with_no_weight_under_both_kernels() {
        for kernel in [Kernel::TruncatedLeastSquares, Kernel::GemanMcClure] {
            let (problem, trust, truth) = corridor();
            let mut start = vec![Pose::identity()];
            for k in 0..19 {
                start.push(start[k] * problem.constraints[k].from_from_to);
            }
            let robust = RobustSettings { kernel, ..RobustSettings::default() };
            let found = solve(&problem, &start, &trust, &robust, &SolverSettings::default()).unwrap();
            assert!(
                found.weights[19] > 0.5 && found.weights[20] > 0.5,
                "{kernel:?} {:?}",
                &found.weights[19..]
            );
            assert!(
                found.weights[21] < 0.1 && found.weights[22] < 0.1,
                "{kernel:?} {:?}",
                &found.weights[19..]
            );
            let (m, _) = se3::distance(&found.solved.poses[19], &truth[19]);
            assert!(m < 0.02, "{m}");
        }
    }

    /// Two loops that are off by 12 and 60 standard deviations of their own; those of the graph come on top.
    #[test]
    fn a_loop_within_a_chain_may_be_off_by_twice_what_it_claims() {
        let (mut problem, mut trust, truth) = corridor();
        let off = |sigmas: f64| {
            let mut off = problem.constraints[20].clone();
            off.from_from_to = truth[off.from].inverse()
                * truth[off.to]
                * se3::exp(&Tangent::new(sigmas * 1e-2, 0.0, 0.0, 0.0, 0.0, 0.0));
            off
        };
        let (near, far) = (off(12.0), off(60.0));
        problem.constraints.extend([near, far]);
        trust.extend([Trust::Doubted; 2]);
        let weights = |trust: &[Trust], within_chain: f64| {
            let robust = RobustSettings { within_chain, ..RobustSettings::default() };
            let found = solve(&problem, &truth, trust, &robust, &SolverSettings::default()).unwrap();
            found.weights[19..].to_vec()
        };
        assert_eq!(weights(&trust, 1.0), [1.0, 1.0, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(weights(&trust, 4.0), [1.0, 1.0, 0.0, 0.0, 1.0, 0.0]);
        // Where odometry does not connect the two ends, they are two chains.
        trust[9] = Trust::Doubted;
        assert_eq!(weights(&trust, 4.0)[4], 0.0);
    }

    #[test]
    fn a_suspended_loop_that_fits_is_taken_back_in() {
        let (problem, mut trust, _) = corridor();
        trust[19] = Trust::Suspended;
        trust[21] = Trust::Suspended;
        let mut start = vec![Pose::identity()];
        for k in 0..19 {
            start.push(start[k] * problem.constraints[k].from_from_to);
        }
        let found =
            solve(&problem, &start, &trust, &RobustSettings::default(), &SolverSettings::default()).unwrap();
        assert_eq!((found.weights[19], found.weights[21]), (1.0, 0.0));
    }
}
