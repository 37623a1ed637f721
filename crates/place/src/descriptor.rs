//! Descriptors: unit vectors in one encoder's space, quantised to bytes.

use serde::{Deserialize, Serialize};
use std::fmt;

/// Most values of a descriptor.
pub const MAX_DIMENSION: usize = 512;
/// Longest name of a space, bytes.
pub const MAX_SPACE_NAME: usize = 128;

/// Names the encoder (and its version or weights) that descriptors come from. Only equal spaces compare.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Space(Box<str>);

impl Space {
    /// A space by name: 1 to 128 printable ASCII characters without spaces.
    pub fn new(name: &str) -> Result<Self, DescriptorError> {
        let ok = (1..=MAX_SPACE_NAME).contains(&name.len()) && name.bytes().all(|b| b.is_ascii_graphic());
        if ok {
            Ok(Space(name.into()))
        } else {
            Err(DescriptorError::Space { name: name.chars().take(80).collect() })
        }
    }

    /// The space of a model: a hash of its file and of its manifest, so that other weights or other
    /// preprocessing are another space.
    pub fn of_model(model: &[u8], manifest: &[u8]) -> Self {
        let mut hasher = blake3::Hasher::new();
        hasher.update(&(model.len() as u64).to_le_bytes());
        hasher.update(model);
        hasher.update(manifest);
        Space(format!("model/{}", &hasher.finalize().to_hex()[..32]).into())
    }

    /// The name.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl TryFrom<String> for Space {
    type Error = DescriptorError;
    fn try_from(name: String) -> Result<Self, DescriptorError> {
        Space::new(&name)
    }
}

impl From<Space> for String {
    fn from(space: Space) -> String {
        space.0.into()
    }
}

impl fmt::Display for Space {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl fmt::Debug for Space {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// Why something is no descriptor; names the field.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum DescriptorError {
    /// A bad name.
    #[error("space {name:?} is not 1 to 128 printable ASCII characters")]
    Space {
        /// Its start.
        name: String,
    },
    /// Too many values, or none.
    #[error("values: {found} of them, 1 to 512 are allowed")]
    Dimension {
        /// Found.
        found: usize,
    },
    /// NaN, infinite, or nothing but zeros.
    #[error("values: not finite, or all zero")]
    Values,
    /// Not finite and positive.
    #[error("scale = {scale} is not finite and positive")]
    Scale {
        /// Found.
        scale: f32,
    },
}

/// A unit vector: `scale * values`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Parts", into = "Parts")]
pub struct Descriptor {
    space: Space,
    scale: f32,
    values: Vec<i8>,
}

#[derive(Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Parts {
    space: Space,
    scale: f32,
    values: Vec<i8>,
}

impl TryFrom<Parts> for Descriptor {
    type Error = DescriptorError;
    fn try_from(p: Parts) -> Result<Self, DescriptorError> {
        Descriptor::new(p.space, p.scale, p.values)
    }
}

impl From<Descriptor> for Parts {
    fn from(d: Descriptor) -> Parts {
        Parts { space: d.space, scale: d.scale, values: d.values }
    }
}

impl Descriptor {
    /// A descriptor that came from elsewhere; every field is checked.
    pub fn new(space: Space, scale: f32, values: Vec<i8>) -> Result<Self, DescriptorError> {
        if !(1..=MAX_DIMENSION).contains(&values.len()) {
            return Err(DescriptorError::Dimension { found: values.len() });
        }
        if values.iter().all(|v| *v == 0) {
            return Err(DescriptorError::Values);
        }
        if !(scale.is_finite() && scale > 0.0) {
            return Err(DescriptorError::Scale { scale });
        }
        Ok(Descriptor { space, scale, values })
    }

    /// Normalises an encoder's output and quantises it to 8 bits (the largest value becomes 127).
    pub fn from_f32(space: Space, values: &[f32]) -> Result<Self, DescriptorError> {
        if !(1..=MAX_DIMENSION).contains(&values.len()) {
            return Err(DescriptorError::Dimension { found: values.len() });
        }
        let norm = values.iter().map(|v| *v as f64 * *v as f64).sum::<f64>().sqrt();
        let largest = values.iter().fold(0.0f64, |m, v| m.max(v.abs() as f64));
        if !(norm > 0.0 && norm.is_finite()) {
            return Err(DescriptorError::Values);
        }
        let quantised = values.iter().map(|v| (*v as f64 / largest * 127.0).round() as i8).collect();
        Descriptor::new(space, (largest / norm / 127.0) as f32, quantised)
    }

    /// Which descriptors it compares with.
    pub fn space(&self) -> &Space {
        &self.space
    }

    /// Value of one quantisation step.
    pub fn scale(&self) -> f32 {
        self.scale
    }

    /// Quantised values.
    pub fn values(&self) -> &[i8] {
        &self.values
    }

    /// 1 / Euclidean norm of the quantised values.
    pub(crate) fn inverse_norm(&self) -> f32 {
        1.0 / (dot(&self.values, &self.values) as f32).sqrt()
    }
}

/// Cosine similarity, -1..1; `None` between different spaces or dimensions.
pub fn similarity(a: &Descriptor, b: &Descriptor) -> Option<f32> {
    if a.space != b.space || a.values.len() != b.values.len() {
        return None;
    }
    let cosine = dot(&a.values, &b.values) as f32 * a.inverse_norm() * b.inverse_norm();
    Some(cosine.clamp(-1.0, 1.0))
}

/// Integer dot product: exact, so that no order of summation matters.
#[multiversion::multiversion(targets("x86_64+avx512f+avx512bw", "x86_64+avx2", "aarch64+neon"))]
pub(crate) fn dot(a: &[i8], b: &[i8]) -> i32 {
    a.iter().zip(b).map(|(x, y)| *x as i32 * *y as i32).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(values: &[f32]) -> Descriptor {
        Descriptor::from_f32(Space::new("test/1").unwrap(), values).unwrap()
    }

    #[test]
    fn quantising_changes_the_cosine_by_less_than_a_hundredth() {
        let a: Vec<f32> = (0..200).map(|i| (i as f32 * 0.37).sin()).collect();
        let b: Vec<f32> = (0..200).map(|i| (i as f32 * 0.37 + 0.5).sin()).collect();
        let exact = {
            let dot: f32 = a.iter().zip(&b).map(|(x, y)| x * y).sum();
            let norm = |v: &[f32]| v.iter().map(|x| x * x).sum::<f32>().sqrt();
            dot / norm(&a) / norm(&b)
        };
        assert!((similarity(&of(&a), &of(&b)).unwrap() - exact).abs() < 0.01);
        assert!((similarity(&of(&a), &of(&a)).unwrap() - 1.0).abs() < 1e-6);
        let unit: f32 = of(&a).values().iter().map(|v| (*v as f32 * of(&a).scale()).powi(2)).sum();
        assert!((unit - 1.0).abs() < 0.02);
    }

    #[test]
    fn different_spaces_do_not_compare() {
        let other = Descriptor::from_f32(Space::of_model(b"weights", b"manifest"), &[1.0, 2.0]).unwrap();
        assert_eq!(similarity(&of(&[1.0, 2.0]), &other), None);
        assert_eq!(similarity(&of(&[1.0, 2.0]), &of(&[1.0, 2.0, 3.0])), None);
        assert_ne!(Space::of_model(b"a", b"b"), Space::of_model(b"a", b"c"));
    }

    #[test]
    fn bad_descriptors_name_what_is_wrong() {
        let space = || Space::new("test/1").unwrap();
        assert_eq!(Descriptor::from_f32(space(), &[0.0; 4]), Err(DescriptorError::Values));
        assert_eq!(Descriptor::from_f32(space(), &[f32::NAN, 1.0]), Err(DescriptorError::Values));
        assert_eq!(Descriptor::from_f32(space(), &[]), Err(DescriptorError::Dimension { found: 0 }));
        assert_eq!(
            Descriptor::from_f32(space(), &[1.0; 513]),
            Err(DescriptorError::Dimension { found: 513 })
        );
        assert!(matches!(Descriptor::new(space(), f32::NAN, vec![1]), Err(DescriptorError::Scale { .. })));
        assert!(
            Space::new("").is_err() && Space::new("a b").is_err() && Space::new(&"x".repeat(129)).is_err()
        );
    }
}
