//! Figures of several variants as bars: one panel for each kind of figure, side by side, in an SVG.

use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};

/// One kind of figure.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BarPanel {
    /// What and in which unit.
    pub title: String,
    /// Digits after the point.
    pub digits: usize,
    /// In the order of the names; what was not measured has no bar.
    pub values: Vec<Option<f64>>,
}

type DrawError = Box<dyn std::error::Error>;

const NAMES: i32 = 320;
const PANEL: i32 = 190;
const ROW: i32 = 34;
const HEAD: i32 = 44;
const FIRST: RGBColor = RGBColor(40, 90, 170);
const OTHERS: RGBColor = RGBColor(150, 175, 215);
const TEXT: RGBColor = RGBColor(60, 60, 60);

/// Names down the left side, a bar for each in every panel; the first stands out, as the others are compared with it.
pub fn bars_svg(names: &[&str], panels: &[BarPanel]) -> Result<String, DrawError> {
    let mut svg = String::new();
    {
        let size = (NAMES + PANEL * panels.len() as i32, HEAD + ROW * names.len() as i32 + 10);
        let canvas = SVGBackend::with_string(&mut svg, (size.0 as u32, size.1 as u32)).into_drawing_area();
        canvas.fill(&WHITE)?;
        let text = |size: i32, right: bool| {
            let side = if right { HPos::Right } else { HPos::Left };
            ("sans-serif", size).into_font().color(&TEXT).pos(Pos::new(side, VPos::Center))
        };
        for (i, name) in names.iter().enumerate() {
            canvas.draw_text(name, &text(15, true), (NAMES - 12, middle(i)))?;
        }
        for (k, panel) in panels.iter().enumerate() {
            let left = NAMES + PANEL * k as i32;
            canvas.draw_text(&panel.title, &text(15, false), (left, HEAD / 2))?;
            let most = panel.values.iter().flatten().filter(|v| v.is_finite()).fold(0.0f64, |a, b| a.max(*b));
            for (i, value) in panel.values.iter().enumerate().take(names.len()) {
                let Some(value) = value.filter(|v| v.is_finite()) else {
                    canvas.draw_text("not measured", &text(13, false), (left, middle(i)))?;
                    continue;
                };
                let share = if most > 0.0 { (value / most).clamp(0.0, 1.0) } else { 0.0 };
                let right = left + ((PANEL - 80) as f64 * share).round() as i32;
                let corners = [(left, middle(i) - ROW / 3), (right, middle(i) + ROW / 3)];
                let color = if i == 0 { FIRST } else { OTHERS };
                canvas.draw(&Rectangle::new(corners, color.filled()))?;
                let digits = panel.digits;
                canvas.draw_text(&format!("{value:.digits$}"), &text(13, false), (right + 5, middle(i)))?;
            }
        }
        canvas.present()?;
    }
    Ok(svg)
}

fn middle(row: usize) -> i32 {
    HEAD + ROW * row as i32 + ROW / 2
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_figure_is_written_and_the_first_row_stands_out() {
        let panel =
            BarPanel { title: "ATE, cm".into(), digits: 2, values: vec![Some(0.123), Some(4.0), None] };
        let svg = bars_svg(&["ours", "less", "none"], &[panel]).unwrap();
        for text in ["ATE, cm", "ours", "less", "0.12", "4.00", "not measured"] {
            assert!(svg.contains(text), "{text}");
        }
        assert_eq!(svg.matches("#285AAA").count(), 1);
    }

    #[test]
    fn zeros_and_bad_numbers_draw_no_bar_and_no_panic() {
        let panel = BarPanel { title: "t".into(), digits: 0, values: vec![Some(0.0), Some(f64::NAN)] };
        assert!(bars_svg(&["a", "b"], &[panel]).unwrap().contains("not measured"));
        assert!(bars_svg(&[], &[]).unwrap().contains("<svg"));
    }
}
