//! A pose graph as an SVG, before and after a solve, side by side.

use plotters::prelude::*;
use std::ops::Range;

/// A graph to draw.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct GraphPicture {
    /// Above the picture.
    pub title: String,
    /// Positions of the nodes, metres.
    pub nodes_m: Vec<[f64; 3]>,
    /// Measurements between consecutive nodes of a robot, by index.
    pub odometry: Vec<(usize, usize)>,
    /// All others, with their weights (0 to 1); those that have lost theirs are red.
    pub loops: Vec<(usize, usize, f64)>,
}

type DrawError = Box<dyn std::error::Error>;

const PANEL: u32 = 900;
const TRACK: RGBColor = RGBColor(40, 90, 170);
const USED: RGBColor = RGBColor(40, 140, 70);
const REFUSED: RGBColor = RGBColor(200, 40, 40);
const TEXT: RGBColor = RGBColor(60, 60, 60);
/// Lines of one kind; more make files that no viewer opens, and no one would tell them apart.
const MOST_LINES: usize = 20_000;

/// The graphs side by side, each seen along the axis in which it is least extended.
pub fn graph_svg(pictures: &[GraphPicture]) -> Result<String, DrawError> {
    let mut svg = String::new();
    {
        let size = (PANEL * pictures.len().max(1) as u32, PANEL);
        let canvas = SVGBackend::with_string(&mut svg, size).into_drawing_area();
        canvas.fill(&WHITE)?;
        for (picture, panel) in pictures.iter().zip(canvas.split_evenly((1, pictures.len().max(1)))) {
            draw(picture, &panel)?;
        }
        canvas.present()?;
    }
    Ok(svg)
}

fn draw(
    picture: &GraphPicture,
    panel: &DrawingArea<SVGBackend, plotters::coord::Shift>,
) -> Result<(), DrawError> {
    let (axes, names) = seen(&picture.nodes_m);
    let points: Vec<(f64, f64)> = picture.nodes_m.iter().map(|p| (p[axes.0], p[axes.1])).collect();
    let (x_range, y_range) = square(&points);
    let mut chart = ChartBuilder::on(panel)
        .margin(20)
        .caption(&picture.title, ("sans-serif", 22).into_font().color(&TEXT))
        .x_label_area_size(40)
        .y_label_area_size(60)
        .build_cartesian_2d(x_range, y_range)?;
    chart
        .configure_mesh()
        .light_line_style(TRANSPARENT)
        .bold_line_style(TEXT.mix(0.15))
        .label_style(("sans-serif", 15).into_font().color(&TEXT))
        .x_desc(format!("{}, m", names.0))
        .y_desc(format!("{}, m", names.1))
        .draw()?;
    let mut lines = |ends: Vec<(usize, usize)>, style: ShapeStyle| -> Result<(), DrawError> {
        let step = ends.len().div_ceil(MOST_LINES).max(1);
        for (a, b) in ends.into_iter().step_by(step) {
            if let (Some(a), Some(b)) = (points.get(a), points.get(b)) {
                chart.draw_series(LineSeries::new([*a, *b], style))?;
            }
        }
        Ok(())
    };
    let of = |used: bool| {
        let chosen = picture.loops.iter().filter(|(_, _, weight)| (*weight >= 0.5) == used);
        chosen.map(|(a, b, _)| (*a, *b)).collect::<Vec<_>>()
    };
    lines(of(false), REFUSED.mix(0.5).stroke_width(1))?;
    lines(of(true), USED.mix(0.5).stroke_width(1))?;
    lines(picture.odometry.clone(), TRACK.stroke_width(1))?;
    Ok(())
}

/// The two axes in which the points reach farthest.
fn seen(points: &[[f64; 3]]) -> ((usize, usize), (&'static str, &'static str)) {
    let reach = |axis: usize| {
        let values = points.iter().map(|p| p[axis]);
        let (least, most) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
        most - least
    };
    let hidden = (0..3).min_by(|a, b| reach(*a).total_cmp(&reach(*b))).unwrap_or(2);
    match hidden {
        0 => ((1, 2), ("y", "z")),
        1 => ((0, 2), ("x", "z")),
        _ => ((0, 1), ("x", "y")),
    }
}

/// Ranges of equal length around all points.
fn square(points: &[(f64, f64)]) -> (Range<f64>, Range<f64>) {
    let empty = (f64::INFINITY, f64::NEG_INFINITY);
    let span = |(a, b): (f64, f64), v: f64| if v.is_finite() { (a.min(v), b.max(v)) } else { (a, b) };
    let (x, y) = points.iter().fold((empty, empty), |(x, y), p| (span(x, p.0), span(y, p.1)));
    let (x, y) = if x.0 <= x.1 && y.0 <= y.1 { (x, y) } else { ((0.0, 0.0), (0.0, 0.0)) };
    let half = 0.53 * (x.1 - x.0).max(y.1 - y.0).max(0.1);
    let around = |(a, b): (f64, f64)| 0.5 * (a + b) - half..0.5 * (a + b) + half;
    (around(x), around(y))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ring(title: &str, weight: f64) -> GraphPicture {
        let nodes_m = (0..12)
            .map(|k| {
                let angle = f64::from(k) * 0.5;
                [angle.cos() * 4.0, 0.1 * angle, angle.sin() * 4.0]
            })
            .collect();
        GraphPicture {
            title: title.into(),
            nodes_m,
            odometry: (0..11).map(|k| (k, k + 1)).collect(),
            loops: vec![(0, 11, 1.0), (2, 7, weight)],
        }
    }

    #[test]
    fn both_graphs_are_drawn_with_their_titles_and_refused_loops_in_red() {
        let svg = graph_svg(&[ring("before", 1.0), ring("after", 0.0)]).unwrap();
        assert!(svg.contains("before") && svg.contains("after"));
        assert!(svg.contains("x, m") && svg.contains("z, m"));
        assert!(svg.contains("#C82828"));
        assert!(!graph_svg(&[ring("before", 1.0)]).unwrap().contains("#C82828"));
    }

    #[test]
    fn no_nodes_and_bad_numbers_are_drawn_as_nothing() {
        let mut bad = ring("bad", 1.0);
        bad.nodes_m[3] = [f64::NAN; 3];
        bad.loops.push((0, 99, 1.0));
        assert!(graph_svg(&[GraphPicture::default(), bad]).unwrap().contains("<svg"));
    }
}
