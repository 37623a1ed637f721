//! Settings from a TOML file, overridden by environment variables.
//!
//! `COMA_AGENT__SERVER__LISTEN=0.0.0.0:7001` sets `server.listen` of the program whose prefix is
//! `COMA_AGENT`. Values are read as TOML (`true`, `8`, `["a", "b"]`), as plain text where that is what
//! the setting takes, or as a comma-separated list.

use serde::de::DeserializeOwned;
use std::path::{Path, PathBuf};
use toml::{Table, Value};

/// Why settings were refused; names the file or variable and the key.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("settings file {path}: {source}", path = path.display())]
    Read {
        /// Which file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file is no TOML.
    #[error("settings file {path} is no TOML: {message}", path = path.display())]
    Syntax {
        /// Which file.
        path: PathBuf,
        /// Where and why.
        message: String,
    },
    /// A key is unknown, missing, or has a wrong value.
    #[error("{origin}: {key}: {message}")]
    Key {
        /// The file or the environment variable.
        origin: String,
        /// The key's path.
        key: String,
        /// What is wrong.
        message: String,
    },
}

/// Settings from `file` (all defaults without one) and this process's environment.
pub fn load<T: DeserializeOwned>(file: Option<&Path>, prefix: &str) -> Result<T, ConfigError> {
    let variables =
        std::env::vars_os().filter_map(|(k, v)| Some((k.into_string().ok()?, v.into_string().ok()?)));
    load_from(file, prefix, variables)
}

struct Override {
    variable: String,
    path: Vec<String>,
    /// Ways to read the value, the most specific first.
    readings: Vec<Value>,
}

/// [`load`] with a given environment.
pub fn load_from<T: DeserializeOwned>(
    file: Option<&Path>,
    prefix: &str,
    variables: impl IntoIterator<Item = (String, String)>,
) -> Result<T, ConfigError> {
    let table = match file {
        None => Table::new(),
        Some(path) => {
            let text = std::fs::read_to_string(path)
                .map_err(|source| ConfigError::Read { path: path.to_owned(), source })?;
            text.parse::<Table>()
                .map_err(|e| ConfigError::Syntax { path: path.to_owned(), message: e.to_string() })?
        }
    };
    let mut overrides = overrides(prefix, variables);
    loop {
        let mut candidate = table.clone();
        for over in &overrides {
            set(&mut candidate, &over.path, over.readings[0].clone()).map_err(|key| ConfigError::Key {
                origin: over.variable.clone(),
                key,
                message: "is a value, not a table".into(),
            })?;
        }
        let error = match serde_path_to_error::deserialize(Value::Table(candidate)) {
            Ok(settings) => return Ok(settings),
            Err(error) => error,
        };
        let key = error.path().to_string();
        let message = error.inner().message().to_owned();
        // `unknown field` errors stop at the table that holds the field.
        let blamed = |o: &Override| {
            let path = o.path.join(".");
            path == key || key.strip_prefix(&path).is_some_and(|rest| rest.starts_with(['[', '.']))
        };
        if let Some(over) = overrides.iter_mut().find(|o| blamed(o) && o.readings.len() > 1) {
            over.readings.remove(0);
            continue;
        }
        let unknown = |o: &&Override| {
            let (last, above) = o.path.split_last().expect("a path has parts");
            above.join(".") == key.trim_matches('.') && message.contains(&format!("`{last}`"))
        };
        let origin = overrides.iter().find(|o| blamed(o)).or_else(|| overrides.iter().find(unknown));
        let origin = match (origin, file) {
            (Some(over), _) => over.variable.clone(),
            (None, Some(path)) => path.display().to_string(),
            (None, None) => "settings".into(),
        };
        return Err(ConfigError::Key { origin, key, message });
    }
}

fn overrides(prefix: &str, variables: impl IntoIterator<Item = (String, String)>) -> Vec<Override> {
    let start = format!("{prefix}__");
    let mut out: Vec<Override> = variables
        .into_iter()
        .filter_map(|(variable, text)| {
            let path: Vec<String> =
                variable.strip_prefix(&start)?.split("__").map(str::to_lowercase).collect();
            let mut readings = Vec::new();
            if let Ok(mut table) = format!("value = {text}").parse::<Table>()
                && table.len() == 1
                && let Some(value) = table.remove("value")
            {
                readings.push(value);
            }
            readings.push(Value::String(text.clone()));
            let items = text.split(',').map(str::trim).filter(|item| !item.is_empty());
            readings.push(Value::Array(items.map(|item| Value::String(item.to_owned())).collect()));
            Some(Override { variable, path, readings })
        })
        .collect();
    out.sort_by(|a, b| a.variable.cmp(&b.variable));
    out
}

fn set(table: &mut Table, path: &[String], value: Value) -> Result<(), String> {
    match path {
        [] => Ok(()),
        [last] => {
            table.insert(last.clone(), value);
            Ok(())
        }
        [first, rest @ ..] => {
            match table.entry(first.clone()).or_insert_with(|| Value::Table(Table::new())) {
                Value::Table(inner) => set(inner, rest, value),
                _ => Err(first.clone()),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde::Deserialize;

    #[derive(Debug, Default, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    struct Server {
        listen: String,
        token: Option<String>,
        calls: u32,
    }

    #[derive(Debug, Default, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    struct Settings {
        seeds: Vec<String>,
        server: Server,
        fast: bool,
    }

    fn read(text: &str, variables: &[(&str, &str)]) -> Result<Settings, ConfigError> {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("agent.toml");
        std::fs::write(&file, text).unwrap();
        let variables = variables.iter().map(|(k, v)| (k.to_string(), v.to_string()));
        load_from(Some(&file), "COMA_X", variables)
    }

    #[test]
    fn the_environment_overrides_the_file() {
        let settings = read(
            "fast = false\n[server]\nlisten = \"a:1\"\ncalls = 3",
            &[
                ("COMA_X__SERVER__LISTEN", "0.0.0.0:7001"),
                // A number where a text is wanted stays a text.
                ("COMA_X__SERVER__TOKEN", "12345"),
                ("COMA_X__FAST", "true"),
                ("COMA_X__SEEDS", "agent:7000, other:7000"),
                ("COMA_Y__FAST", "nonsense"),
            ],
        )
        .unwrap();
        assert_eq!(settings.server.listen, "0.0.0.0:7001");
        assert_eq!(settings.server.token.as_deref(), Some("12345"));
        assert_eq!(settings.server.calls, 3);
        assert!(settings.fast);
        assert_eq!(settings.seeds, ["agent:7000", "other:7000"]);
        assert_eq!(read("", &[("COMA_X__SEEDS", "[\"a\"]")]).unwrap().seeds, ["a"]);
    }

    #[test]
    fn errors_name_the_file_or_variable_and_the_key() {
        let message = |text, variables: &[(&str, &str)]| read(text, variables).unwrap_err().to_string();
        let wrong = message("[server]\ncalls = \"many\"", &[]);
        assert!(wrong.contains("agent.toml: server.calls: invalid type"), "{wrong}");
        let unknown = message("[server]\nlissten = \"a\"", &[]);
        assert!(unknown.contains("agent.toml") && unknown.contains("lissten"), "{unknown}");
        let variable = message("", &[("COMA_X__SERVER__CALLS", "-1")]);
        assert!(variable.starts_with("COMA_X__SERVER__CALLS: server.calls: invalid"), "{variable}");
        let variable = message("", &[("COMA_X__SERVER__LISSTEN", "a")]);
        assert!(variable.starts_with("COMA_X__SERVER__LISSTEN: "), "{variable}");
        let syntax = message("[server\n", &[]);
        assert!(syntax.contains("agent.toml is no TOML"), "{syntax}");
        let missing =
            load_from::<Settings>(Some(Path::new("/no/such.toml")), "X", []).unwrap_err().to_string();
        assert!(missing.starts_with("settings file /no/such.toml: "), "{missing}");
    }
}
