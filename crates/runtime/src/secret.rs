//! A text that is not printed.

use serde::Deserialize;

/// A token. Shows as `***`; compares in a time that does not depend on where two differ.
#[derive(Clone, Deserialize)]
#[serde(transparent)]
pub struct Secret(String);

impl Secret {
    /// Wraps a text.
    pub fn new(text: impl Into<String>) -> Self {
        Secret(text.into())
    }

    /// The text itself, to be sent.
    pub fn reveal(&self) -> &str {
        &self.0
    }

    /// True if `offered` is this secret.
    pub fn matches(&self, offered: &[u8]) -> bool {
        let own = self.0.as_bytes();
        let difference = own.iter().zip(offered).fold(0u8, |sum, (a, b)| sum | (a ^ b));
        own.len() == offered.len() && std::hint::black_box(difference) == 0
    }
}

impl std::fmt::Debug for Secret {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("***")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_secret_matches_itself_and_does_not_show() {
        let secret = Secret::new("open sesame");
        assert!(secret.matches(b"open sesame"));
        for wrong in ["", "open", "open sesamf", "open sesame!"] {
            assert!(!secret.matches(wrong.as_bytes()), "{wrong}");
        }
        assert_eq!(format!("{secret:?}"), "***");
    }
}
