//! The HTML page of a measurement: every number with its standard error, where the errors come from, what the camera saw,
//! and what the numbers rest on.
//!
//! Numbers come from the [`MeasurementRecord`], pictures and curves from [`Looks`]. Plans of more than [`MOST_POSES`]
//! configurations get a map per exitant direction instead of pictures per pose.

mod charts;
mod maps;
mod poses;
mod tables;

use super::html::{base64, escape};
use super::page::{STYLE, document, wide};
use crate::session::MeasurementRecord;
use std::collections::BTreeMap;

/// Up to so many configurations each has its pictures on the page.
pub const MOST_POSES: usize = 64;

/// A picture with an outline drawn over it.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Look {
    /// The PNG file.
    pub png: Vec<u8>,
    /// Width and height in the units of `outline`.
    pub size: [f64; 2],
    /// Corners of a closed line; none: no line.
    pub outline: Vec<[f64; 2]>,
    /// Text under it.
    pub caption: String,
}

/// How often raw values occur.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Histogram {
    /// Raw value at the left edge of the first bin and at the right edge of the last.
    pub range: [f64; 2],
    /// Values per bin, r, g, b.
    pub counts: Vec<[u64; 3]>,
    /// Black level, r, g, b.
    pub black: [f64; 3],
    /// From this raw value on an exposure is not used.
    pub clip: f64,
    /// Text under it.
    pub caption: String,
}

/// Deviation from proportionality at one exposure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LinearityPoint {
    /// 0 red, 1 green, 2 blue.
    pub channel: usize,
    /// Signal over full scale.
    pub level: f64,
    /// Relative deviation left after correction.
    pub residual: f64,
    /// Relative standard error of the signal.
    pub residual_se: f64,
}

/// Variance against signal.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Transfer {
    /// Channel, signal, variance, its standard error; raw values.
    pub points: Vec<(usize, [f64; 3])>,
    /// Variance per signal, r, g, b.
    pub slope: [f64; 3],
    /// Standard deviation without light.
    pub read_noise: f64,
    /// Where it comes from.
    pub source: String,
}

/// What `measurements.json` does not hold.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Looks {
    /// A frame of each configuration.
    pub frames: BTreeMap<u32, Look>,
    /// The merged crop of each configuration.
    pub crops: BTreeMap<u32, Look>,
    /// Raw values in the crop of that frame.
    pub histograms: BTreeMap<u32, Histogram>,
    /// How raw values grow with light, from a calibration.
    pub linearity: Vec<LinearityPoint>,
    /// How raw values scatter.
    pub transfer: Option<Transfer>,
    /// The flat field.
    pub flat: Option<Look>,
}

/// The page; one file that loads nothing.
pub fn measurement_page(record: &MeasurementRecord, looks: &Looks) -> String {
    let title = format!("Measurement {}", record.session.name);
    let mut body = format!("<h1>{}</h1>\n", escape(&title));
    body += &headline(record);
    body += &remarks(record);
    let many = record.configurations.len() > MOST_POSES;
    if many {
        body += &maps::section(record);
    }
    body += &wide(
        "Intensities",
        &folded(many, "all numbers", &tables::intensities(record)),
    );
    body += &wide("Where the errors come from", &tables::budget(record, many));
    body += &charts::section(record, looks);
    if !many {
        body += &poses::section(record, looks);
    }
    body += &wide("What it rests on", &tables::provenance(record));
    document(&title, &format!("{STYLE}{OWN_STYLE}"), &body)
}

fn headline(record: &MeasurementRecord) -> String {
    let mut html = String::new();
    if record.synthetic {
        html += "<p class=\"banner\"><strong>SYNTHETIC</strong>: the frames come from a virtual camera; no camera saw any cloth.</p>\n";
    }
    let planned = record.configurations.len();
    let measured = record.configurations.iter().filter(|c| c.mean.is_some());
    let numbers = measured
        .clone()
        .flat_map(|c| c.mean.into_iter().flatten().flatten());
    let (measured, numbers) = (measured.count(), numbers.count());
    html += &format!(
        "<p class=\"lead\"><strong>{measured} of {planned}</strong> configurations measured: {} mean intensities with their standard errors.</p>\n\
         <p class=\"soft\">{} ({}). {}; channels: {}.</p>\n",
        numbers,
        escape(&record.quantity.replace('_', " ")),
        escape(&record.definition),
        unit_words(&record.unit),
        escape(&record.rgb_space)
    );
    html
}

fn unit_words(unit: &str) -> String {
    match unit {
        "1" => "No unit (1)".to_owned(),
        other => format!("Unit {}", escape(other)),
    }
}

/// Warnings, and messages of configurations.
fn remarks(record: &MeasurementRecord) -> String {
    let messages = record
        .configurations
        .iter()
        .filter_map(|c| c.message.as_ref());
    let items: String = record
        .warnings
        .iter()
        .chain(messages)
        .map(|m| format!("<li>{}</li>\n", escape(m)))
        .collect();
    if items.is_empty() {
        return "<p class=\"banner good\">No warnings.</p>\n".to_owned();
    }
    format!("<div class=\"banner\"><strong>Warnings</strong>\n<ul>\n{items}</ul>\n</div>\n")
}

/// Behind a click when it is long.
fn folded(fold: bool, summary: &str, html: &str) -> String {
    if !fold {
        return html.to_owned();
    }
    let summary = escape(summary);
    format!("<details>\n<summary>{summary}</summary>\n{html}</details>\n")
}

/// The picture with its outline, as a figure.
fn figure(look: &Look) -> String {
    let [width, height] = look.size;
    let points: Vec<String> = look
        .outline
        .iter()
        .map(|[x, y]| format!("{x:.2},{y:.2}"))
        .collect();
    let outline = if points.is_empty() {
        String::new()
    } else {
        format!(
            "<polygon class=\"outline\" points=\"{}\"/>",
            points.join(" ")
        )
    };
    let caption = escape(&look.caption);
    format!(
        "<figure><svg class=\"look\" viewBox=\"0 0 {width} {height}\" role=\"img\" aria-label=\"{caption}\">\
         <image width=\"{width}\" height=\"{height}\" href=\"data:image/png;base64,{}\"/>{outline}</svg>\
         <figcaption>{caption}</figcaption></figure>\n",
        base64(&look.png)
    )
}

/// A mean with its standard error: two significant digits of the error.
fn plus_minus(mean: Option<f64>, standard_error: Option<f64>) -> String {
    let (Some(mean), Some(standard_error)) = (mean, standard_error) else {
        return "not measured".to_owned();
    };
    let decimals = if standard_error > 0.0 {
        (1.0 - standard_error.log10().floor()).clamp(0.0, 9.0) as usize
    } else {
        6
    };
    format!("{mean:.decimals$} ± {standard_error:.decimals$}")
}

const OWN_STYLE: &str = "\
.poses{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,440px),1fr));gap:16px}
.pose{display:grid;grid-template-columns:repeat(auto-fit,minmax(150px,1fr));gap:10px;align-items:start;align-content:start}
.pose h3,.pose p{grid-column:1/-1;margin:0}
.pose p{font-size:.9rem}
figcaption{overflow-wrap:anywhere}
h3{font-size:1rem}
.look{border-radius:6px;background:#000}
.look image{image-rendering:auto}
.outline{fill:none;stroke:#ffd54a;stroke-width:2;vector-effect:non-scaling-stroke}
.limit{stroke:var(--ink);stroke-dasharray:3 3;stroke-opacity:.7}
.black{stroke-opacity:.6;stroke-dasharray:1.5 2.5}
.hist{fill:none;stroke-width:1.4;stroke-linejoin:round}
.hist.c0{stroke:var(--r)}.hist.c1{stroke:var(--g)}.hist.c2{stroke:var(--b)}
.share{display:flex;height:12px;border-radius:3px;overflow:hidden;min-width:120px}
.share i{display:block;height:100%}
.key{display:flex;flex-wrap:wrap;gap:4px 14px;font-size:.86rem;margin:.3em 0 .7em}
.key i{display:inline-block;width:12px;height:12px;border-radius:3px;margin-right:5px;vertical-align:-1px}
.s0{background:#4477aa}.s1{background:#ee6677}.s2{background:#228833}.s3{background:#ccbb44}.s4{background:#66ccee}
.s5{background:#aa3377}.s6{background:#ee7733}.s7{background:#009988}.s8{background:#997700}.s9{background:#9988cc}
.s10{background:#bb5566}.s11{background:#77aadd}.s12{background:#44bb99}.s13{background:#888888}
.maps{display:grid;grid-template-columns:repeat(auto-fill,minmax(220px,1fr));gap:12px}
.rim{fill:none;stroke:var(--line)}
.bad td{background:var(--warnback)}
.course{fill:none;stroke-width:1.4}
.course.c0{stroke:var(--r)}.course.c1{stroke:var(--g)}.course.c2{stroke:var(--b)}
pre{overflow-x:auto;font-size:.78rem}
";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_have_two_digits() {
        assert_eq!(
            plus_minus(Some(0.123_456), Some(0.001_23)),
            "0.1235 ± 0.0012"
        );
        assert_eq!(plus_minus(Some(12.3), Some(4.56)), "12.3 ± 4.6");
        assert_eq!(plus_minus(Some(1234.5), Some(210.0)), "1234 ± 210");
        assert_eq!(plus_minus(Some(0.5), Some(0.0)), "0.500000 ± 0.000000");
        assert_eq!(plus_minus(None, None), "not measured");
    }
}
