//! The report's plots as SVG. They take their colours from the page (`var(--...)`), light or dark.

use super::Report;
use super::html::{LoopLine, Plots};
use super::sections;
use crate::{Curve, CurvePoint};
use coma_geometry::nalgebra::Vector3;
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use std::collections::BTreeMap;
use std::ops::Range;

type DrawError = Box<dyn std::error::Error>;
type Canvas<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// plotters draws at whole pixels: everything is drawn so much larger than it is shown.
const FINE: u32 = 2;
/// Points of one line; more would not be seen.
const MOST_POINTS: usize = 3000;
/// Colours in the page's style; agents beyond take them again.
pub(super) const AGENT_COLORS: usize = 8;

/// A colour that stands for a name of the page's style.
#[derive(Clone, Copy)]
enum Ink {
    Text,
    Faint,
    Truth,
    Accepted,
    Rejected,
    Bar,
    Agent(usize),
}

impl Ink {
    /// A colour that no plot would have otherwise; [`themed`] takes it out again.
    fn color(self) -> RGBColor {
        match self {
            Ink::Text => RGBColor(1, 0, 1),
            Ink::Faint => RGBColor(1, 0, 2),
            Ink::Truth => RGBColor(1, 0, 3),
            Ink::Accepted => RGBColor(1, 0, 4),
            Ink::Rejected => RGBColor(1, 0, 5),
            Ink::Bar => RGBColor(1, 0, 6),
            Ink::Agent(index) => RGBColor(2, 0, (index % AGENT_COLORS) as u8),
        }
    }

    fn variable(self) -> String {
        match self {
            Ink::Text => "var(--muted)".into(),
            Ink::Faint => "var(--grid)".into(),
            Ink::Truth => "var(--truth)".into(),
            Ink::Accepted => "var(--good)".into(),
            Ink::Rejected => "var(--bad)".into(),
            Ink::Bar => "var(--agent-0)".into(),
            Ink::Agent(index) => format!("var(--agent-{})", index % AGENT_COLORS),
        }
    }
}

fn themed(svg: String, width: u32, height: u32) -> String {
    let inks = [Ink::Text, Ink::Faint, Ink::Truth, Ink::Accepted, Ink::Rejected, Ink::Bar];
    let agents = (0..AGENT_COLORS).map(Ink::Agent);
    let svg = inks.into_iter().chain(agents).fold(svg, |svg, ink| {
        let RGBColor(r, g, b) = ink.color();
        svg.replace(&format!("\"#{r:02X}{g:02X}{b:02X}\""), &format!("\"{}\"", ink.variable()))
    });
    // The page decides how large it is shown.
    svg.replacen(&format!("width=\"{}\" height=\"{}\"", width * FINE, height * FINE), "role=\"img\"", 1)
}

fn drawn(
    width: u32,
    height: u32,
    draw: impl FnOnce(&Canvas) -> Result<(), DrawError>,
) -> Result<String, DrawError> {
    let mut svg = String::new();
    {
        let canvas = SVGBackend::with_string(&mut svg, (width * FINE, height * FINE)).into_drawing_area();
        draw(&canvas)?;
        canvas.present()?;
    }
    Ok(themed(svg, width, height))
}

fn text(size: u32, ink: Ink) -> TextStyle<'static> {
    ("sans-serif", size * FINE).into_font().color(&ink.color())
}

fn line(ink: Ink, width: u32) -> ShapeStyle {
    ink.color().stroke_width(width)
}

/// Which agent's colour is which: by the order of names.
pub(super) fn agent_colors(plots: &Plots) -> BTreeMap<&str, usize> {
    let names: std::collections::BTreeSet<&str> =
        plots.curves.iter().map(|curve| curve.agent.as_str()).collect();
    names.into_iter().enumerate().map(|(index, name)| (name, index)).collect()
}

/// Two axes of the world as they are seen from above, with their names.
struct FromAbove {
    right: Vector3<f64>,
    top: Vector3<f64>,
    names: [&'static str; 2],
}

impl FromAbove {
    /// Looks down along the axis of the world that is nearest to `up`.
    fn new(up: [f64; 3]) -> Self {
        let up = Vector3::from(up);
        let axis = up.iamax();
        let upwards = up[axis] >= 0.0;
        // right x top = up
        let (right, top, names) = match (axis, upwards) {
            (0, true) => (Vector3::y(), Vector3::z(), ["y", "z"]),
            (0, false) => (Vector3::y(), -Vector3::z(), ["y", "-z"]),
            (1, true) => (Vector3::x(), -Vector3::z(), ["x", "-z"]),
            (1, false) => (Vector3::x(), Vector3::z(), ["x", "z"]),
            (_, true) => (Vector3::x(), Vector3::y(), ["x", "y"]),
            (_, false) => (Vector3::x(), -Vector3::y(), ["x", "-y"]),
        };
        FromAbove { right, top, names }
    }

    fn see(&self, point_m: &[f64; 3]) -> (f64, f64) {
        let point = Vector3::from(*point_m);
        (self.right.dot(&point), self.top.dot(&point))
    }
}

/// Pieces without a gap in time: where frames were lost, no line is drawn.
fn pieces(curve: &Curve) -> Vec<&[CurvePoint]> {
    let gap_ns = |pair: &[CurvePoint]| pair[0].stamp.0.abs_diff(pair[1].stamp.0) as f64;
    let gaps: Vec<f64> = curve.points.windows(2).map(gap_ns).collect();
    let usual_ns = crate::percentile(&gaps, 50.0).unwrap_or(0.0);
    curve.points.chunk_by(|a, b| a.stamp.0.abs_diff(b.stamp.0) as f64 <= 2.5 * usual_ns).collect()
}

/// At most [`MOST_POINTS`] of them, evenly; the last is kept.
fn thinned<T: Copy>(points: Vec<T>) -> Vec<T> {
    let step = points.len().div_ceil(MOST_POINTS).max(1);
    let last = points.len().saturating_sub(1);
    points
        .into_iter()
        .enumerate()
        .filter(|(i, _)| i % step == 0 || *i == last)
        .map(|(_, point)| point)
        .collect()
}

/// Trajectories against the truth, from above, with loops.
pub(super) fn trajectories(plots: &Plots) -> Result<String, DrawError> {
    let (width, height) = (640u32, 520u32);
    let above = FromAbove::new(plots.up);
    let colors = agent_colors(plots);
    let seen = plots.curves.iter().flat_map(|curve| &curve.points).flat_map(|point| {
        std::iter::once(point.estimate_m).chain(point.truth_m).map(|point_m| above.see(&point_m))
    });
    let (x_range, y_range) = equal_scale(seen, f64::from(width - 78) / f64::from(height - 64));
    drawn(width, height, |canvas| {
        let mut chart = ChartBuilder::on(canvas)
            .margin(10 * FINE)
            .x_label_area_size(44 * FINE)
            .y_label_area_size(58 * FINE)
            .build_cartesian_2d(x_range, y_range)?;
        chart
            .configure_mesh()
            .bold_line_style(line(Ink::Faint, FINE))
            .light_line_style(TRANSPARENT)
            .axis_style(line(Ink::Faint, FINE))
            .label_style(text(16, Ink::Text))
            .axis_desc_style(text(16, Ink::Text))
            .x_labels(8)
            .y_labels(7)
            .x_label_formatter(&|v| tick(*v))
            .y_label_formatter(&|v| tick(*v))
            .x_desc(format!("{}, m", above.names[0]))
            .y_desc(format!("{}, m", above.names[1]))
            .draw()?;
        for curve in &plots.curves {
            for piece in pieces(curve) {
                let truth = piece.iter().filter_map(|p| Some(above.see(&p.truth_m?))).collect();
                chart.draw_series(LineSeries::new(thinned(truth), line(Ink::Truth, 4 * FINE)))?;
            }
        }
        let mut loops: Vec<&LoopLine> = plots.loops.iter().collect();
        loops.sort_by_key(|l| l.accepted);
        for l in loops {
            let end = |(agent, stamp): &(coma_geometry::AgentId, coma_geometry::StampNs)| {
                let own = plots.curves.iter().filter(|curve| curve.agent == *agent);
                own.filter_map(|curve| curve.at(*stamp)).next().map(|point| above.see(&point.estimate_m))
            };
            let (Some(from), Some(to)) = (end(&l.from), end(&l.to)) else { continue };
            let style = match l.accepted {
                true => line(Ink::Accepted, FINE),
                false => {
                    ShapeStyle { color: Ink::Rejected.color().mix(0.3), filled: false, stroke_width: FINE }
                }
            };
            chart.draw_series(LineSeries::new([from, to], style))?;
        }
        for curve in &plots.curves {
            let ink = Ink::Agent(colors[curve.agent.as_str()]);
            for piece in pieces(curve) {
                let estimate = piece.iter().map(|p| above.see(&p.estimate_m)).collect();
                chart.draw_series(LineSeries::new(thinned(estimate), line(ink, 3 * FINE / 2)))?;
            }
            let start = curve.points.first().map(|p| above.see(&p.estimate_m));
            chart.draw_series(start.map(|at| Circle::new(at, 5 * FINE, ink.color().filled())))?;
        }
        Ok(())
    })
}

/// Ranges that hold all points, of one scale on both axes, with a margin.
fn equal_scale(points: impl Iterator<Item = (f64, f64)>, aspect: f64) -> (Range<f64>, Range<f64>) {
    let empty = (f64::INFINITY, f64::NEG_INFINITY);
    let (x, y) = points
        .fold((empty, empty), |(x, y), (px, py)| ((x.0.min(px), x.1.max(px)), (y.0.min(py), y.1.max(py))));
    let (x, y) = if x.0 <= x.1 { (x, y) } else { ((0.0, 0.0), (0.0, 0.0)) };
    let half_height = 0.55 * (y.1 - y.0).max((x.1 - x.0) / aspect).max(0.1);
    let around = |(least, most): (f64, f64), half: f64| {
        let middle = (least + most) / 2.0;
        middle - half..middle + half
    };
    (around(x, half_height * aspect), around(y, half_height))
}

/// Error of every frame by time since the agent's first pose.
pub(super) fn error_over_time(plots: &Plots) -> Result<String, DrawError> {
    let colors = agent_colors(plots);
    let errors = |curve: &Curve| -> Vec<Vec<(f64, f64)>> {
        let since = plots.curves.iter().filter(|other| other.agent == curve.agent);
        let first_ns = since.filter_map(|other| Some(other.points.first()?.stamp.0)).min().unwrap_or(0);
        let at = |p: &CurvePoint| Some(((p.stamp.0.abs_diff(first_ns)) as f64 * 1e-9, p.error_h_m? * 100.0));
        pieces(curve).into_iter().map(|piece| thinned(piece.iter().filter_map(at).collect())).collect()
    };
    let lines: Vec<_> =
        plots.curves.iter().map(|curve| (colors[curve.agent.as_str()], errors(curve))).collect();
    let all = lines.iter().flat_map(|(_, pieces)| pieces).flatten();
    let (last_s, worst_cm) = all.fold((0.0f64, 0.0f64), |(x, y), point| (x.max(point.0), y.max(point.1)));
    let (last_s, worst_cm) = (last_s.max(1e-3), worst_cm.max(1e-6) * 1.08);
    drawn(640, 300, |canvas| {
        let mut chart = ChartBuilder::on(canvas)
            .margin(10 * FINE)
            .x_label_area_size(44 * FINE)
            .y_label_area_size(58 * FINE)
            .build_cartesian_2d(0.0..last_s, 0.0..worst_cm)?;
        chart
            .configure_mesh()
            .disable_x_mesh()
            .bold_line_style(line(Ink::Faint, FINE))
            .light_line_style(TRANSPARENT)
            .axis_style(line(Ink::Faint, FINE))
            .label_style(text(16, Ink::Text))
            .axis_desc_style(text(16, Ink::Text))
            .x_labels(9)
            .y_labels(6)
            .x_label_formatter(&|v| tick(*v))
            .y_label_formatter(&|v| tick(*v))
            .x_desc("time since the first pose, s")
            .y_desc("error, cm")
            .draw()?;
        for (color, pieces) in lines {
            for piece in pieces {
                chart.draw_series(LineSeries::new(piece, line(Ink::Agent(color), 3 * FINE / 2)))?;
            }
        }
        Ok(())
    })
}

fn tick(value: f64) -> String {
    // A tick at zero may be a rounding error away from it.
    let text = format!("{:.3}", value);
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0".into() } else { text.to_owned() }
}

struct Bar {
    name: String,
    value: f64,
    label: String,
}

/// What agents said to each other, by message type, the largest first.
pub(super) fn bytes_by_message(report: &Report) -> Result<Option<String>, DrawError> {
    let Some(traffic) = &report.traffic else { return Ok(None) };
    let sum = traffic.between_agents().max(1) as f64;
    let bars = traffic.lines().iter().filter(|line| line.class.is_between_agents()).map(|line| Bar {
        name: match line.class {
            super::TrafficClass::Gossip => format!("gossip: {}", line.message_type),
            _ => line.message_type.clone(),
        },
        value: line.bytes as f64,
        label: format!("{}  ({:.1} %)", sections::bytes(line.bytes), 100.0 * line.bytes as f64 / sum),
    });
    let mut bars: Vec<Bar> = bars.collect();
    bars.sort_by(|a, b| b.value.total_cmp(&a.value).then_with(|| a.name.cmp(&b.name)));
    self::bars(&bars)
}

/// Seconds of each stage, in the order of the pipeline.
pub(super) fn times_by_stage(report: &Report) -> Result<Option<String>, DrawError> {
    let Some(times) = &report.times else { return Ok(None) };
    let bars = times.stages.iter().map(|stage| Bar {
        name: stage.stage.clone(),
        value: stage.total_s,
        label: match report.per_frame_s(&stage.stage) {
            Some(per_frame_s) => format!("{:.1} s  ({:.1} ms per frame)", stage.total_s, per_frame_s * 1e3),
            None => format!("{:.1} s", stage.total_s),
        },
    });
    self::bars(&bars.collect::<Vec<_>>())
}

/// Horizontal bars with a name before and a label behind; `None` if there is none.
fn bars(bars: &[Bar]) -> Result<Option<String>, DrawError> {
    const ROW: i32 = 30;
    const NAMES: i32 = 205;
    const LABELS: i32 = 215;
    const WIDTH: i32 = 640;
    /// More would not fit a page; the table has them all.
    const MOST: usize = 14;
    let largest = bars.iter().map(|bar| bar.value).fold(0.0, f64::max);
    if !(largest > 0.0) {
        return Ok(None);
    }
    let bars = &bars[..bars.len().min(MOST)];
    let height = ROW * bars.len() as i32 + 12;
    let fine = FINE as i32;
    let svg = drawn(WIDTH as u32, height as u32, |canvas| {
        let names = text(16, Ink::Text).pos(Pos::new(HPos::Right, VPos::Center));
        let labels = text(16, Ink::Text).pos(Pos::new(HPos::Left, VPos::Center));
        for (row, bar) in bars.iter().enumerate() {
            let middle = (6 + ROW * row as i32 + ROW / 2) * fine;
            let half = 9 * fine;
            let length = (bar.value / largest * f64::from(WIDTH - NAMES - LABELS)) as i32 * fine;
            let (left, right) = (NAMES * fine, NAMES * fine + length.max(fine));
            canvas.draw(&Text::new(shortened(&bar.name), (left - 8 * fine, middle), names.clone()))?;
            let style = Ink::Bar.color().filled();
            canvas.draw(&Rectangle::new([(left, middle - half), (right, middle + half)], style))?;
            canvas.draw(&Text::new(bar.label.clone(), (right + 8 * fine, middle), labels.clone()))?;
        }
        Ok(())
    })?;
    Ok(Some(svg))
}

fn shortened(name: &str) -> String {
    const MOST: usize = 28;
    if name.chars().count() <= MOST {
        return name.to_owned();
    }
    name.chars().take(MOST - 1).chain(['…']).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn from_above_turns_neither_left_into_right() {
        for up in [
            [1.0, 0.1, 0.0],
            [-1.0, 0.0, 0.2],
            [0.0, 1.0, 0.0],
            [0.1, -0.9, 0.1],
            [0.0, 0.0, 1.0],
            [0.0, 0.0, -1.0],
        ] {
            let above = FromAbove::new(up);
            let seen_from = above.right.cross(&above.top);
            assert!(seen_from.dot(&Vector3::from(up)) > 0.8, "{up:?}");
        }
    }

    #[test]
    fn both_axes_have_one_scale_and_hold_all_points() {
        let (x, y) = equal_scale([(0.0, 0.0), (8.0, 1.0)].into_iter(), 2.0);
        assert!(((x.end - x.start) / (y.end - y.start) - 2.0).abs() < 1e-9);
        assert!(x.start < 0.0 && x.end > 8.0 && y.start < 0.0 && y.end > 1.0);
        let (x, _) = equal_scale(std::iter::empty(), 1.0);
        assert!(x.start < x.end && x.start.is_finite());
    }

    #[test]
    fn a_line_is_broken_where_frames_are_missing() {
        let point = |stamp| CurvePoint {
            stamp: coma_geometry::StampNs(stamp),
            estimate_m: [0.0; 3],
            truth_m: None,
            error_h_m: None,
            error_p_m: None,
        };
        let curve = Curve {
            agent: coma_geometry::AgentId::new("a").unwrap(),
            component: String::new(),
            aligned: false,
            points: [0, 10, 20, 90, 100].map(point).to_vec(),
        };
        assert_eq!(pieces(&curve).iter().map(|piece| piece.len()).collect::<Vec<_>>(), [3, 2]);
    }

    #[test]
    fn thinning_keeps_both_ends() {
        let points = thinned((0..10_001).collect());
        assert!(points.len() <= MOST_POINTS && points[0] == 0 && points.last() == Some(&10_000));
    }

    #[test]
    fn ticks_are_short() {
        assert_eq!([0.5, -0.0, 1e-12, 12.0, -1.25].map(tick), ["0.5", "0", "0", "12", "-1.25"]);
    }
}
