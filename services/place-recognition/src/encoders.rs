//! The encoders that describe a picture: the builtin one always, models where they can be loaded.

use crate::config::PlaceRecognitionConfig;
use coma_frame::Image;
use coma_place::{Builtin, Descriptor, EncodeError, Encoder, Space, Thresholds};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::{Mutex, PoisonError};
use tracing::{info, warn};

/// An encoder and how users know it.
pub struct Named {
    /// `builtin`, or the name of the model's manifest.
    pub name: String,
    /// The encoder.
    pub encoder: Box<dyn Encoder>,
}

/// All encoders of a service.
pub struct Encoders {
    /// The builtin one first.
    builtin: Builtin,
    models: Vec<Named>,
    /// What could not be loaded.
    refused: Vec<String>,
    /// By model: why it failed on a picture, the last time.
    failed: Mutex<BTreeMap<String, String>>,
}

impl Encoders {
    /// Loads every model that is configured. One that cannot be loaded is left out, and said in
    /// [`Encoders::warnings`]: the builtin encoder goes on alone.
    pub fn load(config: &PlaceRecognitionConfig) -> Encoders {
        let mut out = Encoders {
            builtin: Builtin::default(),
            models: Vec::new(),
            refused: Vec::new(),
            failed: Mutex::default(),
        };
        for manifest in &config.models {
            let path = config.data.join(manifest);
            match open(&path, config) {
                Ok(encoder) if out.all().any(|(_, e)| e.space() == encoder.space()) => {
                    let text = format!("model {}: another one has its space already", path.display());
                    warn!("{text}");
                    out.refused.push(text);
                }
                Ok(encoder) => {
                    let stem = path.file_stem().unwrap_or_default();
                    let name = stem.to_string_lossy().into_owned();
                    info!(name, space = %encoder.space(), dimension = encoder.dimension(), "model loaded");
                    out.models.push(Named { name, encoder });
                }
                Err(reason) => {
                    let text = format!("model {}: {reason}; places are described without it", path.display());
                    warn!("{text}");
                    out.refused.push(text);
                }
            }
        }
        out
    }

    /// Every encoder with its name.
    pub fn all(&self) -> impl Iterator<Item = (&str, &dyn Encoder)> {
        let builtin: (&str, &dyn Encoder) = ("builtin", &self.builtin);
        std::iter::once(builtin).chain(self.models.iter().map(|m| (m.name.as_str(), &*m.encoder)))
    }

    /// Which similarities count, by space.
    pub fn thresholds(&self) -> BTreeMap<Space, Thresholds> {
        self.all().map(|(_, encoder)| (encoder.space().clone(), encoder.thresholds())).collect()
    }

    /// What users should know: models that are not there, and models that failed on a picture.
    pub fn warnings(&self) -> Vec<String> {
        let failed = self.failed.lock().unwrap_or_else(PoisonError::into_inner);
        let failed =
            failed.iter().map(|(name, reason)| format!("model {name} failed on a picture: {reason}"));
        self.refused.iter().cloned().chain(failed).collect()
    }

    /// A picture's descriptors, the builtin one first. A model that fails is left out for this picture.
    ///
    /// # Errors
    /// A picture that the builtin encoder can say nothing of.
    pub fn describe(
        &self,
        color: &Image<[u8; 3]>,
        depth_m: Option<&Image<f32>>,
    ) -> Result<Vec<Descriptor>, EncodeError> {
        let mut out = vec![self.builtin.describe(color, depth_m)?];
        for Named { name, encoder } in &self.models {
            match encoder.describe(color, depth_m) {
                Ok(descriptor) => out.push(descriptor),
                Err(error) => {
                    warn!(model = name, %error, "a picture was described without this model");
                    metrics::counter!("coma_place_model_failures_total").increment(1);
                    let mut failed = self.failed.lock().unwrap_or_else(PoisonError::into_inner);
                    failed.insert(name.clone(), error.to_string());
                }
            }
        }
        Ok(out)
    }
}

#[cfg(not(feature = "onnx"))]
fn open(_manifest: &Path, _config: &PlaceRecognitionConfig) -> Result<Box<dyn Encoder>, String> {
    Err("this program was built without the feature `onnx`".into())
}

#[cfg(feature = "onnx")]
fn open(manifest: &Path, config: &PlaceRecognitionConfig) -> Result<Box<dyn Encoder>, String> {
    onnx::open(manifest, config).map(|model| Box::new(model) as Box<dyn Encoder>)
}

#[cfg(feature = "onnx")]
mod onnx {
    use super::*;
    use coma_encoder::{OnnxEncoder, RuntimeSettings};
    use coma_place::descriptor::MAX_DIMENSION;

    /// A model as an encoder of places.
    pub struct Model {
        space: Space,
        encoder: OnnxEncoder,
    }

    pub fn open(manifest: &Path, config: &PlaceRecognitionConfig) -> Result<Model, String> {
        let settings = RuntimeSettings { library: config.onnx.library.clone(), threads: config.onnx.threads };
        let encoder = OnnxEncoder::open(manifest, &settings).map_err(|e| e.to_string())?;
        if encoder.dimension() > MAX_DIMENSION {
            let found = encoder.dimension();
            return Err(format!(
                "output.dimension is {found}, descriptors have at most {MAX_DIMENSION} values"
            ));
        }
        let space = Space::new(&encoder.space()).map_err(|e| e.to_string())?;
        Ok(Model { space, encoder })
    }

    impl Encoder for Model {
        fn space(&self) -> &Space {
            &self.space
        }

        fn dimension(&self) -> usize {
            self.encoder.dimension()
        }

        fn thresholds(&self) -> Thresholds {
            let coma_encoder::Thresholds { theta_sim, theta_multi } = self.encoder.thresholds();
            Thresholds { theta_sim, theta_multi }
        }

        fn encode(
            &self,
            color: &Image<[u8; 3]>,
            _depth_m: Option<&Image<f32>>,
        ) -> Result<Vec<f32>, EncodeError> {
            self.encoder.encode(color).map_err(|e| EncodeError::Model(e.to_string()))
        }
    }
}
