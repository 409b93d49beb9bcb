//! The tables of a measurement's page.

use super::{folded, plus_minus};
use crate::math::PolarDirection;
use crate::report::html::{escape, number};
use crate::session::{MeasurementRecord, RecordedConfiguration};
use std::collections::BTreeMap;

const CHANNELS: [&str; 3] = ["red", "green", "blue"];

/// Polar angle / azimuth in degrees.
pub(super) fn angles(d: PolarDirection) -> String {
    let degrees = |a: f64| {
        let text = format!("{:.2}", a.to_degrees());
        let text = text.trim_end_matches('0').trim_end_matches('.');
        if text == "-0" {
            "0".to_owned()
        } else {
            text.to_owned()
        }
    };
    format!("{}° / {}°", degrees(d.theta), degrees(d.phi))
}

pub(super) fn turn(c: &RecordedConfiguration) -> String {
    let text = format!("{:.2}", c.configuration.rotation.to_degrees());
    format!("{}°", text.trim_end_matches('0').trim_end_matches('.'))
}

/// The sources of the budget, by decreasing sum of shares of variance; at most what the palette can tell apart comes first.
fn sources(record: &MeasurementRecord) -> Vec<String> {
    let mut sums: BTreeMap<&String, f64> = BTreeMap::new();
    for c in &record.configurations {
        let all = (0..3).map(|k| total_variance(c, k)).collect::<Vec<_>>();
        for (source, parts) in &c.budget {
            for k in 0..3 {
                if all[k] > 0.0 {
                    *sums.entry(source).or_default() += parts[k].powi(2) / all[k];
                }
            }
        }
    }
    let mut list: Vec<(&String, f64)> = sums.into_iter().collect();
    list.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(b.0)));
    list.into_iter().map(|(s, _)| s.clone()).collect()
}

fn total_variance(c: &RecordedConfiguration, channel: usize) -> f64 {
    c.budget.values().map(|p| p[channel].powi(2)).sum()
}

/// Percent with its digits.
fn percent(fraction: f64) -> String {
    format!("{} %", number(100.0 * fraction, 2))
}

/// All means with their standard errors.
pub(super) fn intensities(record: &MeasurementRecord) -> String {
    let mut html = String::from(
        "<p class=\"soft\">Mean ± standard error (one standard deviation); polar angle / azimuth in degrees, laboratory frame.</p>\n\
         <div class=\"scroll\"><table>\n<tr><th>config</th><th>light</th><th>camera</th><th>turn</th>\
         <th>red</th><th>green</th><th>blue</th><th>error up to</th><th>exposures, ms</th><th>pixels</th></tr>\n",
    );
    for c in &record.configurations {
        let class = if c.condition == "good" {
            ""
        } else {
            " class=\"bad\""
        };
        let pose = &c.configuration;
        html += &format!(
            "<tr{class}><td>{}</td><td>{}</td><td>{}</td><td>{}</td>",
            pose.id,
            angles(pose.light),
            angles(pose.camera),
            turn(c)
        );
        html += &match (c.mean, c.standard_error) {
            (Some(mean), Some(se)) => {
                let cells: String = (0..3)
                    .map(|k| format!("<td>{}</td>", plus_minus(mean[k], se[k])))
                    .collect();
                let relative = (0..3).filter_map(|k| Some(se[k]? / mean[k]?));
                let worst = relative.fold(0.0, f64::max);
                format!("{cells}<td>{}</td>", percent(worst))
            }
            _ => {
                let words = escape(&c.condition.replace('_', " "));
                format!("<td colspan=\"4\">not measured: {words}</td>")
            }
        };
        let times: Vec<String> = c.exposures_ms.iter().map(f64::to_string).collect();
        html += &format!(
            "<td>{}</td><td>{}</td></tr>\n",
            times.join(", "),
            number(c.area_px, 4)
        );
    }
    html + "</table></div>\n"
}

/// Which color a source has.
fn key(sources: &[String]) -> String {
    let items: String = sources
        .iter()
        .enumerate()
        .map(|(i, s)| format!("<span><i class=\"s{}\"></i>{}</span>", i % 14, escape(s)))
        .collect();
    format!("<div class=\"key\">{items}</div>\n")
}

/// A bar of shares that sum to one.
fn bar(sources: &[String], share: impl Fn(&str) -> f64) -> String {
    let parts: String = sources
        .iter()
        .enumerate()
        .map(|(i, s)| (i, s, share(s)))
        .filter(|(_, _, x)| *x > 0.0)
        .map(|(i, s, x)| {
            format!(
                "<i class=\"s{}\" style=\"width:{:.2}%\" title=\"{} {}\"></i>",
                i % 14,
                100.0 * x,
                escape(s),
                percent(x)
            )
        })
        .collect();
    format!("<span class=\"share\">{parts}</span>")
}

/// Share of variance by source, all channels of some configurations together.
fn mean_share(configurations: &[&RecordedConfiguration], source: &str) -> f64 {
    let mut sum = 0.0;
    let mut n = 0.0;
    for c in configurations {
        for k in 0..3 {
            let all = total_variance(c, k);
            if all > 0.0 {
                sum += c.budget.get(source).map_or(0.0, |p| p[k].powi(2)) / all;
                n += 1.0;
            }
        }
    }
    if n > 0.0 { sum / n } else { 0.0 }
}

/// The error budget: a bar per configuration and channel, and every part in numbers.
pub(super) fn budget(record: &MeasurementRecord, many: bool) -> String {
    let sources = sources(record);
    let mut html = String::from(
        "<p class=\"soft\">Bars: share of the variance by source. Numbers: one standard deviation, percent of the mean.</p>\n",
    );
    html += &key(&sources);
    if many {
        let all: Vec<&RecordedConfiguration> = record.configurations.iter().collect();
        html += "<p>All configurations together:</p>\n";
        html += &bar(&sources, |s| mean_share(&all, s));
        html += "\n";
    }
    html + &folded(many, "every configuration", &budget_table(record, &sources))
}

fn budget_table(record: &MeasurementRecord, sources: &[String]) -> String {
    let mut html = String::from(
        "<div class=\"scroll\"><table>\n<tr><th>config</th><th class=\"left\">channel</th><th>total</th><th class=\"left\">shares</th>",
    );
    for s in sources {
        html += &format!("<th>{}</th>", escape(s));
    }
    html += "</tr>\n";
    for c in &record.configurations {
        let (Some(mean), Some(se)) = (c.mean, c.standard_error) else {
            continue;
        };
        for k in 0..3 {
            let (Some(mean), Some(se)) = (mean[k], se[k]) else {
                continue;
            };
            let all = total_variance(c, k);
            let share = |s: &str| {
                let part = c.budget.get(s).map_or(0.0, |p| p[k].powi(2));
                if all > 0.0 { part / all } else { 0.0 }
            };
            html += &format!(
                "<tr><td>{}</td><td class=\"left\">{}</td><td>{}</td><td>{}</td>",
                c.configuration.id,
                CHANNELS[k],
                percent(se / mean),
                bar(sources, share)
            );
            for s in sources {
                let part = c.budget.get(s).map_or(0.0, |p| p[k]);
                html += &format!("<td>{}</td>", percent(part / mean));
            }
            html += "</tr>\n";
        }
    }
    html + "</table></div>\n"
}

/// Calibrations, options and all else.
pub(super) fn provenance(record: &MeasurementRecord) -> String {
    let mut html = String::new();
    if record.calibrations.is_empty() {
        html += "<p>No calibration files: black level, noise, vignetting and scale are from the session's own frames.</p>\n";
    } else {
        html += "<div class=\"scroll\"><table>\n<tr><th>calibration</th><th class=\"left\">file</th><th class=\"left\">of</th>\
                 <th class=\"left\">SHA-256</th></tr>\n";
        for c in &record.calibrations {
            let flag = if c.synthetic { ", synthetic" } else { "" };
            html += &format!(
                "<tr><td>{}{flag}</td><td class=\"left\">{}</td><td class=\"left\">{}</td><td class=\"left\"><code>{}</code></td></tr>\n",
                escape(&c.kind),
                escape(&c.file),
                escape(&c.date_utc),
                escape(&c.sha256)
            );
        }
        html += "</table></div>\n";
    }
    let s = &record.session;
    let mut rows = vec![
        ("session".to_owned(), s.name.clone()),
        ("started".to_owned(), s.started_utc.clone()),
        ("rig".to_owned(), s.rig.clone()),
        ("camera".to_owned(), s.camera.clone()),
        ("note".to_owned(), s.note.clone()),
        ("journal SHA-256".to_owned(), s.journal_sha256.clone()),
        ("program".to_owned(), record.program.clone()),
    ];
    let options = record.options.iter();
    rows.extend(options.map(|(name, value)| (name.replace('_', " "), value.to_string())));
    html += "<table class=\"facts\">\n";
    for (name, value) in rows.iter().filter(|(_, value)| !value.is_empty()) {
        html += &format!(
            "<tr><td>{}</td><td>{}</td></tr>\n",
            escape(name),
            escape(value)
        );
    }
    html += "</table>\n";
    if let Ok(text) = serde_json::to_string_pretty(&record.details)
        && !record.details.is_empty()
    {
        let text = format!("<pre>{}</pre>\n", escape(&text));
        html += &folded(
            true,
            "white, noise and the rest, as in measurements.json",
            &text,
        );
    }
    html
}
