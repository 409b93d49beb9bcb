//! Time of one woven segment's integral by every rule, beside its error against independent quadrature; and the chart of it.
//!
//! `cargo bench --bench woven_speed` prints; `-- --chart docs/charts/woven_error.svg` draws as well.

#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

#[path = "common/axes.rs"]
#[allow(dead_code)]
mod axes;

#[path = "../tests/common/woven.rs"]
mod woven;

use goniofit::scatter::Parameters;
use goniofit::scatter::surface::woven::{Layout, Quality, Rung, Segment};
use goniofit::scatter::surface::{SurfaceModel, Woven};
use plotters::prelude::*;
use std::hint::black_box;
use std::time::Instant;
use woven::{Row, quantile, rows};

/// What a rule took and how wrong it was, over all rows.
struct Found {
    name: String,
    group: &'static str,
    us: f64,
    errors: Vec<f64>,
}

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let rows = rows();
    let mut found = vec![
        measure(&rows, "fit", "goniofit", |s, r| {
            s.value(r.wi, r.wr, Quality::Fit)
        }),
        measure(&rows, "fit, derivatives", "goniofit", |s, r| {
            s.slopes(r.wi, r.wr, Quality::Fit).0
        }),
    ];
    for tolerance in [1e-2, 1e-6, 1e-9] {
        let name = match tolerance {
            1e-6 => "report, to 1e-6".to_owned(),
            t => format!("to {t:.0e}"),
        };
        found.push(measure(&rows, &name, "goniofit", |s, r| {
            s.estimate(r.wi, r.wr, tolerance).value
        }));
    }
    found.push(measure(&rows, "report, derivatives", "goniofit", |s, r| {
        s.slopes(r.wi, r.wr, Quality::Report).0
    }));
    for samples in [11, 21, 51, 101, 201, 1001] {
        let name = format!("trapezoid of {samples}");
        found.push(measure(&rows, &name, "published", |s, r| {
            s.value(r.wi, r.wr, Quality::Published(samples))
        }));
    }
    println!(
        "{:>24} {:>10} {:>12} {:>12} {:>12}",
        "", "us", "median err", "90 % err", "largest err"
    );
    for f in &mut found {
        println!(
            "{:>24} {:>10.3} {:>12.1e} {:>12.1e} {:>12.1e}",
            f.name,
            f.us,
            quantile(&mut f.errors, 0.5),
            quantile(&mut f.errors, 0.9),
            quantile(&mut f.errors, 1.0)
        );
    }
    models(&rows);
    if let Some(k) = arguments.iter().position(|a| a == "--chart") {
        chart(&mut found, std::path::Path::new(&arguments[k + 1]));
    }
}

fn measure(
    rows: &[Row],
    name: &str,
    group: &'static str,
    value: impl Fn(&Segment, &Row) -> f64,
) -> Found {
    let segments: Vec<Segment> = rows
        .iter()
        .map(|r| Segment::new(r.shape).unwrap())
        .collect();
    let lit = || rows.iter().zip(&segments).filter(|(r, _)| r.value > 1e-9);
    let errors = lit()
        .map(|(r, s)| (value(s, r) / r.value - 1.0).abs())
        .collect();
    let mut best = f64::INFINITY;
    for _ in 0..15 {
        let start = Instant::now();
        for _ in 0..20 {
            for (r, s) in rows.iter().zip(&segments) {
                black_box(value(black_box(s), black_box(r)));
            }
        }
        best = best.min(start.elapsed().as_secs_f64());
    }
    Found {
        name: name.to_owned(),
        group,
        us: 1e6 * best / (20 * rows.len()) as f64,
        errors,
    }
}

/// Whole models: two kinds of segments, three channels.
fn models(rows: &[Row]) {
    for (name, quality) in [("fit", Quality::Fit), ("report", Quality::Report)] {
        let model = Woven::new(Rung::Nineteen, Layout::plain(0.4).unwrap()).with_quality(quality);
        let surface = model.prepare(&Parameters::defaults(&model)).unwrap();
        let per = |f: &dyn Fn(&Row)| {
            let mut best = f64::INFINITY;
            for _ in 0..15 {
                let start = Instant::now();
                (0..20).for_each(|_| rows.iter().for_each(f));
                best = best.min(start.elapsed().as_secs_f64());
            }
            1e6 * best / (20 * rows.len()) as f64
        };
        let value = per(&|r| {
            black_box(surface.value(r.wi, r.wr));
        });
        let all = per(&|r| {
            black_box(surface.evaluate(r.wi, r.wr));
        });
        println!("woven-19, {name}: BRDF {value:.2} us, with all derivatives {all:.2} us");
    }
    let model = Woven::new(Rung::Nineteen, Layout::plain(0.4).unwrap());
    let start = Instant::now();
    (0..1000).for_each(|_| {
        black_box(model.prepare(&Parameters::defaults(&model)).unwrap());
    });
    println!(
        "woven-19: prepare {:.2} us",
        1e3 * start.elapsed().as_secs_f64()
    );
}

fn chart(found: &mut [Found], file: &std::path::Path) {
    let area = SVGBackend::new(file, (760, 440)).into_drawing_area();
    area.fill(&WHITE).unwrap();
    let times = axes::range(found.iter().map(|f| f.us));
    let floor = 1e-15;
    let mut chart = ChartBuilder::on(&area)
        .caption(
            "Woven segment: error against time of one integral (median and 90 % of 168 published cases)",
            ("sans-serif", 15),
        )
        .margin(12)
        .x_label_area_size(40)
        .y_label_area_size(70)
        .build_cartesian_2d(times.log_scale(), (floor..1.0).log_scale())
        .unwrap();
    chart
        .configure_mesh()
        .x_desc("microseconds on one core")
        .y_desc("relative error")
        .y_label_formatter(&|v| format!("{v:.0e}"))
        .draw()
        .unwrap();
    for (group, color) in [
        ("goniofit", RGBColor(0, 114, 178)),
        ("published", RGBColor(213, 94, 0)),
    ] {
        for f in found
            .iter_mut()
            .filter(|f| f.group == group && !f.name.contains("derivatives"))
        {
            let (low, high) = (quantile(&mut f.errors, 0.5), quantile(&mut f.errors, 0.9));
            let (low, high) = (low.max(floor), high.max(floor));
            let line = [(f.us, low), (f.us, high)];
            chart
                .draw_series(LineSeries::new(line, color.stroke_width(2)))
                .unwrap();
            chart
                .draw_series([Circle::new((f.us, low), 4, color.filled())])
                .unwrap();
            let label = Text::new(f.name.clone(), (f.us * 1.05, high), ("sans-serif", 12));
            chart.draw_series([label]).unwrap();
        }
    }
    area.present().unwrap();
}
