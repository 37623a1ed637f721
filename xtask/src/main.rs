//! The project's chores: `cargo xtask layers`, `ci`, `deny`, `image`.

use anyhow::{Context, Result};
use clap::{Parser, Subcommand};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

mod ci;
#[cfg(test)]
mod conventions;
mod deny;
mod image;
mod layers;
mod licence;
#[cfg(test)]
mod links;
mod rust_source;
mod steps;

#[derive(Parser)]
#[command(name = "cargo xtask", about = "The project's chores")]
struct Arguments {
    #[command(subcommand)]
    task: Task,
}

#[derive(Subcommand)]
enum Task {
    /// Checks who imports whom, and that nothing below the line touches network, disk, clock or async.
    Layers,
    /// Checks licences, banned crates and sources of every dependency against deny.toml.
    Deny,
    /// Formatting, lints, layers, licences, tests: what a change must pass.
    Ci,
    /// Builds the programs statically and puts each into an image FROM scratch.
    Image(image::Options),
}

fn main() -> ExitCode {
    match run(Arguments::parse().task) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("xtask: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn run(task: Task) -> Result<()> {
    let root = root();
    match task {
        Task::Layers => layers::check(&root),
        Task::Deny => deny::check(&root),
        Task::Ci => ci::run(&root),
        Task::Image(options) => image::run(&root, &options),
    }
}

/// The repository's root.
fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("xtask lies in the root").to_path_buf()
}

/// `cargo metadata` of the whole workspace with every feature, as locked.
fn metadata(root: &Path) -> Result<cargo_metadata::Metadata> {
    cargo_metadata::MetadataCommand::new()
        .manifest_path(root.join("Cargo.toml"))
        .features(cargo_metadata::CargoOpt::AllFeatures)
        .other_options(vec!["--locked".into()])
        .exec()
        .context("cargo metadata --locked --all-features")
}
