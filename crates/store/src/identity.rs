//! Who an agent is, and that nobody else is.

use crate::durable;
use coma_geometry::{AgentId, Epoch};
use rand::TryRng;
use rand::rngs::SysRng;
use serde::{Deserialize, Serialize};
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{self, Read, Seek, Write};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

/// The file that holds an identity.
const FILE: &str = "agent.toml";
/// The file whose lock keeps a second process out.
const LOCK: &str = "agent.lock";

/// Why a data folder cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum IdentityError {
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
    /// Another process works in this folder.
    #[error("{folder} is in use by process {process}", folder = folder.display())]
    InUse {
        /// The data folder.
        folder: PathBuf,
        /// The other process's id as it wrote it, or `unknown`.
        process: String,
    },
    /// The identity file is not what this program writes.
    #[error("{path} cannot be read: {reason}", path = path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The settings name another agent than the folder belongs to.
    #[error("{path} belongs to agent {found}, the settings say {configured}", path = path.display())]
    OtherAgent {
        /// The identity file.
        path: PathBuf,
        /// Whose folder it is.
        found: AgentId,
        /// Who was to use it.
        configured: AgentId,
    },
}

fn disk(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> IdentityError {
    move |source| IdentityError::Disk { action, path: path.to_owned(), source }
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct OnDisk {
    agent_id: AgentId,
    epoch: Epoch,
}

/// An agent's name and epoch, kept in its data folder, and the lock on that folder: it is held until this value is
/// dropped or the process ends, however it ends.
#[derive(Debug)]
pub struct Identity {
    agent_id: AgentId,
    epoch: Epoch,
    created: bool,
    folder: PathBuf,
    _lock: File,
}

impl Identity {
    /// Opens the data folder, which is made if it is not there. At the first start the agent takes the configured
    /// name, or makes one (`agent-` and 8 random hexadecimal digits), and an epoch: the UNIX time in milliseconds,
    /// so that an agent that comes back without its disk has a later one. Both are kept from then on.
    ///
    /// # Errors
    /// [`IdentityError::InUse`] if another process has the folder, [`IdentityError::OtherAgent`] if it belongs
    /// to an agent of another name, [`IdentityError::Damaged`], and failures of the disk.
    pub fn open(folder: impl Into<PathBuf>, configured: Option<AgentId>) -> Result<Identity, IdentityError> {
        let since_1970 = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        Self::open_with_epoch(folder, configured, Epoch(since_1970.as_millis() as u64))
    }

    /// As [`open`](Self::open), with the epoch that a first start takes.
    ///
    /// # Errors
    /// As [`open`](Self::open).
    pub fn open_with_epoch(
        folder: impl Into<PathBuf>,
        configured: Option<AgentId>,
        first_epoch: Epoch,
    ) -> Result<Identity, IdentityError> {
        let folder = folder.into();
        durable::create_folder(&folder).map_err(disk("create", &folder))?;
        let lock = lock(&folder)?;
        let path = folder.join(FILE);
        let (stored, created) = match std::fs::read_to_string(&path) {
            Ok(text) => (parse(&path, &text)?, false),
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                let agent_id = match &configured {
                    Some(id) => id.clone(),
                    None => random_name(&path)?,
                };
                let stored = OnDisk { agent_id, epoch: first_epoch };
                let text = toml::to_string(&stored)
                    .map_err(|error| disk("write", &path)(io::Error::other(error)))?;
                // What could not be read back at the next start must not be written at this one.
                parse(&path, &text)?;
                durable::write_file(&path, &folder.join("agent.toml.tmp"), text.as_bytes())
                    .map_err(disk("write", &path))?;
                (stored, true)
            }
            Err(error) if error.kind() == io::ErrorKind::InvalidData => {
                return Err(IdentityError::Damaged { path, reason: error.to_string() });
            }
            Err(error) => return Err(disk("read", &path)(error)),
        };
        match configured {
            Some(configured) if configured != stored.agent_id => {
                Err(IdentityError::OtherAgent { path, found: stored.agent_id, configured })
            }
            _ => {
                let OnDisk { agent_id, epoch } = stored;
                Ok(Identity { agent_id, epoch, created, folder, _lock: lock })
            }
        }
    }

    /// The agent's name.
    pub fn agent_id(&self) -> &AgentId {
        &self.agent_id
    }

    /// The agent's epoch.
    pub fn epoch(&self) -> Epoch {
        self.epoch
    }

    /// Whether this start made the identity: there was no data before.
    pub fn created(&self) -> bool {
        self.created
    }

    /// The data folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }
}

fn parse(path: &Path, text: &str) -> Result<OnDisk, IdentityError> {
    toml::from_str(text).map_err(|error: toml::de::Error| IdentityError::Damaged {
        path: path.to_owned(),
        reason: error.message().to_owned(),
    })
}

/// The lock file, locked, with this process's id in it for the message that others print.
fn lock(folder: &Path) -> Result<File, IdentityError> {
    let path = folder.join(LOCK);
    let mut file = OpenOptions::new()
        .read(true)
        .write(true)
        .create(true)
        .truncate(false)
        .open(&path)
        .map_err(disk("open", &path))?;
    match file.try_lock() {
        Ok(()) => {
            let written = file.set_len(0).and_then(|()| write!(file, "{}", std::process::id()));
            written.map_err(disk("write", &path))?;
            Ok(file)
        }
        Err(TryLockError::WouldBlock) => {
            let mut process = String::new();
            let read = file.rewind().and_then(|()| file.take(20).read_to_string(&mut process));
            if read.is_err() || process.is_empty() {
                process = "unknown".into();
            }
            Err(IdentityError::InUse { folder: folder.to_owned(), process })
        }
        Err(TryLockError::Error(source)) => Err(disk("lock", &path)(source)),
    }
}

fn random_name(path: &Path) -> Result<AgentId, IdentityError> {
    let number = SysRng
        .try_next_u32()
        .map_err(|error| disk("draw a random name for", path)(io::Error::other(error.to_string())))?;
    Ok(AgentId::new(&format!("agent-{number:08x}")).expect("letters, digits and '-'"))
}
