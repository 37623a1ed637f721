//! One file of the log: a short head, then frames.

use crate::frame::{self, Header};
use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// First bytes of every segment; the last is the layout's version.
const MAGIC: [u8; 8] = *b"COMALOG\x01";
/// Magic, then the number of the segment's first record.
pub(crate) const HEAD_BYTES: u64 = 16;
/// What segment files end with.
const SUFFIX: &str = ".log";

/// The file of the segment that begins with record `first`. Names sort as numbers do.
pub(crate) fn path_of(folder: &Path, first: u64) -> PathBuf {
    folder.join(format!("{first:020}{SUFFIX}"))
}

/// The number in a segment's file name.
pub(crate) fn first_of(name: &str) -> Option<u64> {
    let digits = name.strip_suffix(SUFFIX)?;
    (digits.len() == 20).then(|| digits.parse().ok())?
}

/// The bytes of an empty segment.
pub(crate) fn head(first: u64) -> [u8; HEAD_BYTES as usize] {
    let mut head = [0; HEAD_BYTES as usize];
    head[..8].copy_from_slice(&MAGIC);
    head[8..].copy_from_slice(&first.to_le_bytes());
    head
}

/// What a reader finds at its place.
pub(crate) enum Found {
    /// One frame's records.
    Frame(Vec<Vec<u8>>),
    /// The end, exactly after a frame.
    End,
    /// Bytes that are no whole, undamaged frame.
    Bad(&'static str),
    /// A whole header, of a frame over the limit.
    OverLimit,
}

/// Reads a segment frame by frame.
pub(crate) struct SegmentReader {
    file: BufReader<File>,
    first: u64,
    offset: u64,
    length: u64,
    max_body_bytes: usize,
}

impl SegmentReader {
    /// Opens a segment and checks its head; `Ok(Err(reason))` if the head is not right.
    pub(crate) fn open(
        path: &Path,
        first: u64,
        max_body_bytes: usize,
    ) -> io::Result<Result<SegmentReader, &'static str>> {
        let file = File::open(path)?;
        let length = file.metadata()?.len();
        let mut file = BufReader::with_capacity(1 << 16, file);
        if length < HEAD_BYTES {
            return Ok(Err("the file is shorter than a segment's head"));
        }
        let mut found = [0; HEAD_BYTES as usize];
        file.read_exact(&mut found)?;
        if found != head(first) {
            return Ok(Err("the head is not that of this segment"));
        }
        Ok(Ok(SegmentReader { file, first, offset: HEAD_BYTES, length, max_body_bytes }))
    }

    /// Where the next frame begins.
    pub(crate) fn offset(&self) -> u64 {
        self.offset
    }

    /// Length of the file when it was opened.
    pub(crate) fn length(&self) -> u64 {
        self.length
    }

    /// Reads only up to `length`: what lies beyond was written later.
    pub(crate) fn end_at(&mut self, length: u64) {
        self.length = self.length.min(length);
    }

    /// The next frame.
    pub(crate) fn next_frame(&mut self) -> io::Result<Found> {
        let left = self.length - self.offset;
        if left == 0 {
            return Ok(Found::End);
        }
        if left < frame::HEADER_BYTES as u64 {
            return Ok(Found::Bad("the file ends within a record's header"));
        }
        let mut header = [0; frame::HEADER_BYTES];
        self.file.read_exact(&mut header)?;
        let Some(header) = Header::parse(&header, self.first, self.offset) else {
            return Ok(Found::Bad("the checksum of a record's header does not fit"));
        };
        if header.body_bytes as u64 > left - frame::HEADER_BYTES as u64 {
            return Ok(Found::Bad("the file ends within a record"));
        }
        if header.body_bytes > self.max_body_bytes {
            return Ok(Found::OverLimit);
        }
        let mut body = vec![0; header.body_bytes];
        self.file.read_exact(&mut body)?;
        match header.records_of(&body) {
            Some(records) => {
                self.offset += (frame::HEADER_BYTES + header.body_bytes) as u64;
                Ok(Found::Frame(records))
            }
            None => Ok(Found::Bad("the checksum of a record does not fit")),
        }
    }

    /// Whether a whole, undamaged frame lies anywhere beyond `offset`. Then what is bad at `offset` is not the torn
    /// end of the last append, for each append is durable before the next begins.
    pub(crate) fn frame_beyond(&mut self, offset: u64) -> io::Result<bool> {
        self.file.seek(SeekFrom::Start(offset))?;
        let mut rest = Vec::new();
        self.file.by_ref().take(self.length - offset).read_to_end(&mut rest)?;
        let frame_at = |at: usize| {
            let (header, body) = rest[at..].split_first_chunk::<{ frame::HEADER_BYTES }>()?;
            let header = Header::parse(header, self.first, offset + at as u64)?;
            header.records_of(body.get(..header.body_bytes)?)
        };
        Ok((1..rest.len()).any(|at| frame_at(at).is_some()))
    }
}
