//! Times by stage.

use crate::percentile;
use crate::stats::mean;
use serde::{Deserialize, Serialize};

/// The stage whose time per frame is the paper's tracking time.
pub const TRACKING: &str = "tracking";
/// The stage whose time per frame is the paper's mapping time.
pub const MAPPING: &str = "mapping";

/// How long a stage took, over all agents.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StageTime {
    /// Its name.
    pub stage: String,
    /// How often it ran.
    pub count: usize,
    /// All of it, seconds.
    pub total_s: f64,
    /// Of one time, seconds.
    pub mean_s: f64,
    /// 95 of 100 took at most so long, seconds.
    pub p95_s: f64,
}

impl StageTime {
    /// From the seconds of each time that it ran; those that are no time are left out. `None` if there is none.
    pub fn of(stage: &str, seconds: &[f64]) -> Option<Self> {
        let seconds: Vec<f64> = seconds.iter().copied().filter(|s| s.is_finite() && *s >= 0.0).collect();
        Some(StageTime {
            stage: stage.to_owned(),
            count: seconds.len(),
            total_s: seconds.iter().sum(),
            mean_s: mean(&seconds)?,
            p95_s: percentile(&seconds, 95.0)?,
        })
    }
}

/// Where the time of a run went.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Times {
    /// From the first frame to the last file, seconds.
    pub wall_s: Option<f64>,
    /// Processor time of all threads, seconds.
    pub cpu_s: Option<f64>,
    /// In the order of the pipeline.
    pub stages: Vec<StageTime>,
}

impl Times {
    /// A stage by name.
    pub fn stage(&self, name: &str) -> Option<&StageTime> {
        self.stages.iter().find(|stage| stage.stage == name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stage_has_its_sum_mean_and_95th_percentile() {
        let seconds: Vec<f64> = (0..=100).map(|i| f64::from(i) * 0.01).collect();
        let stage = StageTime::of(TRACKING, &seconds).unwrap();
        assert_eq!((stage.count, stage.stage.as_str()), (101, "tracking"));
        assert!((stage.total_s - 50.5).abs() < 1e-9 && (stage.mean_s - 0.5).abs() < 1e-9);
        assert!((stage.p95_s - 0.95).abs() < 1e-9);
    }

    #[test]
    fn what_is_no_time_is_left_out() {
        assert_eq!(StageTime::of(MAPPING, &[f64::NAN, -1.0, 2.0]).unwrap().mean_s, 2.0);
        assert_eq!(StageTime::of(MAPPING, &[]), None);
    }
}
