//! Any image encoder in an ONNX file.

use crate::session::{Model, port_named, shape_words, takes_image};
use crate::{EncoderError, Manifest, RuntimeSettings, Thresholds, normalised_planes, resize_area};
use coma_frame::Image;
use std::path::Path;

/// An image encoder: a model and its manifest. Calls from several threads wait for one another.
pub struct OnnxEncoder {
    model: Model,
    manifest: Manifest,
    space: String,
}

impl OnnxEncoder {
    /// Loads the model that a manifest's file describes.
    ///
    /// # Errors
    /// A missing or wrong manifest or model, another hash than the manifest's, no ONNX Runtime, input or output of
    /// another name or shape.
    pub fn open(manifest_path: &Path, settings: &RuntimeSettings) -> Result<OnnxEncoder, EncoderError> {
        let manifest = Manifest::load(manifest_path)?;
        let path = manifest_path.parent().unwrap_or(Path::new("")).join(&manifest.model);
        let hash = manifest.verify_file(&path)?;
        let model = Model::load(&path, settings, |inputs, outputs| {
            let (input, output) = (&manifest.input, &manifest.output);
            let port = port_named(inputs, "input", &input.name, &path)?;
            if let Some(other) = inputs.iter().find(|other| other.name != input.name) {
                return Err(EncoderError::Shape {
                    path: path.clone(),
                    what: "the number of inputs".into(),
                    found: format!("{} ({:?} too)", inputs.len(), other.name),
                    expected: "1".into(),
                });
            }
            if !takes_image(&port.shape, Some(input.height), Some(input.width)) {
                return Err(EncoderError::Shape {
                    path: path.clone(),
                    what: format!("input {:?}", input.name),
                    found: shape_words(&port.shape),
                    expected: format!("[1, 3, {}, {}] as the manifest says", input.height, input.width),
                });
            }
            let port = port_named(outputs, "output", &output.name, &path)?;
            if port.shape.is_none() {
                return Err(EncoderError::Shape {
                    path: path.clone(),
                    what: format!("output {:?}", output.name),
                    found: shape_words(&port.shape),
                    expected: "a tensor of 32-bit floats".into(),
                });
            }
            Ok(output.name.clone())
        })?;
        let space = manifest.space(&hash);
        let encoder = OnnxEncoder { model, manifest, space };
        // A model often leaves its output's sides free: what comes out is known when it ran once.
        let (width, height) = (encoder.manifest.input.width, encoder.manifest.input.height);
        encoder.pooled(vec![0.5; 3 * width * height])?;
        Ok(encoder)
    }

    /// The name of the descriptors' space: only descriptors of equal spaces are compared.
    pub fn space(&self) -> String {
        self.space.clone()
    }

    /// Numbers in a descriptor.
    pub fn dimension(&self) -> usize {
        self.manifest.output.dimension
    }

    /// The similarities at which two descriptors mean one place.
    pub fn thresholds(&self) -> Thresholds {
        self.manifest.thresholds
    }

    /// The descriptor of an RGB image of any size, of unit length.
    ///
    /// # Errors
    /// An image without pixels, a failure of the model, a descriptor that is zero or not finite.
    pub fn encode(&self, image: &Image<[u8; 3]>) -> Result<Vec<f32>, EncoderError> {
        if image.pixels().is_empty() {
            return Err(EncoderError::Image {
                found: format!("{}x{}", image.width(), image.height()),
                expected: "at least one pixel",
            });
        }
        let input = &self.manifest.input;
        let resized = resize_area(image, input.width, input.height);
        let mut descriptor = self.pooled(normalised_planes(&resized, input.mean, input.std))?;
        let length = descriptor.iter().map(|v| *v as f64 * *v as f64).sum::<f64>().sqrt();
        if !(length > 0.0 && length.is_finite()) {
            return Err(EncoderError::Value {
                path: self.model.path().to_owned(),
                found: format!("a descriptor of length {length}"),
                expected: "a finite one that is not zero",
            });
        }
        descriptor.iter_mut().for_each(|v| *v = (*v as f64 / length) as f32);
        Ok(descriptor)
    }

    fn pooled(&self, planes: Vec<f32>) -> Result<Vec<f32>, EncoderError> {
        let (input, output) = (&self.manifest.input, &self.manifest.output);
        self.model.run([&input.name], [planes], [input.height, input.width], |shape, data| {
            output.pooling.pool(shape, data, output.dimension).ok_or_else(|| EncoderError::Shape {
                path: self.model.path().to_owned(),
                what: format!("output {:?}", output.name),
                found: shape_words(&Some(shape.to_vec())),
                expected: format!("{} as the manifest says", output.pooling.expected_shape(output.dimension)),
            })
        })
    }
}
