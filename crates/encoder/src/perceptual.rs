//! A learnt distance of two images, such as LPIPS (Zhang et al. 2018), from an ONNX file.

use crate::session::{Model, shape_words, takes_image};
use crate::{EncoderError, RuntimeSettings};
use coma_frame::Image;
use std::path::Path;

/// A model with two image inputs `[1, 3, height, width]` in -1..1 and one number as its first output.
pub struct Perceptual {
    model: Model,
    inputs: [String; 2],
    shape: Option<Vec<i64>>,
}

impl Perceptual {
    /// Loads a model.
    ///
    /// # Errors
    /// A missing file, no ONNX Runtime, a file that is no model, other inputs than two images.
    pub fn open(path: &Path, settings: &RuntimeSettings) -> Result<Perceptual, EncoderError> {
        let mut found = None;
        let model = Model::load(path, settings, |inputs, outputs| {
            let wrong = |what: &str, found: String, expected: &str| EncoderError::Shape {
                path: path.to_owned(),
                what: what.to_owned(),
                found,
                expected: expected.to_owned(),
            };
            let [first, second] = inputs else {
                return Err(wrong("the number of inputs", inputs.len().to_string(), "2"));
            };
            for input in [first, second] {
                if !takes_image(&input.shape, None, None) {
                    let what = format!("input {:?}", input.name);
                    return Err(wrong(&what, shape_words(&input.shape), "[1, 3, height, width]"));
                }
            }
            let output = outputs.first().filter(|output| output.shape.is_some());
            let output = output.ok_or_else(|| {
                let words = outputs.first().map_or("missing".into(), |output| shape_words(&output.shape));
                wrong("the first output", words, "a tensor of 32-bit floats")
            })?;
            found = Some(([first.name.clone(), second.name.clone()], first.shape.clone()));
            Ok(output.name.clone())
        })?;
        let (inputs, shape) = found.expect("a model that was loaded has had its inputs looked at");
        Ok(Perceptual { model, inputs, shape })
    }

    /// The distance of two RGB images of one size, colours in 0..1 (clamped to it); 0 = alike.
    ///
    /// # Errors
    /// Images of different sizes, without pixels or of a size that the model does not take; a failure of the model;
    /// another result than one finite number.
    pub fn distance(&self, a: &Image<[f32; 3]>, b: &Image<[f32; 3]>) -> Result<f32, EncoderError> {
        let (width, height) = (a.width(), a.height());
        if a.pixels().is_empty() || (b.width(), b.height()) != (width, height) {
            return Err(EncoderError::Image {
                found: format!("{width}x{height} and {}x{}", b.width(), b.height()),
                expected: "two of one size, with pixels",
            });
        }
        if !takes_image(&self.shape, Some(height), Some(width)) {
            return Err(EncoderError::Shape {
                path: self.model.path().to_owned(),
                what: "the images' size".into(),
                found: format!("[1, 3, {height}, {width}]"),
                expected: shape_words(&self.shape),
            });
        }
        let names = [self.inputs[0].as_str(), self.inputs[1].as_str()];
        self.model.run(names, [planes(a), planes(b)], [height, width], |shape, data| match data {
            [distance] if distance.is_finite() => Ok(*distance),
            [distance] => Err(self.not_a_distance(distance.to_string())),
            _ => Err(self.not_a_distance(format!("a tensor of shape {shape:?}"))),
        })
    }

    fn not_a_distance(&self, found: String) -> EncoderError {
        EncoderError::Value { path: self.model.path().to_owned(), found, expected: "one finite number" }
    }
}

/// `[3, height, width]` in -1..1.
fn planes(image: &Image<[f32; 3]>) -> Vec<f32> {
    let channel = |c: usize| image.pixels().iter().map(move |pixel| pixel[c].clamp(0.0, 1.0) * 2.0 - 1.0);
    (0..3).flat_map(channel).collect()
}
