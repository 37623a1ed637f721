//! Who may import whom. `docs/adr/0001-layout.md` says why.

mod imports;
mod purity;
mod rules;

use crate::metadata;
use anyhow::{Result, bail};
use std::path::Path;

/// Checks the workspace; prints every violation and fails if there is one.
pub fn check(root: &Path) -> Result<()> {
    let metadata = metadata(root)?;
    let crates = imports::workspace(&metadata)?;
    let mut violations = imports::violations(&crates);
    violations.extend(purity::violations(&crates)?);
    for violation in &violations {
        eprintln!("layers: {violation}");
    }
    if !violations.is_empty() {
        bail!("{} violation(s) of the layers; the rules are in xtask/src/layers/rules.rs", violations.len());
    }
    println!("layers: {} crates, every import points down", crates.len());
    Ok(())
}
