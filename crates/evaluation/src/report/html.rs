//! `report.html`: one file with its plots inside, for light and dark screens.

use super::plots;
use super::sections::{self, NOT_MEASURED, cm, number, sections};
use super::table::escape_html;
use super::{MAPPING, Report, TRACKING};
use crate::{Curve, Evaluation};
use coma_geometry::{AgentId, StampNs};

/// What is drawn.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Plots {
    /// Frame by frame, from [`crate::evaluate`].
    pub curves: Vec<Curve>,
    /// Which way is up in their frame, from [`crate::evaluate`].
    pub up: [f64; 3],
    /// Loops between frames of the curves.
    pub loops: Vec<LoopLine>,
    /// Pictures beside the file.
    pub pictures: Vec<Picture>,
}

impl Plots {
    /// Of an evaluation, without loops and pictures.
    pub fn of(evaluation: &Evaluation) -> Self {
        Plots { curves: evaluation.curves.clone(), up: evaluation.up, ..Plots::default() }
    }
}

/// A candidate for a loop, drawn between two frames that have a pose.
#[derive(Clone, Debug, PartialEq)]
pub struct LoopLine {
    /// A frame of one end.
    pub from: (AgentId, StampNs),
    /// A frame of the other.
    pub to: (AgentId, StampNs),
    /// Rejected ones are drawn faintly.
    pub accepted: bool,
}

/// A picture file that the page shows.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Relative to the page, with `/` between folders (`renders/agent-00-000040.png`).
    pub path: String,
    /// What it shows.
    pub caption: String,
}

pub(super) fn page(report: &Report, plots: &Plots) -> String {
    let mut body = headline(report);
    let mut tables = sections(report).into_iter().map(|section| {
        let note = match section.note.as_str() {
            "" => String::new(),
            note => format!("<p class=\"note\">{}</p>\n", escape_html(note)),
        };
        format!("<section>\n<h2>{}</h2>\n{note}{}</section>\n", section.title, section.table.html())
    });
    let figures = tables.next().unwrap_or_default();
    body += &charts(report, plots, &figures);
    body += &pictures(plots);
    body.extend(tables);
    if !report.run.settings.is_null() {
        let settings = serde_json::to_string_pretty(&report.run.settings).unwrap_or_default();
        body +=
            &format!("<details><summary>Settings</summary><pre>{}</pre></details>\n", escape_html(&settings));
    }
    format!(
        "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n\
         <meta name=\"color-scheme\" content=\"light dark\">\n<title>CoMA run report</title>\n\
         <style>\n{}</style>\n</head>\n<body>\n<main>\n{body}</main>\n</body>\n</html>\n",
        include_str!("style.css")
    )
}

/// Title, what ran, and the figures one looks for first.
fn headline(report: &Report) -> String {
    let agents = report.agents.len();
    let mut facts = vec![
        format!("{agents} agent{}", if agents == 1 { "" } else { "s" }),
        format!("{} frames", report.frames_seen()),
    ];
    facts.extend(report.run.backend.clone());
    facts.extend(report.run.started.clone());
    facts.extend(report.run.commit.as_ref().map(|commit| {
        let short: String = commit.chars().take(10).collect();
        format!("commit {short}")
    }));
    let facts: Vec<String> = facts.iter().map(|fact| format!("<span>{}</span>", escape_html(fact))).collect();

    let joint = report.trajectories.as_ref().and_then(|scores| scores.joint());
    let (ate, about_ate) = match (report.trajectories.as_ref(), joint) {
        (None, _) => (NOT_MEASURED.to_owned(), "joint ATE (H)".to_owned()),
        (Some(scores), None) => {
            (format!("{} components", scores.components.len()), "not merged: no joint ATE".to_owned())
        }
        (Some(_), Some(joint)) => {
            let coverage = sections::percent(joint.coverage);
            let judgement = if joint.counts { "" } else { ", does not count" };
            let value = number(cm(joint.ate_m.map(|ate| ate.rmse)), 2);
            let value = if joint.ate_m.is_some() { format!("{value} cm") } else { value };
            (value, format!("joint ATE RMSE (H), coverage {coverage}{judgement}"))
        }
    };
    let with_unit = |value: Option<f64>, digits: usize, unit: &str| match value {
        Some(_) => format!("{} {unit}", number(value, digits)),
        None => NOT_MEASURED.to_owned(),
    };
    let views = report.pictures.held_out;
    let per_frame_s = match (report.per_frame_s(TRACKING), report.per_frame_s(MAPPING)) {
        (Some(tracking_s), Some(mapping_s)) => Some(tracking_s + mapping_s),
        _ => None,
    };
    let tiles = [
        (ate, about_ate),
        (with_unit(views.map(|v| v.psnr_db), 2, "dB"), "PSNR, held-out views".to_owned()),
        (with_unit(per_frame_s.map(|s| s * 1e3), 0, "ms"), "tracking and mapping per frame".to_owned()),
        (with_unit(report.bytes_per_frame(), 0, "B"), "per frame between agents".to_owned()),
        (
            report.map.map_or(NOT_MEASURED.to_owned(), |map| sections::bytes(map.bytes)),
            "map memory".to_owned(),
        ),
    ];
    let tiles: String = tiles
        .iter()
        .map(|(value, about)| {
            let class = if value == NOT_MEASURED { " class=\"none\"" } else { "" };
            format!("<div{class}><b>{}</b><span>{}</span></div>\n", escape_html(value), escape_html(about))
        })
        .collect();
    format!(
        "<header>\n<h1>CoMA run report</h1>\n<p class=\"facts\">{}</p>\n</header>\n<div class=\"tiles\">\n{tiles}</div>\n",
        facts.join("")
    )
}

/// Trajectories and the paper's figures to the left, the other plots to the right.
fn charts(report: &Report, plots: &Plots, figures: &str) -> String {
    let has_points = plots.curves.iter().any(|curve| !curve.points.is_empty());
    let has_errors = plots.curves.iter().flat_map(|curve| &curve.points).any(|p| p.error_h_m.is_some());
    let figure = |title: &str, key: &str, svg: String| {
        format!("<figure>\n<figcaption>{title}</figcaption>\n{key}{svg}</figure>\n")
    };
    let (mut left, mut right) = (String::new(), String::new());
    // A plot that cannot be drawn is left out; its figures are in the tables.
    if has_points && let Ok(svg) = plots::trajectories(plots) {
        left += &figure("Trajectories, from above", &key(plots, true), svg);
    }
    left += figures;
    if has_errors && let Ok(svg) = plots::error_over_time(plots) {
        right += &figure("Error over time, protocol H", &key(plots, false), svg);
    }
    if let Ok(Some(svg)) = plots::bytes_by_message(report) {
        right += &figure("Bytes between agents, by message", "", svg);
    }
    if let Ok(Some(svg)) = plots::times_by_stage(report) {
        right += &figure("Time by stage, all agents", "", svg);
    }
    match right.is_empty() {
        true => left,
        false => format!("<div class=\"charts\">\n<div>\n{left}</div>\n<div>\n{right}</div>\n</div>\n"),
    }
}

/// Which colour is whose.
fn key(plots: &Plots, with_truth_and_loops: bool) -> String {
    let entry = |variable: &str, name: &str| {
        format!("<span><i style=\"background:var({variable})\"></i>{}</span>", escape_html(name))
    };
    let mut entries: Vec<String> = plots::agent_colors(plots)
        .iter()
        .map(|(name, color)| entry(&format!("--agent-{}", color % plots::AGENT_COLORS), name))
        .collect();
    if with_truth_and_loops {
        if plots.curves.iter().flat_map(|curve| &curve.points).any(|point| point.truth_m.is_some()) {
            entries.push(entry("--truth", "truth"));
        }
        for (accepted, variable, name) in
            [(true, "--good", "accepted loop"), (false, "--bad", "rejected loop")]
        {
            if plots.loops.iter().any(|line| line.accepted == accepted) {
                entries.push(entry(variable, name));
            }
        }
    }
    format!("<p class=\"key\">{}</p>\n", entries.concat())
}

fn pictures(plots: &Plots) -> String {
    if plots.pictures.is_empty() {
        return String::new();
    }
    let one = |picture: &Picture| {
        let (path, caption) = (escape_html(&picture.path), escape_html(&picture.caption));
        format!(
            "<figure><img src=\"{path}\" alt=\"{caption}\" loading=\"lazy\"><figcaption>{caption}</figcaption></figure>\n"
        )
    };
    let all: String = plots.pictures.iter().map(one).collect();
    format!(
        "<section>\n<h2>Rendered against recorded</h2>\n<div class=\"pictures\">\n{all}</div>\n</section>\n"
    )
}
