//! The report for readers: titled tables, in the order in which one asks.

use super::figures::Figures;
use super::table::Table;
use super::{Report, TrafficClass};
use crate::trajectory::{ComponentScore, Coverage, TrajectoryScores};
use crate::{LEAST_COVERAGE, NormalisedErrors, PictureScores};

pub(super) const NOT_MEASURED: &str = "not measured";

pub(super) struct Section {
    pub title: &'static str,
    /// What one must know to read the table; may be empty.
    pub note: String,
    pub table: Table,
}

pub(super) fn markdown(report: &Report) -> String {
    let mut text = String::from("# CoMA run report\n");
    for section in sections(report) {
        text += &format!("\n## {}\n\n", section.title);
        if !section.note.is_empty() {
            text += &format!("{}\n\n", section.note);
        }
        text += &section.table.markdown();
    }
    text
}

/// All sections that have something to say; the first always does.
pub(super) fn sections(report: &Report) -> Vec<Section> {
    let mut all = vec![figures(report)];
    if let Some(scores) = &report.trajectories {
        all.extend([components(scores), tracks(scores), relative(scores)]);
    }
    all.extend([pictures(report), map(report), traffic(report), times(report), loops(report), edges(report)]);
    all.extend([agents(report), run(report)]);
    all.retain(|section| !section.table.is_empty());
    all
}

/// The rows of the paper's tables.
fn figures(report: &Report) -> Section {
    let figures = Figures::of(report);
    let (h, p) = (figures.protocol_h, figures.protocol_p);
    let trajectories = report.trajectories.as_ref();
    let mut table = Table::new(1, &["figure", "protocol H", "protocol P"]);
    let ate_h = trajectories.map_or(NOT_MEASURED.into(), ate_h_cell);
    let ate_p = trajectories.map_or(NOT_MEASURED.into(), ate_p_cell);
    table.push(["ATE RMSE, cm".into(), ate_h, ate_p]);
    let mut both = |name: &str, h: Option<f64>, p: Option<f64>, digits: usize| {
        table.push([name.to_owned(), number(h, digits), number(p, digits)]);
    };
    both("PSNR, dB", h.psnr_db, p.psnr_db, 2);
    both("SSIM", h.ssim, p.ssim, 4);
    both("LPIPS", h.lpips, p.lpips, 4);
    both("depth L1, cm", cm(h.depth_l1_m), cm(p.depth_l1_m), 2);
    let mut same = |name: &str, value: Option<f64>, digits| both(name, value, value, digits);
    same("mapping per frame, s", figures.mapping_per_frame_s, 3);
    same("tracking per frame, s", figures.tracking_per_frame_s, 3);
    same("map memory, MB", figures.map_bytes.map(|bytes| bytes as f64 * 1e-6), 2);
    same("bytes per frame between agents", figures.bytes_per_frame, 0);
    let note = "H: one rigid alignment for all agents together, every frame, views that were never mapped. \
                P: an alignment for each agent (the mean over agents is shown), views that the map was made from, of the \
                refined map where there is one.";
    Section { title: "Figures", note: note.into(), table }
}

/// The joint error, or in words why there is none that counts.
pub(super) fn ate_h_cell(scores: &TrajectoryScores) -> String {
    match scores.joint() {
        Some(joint) => counted(joint.ate_m.map(|ate| ate.rmse), joint.coverage),
        None => format!("not joint: {} components", scores.components.len()),
    }
}

fn ate_p_cell(scores: &TrajectoryScores) -> String {
    if let Some(mean_m) = scores.mean_ate_p_m() {
        return number(cm(Some(mean_m)), 2);
    }
    match scores.tracks.iter().filter(|track| track.counts).count() {
        0 if scores.tracks.iter().all(|track| track.ate_p_m.is_none()) => NOT_MEASURED.into(),
        counting => format!("{counting} of {} tracks count", scores.tracks.len()),
    }
}

fn counted(rmse_m: Option<f64>, coverage: Coverage) -> String {
    match rmse_m {
        Some(_) if !coverage.suffices() => {
            format!("{} (does not count: {} of frames)", number(cm(rmse_m), 2), percent(coverage))
        }
        _ => number(cm(rmse_m), 2),
    }
}

fn components(scores: &TrajectoryScores) -> Section {
    let header = [
        "component",
        "agents",
        "aligned",
        "coverage",
        "frames",
        "RMSE, cm",
        "mean",
        "median",
        "max",
        "counts",
    ];
    let mut table = Table::new(3, &header);
    for component in &scores.components {
        let agents: Vec<&str> = component.agents.iter().map(|agent| agent.as_str()).collect();
        let start = [component.component.clone(), agents.join(" "), how_aligned(component).into()];
        let coverage = [percent(component.coverage)];
        table.push(start.into_iter().chain(coverage).chain(spread(component.ate_m)).chain([counts(
            component.counts,
            component.coverage,
            component.unscored.map(|why| why.to_string()),
        )]));
    }
    let mut note = format!(
        "One rigid alignment without scale for each component. An error over less than {:.0} % of the frames does \
         not count.",
        LEAST_COVERAGE * 100.0
    );
    if scores.joint().is_none() && scores.components.len() > 1 {
        note +=
            " The components did not merge: each is aligned on its own, and none of these errors is joint.";
    }
    Section { title: "Absolute error, protocol H", note, table }
}

fn how_aligned(component: &ComponentScore) -> &'static str {
    match (component.truth_from_map.is_some(), component.joint) {
        (false, _) => "not aligned",
        (true, true) => "all agents jointly",
        (true, false) => "this component alone",
    }
}

fn counts(counts: bool, coverage: Coverage, unscored: Option<String>) -> String {
    match unscored {
        Some(why) => format!("no: {why}"),
        None if counts => "yes".into(),
        None => format!("no: coverage {}", percent(coverage)),
    }
}

fn tracks(scores: &TrajectoryScores) -> Section {
    let header = [
        "agent",
        "component",
        "coverage",
        "frames",
        "RMSE, cm",
        "mean",
        "median",
        "max",
        "RMSE under H, cm",
        "counts",
    ];
    let mut table = Table::new(2, &header);
    for track in &scores.tracks {
        let start = [track.agent.to_string(), track.component.clone(), percent(track.coverage)];
        let end = [
            number(cm(track.ate_h_m.map(|ate| ate.rmse)), 2),
            counts(track.counts, track.coverage, track.unscored.map(|why| why.to_string())),
        ];
        table.push(start.into_iter().chain(spread(track.ate_p_m)).chain(end));
    }
    let note =
        "A rigid alignment without scale for each agent alone; beside it, its part of the joint error.";
    Section { title: "Absolute error, protocol P", note: note.into(), table }
}

fn relative(scores: &TrajectoryScores) -> Section {
    let header = [
        "agent",
        "component",
        "over",
        "pairs",
        "RMSE, cm",
        "mean, cm",
        "max, cm",
        "RMSE, deg",
        "mean, deg",
        "max, deg",
    ];
    let mut table = Table::new(3, &header);
    for track in &scores.tracks {
        for rpe in &track.rpe {
            let frames = rpe.delta.frames.get();
            let (t, r) = (rpe.translation_m, rpe.rotation_deg);
            table.push([
                track.agent.to_string(),
                track.component.clone(),
                format!(
                    "{frames} frame{}{}",
                    if frames == 1 { "" } else { "s" },
                    if rpe.delta.all_pairs { ", all pairs" } else { "" }
                ),
                t.count.to_string(),
                number(cm(Some(t.rmse)), 3),
                number(cm(Some(t.mean)), 3),
                number(cm(Some(t.max)), 3),
                number(Some(r.rmse), 3),
                number(Some(r.mean), 3),
                number(Some(r.max), 3),
            ]);
        }
    }
    Section { title: "Relative error", note: String::new(), table }
}

fn pictures(report: &Report) -> Section {
    let header = [
        "views",
        "number",
        "PSNR, dB",
        "PSNR where depth, dB",
        "SSIM",
        "LPIPS",
        "depth L1, cm",
        "depth pixels",
    ];
    let mut table = Table::new(1, &header);
    let mut row = |name: &str, scores: Option<PictureScores>| {
        let Some(scores) = scores else { return };
        table.push([
            name.to_owned(),
            scores.frames.to_string(),
            number(Some(scores.psnr_db), 2),
            number(scores.psnr_where_depth_db, 2),
            number(Some(scores.ssim), 4),
            number(scores.lpips, 4),
            number(cm(scores.depth_l1_m), 2),
            grouped(scores.depth_pixels),
        ]);
    };
    row("held out (protocol H)", report.pictures.held_out);
    row("training (protocol P)", report.pictures.training);
    row("held out, refined map", report.pictures.refined_held_out);
    row("training, refined map", report.pictures.refined_training);
    Section { title: "Pictures", note: "Means over views.".into(), table }
}

fn map(report: &Report) -> Section {
    let mut table = Table::new(0, &["submaps", "surfels", "memory", "bytes per surfel"]);
    if let Some(map) = report.map {
        let per_surfel = (map.surfels > 0).then(|| map.bytes as f64 / map.surfels as f64);
        let per_surfel = per_surfel.map_or("-".into(), |bytes| number(Some(bytes), 1));
        table.push([map.submaps.to_string(), grouped(map.surfels), bytes(map.bytes), per_surfel]);
    }
    Section { title: "Map", note: String::new(), table }
}

fn traffic(report: &Report) -> Section {
    let mut table = Table::new(2, &["for", "message", "messages", "bytes", "bytes per frame"]);
    let frames = report.frames_seen();
    let per_frame = |bytes: u64| match frames {
        0 => "-".into(),
        frames => number(Some(bytes as f64 / frames as f64), 1),
    };
    if let Some(traffic) = &report.traffic {
        let sum = traffic.between_agents();
        table.push(["between agents".into(), "all".into(), String::new(), bytes(sum), per_frame(sum)]);
        for line in traffic.lines() {
            table.push([
                line.class.name().to_owned(),
                line.message_type.clone(),
                line.messages.to_string(),
                bytes(line.bytes),
                per_frame(line.bytes),
            ]);
        }
    }
    let classes: Vec<&str> = TrafficClass::ALL
        .into_iter()
        .filter(|class| class.is_between_agents())
        .map(TrafficClass::name)
        .collect();
    let note = format!(
        "Between agents is {}, all that was written to sockets, counted once at the sender, discovery and the drain \
         at the end included; divided by the {frames} frames of all agents.",
        classes.join(" and ")
    );
    Section { title: "Bytes", note, table }
}

fn times(report: &Report) -> Section {
    let mut table =
        Table::new(1, &["stage", "times", "total, s", "mean, ms", "95 of 100 under, ms", "per frame, ms"]);
    let mut note = String::new();
    if let Some(times) = &report.times {
        for stage in &times.stages {
            table.push([
                stage.stage.clone(),
                stage.count.to_string(),
                number(Some(stage.total_s), 2),
                number(Some(stage.mean_s * 1e3), 2),
                number(Some(stage.p95_s * 1e3), 2),
                number(report.per_frame_s(&stage.stage).map(|s| s * 1e3), 2),
            ]);
        }
        let span = |name: &str, seconds: Option<f64>| seconds.map(|s| format!("{s:.1} s {name}"));
        let spans: Vec<String> = [span("by the clock", times.wall_s), span("of processor time", times.cpu_s)]
            .into_iter()
            .flatten()
            .collect();
        if !spans.is_empty() {
            note = format!("The whole run: {}.", spans.join(", "));
        }
    }
    Section { title: "Times", note, table }
}

fn loops(report: &Report) -> Section {
    let mut table = Table::new(2, &["verdict", "reason", "candidates"]);
    if let Some(loops) = &report.loops {
        let mut row = |verdict: &str, reason: &str, count: usize| {
            table.push([verdict.to_owned(), reason.to_owned(), count.to_string()]);
        };
        row("accepted", "between agents", loops.accepted_between);
        row("accepted", "within an agent", loops.accepted_within);
        row("rejected", "all", loops.rejected());
        for (reason, count) in &loops.rejected {
            row("rejected", &reason.replace('_', " "), *count);
        }
        row("pending", "", loops.pending);
        row("withdrawn", "", loops.withdrawn);
    }
    Section { title: "Loops", note: String::new(), table }
}

fn edges(report: &Report) -> Section {
    let mut table = Table::new(1, &["edges", "number", "mean", "median", "max", "unusable", "calibrated"]);
    for (name, errors) in [("odometry", report.edges.odometry), ("loops", report.edges.loops)] {
        let Some(errors) = errors else { continue };
        table.push([
            name.to_owned(),
            errors.edges.to_string(),
            number(Some(errors.mean), 2),
            number(Some(errors.median), 2),
            number(Some(errors.max), 2),
            errors.unusable.to_string(),
            if errors.is_calibrated() { "yes" } else { "no" }.to_owned(),
        ]);
    }
    let band = NormalisedErrors::CALIBRATED;
    let note = format!(
        "Squared error weighed by the information that the edge claims, 6 degrees of freedom: about 6 where the claim \
         is right, calibrated where the mean is {} to {}.",
        band.start(),
        band.end()
    );
    Section { title: "Certainty of edges", note, table }
}

fn agents(report: &Report) -> Section {
    let mut table = Table::new(2, &["agent", "source", "frames", "with a pose", "submaps"]);
    for agent in &report.agents {
        table.push([
            agent.agent.to_string(),
            agent.source.clone(),
            agent.frames_seen.to_string(),
            agent.frames_posed.to_string(),
            agent.submaps.map_or("-".into(), |submaps| submaps.to_string()),
        ]);
    }
    Section { title: "Agents", note: String::new(), table }
}

fn run(report: &Report) -> Section {
    let run = &report.run;
    let mut table = Table::new(2, &["run", ""]);
    let seed = run.seed.map(|seed| seed.to_string());
    for (name, value) in [
        ("commit", &run.commit),
        ("seed", &seed),
        ("backend", &run.backend),
        ("machine", &run.machine),
        ("started", &run.started),
        ("finished", &run.finished),
    ] {
        table.push([name.to_owned(), value.clone().unwrap_or_else(|| "not recorded".into())]);
    }
    Section { title: "Run", note: String::new(), table }
}

/// With a narrow space between thousands.
fn grouped(count: usize) -> String {
    let digits = count.to_string();
    let groups: Vec<&str> =
        digits.as_bytes().rchunks(3).rev().filter_map(|g| std::str::from_utf8(g).ok()).collect();
    groups.join("\u{202f}")
}

/// Frames, then RMSE, mean, median and maximum in centimetres.
fn spread(ate_m: Option<crate::Spread>) -> [String; 5] {
    let frames = ate_m.map_or(0, |ate| ate.count).to_string();
    let value = |of: fn(crate::Spread) -> f64| number(cm(ate_m.map(of)), 2);
    [frames, value(|ate| ate.rmse), value(|ate| ate.mean), value(|ate| ate.median), value(|ate| ate.max)]
}

pub(super) fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or(NOT_MEASURED.into(), |value| format!("{value:.digits$}"))
}

pub(super) fn cm(metres: Option<f64>) -> Option<f64> {
    metres.map(|metres| metres * 100.0)
}

pub(super) fn percent(coverage: Coverage) -> String {
    // Cut, not rounded: 97.96 % must not look like enough.
    coverage.fraction().map_or("-".into(), |f| format!("{:.1} %", (f * 1000.0 + 1e-9).floor() / 10.0))
}

pub(super) fn bytes(count: u64) -> String {
    match count {
        0..=9_999 => format!("{count} B"),
        10_000..=999_949 => format!("{:.1} kB", count as f64 * 1e-3),
        _ => format!("{:.1} MB", count as f64 * 1e-6),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_coverage_is_never_rounded_up_to_enough() {
        let of = |frames_posed, frames_seen| percent(Coverage { frames_posed, frames_seen });
        assert_eq!(
            (of(9796, 10_000), of(98, 100), of(1, 1)),
            ("97.9 %".into(), "98.0 %".into(), "100.0 %".into())
        );
        assert_eq!(of(0, 0), "-");
    }

    #[test]
    fn counts_are_easy_to_read() {
        assert_eq!(
            [0, 999, 1000, 1_234_567].map(grouped),
            ["0", "999", "1\u{202f}000", "1\u{202f}234\u{202f}567"]
        );
        assert_eq!(
            [812, 98_311, 999_949, 999_950, 9_896_280].map(bytes),
            ["812 B", "98.3 kB", "999.9 kB", "1.0 MB", "9.9 MB"]
        );
    }
}
