//! The chart of kept rows: seconds to each residual, and how wrong the parameters are at the end, per fabric and method.

#[path = "../common/axes.rs"]
mod axes;

use super::{Row, TARGETS};
use axes::{distinct, range, short};
use plotters::coord::Shift;
use plotters::element::ComposedElement;
use plotters::prelude::*;
use std::path::Path;

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

const FONT: &str = "sans-serif";
/// Distinct also to color-blind eyes (Okabe and Ito 2008); marks tell methods apart without color.
const COLORS: [RGBColor; 4] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
];

/// Draws a row of two panels per fabric.
pub(super) fn draw(rows: &[Row], date: &str, file: &Path) {
    let fabrics = distinct(rows.iter().map(|r| r.fabric.as_str()));
    let methods = distinct(rows.iter().map(|r| r.method.as_str()));
    assert!(!fabrics.is_empty(), "there are no rows to draw");
    std::fs::create_dir_all(file.parent().unwrap()).unwrap();
    let size = (860, 320 * fabrics.len() as u32 + 90);
    let whole = SVGBackend::new(file, size).into_drawing_area();
    whole.fill(&WHITE).unwrap();
    let title = format!("Fits from the published start: CPU seconds to a residual ({date})");
    let body = whole.titled(&title, (FONT, 18)).unwrap();
    let (head, body) = body.split_vertically(56);
    legend(&head, &methods);
    let seconds = range(rows.iter().filter_map(|r| r.cpu_s));
    let errors = range(rows.iter().flat_map(|r| [r.color_error, r.width_error]));
    for (area, fabric) in body.split_evenly((fabrics.len(), 1)).iter().zip(&fabrics) {
        let mine: Vec<&Row> = rows.iter().filter(|r| r.fabric == *fabric).collect();
        let (left, right) = area.split_horizontally(520);
        times(&left, fabric, &methods, &mine, seconds.clone());
        parameters(&right, &methods, &mine, errors.clone());
    }
    whole.present().unwrap();
}

fn legend(area: &Area<'_>, methods: &[&str]) {
    for (k, method) in methods.iter().enumerate() {
        let x = 60 + 180 * k as i32;
        let color = COLORS[k % COLORS.len()];
        let line = PathElement::new([(x, 12), (x + 34, 12)], color.stroke_width(2));
        area.draw(&line).unwrap();
        area.draw(&mark(k, (x + 17, 12), color, false)).unwrap();
        let text = Text::new((*method).to_owned(), (x + 42, 5), (FONT, 14));
        area.draw(&text).unwrap();
    }
    let note = "left: median over seeds, bars from fastest to slowest (to the top: not all seeds arrived, k/n did; hollow: half \
                or fewer, the fastest)";
    area.draw(&Text::new(note, (60, 30), (FONT, 12))).unwrap();
}

type Mark<'a, C> = ComposedElement<C, SVGBackend<'a>, Polygon<(i32, i32)>, PathElement<(i32, i32)>>;

/// Disk, square, triangle, diamond; hollow ones are white inside.
fn mark<'a, C>(k: usize, at: C, color: RGBColor, hollow: bool) -> Mark<'a, C> {
    let mut outline: Vec<(i32, i32)> = match k % 4 {
        0 => vec![
            (-4, -2),
            (-2, -4),
            (2, -4),
            (4, -2),
            (4, 2),
            (2, 4),
            (-2, 4),
            (-4, 2),
        ],
        1 => vec![(-4, -4), (4, -4), (4, 4), (-4, 4)],
        2 => vec![(0, -5), (5, 4), (-5, 4)],
        _ => vec![(0, -6), (6, 0), (0, 6), (-6, 0)],
    };
    let inside = if hollow { WHITE } else { color };
    let area = Polygon::new(outline.clone(), inside.filled());
    outline.push(outline[0]);
    EmptyElement::at(at) + area + PathElement::new(outline, color.stroke_width(1))
}

/// Seconds of all seeds to a target, fastest first; infinite where a seed never arrived.
fn seconds_to(rows: &[&Row], method: &str, target: f64) -> Vec<f64> {
    let of_target = |r: &&&Row| r.method == method && (r.target_residual - target).abs() < 1e-9;
    let all = rows.iter().filter(of_target);
    let mut seconds: Vec<f64> = all.map(|r| r.cpu_s.unwrap_or(f64::INFINITY)).collect();
    seconds.sort_by(f64::total_cmp);
    seconds
}

/// The middle one; the slower of two.
fn median(sorted: &[f64]) -> f64 {
    sorted[sorted.len() / 2]
}

fn times(
    area: &Area<'_>,
    fabric: &str,
    methods: &[&str],
    rows: &[&Row],
    seconds: std::ops::Range<f64>,
) {
    let top = seconds.end;
    let mut chart = ChartBuilder::on(area)
        .caption(fabric, (FONT, 15))
        .margin(8)
        .x_label_area_size(38)
        .y_label_area_size(52)
        .build_cartesian_2d(-0.5..TARGETS.len() as f64 - 0.5, seconds.log_scale())
        .unwrap();
    chart
        .configure_mesh()
        .disable_x_mesh()
        .x_labels(2 * TARGETS.len())
        .x_desc("weighted rms residual, %")
        .y_desc("CPU seconds")
        .label_style((FONT, 12))
        .light_line_style(BLACK.mix(0.05))
        .bold_line_style(BLACK.mix(0.15))
        .x_label_formatter(&|x| at_place(*x, &TARGETS.map(|t| t.to_string())))
        .y_label_formatter(&|v| short(*v))
        .draw()
        .unwrap();
    for (k, method) in methods.iter().enumerate() {
        let color = COLORS[k % COLORS.len()];
        let (mut line, mut marks) = (Vec::new(), Vec::new());
        for (place, target) in TARGETS.into_iter().enumerate() {
            let seconds = seconds_to(rows, method, target);
            let arrived = seconds.iter().filter(|s| s.is_finite()).count();
            if arrived == 0 {
                continue;
            }
            // Beside each other, so that bars do not hide bars.
            let x = place as f64 + 0.07 * (k as f64 - 0.5 * (methods.len() as f64 - 1.0));
            let middle = median(&seconds);
            let slowest = seconds[seconds.len() - 1].min(top);
            let bar = PathElement::new([(x, seconds[0]), (x, slowest)], color.stroke_width(1));
            chart.draw_series([bar]).unwrap();
            let y = if middle.is_finite() {
                line.push((x, middle));
                middle
            } else {
                seconds[0]
            };
            let here = mark(k, (x, y), color, !middle.is_finite());
            marks.push((here, (x, y), arrived, seconds.len()));
        }
        let line = LineSeries::new(line, color.stroke_width(2));
        chart.draw_series(line).unwrap();
        for (mark, at, arrived, of) in marks {
            chart.draw_series([mark]).unwrap();
            if arrived < of {
                let text = Text::new(format!("{arrived}/{of}"), (6, -13), (FONT, 11));
                chart.draw_series([EmptyElement::at(at) + text]).unwrap();
            }
        }
    }
}

fn parameters(area: &Area<'_>, methods: &[&str], rows: &[&Row], errors: std::ops::Range<f64>) {
    let n = methods.len() as f64;
    let mut chart = ChartBuilder::on(area)
        .caption(
            "parameters at the end: colors (left), widths (right)",
            (FONT, 13),
        )
        .margin(8)
        .x_label_area_size(38)
        .y_label_area_size(52)
        .build_cartesian_2d(-0.5..n - 0.5, errors.log_scale())
        .unwrap();
    // Of a fit of another length only its seconds: there is no room for more.
    let short_name = |m: &&str| m.rsplit(", ").next().unwrap_or(m).to_owned();
    let names: Vec<String> = methods.iter().map(short_name).collect();
    chart
        .configure_mesh()
        .disable_x_mesh()
        .y_desc("largest relative error, %")
        .label_style((FONT, 12))
        .light_line_style(BLACK.mix(0.05))
        .bold_line_style(BLACK.mix(0.15))
        .x_labels(2 * methods.len())
        .x_label_formatter(&|x| at_place(*x, &names))
        .y_label_formatter(&|v| short(*v))
        .draw()
        .unwrap();
    for (k, method) in methods.iter().enumerate() {
        let color = COLORS[k % COLORS.len()];
        // One of a seed's rows says it for all.
        let of_method =
            |r: &&&Row| r.method == *method && (r.target_residual - TARGETS[0]).abs() < 1e-9;
        let ends: Vec<&&Row> = rows.iter().filter(of_method).collect();
        let colors: Vec<f64> = ends.iter().map(|r| r.color_error).collect();
        let widths: Vec<f64> = ends.iter().map(|r| r.width_error).collect();
        for (offset, mut all) in [(-0.18, colors), (0.18, widths)] {
            if all.is_empty() {
                continue;
            }
            all.sort_by(f64::total_cmp);
            let x = k as f64 + offset;
            let marks = all.iter().map(|y| mark(k, (x, *y), color, true));
            chart.draw_series(marks).unwrap();
            let middle = median(&all);
            let bar = PathElement::new(
                [(x - 0.12, middle), (x + 0.12, middle)],
                BLACK.stroke_width(2),
            );
            chart.draw_series([bar]).unwrap();
        }
    }
}

/// The name at a whole number of an axis of names.
fn at_place(x: f64, names: &[String]) -> String {
    let near = names.get(x.round().max(0.0) as usize);
    let exact = (x - x.round()).abs() < 1e-6;
    near.filter(|_| exact).cloned().unwrap_or_default()
}
