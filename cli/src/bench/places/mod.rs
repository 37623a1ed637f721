//! `coma bench places`: how well descriptors find places again.

mod npy;
mod perturb;
mod score;

use super::cpu::{median, timed};
use super::overlap::Sight;
use crate::progress;
use crate::source::{self, Source};
use anyhow::{Context, bail, ensure};
use clap::Args;
use coma_frame::Image;
use coma_place::{Descriptor, Encoder, similarity};
use coma_place_recognition::{Encoders, OnnxSettings, PlaceRecognitionConfig};
use rayon::prelude::*;
use score::{Known, Passed, Scores};
use serde::Serialize;
use std::fmt::Write as _;
use std::path::PathBuf;

/// Scores the builtin descriptor, and those of models, on sequences by the true overlap of views.
///
/// recall@1: frames with a match (a view over --gap frames apart that shares at least 40 %) whose best candidate is
/// one. AP: average precision of the matches among all pairs. No false pair: share of the matches scored above every
/// pair that shares less than 10 %; then the same by the mean over windows of frames. Perturbed hit: views of other
/// gamma or colours, cropped, or blurred, whose best candidate lies within 12 frames.
#[derive(Args)]
pub struct Arguments {
    /// Sequences, as for `coma run`; their true poses must be known.
    #[arg(required = true)]
    specs: Vec<String>,
    /// Manifests of models to score beside the builtin descriptor.
    #[arg(long, value_name = "MANIFEST.toml")]
    model: Vec<PathBuf>,
    /// Describes every K-th frame.
    #[arg(long, value_name = "K", default_value_t = 5)]
    every: usize,
    /// Frames this near are no pair.
    #[arg(long, default_value_t = 25)]
    gap: usize,
    /// Writes the descriptors as arrays for NumPy: FILE.npy and FILE.perturbed.npy, or FILE.SPACE.npy where there are
    /// several encoders.
    #[arg(long, value_name = "FILE.npy")]
    descriptors_out: Option<PathBuf>,
    /// Prints JSON instead of a table.
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Row {
    spec: String,
    encoder: String,
    space: String,
    bytes: usize,
    #[serde(flatten)]
    scores: Scores,
    /// By the encoder's thresholds.
    passed: Passed,
    /// Processor time of one picture, median, milliseconds.
    encode_ms: f64,
}

/// Runs it.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let sources = source::open(&arguments.specs)?;
    ensure!(
        arguments.descriptors_out.is_none() || sources.len() == 1,
        "--descriptors-out takes the descriptors of one sequence, there are {}",
        sources.len()
    );
    let encoders = encoders(&arguments.model)?;
    let mut rows = Vec::new();
    for source in &sources {
        rows.extend(one(source, &encoders, arguments)?);
    }
    if arguments.json {
        println!("{}", serde_json::to_string_pretty(&rows)?);
    } else {
        print!("{}", table(&rows));
    }
    Ok(())
}

/// The encoders as the service loads them; here a model that cannot be loaded is an error.
fn encoders(models: &[PathBuf]) -> anyhow::Result<Encoders> {
    let config = PlaceRecognitionConfig {
        models: models.to_vec(),
        onnx: OnnxSettings::default(),
        ..PlaceRecognitionConfig::default()
    };
    let encoders = Encoders::load(&config);
    match encoders.warnings().as_slice() {
        [] => Ok(encoders),
        warnings => bail!("{}", warnings.join("\n")),
    }
}

/// What was seen.
struct Picture {
    color: Image<[u8; 3]>,
    depth_m: Image<f32>,
}

fn one(source: &Source, encoders: &Encoders, arguments: &Arguments) -> anyhow::Result<Vec<Row>> {
    let sequence = &*source.sequence;
    let ids: Vec<usize> = (0..sequence.len()).step_by(arguments.every.max(1)).collect();
    let progress = progress::steps(&source.agent, ids.len() as u64);
    let (mut sights, mut pictures) = (Vec::new(), Vec::new());
    for id in &ids {
        let (sight, frame) = Sight::of(sequence, *id).with_context(|| source.spec.clone())?;
        sights.push(sight);
        pictures.push(Picture { color: frame.color, depth_m: frame.depth_m });
        progress.inc(1);
    }
    progress.finish_and_clear();
    let overlap: Vec<Vec<f64>> =
        sights.par_iter().map(|a| sights.iter().map(|b| a.mutual(b)).collect()).collect();
    let several = encoders.all().count() > 1;
    let mut rows = Vec::new();
    for (name, encoder) in encoders.all() {
        let described = describe(&pictures, encoder)?;
        let row = |from: &Descriptor| -> Vec<f32> {
            described.plain.iter().map(|other| similarity(from, other).unwrap_or(-1.0)).collect()
        };
        let matrix: Vec<Vec<f32>> = described.plain.iter().map(row).collect();
        let perturbed: Vec<(usize, Vec<f32>)> =
            described.perturbed.iter().map(|(of, d)| (*of, row(d))).collect();
        let known = Known {
            ids: &ids,
            gap: arguments.gap,
            window: coma_place::Settings::default().window as usize,
            overlap: &overlap,
            similarity: &matrix,
            perturbed: &perturbed,
        };
        if let Some(path) = &arguments.descriptors_out {
            let suffix = if several { format!("{}.npy", name) } else { "npy".into() };
            write(&path.with_extension(&suffix), described.plain.iter())?;
            let suffix = suffix.replace("npy", "perturbed.npy");
            write(&path.with_extension(&suffix), described.perturbed.iter().map(|(_, d)| d))?;
        }
        rows.push(Row {
            spec: source.spec.clone(),
            encoder: name.to_owned(),
            space: encoder.space().to_string(),
            bytes: encoder.dimension(),
            scores: known.scores(),
            passed: known.passed(encoder.thresholds()),
            encode_ms: described.encode_ms,
        });
    }
    Ok(rows)
}

/// One encoder's descriptors.
struct Described {
    plain: Vec<Descriptor>,
    /// With the frame that each was made of: every 4th frame, every perturbation.
    perturbed: Vec<(usize, Descriptor)>,
    encode_ms: f64,
}

fn describe(pictures: &[Picture], encoder: &dyn Encoder) -> anyhow::Result<Described> {
    let (mut plain, mut times_ms) = (Vec::new(), Vec::new());
    for picture in pictures {
        let (descriptor, ms) = timed(|| encoder.describe(&picture.color, Some(&picture.depth_m)));
        plain.push(descriptor?);
        times_ms.push(ms);
    }
    let queries: Vec<(usize, usize)> =
        (0..pictures.len()).step_by(4).flat_map(|k| (0..perturb::KINDS).map(move |kind| (k, kind))).collect();
    let perturbed = queries
        .par_iter()
        .map(|(k, kind)| {
            let view = perturb::perturbed(&pictures[*k].color, *kind);
            Ok((*k, encoder.describe(&view, None)?))
        })
        .collect::<anyhow::Result<Vec<_>>>()?;
    Ok(Described { plain, perturbed, encode_ms: median(times_ms) })
}

fn write<'a>(
    path: &std::path::Path,
    descriptors: impl Iterator<Item = &'a Descriptor>,
) -> anyhow::Result<()> {
    let values = |d: &Descriptor| d.values().iter().map(|v| *v as f32 * d.scale()).collect();
    let rows: Vec<Vec<f32>> = descriptors.map(values).collect();
    std::fs::write(path, npy::of_rows(&rows)).with_context(|| path.display().to_string())
}

fn table(rows: &[Row]) -> String {
    let mut out = String::from(
        "| sequence | encoder | bytes | recall@1 | AP | no false pair | the same, windows | perturbed hit | \
         over both thresholds: matches, others | CPU ms |\n|---|---|---|---|---|---|---|---|---|---|\n",
    );
    for Row { spec, encoder, bytes, scores: s, passed, encode_ms, .. } in rows {
        let _ = writeln!(
            out,
            "| {spec} | {encoder} | {bytes} | {:.3} | {:.3} | {:.3} | {:.3} | {:.3} | {:.2}, {:.2} | {encode_ms:.1} |",
            s.recall_at_1,
            s.average_precision,
            s.recall_without_false,
            s.window_recall_without_false,
            s.perturbed_hit,
            passed.matches,
            passed.others
        );
    }
    out
}
