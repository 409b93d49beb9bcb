//! Where the residuals of a fit lie: goodness, patterns, and a map of configurations by channels.

use super::charts::{CHANNELS, residual_percent};
use super::html::{escape, number};
use crate::fit::{ConfigurationResult, FitResult};
use crate::session::Configuration;

/// More configurations than these are not all shown, only those with the largest residuals.
const MOST_ROWS: usize = 48;

pub(super) const STYLE: &str = "\
.heat{table-layout:fixed;border-collapse:separate;border-spacing:2px;max-width:720px}
.heat td,.heat th{border:0;padding:.3em .2em;text-align:center;font-size:.95rem;font-variant-numeric:tabular-nums}
.heat th:first-child{text-align:left;width:44%;font-weight:400;font-size:.8rem;white-space:normal}
.heat td{border-radius:4px}
.heat .sure{font-weight:700;text-decoration:underline}
.ramp{display:flex;max-width:720px;font-size:.8rem;color:var(--soft);justify-content:space-between;margin:.2em 0 .6em}
.ramp span{padding:.15em .6em;border-radius:4px;color:var(--ink)}
";

/// A background that grows with |value| up to 1: blue below, orange above. Told apart by every common color vision.
pub(super) fn tint(value: f64) -> String {
    let color = if value < 0.0 {
        "70,130,220"
    } else {
        "225,125,40"
    };
    format!(
        "background:rgba({color},{:.2})",
        value.abs().min(1.0) * 0.65
    )
}

/// The section's content.
pub(super) fn section(result: &FitResult) -> String {
    let mut html = String::new();
    if let Some(goodness) = &result.goodness {
        html += &format!(
            "<p>{}.</p>\n<p class=\"soft\">Sum of squared residuals over their error variances: {}, where a right model gives {} on \
             average; {} degrees of freedom (estimated from what the fit absorbs).</p>\n",
            escape(&sentence(&goodness.sentence)),
            number(goodness.statistic, 3),
            number(goodness.expected, 3),
            number(goodness.degrees_of_freedom, 2)
        );
    }
    let significant: Vec<String> = result
        .patterns
        .iter()
        .filter(|p| p.significant)
        .map(|p| format!("<li>{}.</li>\n", escape(&sentence(&p.sentence))))
        .collect();
    if !significant.is_empty() {
        html += &format!("<ul>\n{}</ul>\n", significant.concat());
    } else if !result.patterns.is_empty() {
        html += "<p>No group of configurations and no channel stands out.</p>\n";
    }
    html += &map(result);
    html + &patterns(result)
}

fn map(result: &FitResult) -> String {
    let largest = |c: &ConfigurationResult| {
        (c.relative_residual.iter().flatten()).fold(0.0_f64, |m, r| m.max(r.abs()))
    };
    let reach = result.configs.iter().map(largest).fold(0.02, f64::max);
    let mut shown: Vec<&ConfigurationResult> = result.configs.iter().collect();
    let mut note = String::new();
    if shown.len() > MOST_ROWS {
        shown.sort_by(|a, b| largest(b).total_cmp(&largest(a)));
        shown.truncate(MOST_ROWS);
        note = format!("The {MOST_ROWS} configurations with the largest residuals. ");
    }
    let percent = number(100.0 * reach, 2);
    let mut html = format!(
        "<p class=\"soft\">{note}Rendered minus measured, percent of the configuration's brightness. Underlined: more than three \
         standard errors. Apart: the angle between the azimuths of lamp and camera; 180° is the mirror side, 0° the lamp's \
         own.</p>\n<div class=\"ramp\"><span style=\"{}\">−{percent} %: rendered too dark</span>\
         <span style=\"{}\">+{percent} %: too bright</span></div>\n<table class=\"heat\">\n<tr><th>configuration</th>",
        tint(-1.0),
        tint(1.0)
    );
    for name in CHANNELS {
        html += &format!("<th>{name}</th>");
    }
    html += "</tr>\n";
    for c in shown {
        let pose = &c.configuration;
        html += &format!(
            "<tr><th>{}: lamp {:.0}°, camera {:.0}°, {:.0}° apart, turn {:.0}°</th>",
            pose.id,
            pose.light.theta.to_degrees(),
            pose.camera.theta.to_degrees(),
            apart_deg(pose),
            pose.rotation.to_degrees()
        );
        for k in 0..3 {
            let Some((r, se)) = residual_percent(c, k) else {
                html += "<td title=\"not measured\">–</td>";
                continue;
            };
            let class = if r.abs() > 3.0 * se {
                " class=\"sure\""
            } else {
                ""
            };
            html += &format!(
                "<td{class} style=\"{}\" title=\"{} ± {} %\">{}</td>",
                tint(0.01 * r / reach),
                signed(r),
                number(se, 2),
                signed(r)
            );
        }
        html += "</tr>\n";
    }
    html + "</table>\n"
}

/// The angle between the azimuths of lamp and camera, 0 to 180 degrees.
fn apart_deg(pose: &Configuration) -> f64 {
    let turn = (pose.light.phi - pose.camera.phi).to_degrees();
    let turn = turn.rem_euclid(360.0);
    turn.min(360.0 - turn)
}

fn patterns(result: &FitResult) -> String {
    if result.patterns.is_empty() {
        return String::new();
    }
    let mut html = String::from(
        "<details>\n<summary>all groups looked at</summary>\n<div class=\"scroll\"><table>\n<tr><th>group</th><th>numbers</th>\
         <th>mean residual, %</th><th>by luck in one of</th></tr>\n",
    );
    for p in &result.patterns {
        let chance = if p.probability > 1e-6 {
            format!("{:.0}", 1.0 / p.probability)
        } else {
            "more than a million".to_owned()
        };
        let (open, close) = if p.significant {
            ("<strong>", "</strong>")
        } else {
            ("", "")
        };
        html += &format!(
            "<tr><td>{open}{}{close}</td><td>{}</td><td>{} ± {}</td><td>{chance}</td></tr>\n",
            escape(&p.name),
            p.numbers,
            signed(p.mean_percent),
            number(p.se_percent, 2)
        );
    }
    html + "</table></div>\n<p class=\"soft\">A group is called out when its mean would be the most striking of all these in less \
            than 1 of 100 fits of a right model. A model that fails in one place is bent by the fit elsewhere too.</p>\n</details>\n"
}

/// With its sign and at most one decimal.
fn signed(x: f64) -> String {
    let text = if x.abs() >= 9.95 {
        format!("{x:+.0}")
    } else {
        format!("{x:+.1}")
    };
    text.replace('-', "−")
}

/// A sentence of `fit.json` as the page writes it.
pub(super) fn sentence(text: &str) -> String {
    let text = text.replace("+-", "±");
    let mut letters = text.chars();
    letters.next().map_or_else(String::new, |first| {
        first.to_uppercase().collect::<String>() + letters.as_str()
    })
}
