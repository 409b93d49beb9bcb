//! The charts of a measurement's page: lamp, linearity, photon transfer.

use super::{Looks, Transfer, figure};
use crate::report::html::number;
use crate::report::page::chart;
use crate::report::svg::{Axis, Drawing, Scale, log_range};
use crate::session::{LampPoint, MeasurementRecord};

const WIDTH: f64 = 440.0;
const CHANNELS: [&str; 3] = ["red", "green", "blue"];

/// All charts there is something to draw for.
pub(super) fn section(record: &MeasurementRecord, looks: &Looks) -> String {
    let mut html = String::new();
    if !record.lamp.is_empty() {
        html += &chart(
            "Lamp",
            &lamp(&record.lamp),
            "Brightness at each visit of the reference pose, relative to the first; bars are one standard error. Lines are \
             broken where the lamp was off.",
        );
    }
    if !looks.linearity.is_empty() {
        html += &chart(
            "Linearity",
            &linearity(looks),
            "What is left of the deviation from proportionality after correction, against the signal; bars are one standard error.",
        );
    }
    if let Some(t) = looks.transfer.as_ref().filter(|t| !t.points.is_empty()) {
        let slopes = t.slope.map(|s| number(s, 3)).join(", ");
        let caption = format!(
            "Variance of a raw value against its signal, from {}; lines: {slopes} per raw value (red, green, blue) and a read noise \
             of {}.",
            t.source,
            number(t.read_noise, 3)
        );
        html += &chart("Photon transfer", &transfer(t), &caption);
    }
    if let Some(look) = &looks.flat {
        html += &format!(
            "<section>\n<h2>Flat field</h2>\n{}</section>\n",
            figure(look)
        );
    }
    if html.is_empty() {
        return html;
    }
    format!("<div class=\"grid\">\n{html}</div>\n")
}

fn plot(low: f64, high: f64, from: f64, to: f64) -> Axis {
    Axis {
        scale: Scale::Linear,
        low,
        high,
        from,
        to,
    }
}

/// A range around values, wider by a tenth and never empty.
fn range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let (low, high) = values
        .filter(|v| v.is_finite())
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| {
            (l.min(v), h.max(v))
        });
    if low > high {
        return (0.0, 1.0);
    }
    let margin = (0.1 * (high - low)).max(1e-4 * high.abs()).max(1e-9);
    (low - margin, high + margin)
}

fn lamp(points: &[LampPoint]) -> String {
    let mut d = Drawing::new(WIDTH, 280.0, "The lamp's brightness over the session");
    let ends = points.iter().flat_map(|p| {
        (0..3).flat_map(move |k| {
            [
                p.level[k] - p.standard_error[k],
                p.level[k] + p.standard_error[k],
            ]
        })
    });
    let (low, high) = range(ends);
    let (first, last) = range(points.iter().map(|p| p.elapsed_s / 60.0));
    let x = plot(first, last, 52.0, WIDTH - 12.0);
    let y = plot(low, high, 232.0, 24.0);
    d.axes(&x, &y, "minutes", "relative to the first visit");
    for channel in 0..3 {
        let mut line: Vec<(f64, f64)> = Vec::new();
        let mut stretch = None;
        for p in points {
            if stretch.is_some_and(|s| s != p.stretch) {
                d.polyline(&format!("course c{channel}"), &line);
                line.clear();
            }
            stretch = Some(p.stretch);
            line.push((x.at(p.elapsed_s / 60.0), y.at(p.level[channel])));
        }
        d.polyline(&format!("course c{channel}"), &line);
        for p in points {
            let at = x.at(p.elapsed_s / 60.0);
            let (level, se) = (p.level[channel], p.standard_error[channel]);
            d.line(
                &format!("bar c{channel}"),
                at,
                y.at(level - se),
                at,
                y.at(level + se),
            );
            let title = format!(
                "visit {}, {}: {} ± {}",
                p.visit,
                CHANNELS[channel],
                number(level, 5),
                number(se, 2)
            );
            d.mark(channel, at, y.at(level), &title);
        }
    }
    d.finish()
}

fn linearity(looks: &Looks) -> String {
    let mut d = Drawing::new(WIDTH, 280.0, "Residual non-linearity against signal");
    let points = &looks.linearity;
    let ends = points.iter().flat_map(|p| {
        [
            100.0 * (p.residual - p.residual_se),
            100.0 * (p.residual + p.residual_se),
        ]
    });
    let (low, high) = range(ends.chain([0.0]));
    let (left, right) = log_range(points.iter().map(|p| p.level));
    let x = Axis {
        scale: Scale::Logarithmic,
        low: left,
        high: right,
        from: 52.0,
        to: WIDTH - 12.0,
    };
    let y = plot(low, high, 232.0, 24.0);
    d.axes(&x, &y, "signal over full scale", "deviation, %");
    d.line("axis", x.from, y.at(0.0), x.to, y.at(0.0));
    for p in points {
        let at = x.at(p.level);
        let (value, se) = (100.0 * p.residual, 100.0 * p.residual_se);
        let bar = format!("bar c{}", p.channel);
        d.line(&bar, at, y.at(value - se), at, y.at(value + se));
        let title = format!(
            "{}, signal {}: {} % ± {} %",
            CHANNELS[p.channel.min(2)],
            number(p.level, 3),
            number(value, 2),
            number(se, 2)
        );
        d.mark(p.channel, at, y.at(value), &title);
    }
    d.finish()
}

fn transfer(t: &Transfer) -> String {
    let mut d = Drawing::new(WIDTH, 280.0, "Variance against signal");
    let (left, right) = log_range(t.points.iter().map(|(_, [s, _, _])| *s));
    let (low, high) = log_range(t.points.iter().map(|(_, [_, v, _])| *v));
    let log = |low, high, from, to| Axis {
        scale: Scale::Logarithmic,
        low,
        high,
        from,
        to,
    };
    let x = log(left, right, 52.0, WIDTH - 12.0);
    let y = log(low, high, 232.0, 24.0);
    d.axes(&x, &y, "signal, raw values", "variance, raw values squared");
    for channel in 0..3 {
        let line: Vec<(f64, f64)> = (0..=40)
            .map(|i| left * (right / left).powf(f64::from(i) / 40.0))
            .map(|s| (x.at(s), y.at(t.slope[channel] * s + t.read_noise.powi(2))))
            .collect();
        d.polyline(&format!("course c{channel}"), &line);
    }
    for (channel, [signal, variance, se]) in &t.points {
        let bar = format!("bar c{channel}");
        let at = x.at(*signal);
        d.line(&bar, at, y.at(variance - se), at, y.at(variance + se));
        let title = format!(
            "{}: variance {} ± {} at {}",
            CHANNELS[(*channel).min(2)],
            number(*variance, 3),
            number(*se, 2),
            number(*signal, 4)
        );
        d.mark(*channel, at, y.at(*variance), &title);
    }
    d.finish()
}
