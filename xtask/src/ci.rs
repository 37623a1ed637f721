//! What a change must pass, cheapest first.

use crate::steps::{command, timed};
use crate::{deny, layers};
use anyhow::Result;
use std::path::Path;

/// The project's test command, as the README gives it and `.ci/run` runs it.
pub const TEST_COMMAND: &[&str] = &["cargo", "test", "--release", "--workspace"];

const CLIPPY: &[&str] = &[
    "cargo",
    "clippy",
    "--release",
    "--workspace",
    "--all-targets",
    "--all-features",
    "--",
    "-D",
    "warnings",
];

/// Runs every step; the first that fails ends the run.
pub fn run(root: &Path) -> Result<()> {
    timed("layers", || layers::check(root))?;
    timed("licences", || deny::check(root))?;
    timed("formatting", || command(root, &["cargo", "fmt", "--all", "--check"], &[]))?;
    timed("lints", || command(root, CLIPPY, &[]))?;
    timed("tests", || command(root, TEST_COMMAND, &[]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ci_script_runs_the_test_command() {
        let script = std::fs::read_to_string(crate::root().join(".ci/run")).unwrap();
        assert!(script.contains(&TEST_COMMAND.join(" ")), "{script}");
    }
}
