//! Image encoders for place recognition and a perceptual distance, through ONNX Runtime.
//!
//! A model is described by a [`Manifest`] (a small TOML file beside it); [`OnnxEncoder`] turns a colour image into
//! a descriptor of unit length, [`Perceptual`] gives the distance of two images under a model such as LPIPS. ONNX
//! Runtime is a shared library found when the first model is loaded ([`RuntimeSettings`]): a machine without it
//! builds and runs everything else. Without the feature `onnx` only manifests and preprocessing are here.
mod error;
mod manifest;
mod pooling;
mod preprocess;
mod sha256;

#[cfg(feature = "onnx")]
mod encoder;
#[cfg(feature = "onnx")]
mod perceptual;
#[cfg(feature = "onnx")]
mod runtime;
#[cfg(feature = "onnx")]
mod session;

pub use error::EncoderError;
pub use manifest::{Input, Manifest, Output, Thresholds};
pub use pooling::Pooling;
pub use preprocess::{normalised_planes, resize_area};
pub use sha256::Sha256;

#[cfg(feature = "onnx")]
pub use encoder::OnnxEncoder;
#[cfg(feature = "onnx")]
pub use perceptual::Perceptual;
#[cfg(feature = "onnx")]
pub use runtime::RuntimeSettings;
