//! How wrong a depth sensor is.

use serde::{Deserialize, Serialize};

/// Standard deviation of depth, `base_m + quadratic_per_m * z^2`: structured light and stereo err with
/// the square of depth (Khoshelham & Elberink 2012).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DepthNoise {
    /// Metres at zero depth.
    pub base_m: f32,
    /// Metres per square metre of depth.
    pub quadratic_per_m: f32,
}

impl Default for DepthNoise {
    /// A Kinect-class sensor: 1 mm + 2 mm at 1 m growing with the square.
    fn default() -> Self {
        DepthNoise { base_m: 0.001, quadratic_per_m: 0.0019 }
    }
}

impl DepthNoise {
    /// One standard deviation at depth `z_m`, metres.
    #[inline]
    pub fn sigma_m(&self, z_m: f32) -> f32 {
        self.base_m + self.quadratic_per_m * z_m * z_m
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sigma_grows_with_the_square_of_depth() {
        let noise = DepthNoise { base_m: 0.001, quadratic_per_m: 0.002 };
        assert!((noise.sigma_m(1.0) - 0.003).abs() < 1e-7);
        assert!((noise.sigma_m(3.0) - 0.019).abs() < 1e-7);
    }
}
