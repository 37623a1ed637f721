//! Finding and loading ONNX Runtime.

use crate::EncoderError;
use ort::environment::Environment;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::Mutex;

/// Where ONNX Runtime is and how it runs.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RuntimeSettings {
    /// `libonnxruntime.so`. Where unset: the environment's `ORT_DYLIB_PATH`; where that is unset: the library of the
    /// Python package `onnxruntime`, then the system's.
    pub library: Option<PathBuf>,
    /// Threads of one model. Origin: 1, so that descriptors do not depend on the machine's number of cores.
    pub threads: usize,
}

impl Default for RuntimeSettings {
    fn default() -> Self {
        RuntimeSettings { library: None, threads: 1 }
    }
}

/// The one environment of this process, and the library that it came from.
static LOADED: Mutex<Option<(PathBuf, Environment)>> = Mutex::new(None);

/// The process's environment; the first call loads the library. A process has one library: a later setting of another
/// one is reported and has no effect.
pub(crate) fn environment(settings: &RuntimeSettings) -> Result<Environment, EncoderError> {
    let mut loaded = LOADED.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    if let Some((library, environment)) = &*loaded {
        if settings.library.as_ref().is_some_and(|asked| asked != library) {
            tracing::warn!(loaded = %library.display(), "ONNX Runtime is loaded already, from another library");
        }
        return Ok(environment.clone());
    }
    let (library, environment) =
        load_first(places(settings, std::env::var_os("ORT_DYLIB_PATH").map(Into::into)))?;
    *loaded = Some((library, environment.clone()));
    Ok(environment)
}

/// A library to try, or why a place has none.
struct Place {
    name: String,
    library: Result<PathBuf, String>,
}

/// What is asked for explicitly is the only place; otherwise all that are known.
fn places(settings: &RuntimeSettings, variable: Option<PathBuf>) -> Vec<Place> {
    let existing = |path: &Path| match path.is_file() {
        true => Ok(path.to_owned()),
        false => Err("no such file".to_owned()),
    };
    let explicit = |name: &str, path: &Path| {
        vec![Place { name: format!("{name} {}", path.display()), library: existing(path) }]
    };
    match (&settings.library, variable.filter(|path| !path.as_os_str().is_empty())) {
        (Some(path), _) => explicit("the setting `library`", path),
        (None, Some(path)) => explicit("ORT_DYLIB_PATH", &path),
        (None, None) => vec![
            Place { name: "ORT_DYLIB_PATH".into(), library: Err("not set".into()) },
            Place { name: "the Python package onnxruntime".into(), library: python_library() },
            Place {
                name: "the system's libonnxruntime".into(),
                library: Ok(format!(
                    "{}onnxruntime{}",
                    std::env::consts::DLL_PREFIX,
                    std::env::consts::DLL_SUFFIX
                )
                .into()),
            },
        ],
    }
}

fn load_first(places: Vec<Place>) -> Result<(PathBuf, Environment), EncoderError> {
    let mut tried = Vec::new();
    for Place { name, library } in places {
        let loaded = library.and_then(|library| {
            let environment = ort::init_from(&library).map_err(|error| error.to_string())?;
            let environment = environment.with_name("coma").build().map_err(|error| error.to_string())?;
            Ok((library, environment))
        });
        match loaded {
            Ok(loaded) => return Ok(loaded),
            Err(reason) => tried.push(format!("{name} ({reason})")),
        }
    }
    Err(EncoderError::NoRuntime { tried: tried.join(", ") })
}

/// The library inside the Python package, found without importing it.
fn python_library() -> Result<PathBuf, String> {
    const PRINT_FOLDER: &str = "import importlib.util as u, os; s = u.find_spec('onnxruntime'); \
        print(os.path.join(os.path.dirname(s.origin), 'capi') if s and s.origin else '')";
    let output = Command::new("python3")
        .args(["-c", PRINT_FOLDER])
        .stdin(Stdio::null())
        .stderr(Stdio::null())
        .output()
        .map_err(|error| format!("python3: {error}"))?;
    let folder = String::from_utf8_lossy(&output.stdout).trim().to_owned();
    if folder.is_empty() {
        return Err("not installed for python3".into());
    }
    let entries = std::fs::read_dir(&folder).map_err(|error| format!("{folder}: {error}"))?;
    let is_library = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        name.starts_with("libonnxruntime.") && (name.contains(".so") || name.contains(".dylib"))
    };
    let mut libraries: Vec<PathBuf> =
        entries.flatten().map(|entry| entry.path()).filter(is_library).collect();
    libraries.sort();
    libraries.pop().ok_or_else(|| format!("{folder} has no libonnxruntime"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_missing_library_is_reported_with_every_place() {
        let setting = RuntimeSettings { library: Some("/nowhere/libonnxruntime.so".into()), threads: 1 };
        let error = load_first(places(&setting, Some("/other.so".into()))).unwrap_err().to_string();
        assert!(error.contains("the setting `library` /nowhere/libonnxruntime.so (no such file)"), "{error}");
        assert!(error.contains("ORT_DYLIB_PATH"), "the remedy is named: {error}");
        let unset = RuntimeSettings::default();
        let error = load_first(places(&unset, Some("/other.so".into()))).unwrap_err().to_string();
        assert!(error.contains("tried ORT_DYLIB_PATH /other.so (no such file)"), "{error}");
        let names: Vec<_> = places(&unset, None).into_iter().map(|place| place.name).collect();
        assert_eq!(
            names,
            ["ORT_DYLIB_PATH", "the Python package onnxruntime", "the system's libonnxruntime"]
        );
    }

    #[test]
    fn a_file_that_is_no_library_is_reported() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("libonnxruntime.so");
        std::fs::write(&file, b"not a library").unwrap();
        let settings = RuntimeSettings { library: Some(file.clone()), threads: 1 };
        let error = load_first(places(&settings, None)).unwrap_err().to_string();
        assert!(error.contains(&file.display().to_string()) && !error.contains("no such file"), "{error}");
    }
}
