//! An index as bytes: a magic word, a header (JSON) of what follows, the blocks, and a checksum (BLAKE3) of it all.

use crate::descriptor::Space;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// Kind of an exact index.
pub(crate) const EXACT: &[u8; 8] = b"COMAIX01";
/// Kind of a large index.
#[cfg(feature = "usearch")]
pub(crate) const LARGE: &[u8; 8] = b"COMALG01";
const CHECKSUM: usize = blake3::OUT_LEN;

/// Why bytes are no index.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SavedError {
    /// Something else, another version, or not all of it.
    #[error("the bytes are no saved index of this kind and version")]
    Kind,
    /// They changed since they were written.
    #[error("the bytes are damaged: their checksum is another")]
    Damaged,
    /// A field is not what it must be.
    #[error("{0} of a saved index is out of range")]
    Field(&'static str),
}

/// What a block holds.
#[derive(Serialize, Deserialize)]
pub(crate) struct Head<K> {
    pub space: Space,
    pub dimension: usize,
    pub keys: Vec<K>,
    /// Length of the block.
    pub bytes: usize,
}

pub(crate) fn write<K: Serialize>(kind: &[u8; 8], heads: &[Head<K>], body: &[u8]) -> Vec<u8> {
    let header = serde_json::to_vec(heads).expect("keys and spaces are plain values");
    let mut out = Vec::with_capacity(16 + header.len() + body.len() + CHECKSUM);
    out.extend(kind);
    out.extend((header.len() as u64).to_le_bytes());
    out.extend(header);
    out.extend(body);
    let checksum = blake3::hash(&out);
    out.extend(checksum.as_bytes());
    out
}

/// Walks through bytes whose checksum is right; never beyond their end.
pub(crate) struct Reader<'a> {
    rest: &'a [u8],
}

impl<'a> Reader<'a> {
    pub fn new(kind: &[u8; 8], bytes: &'a [u8]) -> Result<Self, SavedError> {
        let rest = bytes.strip_prefix(kind).ok_or(SavedError::Kind)?;
        let length = rest.len().checked_sub(CHECKSUM).ok_or(SavedError::Kind)?;
        let (rest, checksum) = rest.split_at(length);
        if blake3::hash(&bytes[..kind.len() + length]).as_bytes() != checksum {
            return Err(SavedError::Damaged);
        }
        Ok(Reader { rest })
    }

    /// The blocks' heads; to be called first.
    pub fn heads<K: DeserializeOwned>(&mut self) -> Result<Vec<Head<K>>, SavedError> {
        let length: [u8; 8] = self.take(8)?.try_into().map_err(|_| SavedError::Field("header"))?;
        let length = usize::try_from(u64::from_le_bytes(length)).map_err(|_| SavedError::Field("header"))?;
        serde_json::from_slice(self.take(length)?).map_err(|_| SavedError::Field("header"))
    }

    /// The next bytes.
    pub fn take(&mut self, length: usize) -> Result<&'a [u8], SavedError> {
        let (taken, rest) = self.rest.split_at_checked(length).ok_or(SavedError::Field("length"))?;
        self.rest = rest;
        Ok(taken)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Cut short, changed, of another kind, and empty.
    pub(crate) fn damaged(bytes: &[u8]) -> Vec<Vec<u8>> {
        let cut = [0, 7, 8, 20, bytes.len() / 2, bytes.len() - 1].map(|length| bytes[..length].to_vec());
        let flipped = [0, 9, 30, bytes.len() / 2, bytes.len() - 1].map(|at| {
            let mut changed = bytes.to_vec();
            changed[at] ^= 1;
            changed
        });
        cut.into_iter().chain(flipped).collect()
    }

    #[test]
    fn lengths_beyond_the_end_are_refused_though_the_checksum_is_right() {
        let seal = |mut bytes: Vec<u8>| {
            let checksum = blake3::hash(&bytes);
            bytes.extend(checksum.as_bytes());
            bytes
        };
        let mut bytes = EXACT.to_vec();
        bytes.extend(u64::MAX.to_le_bytes());
        let sealed = seal(bytes);
        let mut reader = Reader::new(EXACT, &sealed).unwrap();
        assert!(matches!(reader.heads::<u32>(), Err(SavedError::Field("length"))));
        assert_eq!(Reader::new(b"COMAXXXX", &sealed).err(), Some(SavedError::Kind));
    }
}
