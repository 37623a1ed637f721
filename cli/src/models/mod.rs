//! `coma models`: the image encoders that can describe places on this machine.

mod folder;
mod install;
mod recommended;

use anyhow::{Context, bail};
use clap::{Args, Subcommand};
use coma_encoder::{Manifest, OnnxEncoder, RuntimeSettings};
use coma_frame::Image;
use folder::Folder;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// What to do with models.
#[derive(Subcommand)]
pub enum Models {
    /// Lists the models of the folder, and the builtin encoder, which needs none.
    List(In),
    Check(CheckArguments),
    Install(install::Arguments),
}

/// Where models lie.
#[derive(Args)]
pub struct In {
    /// Folder of the models; default: coma/models in the user's data folder.
    #[arg(long, env = "COMA_MODELS", value_name = "FOLDER")]
    dir: Option<PathBuf>,
}

/// Loads models as place recognition would, describes a picture with each, and says what is wrong.
#[derive(Args)]
pub struct CheckArguments {
    /// Names of installed models, or manifests; without any, all that are installed.
    models: Vec<String>,
    #[command(flatten)]
    within: In,
    /// `libonnxruntime.so`; default: ORT_DYLIB_PATH, the Python package onnxruntime, the system's.
    #[arg(long)]
    library: Option<PathBuf>,
}

/// Runs it.
pub fn run(models: &Models) -> anyhow::Result<()> {
    match models {
        Models::List(within) => list(&Folder::open(within.dir.as_deref())?),
        Models::Check(arguments) => check(arguments),
        Models::Install(arguments) => install::run(arguments),
    }
}

fn list(folder: &Folder) -> anyhow::Result<()> {
    let builtin = coma_place::Builtin::default();
    let dimension = coma_place::Encoder::dimension(&builtin);
    println!("| model | descriptor | input | pooling | file |\n|---|---|---|---|---|");
    println!("| builtin | {dimension} | any | - | none needed |");
    for path in folder.manifests()? {
        let name = folder::name_of(&path);
        match Manifest::load(&path) {
            Ok(m) => {
                let model = path.with_file_name(&m.model);
                let file = match std::fs::metadata(&model) {
                    Ok(found) => {
                        let hash = if m.sha256.is_some() { "SHA-256 stated" } else { "no SHA-256 stated" };
                        format!("{:.0} MiB, {hash}", found.len() as f64 / (1 << 20) as f64)
                    }
                    Err(error) => format!("{}: {error}", model.display()),
                };
                let (input, output) = (&m.input, &m.output);
                let (width, height, pooling) = (input.width, input.height, output.pooling.name());
                println!("| {name} | {} | {width}x{height} | {pooling} | {file} |", output.dimension);
            }
            Err(error) => println!("| {name} | - | - | - | {error} |"),
        }
    }
    println!("\nfolder: {}", folder.path().display());
    Ok(())
}

fn check(arguments: &CheckArguments) -> anyhow::Result<()> {
    let folder = Folder::open(arguments.within.dir.as_deref())?;
    let manifests: Vec<PathBuf> = match arguments.models.as_slice() {
        [] => folder.manifests()?,
        names => names.iter().map(|name| folder.manifest(name)).collect(),
    };
    if manifests.is_empty() {
        println!("no models in {}: places are described by the builtin encoder", folder.path().display());
        return Ok(());
    }
    let settings = RuntimeSettings { library: arguments.library.clone(), threads: 1 };
    let mut failed = 0;
    for manifest in &manifests {
        match tried(manifest, &settings) {
            Ok(text) => println!("{}: {text}", manifest.display()),
            Err(error) => {
                failed += 1;
                println!("{}: {error:#}", manifest.display());
            }
        }
    }
    if failed > 0 {
        bail!("{failed} of {} models cannot be used", manifests.len());
    }
    Ok(())
}

/// Loads a model and describes a picture, and says how that went.
fn tried(manifest: &Path, settings: &RuntimeSettings) -> anyhow::Result<String> {
    let encoder = OnnxEncoder::open(manifest, settings)?;
    let limit = coma_place::descriptor::MAX_DIMENSION;
    if encoder.dimension() > limit {
        bail!("output.dimension is {}, descriptors have at most {limit} values", encoder.dimension());
    }
    let picture = Image::from_fn(640, 480, |x, y| [x as u8, y as u8, (x / 3 + y / 2) as u8]);
    encoder.encode(&picture).context("describing a picture")?;
    let begin = Instant::now();
    encoder.encode(&picture)?;
    let ms = begin.elapsed().as_secs_f64() * 1e3;
    Ok(format!("works: {} values, space {}, {ms:.0} ms a picture", encoder.dimension(), encoder.space()))
}
