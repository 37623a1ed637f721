//! `coma bench ablation`: what each part of an agent is worth, by leaving it out.

mod alone;
mod cluster;
mod gaussians;
mod show;
mod variant;

use anyhow::Context;
use clap::Args;
use coma_slam::agent::SlamSettings;
use serde::Serialize;
use std::path::PathBuf;
use variant::Variant;

/// Runs the same frames with parts of the method left out, and prints a table: the paper's ablations on your data.
///
/// Each agent tracks and maps alone, without network, peers or loops; its map is rendered from where it thinks its
/// cameras were. What loops are worth is measured by `coma run` and `coma run --no-loops`, all agents together.
///
///   coma bench ablation --frames 60 tum:living-room/agent-0 tum:living-room/agent-1
#[derive(Args)]
pub struct Arguments {
    /// Sequences, as for `coma run`.
    #[arg(required = true)]
    specs: Vec<String>,
    /// Only the first N frames of each sequence (for specs without a range of their own).
    #[arg(long, value_name = "N")]
    frames: Option<usize>,
    /// Only these rows, beside `ours`; default: all.
    #[arg(long, value_delimiter = ',')]
    rows: Vec<Variant>,
    /// Settings of tracking, mapping and rendering that all rows share (TOML; the `slam` table of an agent's settings).
    #[arg(long)]
    settings: Option<PathBuf>,
    /// Views of each agent that are rendered and compared, evenly spread over its frames.
    #[arg(long, default_value_t = 24)]
    views: usize,
    /// Writes `ablation.md` and `ablation.svg` here.
    #[arg(long, value_name = "FOLDER")]
    out: Option<PathBuf>,
    /// Prints JSON instead of a table.
    #[arg(long)]
    json: bool,
}

/// Everything that was measured.
#[derive(Debug, Serialize)]
pub struct Ablation {
    specs: Vec<String>,
    frames: usize,
    views: usize,
    /// What all rows share.
    settings: SlamSettings,
    alone: Vec<Row>,
    cluster: Vec<cluster::Row>,
}

/// One variant, over all agents.
#[derive(Debug, Serialize)]
pub struct Row {
    variant: Variant,
    /// The mean over the agents of each one's RMSE, if every frame that was seen counts; centimetres.
    ate_cm: Option<f64>,
    /// Frames without a pose.
    lost: usize,
    /// Means over the views.
    psnr_db: f64,
    ssim: f64,
    depth_l1_cm: Option<f64>,
    /// Of all closed submaps.
    surfels: usize,
    /// Of those, what the merged maps keep.
    merged: usize,
    /// Processor time of all threads, per frame.
    track_ms: f64,
    map_ms: f64,
    /// Wall time, per frame.
    track_wall_ms: f64,
    map_wall_ms: f64,
}

/// Runs it.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    let settings: SlamSettings = coma_runtime::load(arguments.settings.as_deref(), "COMA_SLAM")?;
    let specs = limited(&arguments.specs, arguments.frames)?;
    let wanted = |variant: Variant| {
        variant == Variant::Ours || arguments.rows.is_empty() || arguments.rows.contains(&variant)
    };
    let mut ablation = Ablation {
        specs: specs.clone(),
        frames: 0,
        views: arguments.views,
        settings: settings.clone(),
        alone: Vec::new(),
        cluster: Vec::new(),
    };
    for variant in Variant::ALONE.into_iter().filter(|variant| wanted(*variant)) {
        let agents = alone::run(variant, &specs, &settings, arguments.views)?;
        ablation.frames = agents.iter().map(|agent| agent.frames).sum();
        ablation.alone.push(row(variant, &agents)?);
    }
    if wanted(Variant::NoLoops) {
        for loops in [true, false] {
            ablation.cluster.push(cluster::run(loops, &specs, &settings)?);
        }
    }
    if arguments.json {
        println!("{}", serde_json::to_string_pretty(&ablation)?);
    } else {
        print!("{}", show::tables(&ablation));
    }
    if let Some(out) = &arguments.out {
        std::fs::create_dir_all(out).with_context(|| format!("--out {}", out.display()))?;
        let write = |name: &str, text: &str| {
            let path = out.join(name);
            std::fs::write(&path, text).with_context(|| path.display().to_string())
        };
        write("ablation.md", &show::page(&ablation))?;
        write("ablation.svg", &show::picture(&ablation)?)?;
    }
    Ok(())
}

/// Specs of the first `frames` frames.
fn limited(specs: &[String], frames: Option<usize>) -> anyhow::Result<Vec<String>> {
    let Some(frames) = frames else { return Ok(specs.to_vec()) };
    let limit = |spec: &String| {
        anyhow::ensure!(!spec.ends_with(']'), "--frames {frames}: {spec} has a range of its own");
        Ok(format!("{spec}[0:{frames}]"))
    };
    specs.iter().map(limit).collect()
}

fn row(variant: Variant, agents: &[alone::Figures]) -> anyhow::Result<Row> {
    let count = agents.len() as f64;
    let frames: f64 = agents.iter().map(|a| a.frames as f64).sum();
    let views: Vec<_> = agents.iter().flat_map(|a| a.views.iter().copied()).collect();
    let scores = coma_evaluation::PictureScores::of(&views).context("no view could be compared")?;
    let ates: Option<Vec<f64>> = agents.iter().map(|a| a.ate_m).collect();
    let per_frame = |of: &dyn Fn(&alone::Figures) -> f64| agents.iter().map(of).sum::<f64>() / frames;
    Ok(Row {
        variant,
        ate_cm: ates.map(|all| all.iter().sum::<f64>() / count * 100.0),
        lost: agents.iter().map(|a| a.frames - a.posed).sum(),
        psnr_db: scores.psnr_db,
        ssim: scores.ssim,
        depth_l1_cm: scores.depth_l1_m.map(|m| m * 100.0),
        surfels: agents.iter().map(|a| a.surfels).sum(),
        merged: agents.iter().map(|a| a.merged).sum(),
        track_ms: per_frame(&|a| a.track.processor_ms),
        map_ms: per_frame(&|a| a.map.processor_ms),
        track_wall_ms: per_frame(&|a| a.track.wall_ms),
        map_wall_ms: per_frame(&|a| a.map.wall_ms),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_limited_unless_a_spec_says_which() {
        let specs = ["tum:a".to_owned(), "b=world:rooms/agent-0".to_owned()];
        assert_eq!(limited(&specs, None).unwrap(), specs);
        assert_eq!(limited(&specs, Some(60)).unwrap(), ["tum:a[0:60]", "b=world:rooms/agent-0[0:60]"]);
        let error = limited(&["tum:a[5:9]".to_owned()], Some(60)).unwrap_err().to_string();
        assert!(error.contains("tum:a[5:9]"), "{error}");
    }
}
