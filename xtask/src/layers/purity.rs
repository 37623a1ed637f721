//! Sources below the edge name no network, disk, clock or async runtime; and names that one folder keeps
//! to itself stay there.

use super::imports::{Crate, layer};
use super::rules::{EDGE_LAYER, EDGE_ONLY_PATHS, IN_FOLDER, NOT_WHOLE};
use crate::rust_source::{code, paths, without_tests};
use anyhow::{Context, Result};
use std::path::{Path, PathBuf};

/// Every violation in the sources of `crates`; their tests, examples and benchmarks are free.
pub fn violations(crates: &[Crate]) -> Result<Vec<String>> {
    let mut found = Vec::new();
    for krate in crates {
        let pure = layer(&krate.name).is_some_and(|layer| layer < EDGE_LAYER);
        let kept = IN_FOLDER.iter().any(|(name, _, _)| *name == krate.name);
        if !pure && !kept {
            continue;
        }
        for (file, source) in sources(&krate.folder.join("src"))? {
            let shown = file.strip_prefix(&krate.folder).unwrap_or(&file);
            let offences = offences(&krate.name, pure, shown, &source);
            found.extend(offences.iter().map(|o| format!("{}: {o}", krate.folder.join(shown).display())));
        }
    }
    Ok(found)
}

/// What one source of a crate does wrong; `file` is relative to the crate's folder.
fn offences(name: &str, pure: bool, file: &Path, source: &str) -> Vec<String> {
    let mut found = Vec::new();
    for (line, path) in paths(&without_tests(&code(source)).0) {
        let plain = path.split(" as ").next().unwrap_or(&path);
        let plain = plain.strip_suffix("::*").unwrap_or(plain);
        let whole = plain != path && NOT_WHOLE.contains(&plain) || plain == "std::time";
        let edge = EDGE_ONLY_PATHS.iter().any(|edge| covers(edge, plain));
        if pure && (whole || edge || matches!(plain, "async" | "await")) {
            found.push(format!(
                "line {line}: {path}: {name} lies below layer {EDGE_LAYER}, where no network, disk, clock or async runtime is known"
            ));
        }
        let folder = IN_FOLDER.iter().find(|(krate, kept, _)| *krate == name && covers(kept, plain));
        if let Some((_, kept, folder)) = folder
            && !(file.starts_with(folder) || file == Path::new(folder).with_extension("rs"))
        {
            found.push(format!("line {line}: {path}: only {folder} knows {kept}"));
        }
    }
    found
}

/// True for `prefix` itself and every path below it.
fn covers(prefix: &str, path: &str) -> bool {
    path.strip_prefix(prefix).is_some_and(|rest| rest.is_empty() || rest.starts_with("::"))
}

/// Every Rust source below `folder` that is built outside tests, sorted.
fn sources(folder: &Path) -> Result<Vec<(PathBuf, String)>> {
    let (mut open, mut found, mut tests) = (vec![folder.to_path_buf()], Vec::new(), Vec::new());
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(&folder).with_context(|| format!("reading {}", folder.display()))? {
            let path = entry?.path();
            if path.is_dir() {
                open.push(path);
            } else if path.extension().is_some_and(|e| e == "rs") {
                let source =
                    std::fs::read_to_string(&path).with_context(|| format!("reading {}", path.display()))?;
                let modules = without_tests(&code(&source)).1;
                tests.extend(modules.iter().map(|module| module_folder(&path).join(module)));
                found.push((path, source));
            }
        }
    }
    found.retain(|(path, _)| !tests.iter().any(|t| path.starts_with(t) || *path == t.with_extension("rs")));
    found.sort();
    Ok(found)
}

/// The folder in which the modules that `file` declares lie.
fn module_folder(file: &Path) -> PathBuf {
    let stem = file.file_stem().and_then(|s| s.to_str());
    if matches!(stem, Some("lib" | "main" | "mod")) {
        file.parent().map(Path::to_path_buf).unwrap_or_default()
    } else {
        file.with_extension("")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(source: &str) -> bool {
        !offences("slam", true, Path::new("src/lib.rs"), source).is_empty()
    }

    #[test]
    fn disk_network_clock_and_async_are_refused_however_they_are_written() {
        for source in [
            "fn f() { std::fs::read(p); }",
            "use std::fs;",
            "use std::{collections::BTreeMap, net::TcpStream};",
            "use std::time::{Duration, Instant};",
            "use std::time; fn f() { time::Instant::now(); }",
            "use std::time::*;",
            "use std as s;",
            "fn f() { ::std::fs::read(p); }",
            "fn f() { let t = std::time::SystemTime::now(); }",
            "use tokio::sync::mpsc;",
            "async fn f() {}",
        ] {
            assert!(refused(source), "{source}");
        }
    }

    #[test]
    fn durations_tests_and_words_in_comments_are_fine() {
        for source in [
            "use std::time::Duration;",
            "fn f(x: std::time::Duration) {}",
            "// std::fs\nconst A: &str = \"std::net\";",
            "#[cfg(test)]\nmod tests { use std::fs; }",
            "use std::io::Read;",
            "fn f() { my::fs::read(); }",
        ] {
            assert!(!refused(source), "{source}");
        }
    }

    #[test]
    fn only_the_gpu_folder_knows_wgpu() {
        let source = "use wgpu::Device;";
        assert!(offences("raster", true, Path::new("src/gpu/device.rs"), source).is_empty());
        assert!(offences("raster", true, Path::new("src/gpu.rs"), source).is_empty());
        assert_eq!(offences("raster", true, Path::new("src/cpu/sort.rs"), source).len(), 1);
    }

    #[test]
    fn modules_of_tests_in_their_own_files_are_left_out() {
        let folder = std::env::temp_dir().join(format!("coma-purity-{}", std::process::id()));
        std::fs::create_dir_all(folder.join("oracle")).unwrap();
        std::fs::write(folder.join("lib.rs"), "#[cfg(test)]\nmod oracle;\nmod kept;").unwrap();
        for file in ["oracle.rs", "oracle/part.rs", "kept.rs"] {
            std::fs::write(folder.join(file), "use std::fs;").unwrap();
        }
        let files: Vec<_> = sources(&folder).unwrap().into_iter().map(|(path, _)| path).collect();
        std::fs::remove_dir_all(&folder).unwrap();
        assert_eq!(files, [folder.join("kept.rs"), folder.join("lib.rs")]);
    }
}
