//! Tables and the picture.

use super::variant::Variant;
use super::{Ablation, Row};
use coma_evaluation::{BarPanel, bars_svg};
use coma_slam::agent::SlamSettings;
use std::fmt::Write as _;

fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or("not measured".to_owned(), |v| format!("{v:.digits$}"))
}

/// Both tables, with what the first row of each is compared with.
pub fn tables(ablation: &Ablation) -> String {
    let mut out = String::from(
        "| each agent alone | ATE cm | lost | PSNR dB | SSIM | depth L1 cm | surfels | merged | track ms | map ms |\n\
         |---|---|---|---|---|---|---|---|---|---|\n",
    );
    for r in &ablation.alone {
        let _ = writeln!(
            out,
            "| {} | {} | {} | {:.2} | {:.4} | {} | {} | {} | {:.0} | {:.0} |",
            r.variant.name(),
            number(r.ate_cm, 3),
            r.lost,
            r.psnr_db,
            r.ssim,
            number(r.depth_l1_cm, 3),
            r.surfels,
            r.merged,
            r.track_ms,
            r.map_ms
        );
    }
    if !ablation.cluster.is_empty() {
        out.push_str(
            "\n| all agents together | maps | joint ATE cm | ATE cm | PSNR dB | SSIM | depth L1 cm | merged |\n\
             |---|---|---|---|---|---|---|---|\n",
        );
    }
    for r in &ablation.cluster {
        let name = if r.loops { Variant::Ours } else { Variant::NoLoops }.name();
        let joint = r.joint_ate_cm.map_or("no joint map".to_owned(), |v| format!("{v:.3}"));
        let _ = writeln!(
            out,
            "| {name} | {} | {joint} | {} | {} | {} | {} | {} |",
            r.maps,
            number(r.own_ate_cm, 3),
            number(r.psnr_db, 2),
            number(r.ssim, 4),
            number(r.depth_l1_cm, 3),
            r.surfels.map_or("not measured".to_owned(), |n| n.to_string())
        );
    }
    out
}

/// The tables with a caption, as a page for the docs.
pub fn page(ablation: &Ablation) -> String {
    let mut out = String::from("# What each part is worth\n\n");
    let _ = writeln!(
        out,
        "`coma bench ablation` makes this page. {} frames in all: {}.\n",
        ablation.frames,
        ablation.specs.iter().map(|s| format!("`{}`", shown(s))).collect::<Vec<_>>().join(", ")
    );
    out.push_str(&tables(ablation));
    let _ = write!(
        out,
        "\n![The first table as bars](ablation.svg)\n\n\
         ATE is the mean over the agents of each one's RMSE after a rigid alignment without scale. Pictures: {} views of \
         each agent, evenly spread, rendered from the merged map of its own submaps at its own poses, without \
         refinement; these frames were mapped. Surfels are those of all closed submaps; merged is what is left when \
         what two submaps show is kept once. Times are processor time of all threads per frame.\n\n",
        ablation.views
    );
    if !ablation.cluster.is_empty() {
        out.push_str(
            "In the second table all agents run as `coma run` runs them, and views are its training views.\n\n",
        );
    }
    let _ = writeln!(out, "{}\n", settings(&ablation.settings));
    for row in &ablation.alone {
        let _ = writeln!(out, "- **{}**: {}.", row.variant.name(), row.variant.change());
    }
    if !ablation.cluster.is_empty() {
        let _ = writeln!(out, "- **{}**: {}.", Variant::NoLoops.name(), Variant::NoLoops.change());
    }
    out
}

/// What all rows share, in a sentence.
fn settings(settings: &SlamSettings) -> String {
    let (mapping, tracking) = (&settings.mapping, &settings.tracking);
    let which = if *settings == SlamSettings::default() { "the defaults" } else { "not all the defaults" };
    format!(
        "Settings are {which}: a seed every {} pixels, {} optimiser steps for each keyframe, every {} frames one, \
         submaps of {} moving frames, tracking at 1/{} of the resolution by Gauss-Newton and at the whole by Adam, with \
         {} steps a frame.",
        mapping.seed.spacing_px,
        mapping.steps_per_keyframe,
        mapping.keyframe_every,
        mapping.moving_frames,
        1u32 << tracking.finest_level.min(31),
        tracking.adam.steps
    )
}

/// A spec without the folders above its data set: a page says what was measured, not where it lay.
fn shown(spec: &str) -> String {
    let (before, path) = match spec.split_once(':') {
        Some((format, path)) => (format!("{format}:"), path),
        None => (String::new(), spec),
    };
    let kept: Vec<&str> = path.rsplit('/').take(2).collect();
    before + &kept.into_iter().rev().collect::<Vec<_>>().join("/")
}

/// The first table as bars.
pub fn picture(ablation: &Ablation) -> anyhow::Result<String> {
    let panel = |title: &str, digits: usize, of: &dyn Fn(&Row) -> Option<f64>| BarPanel {
        title: title.to_owned(),
        digits,
        values: ablation.alone.iter().map(of).collect(),
    };
    let panels = [
        panel("ATE, cm", 2, &|r| r.ate_cm),
        panel("PSNR, dB", 1, &|r| Some(r.psnr_db)),
        panel("depth L1, cm", 2, &|r| r.depth_l1_cm),
        panel("surfels, thousands", 0, &|r| Some(r.surfels as f64 / 1e3)),
        panel("tracking, ms", 0, &|r| Some(r.track_ms)),
        panel("mapping, ms", 0, &|r| Some(r.map_ms)),
    ];
    let names: Vec<&str> = ablation.alone.iter().map(|r| r.variant.name()).collect();
    bars_svg(&names, &panels).map_err(|error| anyhow::anyhow!("ablation.svg: {error}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ablation() -> Ablation {
        let row = |variant, ate_cm| Row {
            variant,
            ate_cm,
            lost: 0,
            psnr_db: 30.0,
            ssim: 0.95,
            depth_l1_cm: Some(0.4),
            surfels: 1000,
            merged: 600,
            track_ms: 20.0,
            map_ms: 40.0,
            track_wall_ms: 10.0,
            map_wall_ms: 20.0,
        };
        Ablation {
            specs: vec!["tum:/data/living-room/agent-0[0:60]".into()],
            frames: 60,
            views: 12,
            settings: SlamSettings::default(),
            alone: vec![row(Variant::Ours, Some(0.123)), row(Variant::Unfused, None)],
            cluster: Vec::new(),
        }
    }

    #[test]
    fn a_page_holds_every_row_and_no_folder_above_the_data() {
        let page = page(&ablation());
        assert!(
            page.contains("| ours | 0.123 | 0 | 30.00 | 0.9500 | 0.400 | 1000 | 600 | 20 | 40 |"),
            "{page}"
        );
        assert!(page.contains("| without fusion and inheritance | not measured |"), "{page}");
        assert!(page.contains("`tum:living-room/agent-0[0:60]`") && !page.contains("/data"), "{page}");
        assert!(page.contains("Settings are the defaults: a seed every 2 pixels"), "{page}");
        assert!(!page.contains("all agents together |"), "what was not run has no table");
    }

    #[test]
    fn the_picture_names_every_row() {
        let svg = picture(&ablation()).unwrap();
        assert!(svg.contains("without fusion and inheritance") && svg.contains("ATE, cm"));
    }
}
