//! What can be wrong with a data set.

use crate::SpecError;
use std::path::{Path, PathBuf};

/// Why a sequence can't be opened or a frame can't be read; names the file, text or setting.
#[derive(Debug, thiserror::Error)]
pub enum DatasetError {
    /// The spec isn't one.
    #[error(transparent)]
    Spec(#[from] SpecError),
    /// A file or folder can't be read or written.
    #[error("{path}: {source}", path = path.display())]
    Io {
        /// Which.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A file was read, and is damaged.
    #[error("{path}: {reason}", path = path.display())]
    Damaged {
        /// Which.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// A picture of a frame can't be decoded.
    #[error("{field} of a frame: {reason}")]
    Picture {
        /// `color` or `depth`.
        field: &'static str,
        /// What is wrong with it.
        reason: String,
    },
    /// A frame beyond the end was asked for.
    #[error("frame {index} does not exist: the sequence has {len} frames")]
    NoSuchFrame {
        /// Asked for.
        index: usize,
        /// There are.
        len: usize,
    },
    /// A setting of the built-in world is out of range.
    #[error("{field} = {value} is out of range: {needed}")]
    Setting {
        /// The field at fault.
        field: &'static str,
        /// Its value.
        value: f64,
        /// What would have been accepted.
        needed: &'static str,
    },
    /// The built-in world has no place of that name.
    #[error("{name:?} is no built-in sequence: {needed}")]
    UnknownWorld {
        /// Asked for.
        name: String,
        /// What there is.
        needed: &'static str,
    },
}

impl DatasetError {
    pub(crate) fn io(path: &Path, source: std::io::Error) -> Self {
        DatasetError::Io { path: path.to_owned(), source }
    }

    pub(crate) fn damaged(path: &Path, reason: impl Into<String>) -> Self {
        DatasetError::Damaged { path: path.to_owned(), reason: reason.into() }
    }
}
