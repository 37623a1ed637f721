//! Processor time: what a step costs, whoever else uses the machine.

use rustix::time::{ClockId, clock_gettime};

/// User and system time of all threads of this process so far, milliseconds.
pub fn process_ms() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 * 1e3 + time.tv_nsec as f64 * 1e-6
}

/// What `work` gives, and the processor time that it took, milliseconds.
pub fn timed<T>(work: impl FnOnce() -> T) -> (T, f64) {
    let before_ms = process_ms();
    let result = work();
    (result, process_ms() - before_ms)
}

/// The middle value; 0 of none.
pub fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    match values.len() {
        0 => 0.0,
        n if n % 2 == 1 => values[n / 2],
        n => 0.5 * (values[n / 2 - 1] + values[n / 2]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_takes_processor_time_and_the_median_is_the_middle() {
        let (sum, ms) = timed(|| (0..5_000_000u64).fold(0u64, |a, b| a.wrapping_mul(31).wrapping_add(b)));
        assert!(sum != 0 && ms > 0.0);
        assert_eq!(median(vec![3.0, 1.0, 2.0]), 2.0);
        assert_eq!(median(vec![4.0, 1.0, 2.0, 3.0]), 2.5);
        assert_eq!(median(Vec::new()), 0.0);
    }
}
