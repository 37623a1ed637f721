//! The two steps by which a file becomes durable under its name.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::Path;

/// Makes the entries of a folder durable: a file that was created, renamed or removed in it.
pub(crate) fn sync_folder(folder: &Path) -> io::Result<()> {
    File::open(folder)?.sync_all()
}

/// Creates a folder with its parents, durably.
pub(crate) fn create_folder(folder: &Path) -> io::Result<()> {
    if folder.is_dir() {
        return Ok(());
    }
    match folder.parent().filter(|parent| !parent.as_os_str().is_empty()) {
        Some(parent) => {
            create_folder(parent)?;
            ignore_existing(fs::create_dir(folder))?;
            sync_folder(parent)
        }
        None => ignore_existing(fs::create_dir(folder)),
    }
}

fn ignore_existing(result: io::Result<()>) -> io::Result<()> {
    match result {
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => Ok(()),
        other => other,
    }
}

/// Writes a whole file under `path`, by way of `temporary` in the same file system: after a crash there is the
/// old file, or the new one, never a part.
pub(crate) fn write_file(path: &Path, temporary: &Path, bytes: &[u8]) -> io::Result<()> {
    let written = (|| {
        let mut file = File::create(temporary)?;
        file.write_all(bytes)?;
        file.sync_all()?;
        fs::rename(temporary, path)
    })();
    if written.is_err() {
        // The disk may be full: leave nothing behind. The first error is the one to report.
        let _ = fs::remove_file(temporary);
    }
    written?;
    sync_folder(path.parent().unwrap_or(Path::new(".")))
}
