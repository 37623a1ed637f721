//! What can be wrong with a model, its manifest or its runtime.

use std::path::PathBuf;

/// Why an encoder cannot be loaded, or an image not encoded.
#[derive(Debug, thiserror::Error)]
pub enum EncoderError {
    /// A file cannot be read.
    #[error("read {path}: {source}", path = path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// The system's own words.
        source: std::io::Error,
    },
    /// The manifest is not TOML of the right fields, or a value is out of its range.
    #[error("manifest {path}: {reason}", path = path.display())]
    Manifest {
        /// The manifest's file.
        path: PathBuf,
        /// The field and what is wrong with it.
        reason: String,
    },
    /// The model file is not the one that the manifest was written for.
    #[error("{path} has SHA-256 {found}, its manifest says {expected}", path = path.display())]
    Hash {
        /// The model's file.
        path: PathBuf,
        /// As computed.
        found: String,
        /// As the manifest says.
        expected: String,
    },
    /// No ONNX Runtime was found.
    #[error(
        "ONNX Runtime cannot be loaded; tried {tried}. Install the Python package `onnxruntime`, or set ORT_DYLIB_PATH \
         or the setting `library` to libonnxruntime.so (1.24 or later)"
    )]
    NoRuntime {
        /// Every place, with what happened there.
        tried: String,
    },
    /// ONNX Runtime cannot load the model.
    #[error("{path} cannot be loaded as an ONNX model: {reason}", path = path.display())]
    Model {
        /// The model's file.
        path: PathBuf,
        /// ONNX Runtime's own words.
        reason: String,
    },
    /// The model has no input or output of this name.
    #[error("{path} has no {kind} {name:?}, it has {found}", path = path.display())]
    NoSuchName {
        /// The model's file.
        path: PathBuf,
        /// Input or output.
        kind: &'static str,
        /// The name looked for.
        name: String,
        /// The names there are.
        found: String,
    },
    /// An input or output of the model is not of the kind or shape that it should be.
    #[error("{path}: {what} is {found}, expected {expected}", path = path.display())]
    Shape {
        /// The model's file.
        path: PathBuf,
        /// Which input or output.
        what: String,
        /// Its shape or kind.
        found: String,
        /// The right one.
        expected: String,
    },
    /// ONNX Runtime failed on an image.
    #[error("{path} failed on an image: {reason}", path = path.display())]
    Run {
        /// The model's file.
        path: PathBuf,
        /// ONNX Runtime's own words.
        reason: String,
    },
    /// The model returned numbers that are no descriptor or distance.
    #[error("{path} returned {found}, expected {expected}", path = path.display())]
    Value {
        /// The model's file.
        path: PathBuf,
        /// What it returned.
        found: String,
        /// What would be right.
        expected: &'static str,
    },
    /// An image without pixels, or two images of different sizes.
    #[error("images of {found} cannot be encoded, expected {expected}")]
    Image {
        /// Their sizes, pixels.
        found: String,
        /// What would be right.
        expected: &'static str,
    },
}
