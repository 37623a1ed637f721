//! An append-only log in segment files.

use crate::segment::{self, Found, HEAD_BYTES, SegmentReader};
use crate::{durable, frame};
use std::collections::VecDeque;
use std::fs::{self, File, OpenOptions};
use std::io::{self, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

/// What a log may hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LogLimits {
    /// A new segment file is begun when the current one would grow beyond this, bytes. Origin: 64 MiB, small
    /// enough to check in well under a second at start.
    pub segment_bytes: u64,
    /// The largest record, bytes. Origin: 4 MiB, the default message limit of gRPC.
    pub max_record_bytes: usize,
    /// The largest batch, bytes, 4 per record included. Origin: 16 MiB.
    pub max_batch_bytes: usize,
}

impl Default for LogLimits {
    fn default() -> Self {
        LogLimits { segment_bytes: 64 << 20, max_record_bytes: 4 << 20, max_batch_bytes: 16 << 20 }
    }
}

/// Why a log cannot be opened, read or written.
#[derive(Debug, thiserror::Error)]
pub enum LogError {
    /// The disk said no.
    #[error("{action} {path}: {source}", path = path.display())]
    Disk {
        /// What was being done.
        action: &'static str,
        /// To which file.
        path: PathBuf,
        /// The system's own words.
        source: io::Error,
    },
    /// Records that were acknowledged cannot be read: not the torn end of a crash.
    #[error("{path} cannot be read from byte {offset} on: {reason}", path = path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Where the damaged part begins.
        offset: u64,
        /// What does not fit.
        reason: &'static str,
    },
    /// A segment file is not there.
    #[error("{folder} has no segment that begins with record {record}; the next one begins with {found}", folder = folder.display())]
    Missing {
        /// The log's folder.
        folder: PathBuf,
        /// The record that should begin a segment.
        record: u64,
        /// The record that does.
        found: u64,
    },
    /// A record or a batch over its limit; nothing was written.
    #[error("{what} has {bytes} bytes, the limit is {limit}")]
    TooLarge {
        /// A record or a batch.
        what: &'static str,
        /// Its size.
        bytes: usize,
        /// The limit.
        limit: usize,
    },
    /// An earlier failure left it unknown what the disk holds: open the log again.
    #[error("{path} failed before; open the log again", path = path.display())]
    Failed {
        /// The segment that failed.
        path: PathBuf,
    },
}

fn disk(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> LogError {
    move |source| LogError::Disk { action, path: path.to_owned(), source }
}

/// What opening a log found.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Recovery {
    /// Whole records.
    pub records: u64,
    /// Bytes of an append that never returned, cut from the end. A batch is cut as a whole.
    pub torn_bytes: u64,
}

/// One record of a log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Record {
    /// Its number, counted from 0.
    pub index: u64,
    /// What was appended.
    pub bytes: Vec<u8>,
}

/// Numbered records in a folder of segment files. What [`append`](Self::append) returned for is there after a kill
/// or a power cut; the torn end of an append that did not return is cut at the next start; any other damage is an
/// error that names file and offset. A log has one writer: hold the folder's lock ([`Identity`](crate::Identity)).
#[derive(Debug)]
pub struct AppendLog {
    folder: PathBuf,
    limits: LogLimits,
    /// First record of every segment, ascending; never empty.
    segments: Vec<u64>,
    /// The last segment, opened for appending.
    file: File,
    file_bytes: u64,
    records: u64,
    bytes: u64,
    recovery: Recovery,
    failed: bool,
}

impl AppendLog {
    /// Opens the log in `folder`, which is made if it is not there. Every record is read and checked.
    ///
    /// # Errors
    /// [`LogError::Damaged`] and [`LogError::Missing`] if acknowledged records are lost; nothing is changed then.
    pub fn open(folder: impl Into<PathBuf>, limits: LogLimits) -> Result<AppendLog, LogError> {
        let folder = folder.into();
        durable::create_folder(&folder).map_err(disk("create", &folder))?;
        let mut segments = segments_in(&folder)?;
        if segments.is_empty() {
            create_segment(&folder, 0)?;
            segments.push(0);
        }
        let mut recovery = Recovery::default();
        let mut bytes = 0;
        let mut whole_bytes = 0;
        for (k, first) in segments.iter().enumerate() {
            if *first != recovery.records {
                return Err(LogError::Missing { folder, record: recovery.records, found: *first });
            }
            let path = segment::path_of(&folder, *first);
            let last = k + 1 == segments.len();
            let mut reader = open_segment(&path, *first, &limits)?;
            loop {
                match reader.next_frame().map_err(disk("read", &path))? {
                    Found::Frame(records) => recovery.records += records.len() as u64,
                    Found::End => break,
                    Found::OverLimit => return Err(over_limit(path, &reader)),
                    Found::Bad(reason) => {
                        let offset = reader.offset();
                        let torn = last && !reader.frame_beyond(offset).map_err(disk("read", &path))?;
                        if !torn {
                            return Err(LogError::Damaged { path, offset, reason });
                        }
                        recovery.torn_bytes = reader.length() - offset;
                        break;
                    }
                }
            }
            whole_bytes = reader.offset();
            bytes += whole_bytes;
        }
        let path = segment::path_of(&folder, segments[segments.len() - 1]);
        let file = OpenOptions::new().append(true).open(&path).map_err(disk("open", &path))?;
        if recovery.torn_bytes > 0 {
            file.set_len(whole_bytes).map_err(disk("cut the torn end of", &path))?;
            file.sync_all().map_err(disk("sync", &path))?;
        }
        let records = recovery.records;
        Ok(AppendLog {
            folder,
            limits,
            segments,
            file,
            file_bytes: whole_bytes,
            records,
            bytes,
            recovery,
            failed: false,
        })
    }

    /// What opening found.
    pub fn recovery(&self) -> &Recovery {
        &self.recovery
    }

    /// Number of records.
    pub fn len(&self) -> u64 {
        self.records
    }

    /// Whether there is no record.
    pub fn is_empty(&self) -> bool {
        self.records == 0
    }

    /// Size of all segment files, bytes.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Appends one record and makes it durable; its number.
    ///
    /// # Errors
    /// [`LogError::TooLarge`], or a failure of the disk. A full disk leaves the log as it was; after a failed sync
    /// nobody knows what is on the disk, and every further append is [`LogError::Failed`].
    pub fn append(&mut self, record: &[u8]) -> Result<u64, LogError> {
        Ok(self.append_batch(&[record])?.start)
    }

    /// Appends several records and makes them durable with one sync, all or none; their numbers.
    ///
    /// # Errors
    /// As [`append`](Self::append).
    pub fn append_batch(&mut self, records: &[impl AsRef<[u8]>]) -> Result<Range<u64>, LogError> {
        if records.is_empty() {
            return Ok(self.records..self.records);
        }
        self.check_sizes(records)?;
        if self.failed {
            return Err(LogError::Failed { path: self.last_path() });
        }
        let frame_bytes = (frame::HEADER_BYTES + frame::body_bytes(records)) as u64;
        if self.file_bytes > HEAD_BYTES && self.file_bytes + frame_bytes > self.limits.segment_bytes {
            self.begin_segment()?;
        }
        let bytes = frame::encode(records, self.segments[self.segments.len() - 1], self.file_bytes);
        if let Err(source) = self.file.write_all(&bytes) {
            // What was written of it is not acknowledged and can be cut; if not, a restart will.
            self.failed = self.file.set_len(self.file_bytes).is_err();
            return Err(disk("append to", &self.last_path())(source));
        }
        if let Err(source) = self.file.sync_data() {
            self.failed = true;
            return Err(disk("sync", &self.last_path())(source));
        }
        self.file_bytes += bytes.len() as u64;
        self.bytes += bytes.len() as u64;
        let first = self.records;
        self.records += records.len() as u64;
        Ok(first..self.records)
    }

    fn check_sizes(&self, records: &[impl AsRef<[u8]>]) -> Result<(), LogError> {
        let largest = records.iter().map(|record| record.as_ref().len()).max().unwrap_or(0);
        let too_large = |what, bytes, limit| Err(LogError::TooLarge { what, bytes, limit });
        if largest > self.limits.max_record_bytes {
            return too_large("a record", largest, self.limits.max_record_bytes);
        }
        let body = frame::body_bytes(records);
        let limit = max_body_bytes(&self.limits);
        if body > limit { too_large("a batch", body, limit) } else { Ok(()) }
    }

    fn begin_segment(&mut self) -> Result<(), LogError> {
        let path = create_segment(&self.folder, self.records)?;
        self.file = OpenOptions::new().append(true).open(&path).map_err(disk("open", &path))?;
        self.segments.push(self.records);
        self.file_bytes = HEAD_BYTES;
        self.bytes += HEAD_BYTES;
        Ok(())
    }

    fn last_path(&self) -> PathBuf {
        segment::path_of(&self.folder, self.segments[self.segments.len() - 1])
    }

    /// All records from the first, read from disk and checked one by one. After an error the iterator ends.
    pub fn iter(&self) -> Records<'_> {
        Records { log: self, next_segment: 0, reader: None, ready: VecDeque::new(), index: 0 }
    }
}

impl<'a> IntoIterator for &'a AppendLog {
    type Item = Result<Record, LogError>;
    type IntoIter = Records<'a>;
    fn into_iter(self) -> Records<'a> {
        self.iter()
    }
}

/// The records of a log, in order.
pub struct Records<'a> {
    log: &'a AppendLog,
    next_segment: usize,
    reader: Option<(PathBuf, SegmentReader)>,
    ready: VecDeque<Vec<u8>>,
    index: u64,
}

impl Records<'_> {
    fn fill(&mut self) -> Result<(), LogError> {
        while self.ready.is_empty() {
            let Some((path, reader)) = &mut self.reader else {
                let Some(first) = self.log.segments.get(self.next_segment) else { return Ok(()) };
                let path = segment::path_of(&self.log.folder, *first);
                let mut reader = open_segment(&path, *first, &self.log.limits)?;
                self.next_segment += 1;
                if self.next_segment == self.log.segments.len() {
                    // What a failed append left beyond is not part of the log.
                    reader.end_at(self.log.file_bytes);
                }
                self.reader = Some((path, reader));
                continue;
            };
            match reader.next_frame().map_err(disk("read", path))? {
                Found::Frame(records) => self.ready.extend(records),
                Found::End => self.reader = None,
                Found::OverLimit => return Err(over_limit(path.clone(), reader)),
                Found::Bad(reason) => {
                    return Err(LogError::Damaged { path: path.clone(), offset: reader.offset(), reason });
                }
            }
        }
        Ok(())
    }
}

impl Iterator for Records<'_> {
    type Item = Result<Record, LogError>;

    fn next(&mut self) -> Option<Self::Item> {
        if let Err(error) = self.fill() {
            self.reader = None;
            self.next_segment = self.log.segments.len();
            return Some(Err(error));
        }
        let bytes = self.ready.pop_front()?;
        self.index += 1;
        Some(Ok(Record { index: self.index - 1, bytes }))
    }
}

/// The largest body of a frame: a batch, or one record of the largest size; always under 32 bits.
fn max_body_bytes(limits: &LogLimits) -> usize {
    limits.max_batch_bytes.max(limits.max_record_bytes.saturating_add(4)).min(u32::MAX as usize)
}

fn open_segment(path: &Path, first: u64, limits: &LogLimits) -> Result<SegmentReader, LogError> {
    SegmentReader::open(path, first, max_body_bytes(limits))
        .map_err(disk("read", path))?
        .map_err(|reason| LogError::Damaged { path: path.to_owned(), offset: 0, reason })
}

fn over_limit(path: PathBuf, reader: &SegmentReader) -> LogError {
    let reason = "a record or batch is longer than the limits that the log was opened with";
    LogError::Damaged { path, offset: reader.offset(), reason }
}

/// Makes an empty segment, durably: its head is never torn.
fn create_segment(folder: &Path, first: u64) -> Result<PathBuf, LogError> {
    let path = segment::path_of(folder, first);
    durable::write_file(&path, &folder.join("segment.tmp"), &segment::head(first))
        .map_err(disk("create", &path))?;
    Ok(path)
}

/// First records of the segments in a folder, ascending.
fn segments_in(folder: &Path) -> Result<Vec<u64>, LogError> {
    let mut segments = Vec::new();
    for entry in fs::read_dir(folder).map_err(disk("list", folder))? {
        let entry = entry.map_err(disk("list", folder))?;
        segments.extend(entry.file_name().to_str().and_then(segment::first_of));
    }
    segments.sort_unstable();
    Ok(segments)
}
