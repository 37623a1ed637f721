//! Time by the clock and of the processor, of one step.

use super::cpu;
use serde::Serialize;
use std::time::Instant;

/// What a step took.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Spent {
    /// Of the processor, all threads together.
    pub cpu_ms: f64,
    /// By the clock.
    pub wall_ms: f64,
}

/// What `work` gives, and what it took.
pub fn timed<T>(work: impl FnOnce() -> T) -> (T, Spent) {
    let wall = Instant::now();
    let (result, cpu_ms) = cpu::timed(work);
    (result, Spent { cpu_ms, wall_ms: wall.elapsed().as_secs_f64() * 1e3 })
}
