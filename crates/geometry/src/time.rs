//! Sensor time.

use serde::{Deserialize, Serialize};

/// A sensor clock's reading in nanoseconds. Stamps order the frames of one session, are written back
/// unchanged, and are never compared between agents.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct StampNs(pub i64);

impl StampNs {
    /// Seconds, for plots and TUM files. Exact digits need the input's own text.
    pub fn seconds(self) -> f64 {
        self.0 as f64 * 1e-9
    }

    /// Nearest stamp to `seconds`.
    pub fn from_seconds(seconds: f64) -> Self {
        StampNs((seconds * 1e9).round() as i64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stamps_are_signed_nanoseconds() {
        assert_eq!(StampNs::from_seconds(1.5), StampNs(1_500_000_000));
        assert_eq!(StampNs(-250_000_000).seconds(), -0.25);
        assert!(StampNs(-1) < StampNs(0));
    }
}
