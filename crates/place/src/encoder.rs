//! The trait behind which image encoders stand.

use crate::descriptor::{Descriptor, DescriptorError, Space};
use coma_frame::Image;
use serde::{Deserialize, Serialize};

/// When two places are similar enough to be worth registering. They belong to an encoder.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Thresholds {
    /// Least cosine similarity of two anchors.
    pub theta_sim: f32,
    /// Least mean similarity of the anchors of both windows with their best counterparts.
    pub theta_multi: f32,
}

/// Why an image was not encoded.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EncodeError {
    /// Too small to say anything.
    #[error("image is {width}x{height}, at least 16x16 is needed")]
    Size {
        /// Found.
        width: usize,
        /// Found.
        height: usize,
    },
    /// The model failed.
    #[error("encoder failed: {0}")]
    Model(String),
    /// The model's output makes no descriptor.
    #[error(transparent)]
    Descriptor(#[from] DescriptorError),
}

/// Turns images into vectors whose cosine tells how alike two places look.
///
/// Laws: equal images give equal vectors; every vector has `dimension()` values; two encoders with one
/// `space()` give the same vectors. An error concerns that image only.
pub trait Encoder: Send + Sync {
    /// The space of its descriptors.
    fn space(&self) -> &Space;
    /// Values per vector, at most 512.
    fn dimension(&self) -> usize;
    /// Calibrated thresholds.
    fn thresholds(&self) -> Thresholds;
    /// Encodes an image; depth (metres, 0 = none, same size) where the encoder can use it.
    fn encode(&self, color: &Image<[u8; 3]>, depth_m: Option<&Image<f32>>) -> Result<Vec<f32>, EncodeError>;

    /// Encodes, normalises and quantises.
    fn describe(
        &self,
        color: &Image<[u8; 3]>,
        depth_m: Option<&Image<f32>>,
    ) -> Result<Descriptor, EncodeError> {
        Ok(Descriptor::from_f32(self.space().clone(), &self.encode(color, depth_m)?)?)
    }
}
