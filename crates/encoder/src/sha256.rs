//! The hash by which a model's file is known.

use crate::EncoderError;
use sha2::Digest;
use std::fmt;
use std::fs::File;
use std::path::Path;

/// SHA-256 of a file; its text is 64 hexadecimal digits.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Sha256(pub [u8; 32]);

impl Sha256 {
    /// Reads the whole file.
    ///
    /// # Errors
    /// [`EncoderError::File`].
    pub fn of_file(path: &Path) -> Result<Self, EncoderError> {
        let failed = |source| EncoderError::File { path: path.to_owned(), source };
        let mut hasher = sha2::Sha256::new();
        std::io::copy(&mut File::open(path).map_err(failed)?, &mut hasher).map_err(failed)?;
        Ok(Sha256(hasher.finalize().into()))
    }
}

impl fmt::Display for Sha256 {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_what_sha256sum_prints() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("abc");
        std::fs::write(&path, "abc").unwrap();
        let expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(Sha256::of_file(&path).unwrap().to_string(), expected);
        assert!(Sha256::of_file(Path::new("/nowhere")).is_err());
    }
}
