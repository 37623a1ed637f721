//! Licences, banned crates and sources of every dependency, by the lists of deny.toml.
//!
//! `cargo deny check licenses bans sources` is the thorough tool (it also reads the licence texts) and is
//! run too where it is installed. Installing it takes minutes, so what every change needs of it, the lists
//! against `cargo metadata`, is here.

use crate::steps::{answers, command};
use crate::{licence, metadata};
use anyhow::{Context, Result, bail};
use cargo_metadata::Package;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;

/// The part of deny.toml that is read here.
#[derive(Deserialize)]
struct Lists {
    licenses: Licences,
    bans: Bans,
    sources: Sources,
}

#[derive(Deserialize)]
struct Licences {
    allow: Vec<String>,
}

#[derive(Deserialize)]
struct Bans {
    deny: Vec<Banned>,
}

#[derive(Deserialize)]
struct Banned {
    #[serde(rename = "crate")]
    name: String,
    reason: String,
}

#[derive(Deserialize)]
struct Sources {
    #[serde(rename = "allow-registry")]
    allow_registry: Vec<String>,
}

/// Checks every package of the lock file that some feature uses; prints every violation and fails if there
/// is one.
pub fn check(root: &Path) -> Result<()> {
    let text = std::fs::read_to_string(root.join("deny.toml")).context("reading deny.toml")?;
    let lists: Lists = toml::from_str(&text).context("deny.toml")?;
    let metadata = metadata(root)?;
    let found: Vec<_> = metadata.packages.iter().flat_map(|package| violations(package, &lists)).collect();
    for violation in &found {
        eprintln!("deny: {violation}");
    }
    if !found.is_empty() {
        bail!("{} violation(s) of deny.toml", found.len());
    }
    let mut tally = BTreeMap::<&str, usize>::new();
    for package in &metadata.packages {
        *tally.entry(package.license.as_deref().unwrap_or("none")).or_default() += 1;
    }
    println!(
        "deny: {} packages under {} licence expressions, all allowed",
        metadata.packages.len(),
        tally.len()
    );
    if answers(&["cargo", "deny", "--version"]) {
        return command(root, &["cargo", "deny", "--locked", "check", "licenses", "bans", "sources"], &[]);
    }
    Ok(())
}

fn violations(package: &Package, lists: &Lists) -> Vec<String> {
    let shown = format!("{} {}", package.name, package.version);
    let mut found = Vec::new();
    let allowed = |name: &str| lists.licenses.allow.iter().any(|allowed| allowed == name);
    match package.license.as_deref().map(|expression| licence::is_allowed(expression, &allowed)) {
        Some(Ok(true)) => {}
        Some(Ok(false)) => {
            let expression = package.license.as_deref().unwrap_or_default();
            found.push(format!("{shown}: licence {expression} is not in licenses.allow"));
        }
        Some(Err(reason)) => found.push(format!("{shown}: {reason}")),
        None => found.push(format!("{shown}: names no licence")),
    }
    if let Some(banned) = lists.bans.deny.iter().find(|banned| package.name.as_str() == banned.name) {
        found.push(format!("{shown}: banned: {}", banned.reason));
    }
    // A package without a source is one of the workspace.
    if let Some(source) = &package.source {
        let registry = source.repr.strip_prefix("registry+").or(source.repr.strip_prefix("sparse+"));
        if !registry.is_some_and(|url| lists.sources.allow_registry.iter().any(|allowed| allowed == url)) {
            found.push(format!("{shown}: comes from {source}, which sources.allow-registry does not name"));
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    const REGISTRY: &str = "https://github.com/rust-lang/crates.io-index";

    fn lists() -> Lists {
        Lists {
            licenses: Licences { allow: vec!["MIT".into()] },
            bans: Bans { deny: vec![Banned { name: "openssl-sys".into(), reason: "rustls".into() }] },
            sources: Sources { allow_registry: vec![REGISTRY.into()] },
        }
    }

    /// Some package of this workspace's graph, made over.
    fn package(change: impl FnOnce(&mut Package)) -> Package {
        let metadata = metadata(&crate::root()).unwrap();
        let found = metadata.packages.into_iter().find(|package| package.name.as_str() == "anyhow");
        let mut package = found.expect("anyhow is a dependency of this program");
        package.license = Some("MIT".into());
        change(&mut package);
        package
    }

    #[test]
    fn each_list_is_enforced() {
        assert_eq!(violations(&package(|_| {}), &lists()), Vec::<String>::new());
        let one = |package: Package, words: &str| {
            let found = violations(&package, &lists());
            assert!(found.len() == 1 && found[0].contains(words), "{words}: {found:?}");
        };
        one(package(|p| p.license = Some("GPL-3.0-only".into())), "GPL-3.0-only is not in");
        one(package(|p| p.license = None), "names no licence");
        let git = cargo_metadata::Source { repr: "git+https://example.org/x".into() };
        one(package(|p| p.source = Some(git)), "comes from");
        let banned = Bans { deny: vec![Banned { name: "anyhow".into(), reason: "a test".into() }] };
        let found = violations(&package(|_| {}), &Lists { bans: banned, ..lists() });
        assert_eq!(found.len(), 1, "{found:?}");
    }
}
