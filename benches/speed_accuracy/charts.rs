//! Charts of a kept run: error against CPU seconds, both logarithmic.

#[path = "../common/axes.rs"]
mod axes;

use super::{MATERIALS, Results, Row, root};
use axes::{distinct, range, short};
use plotters::coord::Shift;
use plotters::prelude::*;
use std::path::Path;

type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

const FONT: &str = "sans-serif";
const GRAY: RGBColor = RGBColor(120, 120, 120);
/// Distinct also to color-blind eyes (Okabe and Ito 2008).
const COLORS: [RGBColor; 4] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
];

/// One line of a chart.
struct Series {
    name: String,
    color: RGBAColor,
    hollow: bool,
    points: Vec<(f64, f64)>,
}

/// Draws the charts there are numbers for into `folder`.
pub(super) fn draw(results: &Results, folder: &Path) {
    std::fs::create_dir_all(folder).unwrap();
    materials(results, &folder.join("speed_accuracy.svg"));
    configurations(results, &folder.join("speed_accuracy_configurations.svg"));
    if let Some(file) = newest("_ray_scale.json") {
        rays(&file, &folder.join("ray_scale.svg"));
    }
}

/// One panel per material: renderers as lines, the prototype as a gray bar at 1 %.
fn materials(results: &Results, file: &Path) {
    let names = distinct(results.rows.iter().map(|r| r.fabric.as_str()));
    let (columns, n_rows) = (names.len().min(2), names.len().div_ceil(2));
    let size = (430 * columns as u32, 310 * n_rows as u32 + 50);
    let whole = SVGBackend::new(file, size).into_drawing_area();
    whole.fill(&WHITE).unwrap();
    let title = format!(
        "Error of 48 mean intensities against CPU seconds, derivatives included ({})",
        &results.date[..10]
    );
    let body = whole.titled(&title, (FONT, 17)).unwrap();
    let mut panels = Vec::new();
    for name in names {
        let mine: Vec<&Row> = results.rows.iter().filter(|r| r.fabric == name).collect();
        let mut series = Vec::new();
        for (k, renderer) in distinct(mine.iter().map(|r| r.renderer.as_str()))
            .into_iter()
            .enumerate()
        {
            let rows = mine.iter().filter(|r| r.renderer == renderer);
            let color = COLORS[k % COLORS.len()].to_rgba();
            series.push(Series {
                name: renderer.to_owned(),
                color,
                hollow: false,
                points: rows.clone().map(|r| (r.cpu_s, 100.0 * r.error())).collect(),
            });
            if rows.clone().any(|r| r.error_actual.is_some()) {
                series.push(Series {
                    name: format!("{renderer}, as stated"),
                    color: color.mix(0.55),
                    hollow: true,
                    points: rows.map(|r| (r.cpu_s, 100.0 * r.error_stated)).collect(),
                });
            }
        }
        if let Some((_, range)) = MATERIALS.iter().find(|(m, _)| *m == name) {
            series.push(Series {
                name: "prototype".to_owned(),
                color: GRAY.to_rgba(),
                hollow: true,
                points: range.map(|s| (s, 1.0)).to_vec(),
            });
        }
        panels.push((name.to_owned(), series));
    }
    let axes = Axes::around("CPU s", "error, %", &panels);
    for (area, (name, series)) in (body.split_evenly((n_rows, columns)).iter()).zip(&panels) {
        panel(area, name, &axes, series, true);
    }
    body.present().unwrap();
}

/// One panel per configuration: materials by color, the basic renderer faint.
fn configurations(results: &Results, file: &Path) {
    let with: Vec<&Row> = results
        .rows
        .iter()
        .filter(|r| !r.configurations.is_empty())
        .collect();
    let Some(first) = with.first() else { return };
    let columns = 4;
    let n_rows = first.configurations.len().div_ceil(columns);
    let size = (260 * columns as u32, 215 * n_rows as u32 + 80);
    let whole = SVGBackend::new(file, size).into_drawing_area();
    whole.fill(&WHITE).unwrap();
    let title = "Stated error of each configuration, %, against CPU seconds of all 16 together: fast (full), basic (faint)";
    let body = whole.titled(title, (FONT, 17)).unwrap();
    let (legend, body) = body.split_vertically(26);
    let names = distinct(with.iter().map(|r| r.fabric.as_str()));
    for (k, name) in names.iter().enumerate() {
        let x = 40 + 120 * k as i32;
        let color = COLORS[k % COLORS.len()];
        legend
            .draw(&Circle::new((x, 12), 4, color.filled()))
            .unwrap();
        legend
            .draw(&Text::new((*name).to_owned(), (x + 10, 5), (FONT, 14)))
            .unwrap();
    }
    let mut panels = Vec::new();
    for (i, c) in first.configurations.iter().enumerate() {
        let mut series = Vec::new();
        for (k, name) in names.iter().enumerate() {
            for renderer in ["basic", "fast"] {
                let rows = with
                    .iter()
                    .filter(|r| r.fabric == *name && r.renderer == renderer);
                // Stated: the scatter of a few runs says little about a single configuration.
                let error = |r: &Row| 100.0 * r.configurations[i].error_stated;
                series.push(Series {
                    name: String::new(),
                    color: COLORS[k % COLORS.len()].mix(if renderer == "fast" {
                        1.0
                    } else {
                        0.35
                    }),
                    hollow: renderer == "basic",
                    points: rows.map(|r| (r.cpu_s, error(r))).collect(),
                });
            }
        }
        panels.push((format!("configuration {}", c.config), series));
    }
    let axes = Axes::around("", "", &panels);
    for (area, (title, series)) in (body.split_evenly((n_rows, columns)).iter()).zip(&panels) {
        panel(area, title, &axes, series, false);
    }
    body.present().unwrap();
}

/// Rays per second against the number of segments, from `ray_speed --scale --json`.
fn rays(from: &Path, file: &Path) {
    let text = std::fs::read_to_string(from).unwrap();
    let rows: Vec<serde_json::Value> = text
        .lines()
        .filter_map(|l| serde_json::from_str(l).ok())
        .collect();
    let wanted = [
        ("closest, path order", "mrays_closest"),
        ("any, path order", "mrays_any"),
        ("closest, shuffled", "mrays_closest_shuffled"),
        ("any, shuffled", "mrays_any_shuffled"),
    ];
    let series: Vec<Series> = (0..4)
        .map(|k| Series {
            name: wanted[k].0.to_owned(),
            color: COLORS[k % 2].to_rgba(),
            hollow: k >= 2,
            points: rows
                .iter()
                .filter_map(|r| Some((r["segments"].as_f64()?, r[wanted[k].1].as_f64()?)))
                .collect(),
        })
        .collect();
    let whole = SVGBackend::new(file, (620, 400)).into_drawing_area();
    whole.fill(&WHITE).unwrap();
    let panels = [("Bounce rays, one core".to_owned(), series)];
    let axes = Axes::around("segments", "million rays per CPU s", &panels);
    panel(&whole, &panels[0].0, &axes, &panels[0].1, true);
    whole.present().unwrap();
}

/// Logarithmic axes that all panels of a chart share.
struct Axes<'a> {
    names: [&'a str; 2],
    x: std::ops::Range<f64>,
    y: std::ops::Range<f64>,
}

impl<'a> Axes<'a> {
    fn around(x: &'a str, y: &'a str, panels: &[(String, Vec<Series>)]) -> Self {
        let points = || panels.iter().flat_map(|p| &p.1).flat_map(|s| &s.points);
        Self {
            names: [x, y],
            x: range(points().map(|p| p.0)),
            y: range(points().map(|p| p.1)),
        }
    }
}

fn panel(area: &Area<'_>, title: &str, axes: &Axes<'_>, series: &[Series], legend: bool) {
    let [x_name, y_name] = axes.names;
    let mut chart = ChartBuilder::on(area)
        .caption(title, (FONT, 15))
        .margin(8)
        .x_label_area_size(if x_name.is_empty() { 20 } else { 36 })
        .y_label_area_size(if y_name.is_empty() { 34 } else { 50 })
        .build_cartesian_2d(axes.x.clone().log_scale(), axes.y.clone().log_scale())
        .unwrap();
    chart
        .configure_mesh()
        .x_desc(x_name)
        .y_desc(y_name)
        .label_style((FONT, 12))
        .light_line_style(BLACK.mix(0.05))
        .bold_line_style(BLACK.mix(0.15))
        .x_labels(6)
        .y_labels(6)
        .x_label_formatter(&|v| short(*v))
        .y_label_formatter(&|v| short(*v))
        .draw()
        .unwrap();
    for s in series {
        let style = ShapeStyle {
            color: s.color,
            filled: !s.hollow,
            stroke_width: if s.hollow { 1 } else { 2 },
        };
        let drawn = chart
            .draw_series(LineSeries::new(s.points.iter().copied(), style))
            .unwrap();
        drawn
            .label(&s.name)
            .legend(move |(x, y)| PathElement::new([(x, y), (x + 18, y)], style));
        let marks = s.points.iter().map(|p| Circle::new(*p, 3, style));
        chart.draw_series(marks).unwrap();
    }
    if legend {
        chart
            .configure_series_labels()
            .position(SeriesLabelPosition::UpperRight)
            .background_style(WHITE.mix(0.8))
            .label_font((FONT, 12))
            .draw()
            .unwrap();
    }
}

/// The newest dated run whose name ends so.
fn newest(ending: &str) -> Option<std::path::PathBuf> {
    let files = std::fs::read_dir(root().join("benches/runs")).ok()?;
    let paths = files.filter_map(|f| Some(f.ok()?.path()));
    paths
        .filter(|p| p.to_str().is_some_and(|p| p.ends_with(ending)))
        .max()
}
