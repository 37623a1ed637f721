//! From a model's tokens or feature map to one descriptor.

use serde::{Deserialize, Serialize};

/// How an output becomes one descriptor of `dimension` numbers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Pooling {
    /// The output is the descriptor: `[1, dimension]`, possibly with sides of 1 more.
    #[default]
    None,
    /// The first token of `[1, tokens, dimension]`.
    Cls,
    /// The mean over the tokens of `[1, tokens, dimension]`, or over the pixels of `[1, dimension, height, width]`.
    Mean {
        /// Leading tokens left out: the class token and registers.
        #[serde(default)]
        skip_tokens: usize,
    },
    /// The generalised mean of Radenovic, Tolias and Chum 2018, `mean(max(x, 1e-6)^power)^(1/power)`, over tokens or
    /// pixels as [`Mean`](Self::Mean).
    Gem {
        /// 1 is the mean of what is positive; large is the maximum.
        power: f32,
        /// Leading tokens left out: the class token and registers.
        #[serde(default)]
        skip_tokens: usize,
    },
}

impl Pooling {
    /// Its name in a manifest.
    pub fn name(&self) -> &'static str {
        match self {
            Pooling::None => "none",
            Pooling::Cls => "cls",
            Pooling::Mean { .. } => "mean",
            Pooling::Gem { .. } => "gem",
        }
    }

    /// Words for the shape that this pooling takes.
    #[cfg_attr(not(feature = "onnx"), allow(dead_code, reason = "only the runtime's side reports shapes"))]
    pub(crate) fn expected_shape(&self, dimension: usize) -> String {
        match self {
            Pooling::None => format!("[1, {dimension}]"),
            Pooling::Cls => format!("[1, tokens, {dimension}]"),
            Pooling::Mean { skip_tokens } | Pooling::Gem { skip_tokens, .. } => {
                format!("[1, over {skip_tokens} tokens, {dimension}] or [1, {dimension}, height, width]")
            }
        }
    }

    /// The descriptor of one output, not normalised; `None` if the shape is not the right one.
    #[cfg_attr(not(feature = "onnx"), allow(dead_code, reason = "only the runtime's side has outputs"))]
    pub(crate) fn pool(&self, shape: &[i64], data: &[f32], dimension: usize) -> Option<Vec<f32>> {
        let shape: Vec<usize> =
            shape.iter().map(|side| usize::try_from(*side).ok()).collect::<Option<_>>()?;
        let expected = shape.iter().try_fold(1usize, |product, side| product.checked_mul(*side))?;
        if shape.first() != Some(&1) || data.len() != expected {
            return None;
        }
        let (skip_tokens, power) = match *self {
            Pooling::None => return (data.len() == dimension).then(|| data.to_vec()),
            Pooling::Cls => {
                let right = shape.len() == 3 && shape[1] > 0 && shape[2] == dimension;
                return right.then(|| data[..dimension].to_vec());
            }
            Pooling::Mean { skip_tokens } => (skip_tokens, None),
            Pooling::Gem { power, skip_tokens } => (skip_tokens, Some(power as f64)),
        };
        // Number of places, and the distance from one to the next and from one channel to the next.
        let (places, place_stride, channel_stride) = match shape[..] {
            [_, tokens, channels] if channels == dimension => (tokens, channels, 1),
            [_, channels, height, width] if channels == dimension => (height * width, 1, height * width),
            _ => return None,
        };
        let first = if shape.len() == 3 { skip_tokens } else { 0 };
        if first >= places {
            return None;
        }
        let pooled = (0..dimension).map(|channel| {
            let values = (first..places).map(|p| data[p * place_stride + channel * channel_stride] as f64);
            let count = (places - first) as f64;
            match power {
                None => values.sum::<f64>() / count,
                Some(power) => {
                    (values.map(|v| v.max(1e-6).powf(power)).sum::<f64>() / count).powf(1.0 / power)
                }
            }
        });
        Some(pooled.map(|v| v as f32).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Three tokens of two channels.
    const TOKENS: [f32; 6] = [9.0, -9.0, 1.0, 2.0, 3.0, 4.0];

    #[test]
    fn each_pooling_takes_what_it_says_from_tokens() {
        let pool = |pooling: Pooling| pooling.pool(&[1, 3, 2], &TOKENS, 2).unwrap();
        assert_eq!(pool(Pooling::Cls), [9.0, -9.0]);
        assert_eq!(pool(Pooling::Mean { skip_tokens: 1 }), [2.0, 3.0]);
        assert_eq!(pool(Pooling::Mean { skip_tokens: 0 }), [13.0 / 3.0, -1.0]);
        let gem = pool(Pooling::Gem { power: 2.0, skip_tokens: 1 });
        assert!((gem[0] - 5f32.sqrt()).abs() < 1e-6 && (gem[1] - 10f32.sqrt()).abs() < 1e-6, "{gem:?}");
        assert_eq!(Pooling::None.pool(&[1, 6], &TOKENS, 6).unwrap(), TOKENS);
        assert_eq!(Pooling::None.pool(&[1, 6, 1, 1], &TOKENS, 6).unwrap(), TOKENS);
    }

    #[test]
    fn a_feature_map_is_pooled_over_its_pixels_and_no_token_is_skipped() {
        let map = [1.0, 2.0, 3.0, 6.0, 10.0, 20.0, 30.0, 60.0]; // two channels of 2x2
        assert_eq!(Pooling::Mean { skip_tokens: 1 }.pool(&[1, 2, 2, 2], &map, 2).unwrap(), [3.0, 30.0]);
    }

    #[test]
    fn another_shape_is_none() {
        for shape in [&[1, 2, 3][..], &[2, 3, 1], &[6], &[], &[1, -1, 2], &[1, 3, 2, 1, 1], &[1, 2, 2]] {
            for pooling in [Pooling::Cls, Pooling::Mean { skip_tokens: 0 }, Pooling::None] {
                assert_eq!(pooling.pool(shape, &TOKENS, 2), None, "{shape:?}");
            }
        }
        assert_eq!(Pooling::Mean { skip_tokens: 3 }.pool(&[1, 3, 2], &TOKENS, 2), None);
    }
}
