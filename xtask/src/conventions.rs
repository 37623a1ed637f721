//! docs/conventions.md names, for each convention, the test that holds it; these tests hold the page.

/// One line of the page's tables: the convention and the tests named in its last column, each as
/// (folder of the crate, name of the test).
fn lines() -> Vec<(String, Vec<(String, String)>)> {
    let page = std::fs::read_to_string(crate::root().join("docs/conventions.md")).unwrap();
    let rows = page.lines().filter(|line| line.starts_with("| ") && !line.starts_with("| what"));
    rows.map(|row| {
        let cells: Vec<&str> = row.trim_matches('|').split(" | ").map(str::trim).collect();
        let tests = cells.last().unwrap().split(',').map(|test| {
            let test = test.trim().trim_matches('`');
            let (folder, name) =
                test.split_once("::").unwrap_or_else(|| panic!("{row}: {test:?} names no test"));
            (folder.to_string(), name.to_string())
        });
        (cells[0].to_string(), tests.collect())
    })
    .collect()
}

/// True if a source below `folder` has a `#[test]` of this name (attributes may stand between the two).
fn has_test(folder: &std::path::Path, name: &str) -> bool {
    let Ok(entries) = std::fs::read_dir(folder) else { return false };
    entries.flatten().map(|entry| entry.path()).any(|path| {
        if path.is_dir() {
            return path.file_name().is_some_and(|name| name != "target") && has_test(&path, name);
        }
        path.extension().is_some_and(|e| e == "rs")
            && declares_test(&std::fs::read_to_string(path).unwrap(), name)
    })
}

fn declares_test(source: &str, name: &str) -> bool {
    let source = crate::rust_source::code(source);
    let declared = format!("fn {name}()");
    source.match_indices(&declared).any(|(at, _)| {
        let item = source[..at].rfind(['}', ';', '{']).map_or(0, |end| end + 1);
        source[item..at].contains("#[test]") || source[item..at].contains("#[tokio::test")
    })
}

#[test]
fn every_convention_names_a_test_that_exists() {
    let lines = lines();
    assert!(lines.len() >= 15, "only {} lines were read", lines.len());
    let root = crate::root();
    let missing: Vec<_> = lines
        .iter()
        .flat_map(|(convention, tests)| tests.iter().map(move |test| (convention, test)))
        .filter(|(_, (folder, name))| !has_test(&root.join(folder), name))
        .collect();
    assert!(missing.is_empty(), "docs/conventions.md names tests that are not there: {missing:#?}");
}

#[test]
fn a_test_that_is_only_mentioned_does_not_count() {
    assert!(declares_test("mod t { #[test]\n fn holds() {} }", "holds"));
    assert!(declares_test("#[test]\n#[ignore = \"slow\"]\nfn holds() {}", "holds"));
    assert!(!declares_test("// #[test] fn holds() {}", "holds"));
    assert!(!declares_test("#[test]\nfn other() {}\nfn holds() {}", "holds"));
    assert!(!has_test(&crate::root().join("crates/geometry"), "no_such_test"));
}
