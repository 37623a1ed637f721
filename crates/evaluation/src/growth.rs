//! Figures that grow, as an SVG: one line for each.

use plotters::prelude::*;

/// A line of a plot.
#[derive(Clone, Debug, PartialEq)]
pub struct Line {
    /// Beside the line.
    pub name: String,
    /// Its points, by x.
    pub points: Vec<(f64, f64)>,
}

/// One panel: lines over a common axis.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Growth {
    /// What grows, with its unit.
    pub y: String,
    /// Over what.
    pub x: String,
    /// The lines.
    pub lines: Vec<Line>,
}

type DrawError = Box<dyn std::error::Error>;

const PANEL: (u32, u32) = (640, 420);
const TEXT: RGBColor = RGBColor(60, 60, 60);
const INKS: [RGBColor; 4] =
    [RGBColor(40, 90, 170), RGBColor(200, 90, 30), RGBColor(40, 140, 70), RGBColor(130, 60, 150)];

/// The panels side by side; both axes begin at zero.
pub fn growth_svg(panels: &[Growth]) -> Result<String, DrawError> {
    let mut svg = String::new();
    {
        let count = panels.len().max(1);
        let canvas = SVGBackend::with_string(&mut svg, (PANEL.0 * count as u32, PANEL.1)).into_drawing_area();
        canvas.fill(&WHITE)?;
        for (panel, area) in panels.iter().zip(canvas.split_evenly((1, count))) {
            let points =
                panel.lines.iter().flat_map(|l| &l.points).filter(|(x, y)| x.is_finite() && y.is_finite());
            let (x_most, y_most) =
                points.fold((0.0f64, 0.0f64), |most, p| (most.0.max(p.0), most.1.max(p.1)));
            let font = ("sans-serif", 15).into_font().color(&TEXT);
            let mut chart = ChartBuilder::on(&area)
                .margin(16)
                .x_label_area_size(40)
                .y_label_area_size(64)
                .build_cartesian_2d(0.0..x_most.max(1e-9) * 1.05, 0.0..y_most.max(1e-9) * 1.1)?;
            chart
                .configure_mesh()
                .light_line_style(TRANSPARENT)
                .bold_line_style(TEXT.mix(0.15))
                .label_style(font.clone())
                .x_desc(&panel.x)
                .y_desc(&panel.y)
                .draw()?;
            for (line, ink) in panel.lines.iter().zip(INKS.iter().cycle()) {
                chart
                    .draw_series(
                        LineSeries::new(line.points.iter().copied(), ink.stroke_width(2)).point_size(3),
                    )?
                    .label(&line.name)
                    .legend(|(x, y)| PathElement::new([(x, y), (x + 18, y)], ink.stroke_width(2)));
            }
            chart
                .configure_series_labels()
                .position(SeriesLabelPosition::UpperLeft)
                .label_font(font)
                .background_style(WHITE.mix(0.8))
                .draw()?;
        }
        canvas.present()?;
    }
    Ok(svg)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_line_is_named_and_nothing_is_drawn_of_nothing() {
        let line = |name: &str, k: f64| Line {
            name: name.into(),
            points: (1..5).map(|x| (f64::from(x), k * f64::from(x))).collect(),
        };
        let panel = Growth {
            y: "solve, s".into(),
            x: "agents".into(),
            lines: vec![line("central", 2.0), line("block by block", 1.0)],
        };
        let svg = growth_svg(&[panel, Growth::default()]).unwrap();
        assert!(svg.contains("central") && svg.contains("block by block") && svg.contains("solve, s"));
    }
}
