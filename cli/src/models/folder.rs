//! The folder of the models: `NAME.toml`, a manifest, beside the model that it describes.

use anyhow::{Context, ensure};
use std::path::{Path, PathBuf};

/// Where models are installed.
pub struct Folder(PathBuf);

impl Folder {
    /// The folder given, or the one in the user's data folder. It need not be there yet.
    pub fn open(given: Option<&Path>) -> anyhow::Result<Self> {
        let variable = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
        let home = || variable("HOME").or(variable("USERPROFILE")).map(|home| home.join(".local/share"));
        let path = match given {
            Some(path) => path.to_owned(),
            None => variable("XDG_DATA_HOME")
                .or_else(home)
                .context("neither HOME nor XDG_DATA_HOME is set: say --dir")?
                .join("coma/models"),
        };
        // Manifests are told to services that may run elsewhere.
        Ok(Folder(std::path::absolute(&path).with_context(|| path.display().to_string())?))
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.0
    }

    /// All manifests, by name.
    pub fn manifests(&self) -> anyhow::Result<Vec<PathBuf>> {
        let entries = match std::fs::read_dir(&self.0) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
            entries => entries.with_context(|| self.0.display().to_string())?,
        };
        let paths = entries.map(|entry| Ok(entry?.path())).collect::<std::io::Result<Vec<_>>>();
        let mut paths = paths.with_context(|| self.0.display().to_string())?;
        paths.retain(|path| path.extension().is_some_and(|e| e == "toml"));
        paths.sort();
        Ok(paths)
    }

    /// The manifest of an installed model, or a manifest named by its path.
    pub fn manifest(&self, name: &str) -> PathBuf {
        if checked(name).is_ok() && !name.ends_with(".toml") {
            self.0.join(format!("{name}.toml"))
        } else {
            PathBuf::from(name)
        }
    }
}

/// A model's name is that of its manifest.
pub fn name_of(manifest: &Path) -> String {
    manifest.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

/// Refuses names that are no plain file name.
pub fn checked(name: &str) -> anyhow::Result<&str> {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    let right = (1..=64).contains(&name.len()) && name.chars().all(plain) && !name.starts_with('.');
    ensure!(right, "a model's name has 1 to 64 letters, digits, -, _ and ., not {name:?}");
    Ok(name)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_stay_inside_the_folder() {
        for wrong in ["", ".hidden", "../m", "a/b", "a b", &"x".repeat(65)] {
            assert!(checked(wrong).is_err(), "{wrong}");
        }
        let folder = Folder::open(Some(Path::new("models"))).unwrap();
        assert!(folder.path().is_absolute() && folder.manifests().unwrap().is_empty());
        assert_eq!(folder.manifest("dinov2-vits14"), folder.path().join("dinov2-vits14.toml"));
        assert_eq!(folder.manifest("x/m.toml"), Path::new("x/m.toml"));
    }
}
