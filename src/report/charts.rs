//! The charts of a fit.

use super::html::number;
use super::svg::{Axis, Drawing, Scale, log_range};
use crate::fit::{ConfigurationResult, FitResult, ParameterResult};

const WIDTH: f64 = 440.0;
pub(super) const CHANNELS: [&str; 3] = ["red", "green", "blue"];

/// Measured against rendered intensity, both logarithmic, with error bars of one standard error.
pub(super) fn scatter(result: &FitResult) -> String {
    let mut d = Drawing::new(WIDTH, 400.0, "Rendered against measured intensities");
    let numbers = result.configs.iter().flat_map(|c| {
        let rendered = c.rendered.into_iter();
        c.measured.into_iter().zip(rendered)
    });
    // A channel that was not measured has no mark.
    let shown = numbers.filter_map(|(m, r)| Some([m?, r]));
    let (low, high) = log_range(shown.flatten());
    let x = Axis {
        scale: Scale::Logarithmic,
        low,
        high,
        from: 52.0,
        to: WIDTH - 12.0,
    };
    let y = Axis {
        scale: Scale::Logarithmic,
        low,
        high,
        from: 350.0,
        to: 24.0,
    };
    d.axes(
        &x,
        &y,
        "measured normalized radiance",
        "rendered normalized radiance",
    );
    d.line("identity", x.at(low), y.at(low), x.at(high), y.at(high));
    for c in &result.configs {
        for k in 0..3 {
            let (Some(m), Some(m_se)) = (c.measured[k], c.measured_se[k]) else {
                continue;
            };
            let (r, r_se) = (c.rendered[k], c.rendered_se[k]);
            let bar = format!("bar c{k}");
            d.line(&bar, x.at(m - m_se), y.at(r), x.at(m + m_se), y.at(r));
            d.line(&bar, x.at(m), y.at(r - r_se), x.at(m), y.at(r + r_se));
            let title = format!(
                "configuration {}, {}: measured {} ± {}, rendered {} ± {}",
                c.configuration.id,
                CHANNELS[k],
                number(m, 3),
                number(m_se, 2),
                number(r, 3),
                number(r_se, 2)
            );
            d.mark(k, x.at(m), y.at(r), &title);
        }
    }
    legend(&mut d, 66.0, 40.0);
    d.finish()
}

fn legend(d: &mut Drawing, x: f64, y: f64) {
    for (k, name) in CHANNELS.iter().enumerate() {
        let y = y + 16.0 * k as f64;
        d.mark(k, x, y, name);
        d.text("tick", x + 9.0, y + 3.5, "start", name);
    }
}

/// A relative residual and its standard error, percent; none where nothing was measured.
pub(super) fn residual_percent(c: &ConfigurationResult, channel: usize) -> Option<(f64, f64)> {
    let se = c.measured_se[channel]?.hypot(c.rendered_se[channel]);
    Some((
        100.0 * c.relative_residual[channel]?,
        100.0 * c.weight.sqrt() * se,
    ))
}

/// Relative residual per configuration and channel, with one standard error of measurement and render together.
pub(super) fn residuals(result: &FitResult) -> String {
    let mut d = Drawing::new(WIDTH, 300.0, "Relative residual per configuration");
    let n = result.configs.len() as f64;
    let reach = result
        .configs
        .iter()
        .flat_map(|c| (0..3).filter_map(|k| residual_percent(c, k)))
        .map(|(value, se)| value.abs() + se)
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
    let band = (right - left) / n;
    for (i, c) in result.configs.iter().enumerate() {
        let start = left + band * (i as f64 + 0.14);
        let width = band * 0.72 / 3.0;
        for k in 0..3 {
            let Some((value, se)) = residual_percent(c, k) else {
                continue;
            };
            let at = start + width * k as f64;
            let (top, bottom) = (y.at(value.max(0.0)), y.at(value.min(0.0)));
            d.rectangle(
                &format!("fill c{k}"),
                at,
                top,
                width * 0.9,
                (bottom - top).max(0.6),
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
        let id = c.configuration.id.to_string();
        if n <= 24.0 || i % 4 == 0 {
            d.text("tick", left + band * (i as f64 + 0.5), 272.0, "middle", &id);
        }
    }
    d.line("axis", left, y.at(0.0), right, y.at(0.0));
    d.text(
        "name",
        0.5 * (left + right),
        291.0,
        "middle",
        "configuration",
    );
    d.text(
        "name",
        left,
        15.0,
        "start",
        "rendered − measured, % of brightness",
    );
    d.finish()
}

/// Weighted rms residual of every iteration's fresh pair, the Monte Carlo part of the error, and the final check.
pub(super) fn convergence(result: &FitResult) -> String {
    let mut d = Drawing::new(WIDTH, 300.0, "Residual against camera paths");
    let o = &result.objective;
    let total = result.time.paths as f64;
    let (low, high) = log_range(
        result
            .history
            .iter()
            .flat_map(|h| [h.weighted_rms_percent, h.monte_carlo_percent])
            .chain([o.weighted_rms_percent, o.fit_monte_carlo_percent]),
    );
    let low = low.max(high / 1e4);
    let first = result.history.first().map_or(1.0, |h| h.total_paths as f64);
    let x = Axis {
        scale: Scale::Logarithmic,
        low: first / 1.2,
        high: total * 1.2,
        from: 46.0,
        to: WIDTH - 10.0,
    };
    let y = Axis {
        scale: Scale::Logarithmic,
        low,
        high,
        from: 250.0,
        to: 24.0,
    };
    d.axes(&x, &y, "camera paths so far", "weighted rms residual, %");
    let curve = |value: &dyn Fn(usize) -> f64| -> Vec<(f64, f64)> {
        (0..result.history.len())
            .map(|i| (x.at(result.history[i].total_paths as f64), y.at(value(i))))
            .collect()
    };
    d.polyline("noise", &curve(&|i| result.history[i].monte_carlo_percent));
    d.polyline("curve", &curve(&|i| result.history[i].weighted_rms_percent));
    for h in &result.history {
        let at = x.at(h.total_paths as f64);
        let (value, se) = (h.weighted_rms_percent, h.weighted_rms_se_percent);
        d.line("whisker", at, y.at(value - se), at, y.at(value + se));
        let title = format!(
            "{} % ± {} after {:.1} s",
            number(value, 3),
            number(se, 2),
            h.wall_s
        );
        d.disk(
            if h.accepted { "dot" } else { "hollow" },
            at,
            y.at(value),
            3.4,
            &title,
        );
    }
    let (value, se) = (o.weighted_rms_percent, o.weighted_rms_se_percent);
    d.line(
        "whisker",
        x.at(total),
        y.at(value - se),
        x.at(total),
        y.at(value + se),
    );
    d.disk(
        "final",
        x.at(total),
        y.at(value),
        4.6,
        &format!("final check: {} %", number(value, 3)),
    );
    d.finish()
}

/// Every parameter between its bounds, with its intervals.
pub(super) fn parameters(result: &FitResult) -> String {
    let row = 30.0;
    let height = 24.0 + row * result.uncertainty.len() as f64;
    let mut d = Drawing::new(WIDTH, height, "Parameters between their bounds");
    let longest = result.uncertainty.iter().map(|p| p.name.len()).max();
    let names = 70.0_f64.max(LETTER * longest.unwrap_or(0) as f64);
    for (i, p) in result.uncertainty.iter().enumerate() {
        let truth = result.truth.as_ref().and_then(|t| t.values.get(i).copied());
        parameter(&mut d, p, truth, [names, 20.0 + row * i as f64]);
    }
    d.finish()
}

/// Width of a letter of a name.
const LETTER: f64 = 7.2;

/// One row at height y; the name ends at `names`.
fn parameter(d: &mut Drawing, p: &ParameterResult, truth: Option<f64>, [names, y]: [f64; 2]) {
    let wide = p.lower_bound > 0.0 && p.unit != "1";
    let scale = if wide {
        Scale::Logarithmic
    } else {
        Scale::Linear
    };
    let x = Axis {
        scale,
        low: p.lower_bound,
        high: p.upper_bound,
        from: names + 44.0,
        to: WIDTH - 104.0,
    };
    let unit = if p.unit == "1" { "" } else { "°" };
    d.text("label", names, y + 4.0, "end", &p.name);
    d.text(
        "tick",
        names + 38.0,
        y + 3.5,
        "end",
        &trimmed(p.lower_bound),
    );
    d.text(
        "tick",
        x.to + 5.0,
        y + 3.5,
        "start",
        &trimmed(p.upper_bound),
    );
    d.line("track", x.from, y, x.to, y);
    d.line(
        "outer",
        x.at(p.interval_95[0]),
        y,
        x.at(p.interval_95[1]),
        y,
    );
    d.line(
        "inner",
        x.at(p.interval_68[0]),
        y,
        x.at(p.interval_68[1]),
        y,
    );
    d.line("start", x.at(p.initial), y - 7.0, x.at(p.initial), y + 7.0);
    if let Some(truth) = truth {
        let at = x.at(truth);
        d.raw(&format!(
            "<path class=\"truth\" d=\"M{at:.1} {:.1}l5 5l-5 5l-5 -5z\"><title>truth {}</title></path>",
            y - 5.0,
            number(truth, 4)
        ));
    }
    let title = format!("{}: {}{unit}", p.name, number(p.value, 4));
    d.disk("dot", x.at(p.value), y, 4.0, &title);
    d.text(
        "value",
        WIDTH - 4.0,
        y + 4.0,
        "end",
        &format!("{}{unit}", number(p.value, 3)),
    );
}

/// A bound without trailing zeros.
fn trimmed(x: f64) -> String {
    let text = format!("{x:.3}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}
