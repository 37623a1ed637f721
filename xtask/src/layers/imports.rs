//! The rules on imports between crates, checked on what `cargo metadata` says.

use super::rules::{EDGE_LAYER, EDGE_ONLY, FENCED, GUARDED, IN_TESTS, LAYERS, SIDEWAYS};
use anyhow::{Context, Result};
use cargo_metadata::{DependencyKind, Metadata, PackageId};
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

/// A crate of the workspace with what it imports.
#[derive(Clone, Debug, Default)]
pub struct Crate {
    /// The package's name without `coma-`.
    pub name: String,
    /// Where its Cargo.toml lies.
    pub folder: PathBuf,
    /// What its Cargo.toml names, optional dependencies included.
    pub imports: Vec<Import>,
    /// Every outside crate that its library is built with, directly or through others.
    pub closure: BTreeSet<String>,
}

/// One line of `[dependencies]`, `[build-dependencies]` or `[dev-dependencies]`.
#[derive(Clone, Debug)]
pub struct Import {
    /// For a crate of ours the name without `coma-`.
    pub name: String,
    /// A crate of this workspace.
    pub ours: bool,
    /// Seen by the crate's tests only.
    pub dev: bool,
}

/// The layer of one of our crates.
pub fn layer(name: &str) -> Option<u8> {
    LAYERS.iter().find(|(_, crates)| crates.contains(&name)).map(|(layer, _)| *layer)
}

/// Every violation of the import rules, in the order of `crates`.
pub fn violations(crates: &[Crate]) -> Vec<String> {
    crates.iter().flat_map(violations_of).collect()
}

fn violations_of(krate: &Crate) -> Vec<String> {
    let name = krate.name.as_str();
    let Some(own) = layer(name) else {
        return vec![format!("{name} has no layer: add it to LAYERS")];
    };
    let mut found = Vec::new();
    if !krate.folder.ends_with(name) {
        found.push(format!("{name} lies in {}: folder and package are named alike", krate.folder.display()));
    }
    for import in &krate.imports {
        let target = import.name.as_str();
        if import.ours {
            found.extend(ours(name, own, import));
        } else if let Some((_, places)) = FENCED.iter().find(|(crates, _)| crates.contains(&target))
            && !places.contains(&name)
        {
            found.push(format!("{name} imports {target}, which only {} may know", places.join(", ")));
        } else if import.dev && own < EDGE_LAYER && EDGE_ONLY.contains(&target) {
            found.push(format!(
                "{name} (layer {own}) imports {target} in its tests: it is pure below {EDGE_LAYER}"
            ));
        }
    }
    if own < EDGE_LAYER {
        let reached = EDGE_ONLY.iter().filter(|outside| krate.closure.contains(**outside));
        found.extend(reached.map(|outside| {
            format!(
                "{name} (layer {own}) is built with {outside}: no network, clock or async below {EDGE_LAYER}"
            )
        }));
    }
    found
}

fn ours(name: &str, own: u8, import: &Import) -> Option<String> {
    let target = import.name.as_str();
    let Some(other) = layer(target) else {
        return Some(format!("{name} imports {target}, which has no layer"));
    };
    if import.dev && IN_TESTS.contains(&target) {
        return None;
    }
    let guard = GUARDED.iter().find(|(crates, _, _)| crates.contains(&target));
    if let Some((_, places, why)) = guard
        && !places.contains(&name)
    {
        return Some(format!("{name} imports {target}, which only {} may: {why}", places.join(", ")));
    }
    let sideways = SIDEWAYS.iter().any(|(from, to, _)| (*from, *to) == (name, target));
    if other < own || sideways {
        return None;
    }
    Some(format!("{name} (layer {own}) imports {target} (layer {other}): imports point down"))
}

/// The workspace's crates, by name.
pub fn workspace(metadata: &Metadata) -> Result<Vec<Crate>> {
    let short = |name: &str| name.strip_prefix("coma-").unwrap_or(name).to_string();
    let members: BTreeSet<&PackageId> = metadata.workspace_members.iter().collect();
    let packages: BTreeMap<_, _> = metadata.packages.iter().map(|p| (&p.id, p)).collect();
    let mut crates = Vec::new();
    for id in &members {
        let package = packages.get(id).context("a workspace member without its package")?;
        let imports = package.dependencies.iter().map(|dependency| Import {
            name: if dependency.path.is_some() { short(&dependency.name) } else { dependency.name.clone() },
            ours: dependency.path.is_some(),
            dev: dependency.kind == DependencyKind::Development,
        });
        let closure = closure(metadata, id)?;
        crates.push(Crate {
            name: short(&package.name),
            folder: package.manifest_path.parent().context("Cargo.toml in no folder")?.into(),
            imports: imports.collect(),
            closure: closure
                .iter()
                .filter(|id| !members.contains(*id))
                .filter_map(|id| packages.get(id).map(|p| p.name.to_string()))
                .collect(),
        });
    }
    crates.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(crates)
}

/// Every package that `root` is linked with: what only its tests or build scripts use is left out.
fn closure<'a>(metadata: &'a Metadata, root: &'a PackageId) -> Result<BTreeSet<&'a PackageId>> {
    let nodes = &metadata.resolve.as_ref().context("cargo metadata without a dependency graph")?.nodes;
    let nodes: BTreeMap<_, _> = nodes.iter().map(|node| (&node.id, node)).collect();
    let mut seen = BTreeSet::new();
    let mut open = vec![root];
    while let Some(id) = open.pop() {
        let node = nodes.get(id).context("a package outside the dependency graph")?;
        for dependency in &node.deps {
            let linked = dependency.dep_kinds.iter().any(|kind| kind.kind == DependencyKind::Normal);
            if linked && seen.insert(&dependency.pkg) {
                open.push(&dependency.pkg);
            }
        }
    }
    Ok(seen)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn krate(name: &str, imports: &[Import]) -> Crate {
        Crate {
            name: name.into(),
            folder: format!("crates/{name}").into(),
            imports: imports.to_vec(),
            closure: BTreeSet::new(),
        }
    }
    fn ours(name: &str) -> Import {
        Import { name: name.into(), ours: true, dev: false }
    }
    fn outside(name: &str) -> Import {
        Import { name: name.into(), ours: false, dev: false }
    }
    fn in_tests(import: Import) -> Import {
        Import { dev: true, ..import }
    }
    /// True if the one import of the one crate is refused.
    fn refused(name: &str, import: Import) -> bool {
        !violations(&[krate(name, &[import])]).is_empty()
    }

    #[test]
    fn imports_point_down() {
        assert!(!refused("slam", ours("raster")));
        assert!(refused("raster", ours("slam")));
        assert!(refused("geometry", ours("frame")));
        assert!(refused("raster", ours("registration")), "sideways");
        assert!(!refused("depth-codec", ours("frame")), "sideways, with a reason");
    }

    #[test]
    fn services_never_import_one_another() {
        for a in ["agent", "place-recognition", "dpgo", "viewer-gateway"] {
            for b in ["agent", "place-recognition", "dpgo", "viewer-gateway"] {
                assert!(refused(a, ours(b)), "{a} -> {b}");
            }
        }
        assert!(!refused("agent", ours("wire")));
        assert!(!refused("cli", ours("agent")));
    }

    #[test]
    fn only_programs_know_the_ground_truth() {
        for truth in ["dataset", "evaluation"] {
            assert!(refused("agent", ours(truth)), "agent -> {truth}");
            assert!(refused("slam", ours(truth)), "slam -> {truth}");
            assert!(!refused("cli", ours(truth)));
        }
        assert!(!refused("slam", in_tests(ours("dataset"))), "tests may have a world with a known answer");
        assert!(refused("slam", in_tests(ours("evaluation"))));
        assert!(refused("raster", in_tests(ours("slam"))), "other dev-dependencies point down too");
    }

    #[test]
    fn outside_crates_stay_in_their_place() {
        for (outside_crate, at_home) in [
            ("prost", "wire"),
            ("tonic", "agent"),
            ("ort", "encoder"),
            ("wgpu", "raster"),
            ("axum", "viewer-gateway"),
        ] {
            assert!(!refused(at_home, outside(outside_crate)), "{outside_crate} in {at_home}");
            assert!(refused("store", outside(outside_crate)), "{outside_crate} in store");
            assert!(
                refused("store", in_tests(outside(outside_crate))),
                "{outside_crate} in the tests of store"
            );
        }
    }

    #[test]
    fn nothing_below_the_line_is_built_with_an_async_runtime() {
        let through_others = |name| Crate { closure: ["tokio".to_string()].into(), ..krate(name, &[]) };
        assert_eq!(violations(&[through_others("slam")]).len(), 1);
        assert_eq!(violations(&[through_others("wire")]).len(), 0);
        assert!(refused("place", in_tests(outside("tokio"))));
    }

    #[test]
    fn a_new_crate_needs_a_layer_and_a_folder_of_its_name() {
        assert!(violations(&[krate("misc", &[])])[0].contains("no layer"));
        let elsewhere = Crate { folder: "crates/other".into(), ..krate("place", &[]) };
        assert!(violations(&[elsewhere])[0].contains("named alike"));
    }

    #[test]
    fn this_workspace_is_read_as_it_is() {
        let crates = workspace(&crate::metadata(&crate::root()).unwrap()).unwrap();
        let slam = crates.iter().find(|c| c.name == "slam").unwrap();
        assert!(slam.imports.iter().any(|i| i.ours && i.name == "geometry"));
        assert!(slam.closure.contains("nalgebra"), "{:?}", slam.closure);
        let agent = crates.iter().find(|c| c.name == "agent").unwrap();
        assert!(agent.closure.contains("tokio"));
        assert_eq!(crates.len(), LAYERS.iter().map(|(_, crates)| crates.len()).sum::<usize>());
    }
}
