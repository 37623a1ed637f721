//! What loops are worth: the whole cluster, as `coma run` runs it, with and without them.

use anyhow::{Context, ensure};
use coma_evaluation::Report;
use coma_slam::agent::SlamSettings;
use serde::Serialize;
use std::process::{Command, Stdio};

/// One run.
#[derive(Debug, Serialize)]
pub struct Row {
    pub loops: bool,
    /// Maps that did not merge count apart.
    pub maps: usize,
    /// One alignment for all agents; `None` unless all share one map.
    pub joint_ate_cm: Option<f64>,
    /// One alignment for each agent, their mean.
    pub own_ate_cm: Option<f64>,
    pub psnr_db: Option<f64>,
    pub ssim: Option<f64>,
    pub depth_l1_cm: Option<f64>,
    /// Of the largest merged map.
    pub surfels: Option<usize>,
}

/// Runs this program's own `run`, in a process of its own, and reads its report.
pub fn run(loops: bool, specs: &[String], settings: &SlamSettings) -> anyhow::Result<Row> {
    let folder = tempfile::tempdir().context("a folder for the run")?;
    let (config, out) = (folder.path().join("agent.toml"), folder.path().join("run"));
    let mut table = toml::Table::new();
    table.insert("slam".into(), toml::Value::try_from(settings)?);
    std::fs::write(&config, table.to_string()).with_context(|| config.display().to_string())?;
    let mut command = Command::new(std::env::current_exe().context("where this program lies")?);
    command.arg("run").args(specs).arg("--config").arg(&config).arg("--out").arg(&out);
    if !loops {
        command.arg("--no-loops");
    }
    let status = command.stdout(Stdio::null()).status().context("coma run")?;
    ensure!(status.success(), "coma run: {status}");
    let path = out.join("report.json");
    let text = std::fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    Ok(row(loops, &Report::from_json(&text).with_context(|| path.display().to_string())?))
}

fn row(loops: bool, report: &Report) -> Row {
    let scores = report.trajectories.as_ref();
    let joint = scores.and_then(|s| s.joint()).filter(|component| component.counts);
    let views = report.pictures.training;
    Row {
        loops,
        maps: scores.map_or(0, |s| s.components.len()),
        joint_ate_cm: joint.and_then(|component| component.ate_m).map(|ate| ate.rmse * 100.0),
        own_ate_cm: scores.and_then(|s| s.mean_ate_p_m()).map(|m| m * 100.0),
        psnr_db: views.map(|v| v.psnr_db),
        ssim: views.map(|v| v.ssim),
        depth_l1_cm: views.and_then(|v| v.depth_l1_m).map(|m| m * 100.0),
        surfels: report.map.map(|map| map.surfels),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use coma_evaluation::{MapSize, PictureScores, Pictures};

    #[test]
    fn a_row_repeats_what_the_report_says_and_leaves_open_what_it_does_not() {
        let scores = PictureScores {
            frames: 2,
            psnr_db: 31.0,
            psnr_where_depth_db: None,
            ssim: 0.9,
            lpips: None,
            depth_l1_m: Some(0.004),
            depth_pixels: 10,
        };
        let report = Report {
            pictures: Pictures { training: Some(scores), ..Pictures::default() },
            map: Some(MapSize { submaps: 3, surfels: 77, bytes: 1 }),
            ..Default::default()
        };
        let row = row(true, &report);
        assert_eq!((row.psnr_db, row.ssim, row.surfels), (Some(31.0), Some(0.9), Some(77)));
        assert!((row.depth_l1_cm.unwrap() - 0.4).abs() < 1e-12);
        assert_eq!((row.joint_ate_cm, row.own_ate_cm), (None, None));
    }
}
