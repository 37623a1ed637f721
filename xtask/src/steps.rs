//! Running commands one after the other, each with its time.

use anyhow::{Context, Result, bail};
use std::path::Path;
use std::process::Command;
use std::time::Instant;

/// Runs `f`, printing its name before and its time after.
pub fn timed<T>(name: &str, f: impl FnOnce() -> Result<T>) -> Result<T> {
    eprintln!("==> {name}");
    let begin = Instant::now();
    let result = f();
    let verdict = if result.is_ok() { "done" } else { "FAILED" };
    eprintln!("<== {name}: {verdict} after {:.0} s", begin.elapsed().as_secs_f64());
    result
}

/// Runs a command line in `directory` and fails if it does; the command's own output is passed on.
pub fn command(directory: &Path, line: &[&str], environment: &[(&str, &str)]) -> Result<()> {
    let shown = line.join(" ");
    let (program, arguments) = line.split_first().context("an empty command line")?;
    let status = Command::new(program)
        .args(arguments)
        .envs(environment.iter().copied())
        .current_dir(directory)
        .status()
        .with_context(|| format!("starting `{shown}`"))?;
    if !status.success() {
        bail!("`{shown}` ended with {status}");
    }
    Ok(())
}

/// True if a program answers `program argument` without failing.
pub fn answers(line: &[&str]) -> bool {
    let Some((program, arguments)) = line.split_first() else { return false };
    Command::new(program).args(arguments).output().is_ok_and(|output| output.status.success())
}
