//! The drawings of a comparison of models.

use crate::fit::{FittedModel, PoseResidual, SideBySide};
use crate::report::charts::CHANNELS;
use crate::report::html::number;
use crate::report::svg::{Axis, Drawing, Scale, log_range};

const WIDTH: f64 = 440.0;

/// How much too bright each model is, pose by pose.
pub(super) fn brightness(result: &SideBySide) -> String {
    let mut d = Drawing::new(
        WIDTH,
        320.0,
        "Relative brightness residual per pose and model",
    );
    let rows = || result.models.iter().flat_map(|m| &m.fitted.configs);
    let reach = rows()
        .map(|r| r.brightness_percent.abs() + r.brightness_se_percent)
        .fold(1.0_f64, f64::max)
        .min(300.0);
    let (left, right) = (46.0, WIDTH - 8.0);
    let y = Axis {
        scale: Scale::Linear,
        low: -1.08 * reach,
        high: 1.08 * reach,
        from: 258.0,
        to: 24.0,
    };
    for v in y.ticks() {
        d.line("grid", left, y.at(v), right, y.at(v));
        d.text("tick", left - 5.0, y.at(v) + 3.5, "end", &number(v, 2));
    }
    let poses = result.models.first().map_or(&[][..], |m| &m.fitted.configs);
    let band = (right - left) / poses.len().max(1) as f64;
    let width = band * 0.76 / result.models.len().max(1) as f64;
    for (i, pose) in poses.iter().enumerate() {
        let start = left + band * (i as f64 + 0.12);
        for (k, m) in result.models.iter().enumerate() {
            let Some(r) = m.fitted.configs.get(i) else {
                continue;
            };
            let at = start + width * k as f64;
            let (value, se) = (r.brightness_percent, r.brightness_se_percent);
            let (top, bottom) = (y.at(value.max(0.0)), y.at(value.min(0.0)));
            d.rectangle(
                &format!("k{k}"),
                at,
                top,
                width * 0.9,
                (bottom - top).max(0.5),
            );
            let middle = at + 0.45 * width;
            d.line(
                "whisker",
                middle,
                y.at(value - se),
                middle,
                y.at(value + se),
            );
        }
        let id = pose.configuration.id.to_string();
        d.text("tick", left + band * (i as f64 + 0.5), 273.0, "middle", &id);
    }
    d.line("axis", left, y.at(0.0), right, y.at(0.0));
    d.text("name", left, 16.0, "start", "predicted minus measured, %");
    d.text(
        "name",
        0.5 * (left + right),
        289.0,
        "middle",
        "configuration",
    );
    for (k, m) in result.models.iter().enumerate() {
        let x = left + 132.0 * k as f64;
        d.rectangle(&format!("k{k}"), x, 300.0, 9.0, 9.0);
        d.text("tick", x + 13.0, 308.5, "start", &m.name);
    }
    d.finish()
}

/// Predicted against measured intensities of one model, both logarithmic.
pub(super) fn scatter(model: &FittedModel) -> String {
    let label = format!("Predicted against measured intensities, {}", model.name);
    let mut d = Drawing::new(WIDTH, 380.0, &label);
    let seen = model.fitted.configs.iter();
    let unseen = model.validation.iter().flat_map(|v| &v.configs);
    let both = |r: &PoseResidual| {
        let pairs = r.measured.into_iter().zip(r.predicted);
        let pairs = pairs.filter_map(|(m, p)| Some([m?, p]));
        pairs.flatten().collect::<Vec<_>>()
    };
    let (low, high) = log_range(seen.clone().chain(unseen.clone()).flat_map(both));
    let axis = |from: f64, to: f64| Axis {
        scale: Scale::Logarithmic,
        low,
        high,
        from,
        to,
    };
    let (x, y) = (axis(52.0, WIDTH - 12.0), axis(330.0, 24.0));
    d.axes(
        &x,
        &y,
        "measured normalized radiance",
        "predicted normalized radiance",
    );
    d.line("identity", x.at(low), y.at(low), x.at(high), y.at(high));
    for (r, large) in unseen.map(|r| (r, false)).chain(seen.map(|r| (r, true))) {
        for (k, channel) in CHANNELS.iter().enumerate() {
            let Some(m) = r.measured[k] else { continue };
            let p = r.predicted[k];
            let title = format!(
                "configuration {}, {channel}: measured {}, predicted {}",
                r.configuration.id,
                number(m, 3),
                number(p, 3)
            );
            if large {
                d.mark(k, x.at(m), y.at(p), &title);
            } else {
                d.disk(&format!("m{k}"), x.at(m), y.at(p), 1.7, &title);
            }
        }
    }
    d.finish()
}
