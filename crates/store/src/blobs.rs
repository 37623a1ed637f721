//! Files named by the hash of their content.

use crate::durable;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::SystemTime;

/// The BLAKE3 hash of a blob's bytes; written as 64 hexadecimal digits.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct BlobName([u8; 32]);

/// Why a text is no [`BlobName`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("a blob's name has 64 digits of 0-9 and a-f, this is {text:?}")]
pub struct InvalidBlobName {
    /// The refused text, cut to 80 characters.
    pub text: String,
}

impl BlobName {
    /// The name of these bytes.
    pub fn of(bytes: &[u8]) -> BlobName {
        BlobName(*blake3::hash(bytes).as_bytes())
    }

    /// A name received as its 32 bytes.
    pub fn from_bytes(hash: [u8; 32]) -> BlobName {
        BlobName(hash)
    }

    /// The hash.
    pub fn as_bytes(&self) -> &[u8; 32] {
        &self.0
    }
}

impl fmt::Display for BlobName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for BlobName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "BlobName({self})")
    }
}

impl FromStr for BlobName {
    type Err = InvalidBlobName;

    fn from_str(text: &str) -> Result<BlobName, InvalidBlobName> {
        let digit = |c: u8| match c {
            b'0'..=b'9' => Some(c - b'0'),
            b'a'..=b'f' => Some(c - b'a' + 10),
            _ => None,
        };
        let parse = || {
            let digits: &[u8; 64] = text.as_bytes().try_into().ok()?;
            let mut hash = [0; 32];
            for (byte, pair) in hash.iter_mut().zip(digits.chunks_exact(2)) {
                *byte = digit(pair[0])? << 4 | digit(pair[1])?;
            }
            Some(BlobName(hash))
        };
        parse().ok_or_else(|| InvalidBlobName { text: text.chars().take(80).collect() })
    }
}

/// What a blob store may hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BlobSettings {
    /// The largest blob, bytes. Origin: 64 MiB, a packed submap of about 2.7 million surfels.
    pub max_blob_bytes: u64,
    /// Blobs that are not pinned are removed, the least recently used first, while all together take more than
    /// this, bytes. Origin: 8 GiB, some 20 hours of anchors' depth at 100 kB and 4 a second.
    pub budget_bytes: u64,
}

impl Default for BlobSettings {
    fn default() -> Self {
        BlobSettings { max_blob_bytes: 64 << 20, budget_bytes: 8 << 30 }
    }
}

/// Why a blob cannot be stored or read.
#[derive(Debug, thiserror::Error)]
pub enum BlobError {
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
    /// A blob over the limit; nothing was written.
    #[error("a blob has {bytes} bytes, the limit is {limit}")]
    TooLarge {
        /// Its size.
        bytes: u64,
        /// The limit.
        limit: u64,
    },
    /// The file's bytes no longer have the hash that names them. It was removed, so that the blob can be fetched
    /// again.
    #[error("{path} was damaged ({bytes} bytes that do not hash to its name) and has been removed", path = path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// Its length.
        bytes: u64,
    },
}

fn disk(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> BlobError {
    move |source| BlobError::Disk { action, path: path.to_owned(), source }
}

#[derive(Debug)]
struct Entry {
    bytes: u64,
    /// Larger is more recent.
    used: u64,
}

/// Evidence and submaps on disk, each under the hash of its bytes: `ab/ab12...`, written to a temporary file, synced
/// and renamed. Read bytes are checked against their name. The order of use survives a restart in the files' times
/// of modification.
#[derive(Debug)]
pub struct Blobs {
    folder: PathBuf,
    settings: BlobSettings,
    entries: BTreeMap<BlobName, Entry>,
    pinned: BTreeSet<BlobName>,
    total_bytes: u64,
    clock: u64,
}

impl Blobs {
    /// Opens the store in `folder`, which is made if it is not there. Files that are no blobs are left alone.
    ///
    /// # Errors
    /// Failures of the disk.
    pub fn open(folder: impl Into<PathBuf>, settings: BlobSettings) -> Result<Blobs, BlobError> {
        let folder = folder.into();
        durable::create_folder(&folder).map_err(disk("create", &folder))?;
        let mut found = Vec::new();
        for entry in fs::read_dir(&folder).map_err(disk("list", &folder))? {
            let fan = entry.map_err(disk("list", &folder))?.path();
            if !fan.is_dir() {
                continue;
            }
            for entry in fs::read_dir(&fan).map_err(disk("list", &fan))? {
                let entry = entry.map_err(disk("list", &fan))?;
                let Some(name) = entry.file_name().to_str().and_then(|name| name.parse::<BlobName>().ok())
                else {
                    continue;
                };
                let metadata = entry.metadata().map_err(disk("read", &entry.path()))?;
                if metadata.is_file() && entry.path() == path_of(&folder, &name) {
                    let modified = metadata.modified().unwrap_or(SystemTime::UNIX_EPOCH);
                    found.push((modified, name, metadata.len()));
                }
            }
        }
        found.sort();
        let total_bytes = found.iter().map(|(_, _, bytes)| bytes).sum();
        let clock = found.len() as u64;
        let entry = |(used, (_, name, bytes))| (name, Entry { bytes, used });
        let entries = (0u64..).zip(found).map(entry).collect();
        Ok(Blobs { folder, settings, entries, pinned: BTreeSet::new(), total_bytes, clock })
    }

    /// Stores bytes durably and returns their name; what is there already is only marked as used. Then
    /// [evicts](Self::evict) others if the budget asks for it.
    ///
    /// # Errors
    /// [`BlobError::TooLarge`] and failures of the disk.
    pub fn put(&mut self, bytes: &[u8]) -> Result<BlobName, BlobError> {
        let limit = self.settings.max_blob_bytes;
        if bytes.len() as u64 > limit {
            return Err(BlobError::TooLarge { bytes: bytes.len() as u64, limit });
        }
        let name = BlobName::of(bytes);
        let used = self.tick();
        if let Some(entry) = self.entries.get_mut(&name) {
            entry.used = used;
            return Ok(name);
        }
        let path = path_of(&self.folder, &name);
        let fan = path.parent().expect("a blob lies in a folder");
        durable::create_folder(fan).map_err(disk("create", fan))?;
        durable::write_file(&path, &self.folder.join("blob.tmp"), bytes).map_err(disk("write", &path))?;
        self.entries.insert(name, Entry { bytes: bytes.len() as u64, used });
        self.total_bytes += bytes.len() as u64;
        self.evict_except(Some(&name))?;
        Ok(name)
    }

    /// The bytes of a blob, or `None` if it is not here.
    ///
    /// # Errors
    /// [`BlobError::Damaged`] if they do not hash to the name, and failures of the disk.
    pub fn get(&mut self, name: &BlobName) -> Result<Option<Vec<u8>>, BlobError> {
        let used = self.tick();
        let Some(entry) = self.entries.get_mut(name) else { return Ok(None) };
        entry.used = used;
        let path = path_of(&self.folder, name);
        let mut bytes = Vec::new();
        let read = File::open(&path).and_then(|file| {
            // Its time of modification keeps the order of use; a file system that has none loses only that.
            let _ = file.set_modified(SystemTime::now());
            file.take(entry.bytes + 1).read_to_end(&mut bytes)
        });
        match read {
            Ok(_) if BlobName::of(&bytes) == *name => Ok(Some(bytes)),
            Ok(found) => {
                self.remove(name)?;
                Err(BlobError::Damaged { path, bytes: found as u64 })
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                // Removed behind our back: the same as damaged, for whoever counts on it.
                self.forget(name);
                Err(BlobError::Damaged { path, bytes: 0 })
            }
            Err(error) => Err(disk("read", &path)(error)),
        }
    }

    /// Whether a blob is here; does not count as use.
    pub fn contains(&self, name: &BlobName) -> bool {
        self.entries.contains_key(name)
    }

    /// Number of blobs.
    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// Whether there is no blob.
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    /// Size of all blobs, bytes.
    pub fn total_bytes(&self) -> u64 {
        self.total_bytes
    }

    /// Keeps a blob from eviction, also one that is put later. Pins live in memory: its owner pins again after
    /// a start.
    pub fn pin(&mut self, name: BlobName) {
        self.pinned.insert(name);
    }

    /// Takes a pin away.
    pub fn unpin(&mut self, name: &BlobName) {
        self.pinned.remove(name);
    }

    /// Removes the least recently used blobs that are not pinned until the budget holds; their names. Pinned blobs
    /// alone may exceed it.
    ///
    /// # Errors
    /// Failures of the disk.
    pub fn evict(&mut self) -> Result<Vec<BlobName>, BlobError> {
        self.evict_except(None)
    }

    fn evict_except(&mut self, kept: Option<&BlobName>) -> Result<Vec<BlobName>, BlobError> {
        if self.total_bytes <= self.settings.budget_bytes {
            return Ok(Vec::new());
        }
        let removable = |name: &BlobName| !self.pinned.contains(name) && Some(name) != kept;
        let mut by_use: Vec<_> = self
            .entries
            .iter()
            .filter(|(name, _)| removable(name))
            .map(|(name, e)| (e.used, *name))
            .collect();
        by_use.sort_unstable();
        let mut evicted = Vec::new();
        for (_, name) in by_use {
            if self.total_bytes <= self.settings.budget_bytes {
                break;
            }
            self.remove(&name)?;
            evicted.push(name);
        }
        Ok(evicted)
    }

    fn remove(&mut self, name: &BlobName) -> Result<(), BlobError> {
        let path = path_of(&self.folder, name);
        match fs::remove_file(&path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                return Err(disk("remove", &path)(error));
            }
            _ => self.forget(name),
        }
        Ok(())
    }

    fn forget(&mut self, name: &BlobName) {
        if let Some(entry) = self.entries.remove(name) {
            self.total_bytes -= entry.bytes;
        }
    }

    fn tick(&mut self) -> u64 {
        self.clock += 1;
        self.clock
    }
}

fn path_of(folder: &Path, name: &BlobName) -> PathBuf {
    let name = name.to_string();
    folder.join(&name[..2]).join(name)
}
