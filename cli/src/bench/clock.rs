//! Time by the clock and of the processor.

use serde::Serialize;
use std::time::Instant;

/// What a stage took.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Spent {
    /// Of the processor, this thread alone; `None` where the system does not tell.
    pub cpu_ms: Option<f64>,
    /// By the clock.
    pub wall_ms: f64,
}

impl Spent {
    /// "cpu" or "cpu (wall)" in milliseconds, for tables.
    pub fn text(&self) -> String {
        match self.cpu_ms {
            Some(cpu_ms) => format!("{cpu_ms:.1}"),
            None => "not measured".into(),
        }
    }
}

/// Runs `work`, which must stay on this thread.
pub fn timed<T>(work: impl FnOnce() -> T) -> (T, Spent) {
    let (wall, cpu) = (Instant::now(), thread_cpu_ms());
    let result = work();
    let cpu_ms = cpu.zip(thread_cpu_ms()).map(|(before, after)| after - before);
    (result, Spent { cpu_ms, wall_ms: wall.elapsed().as_secs_f64() * 1e3 })
}

/// First field of Linux's schedstat: nanoseconds on a processor.
fn thread_cpu_ms() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    Some(text.split_whitespace().next()?.parse::<u64>().ok()? as f64 * 1e-6)
}
