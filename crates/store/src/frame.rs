//! The unit that is written, checked and cut as a whole: one batch of records.
//!
//! | bytes | meaning (little-endian) |
//! |---|---|
//! | 4 | length of the body |
//! | 4 | number of records |
//! | 4 | CRC-32 of the body |
//! | 4 | CRC-32 of the 12 bytes before, the segment's first record number and the frame's offset |
//! | | body: for each record its length (4 bytes) and its bytes |
//!
//! The header has its own sum so that a damaged length is not taken for a torn tail, and the sum covers the place
//! so that a copy of a frame inside a record is not taken for one.

/// Bytes of a frame's header.
pub(crate) const HEADER_BYTES: usize = 16;

/// A frame's header, its sum checked.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Header {
    pub(crate) body_bytes: usize,
    pub(crate) records: usize,
    body_crc: u32,
}

fn place_crc(header: &[u8], segment: u64, offset: u64) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(&header[..12]);
    hasher.update(&segment.to_le_bytes());
    hasher.update(&offset.to_le_bytes());
    hasher.finalize()
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"))
}

/// Bytes of the body that holds these records.
pub(crate) fn body_bytes(records: &[impl AsRef<[u8]>]) -> usize {
    records.iter().map(|record| 4 + record.as_ref().len()).sum()
}

/// One frame for the place where it will lie. The body's length must fit 32 bits.
pub(crate) fn encode(records: &[impl AsRef<[u8]>], segment: u64, offset: u64) -> Vec<u8> {
    let length = body_bytes(records);
    let mut bytes = vec![0u8; HEADER_BYTES];
    bytes.reserve_exact(length);
    for record in records {
        bytes.extend_from_slice(&(record.as_ref().len() as u32).to_le_bytes());
        bytes.extend_from_slice(record.as_ref());
    }
    let body_crc = crc32fast::hash(&bytes[HEADER_BYTES..]);
    bytes[0..4].copy_from_slice(&(length as u32).to_le_bytes());
    bytes[4..8].copy_from_slice(&(records.len() as u32).to_le_bytes());
    bytes[8..12].copy_from_slice(&body_crc.to_le_bytes());
    let header_crc = place_crc(&bytes, segment, offset);
    bytes[12..16].copy_from_slice(&header_crc.to_le_bytes());
    bytes
}

impl Header {
    /// The header, if its sum is right for this place.
    pub(crate) fn parse(bytes: &[u8; HEADER_BYTES], segment: u64, offset: u64) -> Option<Header> {
        (u32_at(bytes, 12) == place_crc(bytes, segment, offset)).then(|| Header {
            body_bytes: u32_at(bytes, 0) as usize,
            records: u32_at(bytes, 4) as usize,
            body_crc: u32_at(bytes, 8),
        })
    }

    /// The records of this header's body; `None` if it is damaged.
    pub(crate) fn records_of(&self, body: &[u8]) -> Option<Vec<Vec<u8>>> {
        if body.len() != self.body_bytes || crc32fast::hash(body) != self.body_crc {
            return None;
        }
        let mut records = Vec::new();
        let mut rest = body;
        while let Some((length, tail)) = rest.split_first_chunk::<4>() {
            let (record, tail) = tail.split_at_checked(u32::from_le_bytes(*length) as usize)?;
            records.push(record.to_vec());
            rest = tail;
        }
        (rest.is_empty() && records.len() == self.records).then_some(records)
    }
}
