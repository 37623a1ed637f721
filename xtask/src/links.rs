//! Pages at the root and in docs/ link files of the repository; these tests hold the links.

use std::path::{Path, PathBuf};

/// Targets of `[text](target)` that are no addresses, without their anchors.
fn targets(page: &str) -> Vec<&str> {
    let after = page.split("](").skip(1).filter_map(|rest| rest.split(')').next());
    let files = after.filter(|target| !target.contains("://") && !target.starts_with(['#', '<']));
    files.map(|target| target.split('#').next().unwrap_or(target)).collect()
}

fn pages(folder: &Path) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let paths = entries.flatten().map(|entry| entry.path());
    paths.filter(|path| path.extension().is_some_and(|extension| extension == "md")).collect()
}

#[test]
fn links_of_the_pages_lead_somewhere() {
    let root = crate::root();
    let mut seen = 0;
    for folder in [root.clone(), root.join("docs"), root.join("docs/adr"), root.join("docker")] {
        for page in pages(&folder) {
            let text = std::fs::read_to_string(&page).unwrap();
            for target in targets(&text) {
                seen += 1;
                assert!(folder.join(target).exists(), "{}: {target} is not there", page.display());
            }
        }
    }
    assert!(seen > 30, "only {seen} links were read");
}

#[test]
fn a_link_is_what_stands_in_parentheses_after_brackets() {
    let page = "[a](b/c.rs) (no) [x](https://x.org/y) [d](e.md#part) [f](#here)";
    assert_eq!(targets(page), ["b/c.rs", "e.md"]);
}
