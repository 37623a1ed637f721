//! What has to be known of a model to use it.

use crate::{EncoderError, Pooling, Sha256};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// The largest side of an input, and the largest dimension of a descriptor.
const MAX_SIDE: usize = 4096;

/// A model's manifest.
///
/// ```toml
/// model = "dinov2-vits14.onnx"   # relative to this file
/// sha256 = "0123..."             # optional; `sha256sum dinov2-vits14.onnx`
///
/// [input]
/// name = "pixel_values"
/// width = 224
/// height = 224
/// mean = [0.485, 0.456, 0.406]
/// std = [0.229, 0.224, 0.225]
///
/// [output]
/// name = "last_hidden_state"
/// dimension = 384
/// pooling = { kind = "gem", power = 3.0, skip_tokens = 1 }
///
/// [thresholds]
/// theta_sim = 0.8
/// theta_multi = 0.6
/// ```
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// The model's file, relative to the manifest's.
    pub model: PathBuf,
    /// SHA-256 of the model's file, 64 hexadecimal digits, as publishers of models state it; not checked where absent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sha256: Option<String>,
    /// What the model takes.
    pub input: Input,
    /// What the model gives.
    pub output: Output,
    /// When two descriptors mean one place.
    pub thresholds: Thresholds,
}

/// A model's input: `[1, 3, height, width]`, RGB, `(value / 255 - mean) / std`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Input {
    /// The input's name.
    pub name: String,
    /// Pixels.
    pub width: usize,
    /// Pixels.
    pub height: usize,
    /// By channel, of values in 0..1.
    pub mean: [f32; 3],
    /// By channel, of values in 0..1.
    pub std: [f32; 3],
}

/// A model's output and how it becomes one descriptor.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Output {
    /// The output's name.
    pub name: String,
    /// Numbers in a descriptor.
    pub dimension: usize,
    /// How tokens or pixels become one descriptor.
    #[serde(default)]
    pub pooling: Pooling,
}

/// Cosine similarities, calibrated for the encoder.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Thresholds {
    /// Two frames above it are a candidate.
    pub theta_sim: f32,
    /// The mean over both windows above it makes the candidate one to verify.
    pub theta_multi: f32,
}

impl Manifest {
    /// Reads a manifest's file.
    ///
    /// # Errors
    /// [`EncoderError::File`], and [`EncoderError::Manifest`] that names the field.
    pub fn load(path: &Path) -> Result<Manifest, EncoderError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| EncoderError::File { path: path.to_owned(), source })?;
        let manifest: Manifest = toml::from_str(&text)
            .map_err(|error| EncoderError::Manifest { path: path.to_owned(), reason: error.to_string() })?;
        manifest.check(path)?;
        Ok(manifest)
    }

    /// Checks every value; `path` is named in the error.
    ///
    /// # Errors
    /// [`EncoderError::Manifest`].
    pub fn check(&self, path: &Path) -> Result<(), EncoderError> {
        let require = |ok: bool, reason: String| {
            if ok { Ok(()) } else { Err(EncoderError::Manifest { path: path.to_owned(), reason }) }
        };
        let Manifest { sha256, input, output, thresholds, .. } = self;
        let side = |v: usize| (1..=MAX_SIDE).contains(&v);
        require(side(input.width), format!("input.width is {}, expected 1 to {MAX_SIDE}", input.width))?;
        require(side(input.height), format!("input.height is {}, expected 1 to {MAX_SIDE}", input.height))?;
        let finite = input.mean.iter().all(|m| m.is_finite());
        require(finite, format!("input.mean is {:?}, expected finite numbers", input.mean))?;
        let positive = input.std.iter().all(|s| *s > 0.0 && s.is_finite());
        require(positive, format!("input.std is {:?}, expected positive numbers", input.std))?;
        let dimension = output.dimension;
        require(side(dimension), format!("output.dimension is {dimension}, expected 1 to {MAX_SIDE}"))?;
        for (field, name) in [("input.name", &input.name), ("output.name", &output.name)] {
            require(!name.is_empty(), format!("{field} is empty"))?;
        }
        if let Pooling::Gem { power, .. } = output.pooling {
            let right = (1.0..=100.0).contains(&power);
            require(right, format!("output.pooling.power is {power}, expected 1 to 100"))?;
        }
        for (field, value) in [("theta_sim", thresholds.theta_sim), ("theta_multi", thresholds.theta_multi)] {
            let right = (-1.0..=1.0).contains(&value);
            require(right, format!("thresholds.{field} is {value}, expected -1 to 1"))?;
        }
        if let Some(hash) = sha256 {
            let right = hash.len() == 64 && hash.bytes().all(|c| c.is_ascii_hexdigit());
            require(right, format!("sha256 is {hash:?}, expected 64 hexadecimal digits"))?;
        }
        Ok(())
    }

    /// Hashes the model's file, which must have [`Manifest::sha256`] if that is stated.
    ///
    /// # Errors
    /// [`EncoderError::File`] and [`EncoderError::Hash`].
    pub fn verify_file(&self, path: &Path) -> Result<Sha256, EncoderError> {
        let hash = Sha256::of_file(path)?;
        match &self.sha256 {
            Some(expected) if !hash.to_string().eq_ignore_ascii_case(expected) => Err(EncoderError::Hash {
                path: path.to_owned(),
                found: hash.to_string(),
                expected: expected.clone(),
            }),
            _ => Ok(hash),
        }
    }

    /// The name of the descriptors' space: only descriptors of equal spaces are compared. A hash of the model's and of
    /// all that decides how it is used; file names and thresholds are no part of it.
    pub fn space(&self, model_sha256: &Sha256) -> String {
        let Input { name: input_name, width, height, mean, std } = &self.input;
        let Output { name: output_name, dimension, pooling } = &self.output;
        let bits = |v: &[f32; 3]| v.map(f32::to_bits);
        let pooling_bits = match *pooling {
            Pooling::None => (0, 0, 0),
            Pooling::Cls => (1, 0, 0),
            Pooling::Mean { skip_tokens } => (2, 0, skip_tokens),
            Pooling::Gem { power, skip_tokens } => (3, power.to_bits(), skip_tokens),
        };
        let use_of_it = format!(
            "{input_name:?} {width} {height} {:?} {:?} {output_name:?} {dimension} {pooling_bits:?}",
            bits(mean),
            bits(std)
        );
        let mut hasher = blake3::Hasher::new();
        hasher.update(b"coma descriptor space 1").update(&model_sha256.0).update(use_of_it.as_bytes());
        format!("onnx/{}", &hasher.finalize().to_hex()[..32])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TEXT: &str = r#"
        model = "m.onnx"
        [input]
        name = "pixels"
        width = 224
        height = 224
        mean = [0.5, 0.5, 0.5]
        std = [0.2, 0.2, 0.2]
        [output]
        name = "tokens"
        dimension = 384
        pooling = { kind = "gem", power = 3.0, skip_tokens = 1 }
        [thresholds]
        theta_sim = 0.8
        theta_multi = 0.6
    "#;

    fn load(text: &str) -> Result<Manifest, EncoderError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.toml");
        std::fs::write(&path, text).unwrap();
        Manifest::load(&path)
    }

    #[test]
    fn a_manifest_is_read_with_its_pooling() {
        let manifest = load(TEXT).unwrap();
        assert_eq!(manifest.output.pooling, Pooling::Gem { power: 3.0, skip_tokens: 1 });
        assert_eq!(manifest.sha256, None);
    }

    #[test]
    fn wrong_values_are_named_by_their_field() {
        let cases = [
            ("width = 224", "width = 0", "input.width is 0"),
            ("std = [0.2, 0.2, 0.2]", "std = [0.2, 0.0, 0.2]", "input.std"),
            ("mean = [0.5, 0.5, 0.5]", "mean = [nan, 0.5, 0.5]", "input.mean"),
            ("dimension = 384", "dimension = 100000", "output.dimension is 100000"),
            ("power = 3.0", "power = 0.0", "output.pooling.power is 0"),
            ("theta_sim = 0.8", "theta_sim = 8.0", "thresholds.theta_sim is 8"),
            ("theta_sim = 0.8", "theta_zim = 0.8", "theta_zim"),
            ("name = \"tokens\"", "name = \"\"", "output.name is empty"),
            ("model = \"m.onnx\"", "model = \"m.onnx\"\nsha256 = \"12\"", "sha256 is \"12\""),
            ("kind = \"gem\"", "kind = \"max\"", "max"),
        ];
        for (right, wrong, message) in cases {
            let error = load(&TEXT.replace(right, wrong)).unwrap_err().to_string();
            assert!(error.contains(message) && error.contains("m.toml"), "{wrong}: {error}");
        }
        assert!(matches!(Manifest::load(Path::new("/nowhere.toml")), Err(EncoderError::File { .. })));
    }

    #[test]
    fn the_space_changes_with_model_and_use_but_not_with_thresholds() {
        let manifest = load(TEXT).unwrap();
        let (one, two) = (Sha256([1; 32]), Sha256([2; 32]));
        let space = manifest.space(&one);
        assert_eq!(space, load(&TEXT.replace("0.8", "0.7").replace("m.onnx", "n.onnx")).unwrap().space(&one));
        assert_ne!(space, manifest.space(&two));
        for (right, wrong) in
            [("skip_tokens = 1", "skip_tokens = 0"), ("width = 224", "width = 112"), ("[0.5,", "[0.4,")]
        {
            assert_ne!(space, load(&TEXT.replace(right, wrong)).unwrap().space(&one), "{wrong}");
        }
    }
}
