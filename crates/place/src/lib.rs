//! Places: descriptors and the index.

/// A place descriptor, quantised: `values[i] * scale`, of unit length before.
#[derive(Clone, Debug, PartialEq)]
pub struct Descriptor {
    /// Only descriptors of equal spaces are compared.
    pub space: String,
    /// What one step of a value means.
    pub scale: f32,
    /// `[dimension]`.
    pub values: Vec<i8>,
}
