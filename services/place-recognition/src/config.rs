//! Settings of a place-recognition service.

use anyhow::ensure;
use coma_runtime::{Class, LogSettings, ServerSettings};
use serde::Deserialize;
use std::path::PathBuf;

/// Settings of a place-recognition service; every one has a default, and
/// `COMA_PLACE_RECOGNITION__NAME=value` overrides the file.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PlaceRecognitionConfig {
    /// Where it serves.
    pub server: ServerSettings,
    /// What the program logs.
    pub log: LogSettings,
    /// Folder from which relative paths of models start.
    pub data: PathBuf,
    /// Manifests of the models that describe pictures beside the builtin encoder, at most
    /// [`MAX_MODELS`]. One that cannot be loaded is left out, with a warning.
    pub models: Vec<PathBuf>,
    /// How models run.
    pub onnx: OnnxSettings,
    /// Which anchors are candidates.
    pub candidates: coma_place::Settings,
    /// Indices that are kept; beyond, the least recently used one is dropped, and its callers insert
    /// again. Default: 64.
    pub max_indices: usize,
    /// Anchors in one index; more are refused. One takes about 1 KiB with the builtin descriptor, 10 KiB
    /// at most. Default: 20000.
    pub max_anchors_per_index: usize,
    /// Approximate search instead of exact, for indices of some 10^5 anchors and more: needs a program that was built
    /// with the feature `usearch`. Default: false.
    pub approximate: bool,
    /// Pixels of a picture; larger ones are refused. Default: 3840 x 2160.
    pub max_pixels: usize,
    /// Pictures that are decoded and encoded at once; none: one per core. Others wait.
    pub threads: Option<usize>,
}

/// How models run.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OnnxSettings {
    /// `libonnxruntime.so`. Where unset: `ORT_DYLIB_PATH`, then that of the Python package
    /// `onnxruntime`, then the system's.
    pub library: Option<PathBuf>,
    /// Threads of one model. Default: 1, so that descriptors do not depend on the number of cores.
    pub threads: usize,
}

/// Models beside the builtin encoder: an anchor has at most 8 descriptors on the wire.
pub const MAX_MODELS: usize = 7;

impl Default for OnnxSettings {
    fn default() -> Self {
        OnnxSettings { library: None, threads: 1 }
    }
}

impl Default for PlaceRecognitionConfig {
    fn default() -> Self {
        PlaceRecognitionConfig {
            // Every call may hold a message of the largest size: fewer at once than elsewhere.
            server: ServerSettings {
                class: Class::Local,
                max_concurrent_calls: 32,
                ..ServerSettings::default()
            },
            log: LogSettings::default(),
            data: PathBuf::from("."),
            models: Vec::new(),
            onnx: OnnxSettings::default(),
            candidates: coma_place::Settings::default(),
            max_indices: 64,
            max_anchors_per_index: 20_000,
            approximate: false,
            max_pixels: 3840 * 2160,
            threads: None,
        }
    }
}

impl PlaceRecognitionConfig {
    /// Refuses settings out of range, by name.
    pub(crate) fn check(&self) -> anyhow::Result<()> {
        let within = |name: &str, value: usize, low: usize, high: usize| {
            ensure!((low..=high).contains(&value), "{name} = {value} must be {low} to {high}");
            Ok(())
        };
        ensure!(
            !self.approximate || cfg!(feature = "usearch"),
            "approximate = true: this program was built without the feature `usearch`"
        );
        within("models", self.models.len(), 0, MAX_MODELS)?;
        within("onnx.threads", self.onnx.threads, 1, 256)?;
        within("candidates.window_frames", self.candidates.window_frames as usize, 0, 1000)?;
        within("candidates.nearest", self.candidates.nearest, 1, 1000)?;
        within("max_indices", self.max_indices, 1, 10_000)?;
        within("max_anchors_per_index", self.max_anchors_per_index, 1, 10_000_000)?;
        within("max_pixels", self.max_pixels, 64, 8192 * 8192)?;
        within("threads", self.threads.unwrap_or(1), 1, 256)
    }
}
