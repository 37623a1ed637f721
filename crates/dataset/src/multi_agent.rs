//! Folders with one folder per agent: ReplicaMultiagent (`agent_0`, or `apart_1_part1` as CP-SLAM
//! published them) and AriaMultiagent (`agent_0`, `agent_1`, ...), each in the layout of Replica.

use crate::{DatasetError, replica};
use std::fs;
use std::path::{Path, PathBuf};

/// The agents' folders, sorted by name; the folder itself if it holds one sequence.
pub(crate) fn agent_folders(folder: &Path) -> Result<Vec<PathBuf>, DatasetError> {
    if replica::is_sequence(folder) {
        return Ok(vec![folder.to_owned()]);
    }
    let mut out = Vec::new();
    for entry in fs::read_dir(folder).map_err(|e| DatasetError::io(folder, e))? {
        let path = entry.map_err(|e| DatasetError::io(folder, e))?.path();
        if path.is_dir() && replica::is_sequence(&path) {
            out.push(path);
        }
    }
    // agent_10 comes after agent_9: shorter names first.
    out.sort_by_key(|p| (p.as_os_str().len(), p.clone()));
    if out.is_empty() {
        return Err(DatasetError::damaged(
            folder,
            "holds no agent folders (agent_*/results or *_part*/results)",
        ));
    }
    Ok(out)
}
