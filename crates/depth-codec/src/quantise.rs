//! From metres to whole codes and back. Code 0 is "no measurement".

use crate::DepthCodecError;
use coma_frame::{DepthNoise, Image};

/// Codes of the 12-bit form: 1 to this.
const LINEAR12_CODES: u16 = 4095;

/// How metres become whole codes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Quantisation {
    /// Whole units of the sensor: nothing is lost when the depth came from such units. Depth under half a unit
    /// or over 65535 units becomes "no measurement".
    Lossless16 {
        /// 1000 for millimetres.
        units_per_metre: f32,
    },
    /// The paper's 12 bits: 4095 levels from `near_m` to `far_m`; depth outside becomes "no measurement".
    Linear12 {
        /// The nearest depth, metres.
        near_m: f32,
        /// The farthest depth, metres.
        far_m: f32,
    },
    /// Steps that grow with the sensor's noise, so that the error stays under `fraction` of one standard
    /// deviation at every depth. The range is that of the image: nothing falls outside.
    NoiseProportional {
        /// The sensor's noise.
        noise: DepthNoise,
        /// The largest error as a fraction of one standard deviation.
        fraction: f32,
    },
}

/// How far a decoded depth can be from the encoded one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ErrorBound {
    /// Depth that was whole units is the same; any other is at most this far, metres (half a unit).
    HalfUnit {
        /// Metres.
        max_m: f32,
    },
    /// The same bound at every depth, metres.
    Uniform {
        /// Metres.
        max_m: f32,
    },
    /// At most this fraction of the sensor's standard deviation.
    Noise {
        /// The sensor's noise.
        noise: DepthNoise,
        /// Fraction of one standard deviation.
        fraction: f32,
    },
}

impl ErrorBound {
    /// The bound for a pixel whose true depth is `z_m`, metres; rounding to f32 included.
    pub fn at_m(&self, z_m: f32) -> f32 {
        let rounding_m = 2.5e-7 * z_m.abs();
        match *self {
            ErrorBound::HalfUnit { max_m } | ErrorBound::Uniform { max_m } => max_m + rounding_m,
            ErrorBound::Noise { noise, fraction } => fraction * noise.sigma_m(z_m) * 1.000_001 + rounding_m,
        }
    }
}

/// The quantisation as the header holds it: all that a decoder needs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Stored {
    Lossless16 { units_per_metre: f32 },
    Linear12 { near_m: f32, far_m: f32 },
    Noise { noise: DepthNoise, fraction: f32, near_m: f32, far_m: f32 },
}

/// Makes codes of an image.
pub(crate) struct Codes;

impl Codes {
    /// The codes of `depth_m`, and what the header must say about them.
    pub(crate) fn of(
        depth_m: &Image<f32>,
        quantisation: &Quantisation,
    ) -> Result<(Image<u16>, Stored), DepthCodecError> {
        let measured = |z: f32| z > 0.0 && z.is_finite();
        match *quantisation {
            Quantisation::Lossless16 { units_per_metre } => {
                let stored = Stored::lossless(units_per_metre)?;
                let scale = units_per_metre as f64;
                let code = |z: &f32| {
                    let units = *z as f64 * scale + 0.5;
                    if measured(*z) && units < 65536.0 { units as u16 } else { 0 }
                };
                Ok((depth_m.map(code), stored))
            }
            Quantisation::Linear12 { near_m, far_m } => {
                let stored = Stored::Linear12 { near_m, far_m };
                stored.check()?;
                let per_step = 1.0 / linear12_step_m(near_m, far_m);
                let code = |z: &f32| {
                    let inside = measured(*z) && *z >= near_m && *z <= far_m;
                    if inside { 1 + ((*z as f64 - near_m as f64) * per_step + 0.5) as u16 } else { 0 }
                };
                Ok((depth_m.map(code), stored))
            }
            Quantisation::NoiseProportional { noise, fraction } => {
                let depths = || depth_m.pixels().iter().copied().filter(|z| measured(*z));
                // An image without a measurement has any range.
                let near_m = depths().reduce(f32::min).unwrap_or(1.0);
                let far_m = depths().reduce(f32::max).unwrap_or(1.0);
                let stored = Stored::Noise { noise, fraction, near_m, far_m };
                stored.check()?;
                let nearest = NearestLevel::new(noise_levels_m(noise, fraction, near_m, far_m)?);
                Ok((depth_m.map(|z| if measured(*z) { nearest.code(*z) } else { 0 }), stored))
            }
        }
    }
}

impl Stored {
    pub(crate) fn lossless(units_per_metre: f32) -> Result<Stored, DepthCodecError> {
        let stored = Stored::Lossless16 { units_per_metre };
        stored.check()?;
        Ok(stored)
    }

    /// Whether every parameter is in its range: for settings and for headers alike.
    pub(crate) fn check(&self) -> Result<(), DepthCodecError> {
        let require = |ok: bool, name, value: f32, expected| {
            if ok { Ok(()) } else { Err(DepthCodecError::Setting { name, value: value as f64, expected }) }
        };
        let positive = |v: f32| v > 0.0 && v.is_finite();
        let not_negative = |v: f32| v >= 0.0 && v.is_finite();
        match *self {
            Stored::Lossless16 { units_per_metre } => {
                require(positive(units_per_metre), "units_per_metre", units_per_metre, "a positive number")
            }
            Stored::Linear12 { near_m, far_m } => {
                require(not_negative(near_m), "near_m", near_m, "zero or more")?;
                require(far_m > near_m && far_m.is_finite(), "far_m", far_m, "more than near_m")
            }
            Stored::Noise { noise, fraction, near_m, far_m } => {
                require(not_negative(noise.base_m), "noise.base_m", noise.base_m, "zero or more")?;
                let quadratic = noise.quadratic_per_m;
                require(not_negative(quadratic), "noise.quadratic_per_m", quadratic, "zero or more")?;
                require(positive(fraction), "fraction", fraction, "a positive number")?;
                require(positive(near_m), "near_m", near_m, "a positive number")?;
                require(far_m >= near_m && far_m.is_finite(), "far_m", far_m, "near_m or more")
            }
        }
    }

    pub(crate) fn error_bound(&self) -> ErrorBound {
        match *self {
            Stored::Lossless16 { units_per_metre } => ErrorBound::HalfUnit { max_m: 0.5 / units_per_metre },
            Stored::Linear12 { near_m, far_m } => {
                ErrorBound::Uniform { max_m: (0.5 * linear12_step_m(near_m, far_m)) as f32 }
            }
            Stored::Noise { noise, fraction, .. } => ErrorBound::Noise { noise, fraction },
        }
    }

    /// The depth of every code that this quantisation has.
    pub(crate) fn depth_of_code(&self) -> Result<DepthOfCode, DepthCodecError> {
        let levels_m: Vec<f32> = match *self {
            Stored::Lossless16 { units_per_metre } => {
                // The expression by which sequences are read, so that the same bits come back.
                return Ok(DepthOfCode::Units { units_per_metre });
            }
            Stored::Linear12 { near_m, far_m } => {
                let step_m = linear12_step_m(near_m, far_m);
                (0..LINEAR12_CODES).map(|k| (near_m as f64 + k as f64 * step_m) as f32).collect()
            }
            Stored::Noise { noise, fraction, near_m, far_m } => {
                noise_levels_m(noise, fraction, near_m, far_m)?.into_iter().map(|z| z as f32).collect()
            }
        };
        Ok(DepthOfCode::Levels(levels_m))
    }
}

/// The inverse of a quantisation.
pub(crate) enum DepthOfCode {
    Units {
        units_per_metre: f32,
    },
    /// Depth in metres of code 1, 2, ...
    Levels(Vec<f32>),
}

impl DepthOfCode {
    #[inline]
    pub(crate) fn get(&self, code: u16) -> Result<f32, DepthCodecError> {
        if code == 0 {
            return Ok(0.0);
        }
        match self {
            DepthOfCode::Units { units_per_metre } => Ok(code as f32 / units_per_metre),
            DepthOfCode::Levels(levels_m) => {
                levels_m.get(code as usize - 1).copied().ok_or(DepthCodecError::Malformed {
                    what: "depth code",
                    found: code as usize,
                    expected: levels_m.len(),
                })
            }
        }
    }
}

/// Distance of two neighbouring 12-bit levels, metres.
fn linear12_step_m(near_m: f32, far_m: f32) -> f64 {
    (far_m as f64 - near_m as f64) / (LINEAR12_CODES - 1) as f64
}

/// Levels from `near_m` to `far_m`, each at most `2 fraction sigma` beyond the one before. Between two levels
/// sigma is at least that of the nearer one, so the nearest level is within `fraction sigma(z)` of any z.
/// Sums and products in f64 only: the same numbers on every machine.
fn noise_levels_m(
    noise: DepthNoise,
    fraction: f32,
    near_m: f32,
    far_m: f32,
) -> Result<Vec<f64>, DepthCodecError> {
    let step_at =
        |z: f64| 2.0 * fraction as f64 * (noise.base_m as f64 + noise.quadratic_per_m as f64 * (z * z));
    let mut levels_m = vec![near_m as f64];
    let mut z = near_m as f64;
    while z < far_m as f64 {
        let next = (z + step_at(z)).min(far_m as f64);
        if next <= z || levels_m.len() == u16::MAX as usize {
            return Err(DepthCodecError::TooManyLevels {
                step_m: step_at(near_m as f64),
                near_m: near_m as f64,
                far_m: far_m as f64,
            });
        }
        levels_m.push(next);
        z = next;
    }
    Ok(levels_m)
}

/// Finds the nearest of ascending levels: a table of evenly spaced bins, then bisection in the bin.
struct NearestLevel {
    levels_m: Vec<f64>,
    bins_per_m: f64,
    /// For each bin (and one past the last) the first level at or beyond its start.
    first: Vec<u32>,
}

impl NearestLevel {
    const BINS: usize = 4096;

    fn new(levels_m: Vec<f64>) -> NearestLevel {
        let (near, far) = (levels_m[0], levels_m[levels_m.len() - 1]);
        let bins_per_m = if far > near { Self::BINS as f64 / (far - near) } else { 0.0 };
        let mut first = vec![levels_m.len() as u32; Self::BINS + 1];
        let mut bin = 0;
        for (k, level) in levels_m.iter().enumerate() {
            let last = (((level - near) * bins_per_m) as usize).min(Self::BINS - 1);
            while bin <= last {
                first[bin] = k as u32;
                bin += 1;
            }
        }
        NearestLevel { levels_m, bins_per_m, first }
    }

    /// Code of the level nearest to `z_m`, which lies within the levels.
    #[inline]
    fn code(&self, z_m: f32) -> u16 {
        let z = z_m as f64;
        let levels = &self.levels_m;
        let bin = (((z - levels[0]) * self.bins_per_m) as usize).min(Self::BINS - 1);
        let (from, to) = (self.first[bin] as usize, self.first[bin + 1] as usize);
        let above = (from + levels[from..to].partition_point(|level| *level < z)).min(levels.len() - 1);
        let below = above.saturating_sub(1);
        let nearest = if z - levels[below] < levels[above] - z { below } else { above };
        nearest as u16 + 1
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bins_find_the_level_that_a_plain_search_finds() {
        let levels = noise_levels_m(DepthNoise::default(), 0.25, 0.4, 9.0).unwrap();
        let nearest = NearestLevel::new(levels.clone());
        for i in 0..20_000 {
            let z_m = 0.4 + 8.6 * i as f32 / 20_000.0;
            let distance = |k: usize| (levels[k] - z_m as f64).abs();
            let found = nearest.code(z_m) as usize - 1;
            let best =
                (0..levels.len()).min_by(|a, b| distance(*a).partial_cmp(&distance(*b)).unwrap()).unwrap();
            assert!(distance(found) <= distance(best), "{z_m}: level {found}, nearest is {best}");
        }
    }

    #[test]
    fn a_far_outlier_costs_few_levels() {
        let levels = noise_levels_m(DepthNoise::default(), 0.5, 0.5, 1e30).unwrap();
        assert!(levels.len() < 2000, "{}", levels.len());
    }

    #[test]
    fn a_range_that_16_bits_cannot_hold_is_refused() {
        let noise = DepthNoise { base_m: 1e-6, quadratic_per_m: 0.0 };
        let refused = noise_levels_m(noise, 0.5, 0.5, 10.0);
        assert!(matches!(refused, Err(DepthCodecError::TooManyLevels { .. })));
        let still = DepthNoise { base_m: 0.0, quadratic_per_m: 0.0 };
        assert!(noise_levels_m(still, 0.5, 0.5, 10.0).is_err());
    }
}
