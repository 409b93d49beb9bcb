//! The page.

use super::charts;
use super::html::{base64, escape, number};
use super::residual_map::{self, tint};
use crate::base::{Context, Error, Result};
use crate::fit::{FitResult, Verdict};

/// What the page says besides the fit itself.
#[derive(Debug, Clone, Default)]
pub struct Provenance {
    /// Heading; `Fit of <fabric>` when none.
    pub title: Option<String>,
    /// More rows for the table of how the fit was made: name and value.
    pub facts: Vec<(String, String)>,
    /// Sections put before that table.
    pub sections: Vec<Section>,
}

/// An extra section, made by the caller.
#[derive(Debug, Clone, Default)]
pub struct Section {
    /// Heading.
    pub title: String,
    /// Paragraphs of plain text.
    pub paragraphs: Vec<String>,
    /// A table under them.
    pub table: Option<Table>,
    /// Pictures under that.
    pub pictures: Vec<Picture>,
}

/// A table of plain text.
#[derive(Debug, Clone, Default)]
pub struct Table {
    /// Column headings.
    pub head: Vec<String>,
    /// Rows as long as the head.
    pub rows: Vec<Vec<String>>,
}

/// A picture that travels inside the page.
#[derive(Debug, Clone)]
pub struct Picture {
    /// Text under it.
    pub caption: String,
    /// The PNG file.
    pub png: Vec<u8>,
}

impl Picture {
    /// A picture of 8-bit sRGB pixels, row by row from the top, three bytes each.
    ///
    /// # Errors
    /// When the number of bytes is not `3 width height`, or a side is zero.
    pub fn from_rgb(
        caption: impl Into<String>,
        width: u32,
        height: u32,
        pixels: &[u8],
    ) -> Result<Self> {
        let image = image::RgbImage::from_raw(width, height, pixels.to_vec())
            .filter(|i| i.as_raw().len() == pixels.len() && width * height > 0)
            .ok_or_else(|| {
                Error::new(format!(
                    "picture of {width} x {height} pixels: {} bytes, expected 3 for each",
                    pixels.len()
                ))
            })?;
        let mut png = std::io::Cursor::new(Vec::new());
        image
            .write_to(&mut png, image::ImageFormat::Png)
            .context(|| "the picture cannot be encoded")?;
        Ok(Self {
            caption: caption.into(),
            png: png.into_inner(),
        })
    }
}

pub(super) const STYLE: &str = "\
:root{color-scheme:light dark;--paper:#fbfaf8;--ink:#1f2328;--soft:#646b73;--line:#dcd9d3;--panel:#fff;--accent:#2f5d8a;
--r:#c8342b;--g:#2b8a3e;--b:#2f62d9;--warn:#8a4b00;--warnback:#fff1d6;--good:#20653a;--goodback:#e4f4e8}
@media(prefers-color-scheme:dark){:root{--paper:#16181b;--ink:#e4e6e8;--soft:#9aa2ab;--line:#34383d;--panel:#1d2024;
--accent:#7fb2e5;--r:#ff7b70;--g:#5fd07c;--b:#86a8ff;--warn:#ffc873;--warnback:#3a2c12;--good:#8fdca6;--goodback:#17301f}}
*{box-sizing:border-box}
body{margin:0;background:var(--paper);color:var(--ink);font:16px/1.5 system-ui,sans-serif}
main{max-width:1080px;margin:0 auto;padding:20px 16px 48px}
h1{font-size:1.5rem;line-height:1.25;margin:.2em 0 .5em;overflow-wrap:anywhere}
h2{font-size:1.1rem;margin:0 0 .5em}
p{margin:.4em 0}
.lead{font-size:1.12rem}
.soft,figcaption{color:var(--soft);font-size:.88rem}
.banner{background:var(--warnback);color:var(--warn);padding:.6em .9em;border-radius:8px;margin:.6em 0}
.good{background:var(--goodback);color:var(--good)}
.grid{display:grid;grid-template-columns:repeat(auto-fit,minmax(min(100%,400px),1fr));gap:16px;margin:16px 0}
section{background:var(--panel);border:1px solid var(--line);border-radius:10px;padding:14px 16px;min-width:0}
.wide{margin:16px 0}
svg{width:100%;height:auto;display:block}
.scroll{overflow-x:auto}
table{border-collapse:collapse;font-size:.86rem;width:100%}
th,td{padding:.25em .55em;text-align:right;white-space:nowrap;border-bottom:1px solid var(--line)}
th{font-weight:600;color:var(--soft)}
th:first-child,td:first-child,.left{text-align:left}
.facts td{white-space:normal;text-align:left;overflow-wrap:anywhere;vertical-align:top}
.facts td:first-child{white-space:nowrap;color:var(--soft)}
.dense td,.dense th{padding:.2em .35em;text-align:center;font-size:.78rem}
.dense th:first-child{text-align:left}
code{font:.86rem ui-monospace,monospace;overflow-wrap:anywhere}
ul{margin:.3em 0;padding-left:1.2em}
.pictures{display:grid;grid-template-columns:repeat(auto-fill,minmax(120px,1fr));gap:10px}
figure{margin:0}figure img{width:100%;height:auto;border-radius:6px;display:block;image-rendering:auto}
summary{cursor:pointer;font-weight:600}
.tick,.name,.label,.value{font-size:11px;fill:var(--soft)}
.label,.value{fill:var(--ink);font-size:12px}
.grid-line,.grid line{stroke-width:1}
line.grid{stroke:var(--line);stroke-width:.7}
.frame{fill:none;stroke:var(--line)}
.identity{stroke:var(--soft);stroke-dasharray:4 4}
.axis{stroke:var(--soft)}
.m0{fill:var(--r)}.m1{fill:var(--g)}.m2{fill:var(--b)}
.m0,.m1,.m2{fill-opacity:.8}
.bar{stroke-width:1;stroke-opacity:.55}
.c0{stroke:var(--r)}.c1{stroke:var(--g)}.c2{stroke:var(--b)}
.fill{stroke:none;fill-opacity:.85}.fill.c0{fill:var(--r)}.fill.c1{fill:var(--g)}.fill.c2{fill:var(--b)}
.whisker{stroke:var(--ink);stroke-opacity:.6}
.curve{fill:none;stroke:var(--accent);stroke-width:1.6}
.noise{fill:none;stroke:var(--soft);stroke-dasharray:3 3;stroke-width:1.3}
.dot{fill:var(--accent)}.hollow{fill:var(--panel);stroke:var(--accent);stroke-width:1.4}
.final{fill:var(--ink)}
.track{stroke:var(--line);stroke-width:4;stroke-linecap:round}
.outer{stroke:var(--accent);stroke-opacity:.4;stroke-width:5}
.inner{stroke:var(--accent);stroke-opacity:.75;stroke-width:8}
.start{stroke:var(--soft);stroke-width:1.5}
.truth{fill:none;stroke:var(--r);stroke-width:1.6}
";

/// The whole page.
pub fn page(result: &FitResult, provenance: &Provenance) -> String {
    let title = provenance.title.clone().unwrap_or_else(|| {
        let fabric = if result.fabric.is_empty() {
            "a fabric"
        } else {
            &result.fabric
        };
        format!("Fit of {fabric}")
    });
    let mut body = format!("<h1>{}</h1>\n", escape(&title));
    body += &headline(result);
    body += "<div class=\"grid\">\n";
    body += &chart(
        "Measured and rendered",
        &charts::scatter(result),
        "On the dashed line render and measurement agree. Bars are one standard error.",
    );
    body += &chart(
        "Parameters between their bounds",
        &charts::parameters(result),
        &format!(
            "Dot: fitted. Thick bar: 68 % interval, thin bar: 95 %. Tick: start.{} Angles in degrees, on a logarithmic scale.",
            if result.truth.is_some() {
                " Diamond: truth."
            } else {
                ""
            }
        ),
    );
    body += &chart(
        "Residual by configuration",
        &charts::residuals(result),
        "Red, green and blue bars; whiskers are one standard error of measurement and render together.",
    );
    body += &chart(
        "Convergence",
        &charts::convergence(result),
        "Each dot is a fresh pair of independent renders; on the bottom edge where the unbiased estimate is not positive. \
         Hollow: a step taken back. Dashed: Monte Carlo part of the error. Black: the final check.",
    );
    body += "</div>\n";
    body += &wide("Where the residuals lie", &residual_map::section(result));
    body += &wide("Parameters", &parameter_table(result));
    body += &wide("Configurations", &configuration_table(result));
    body += &wide("Correlations", &correlation_table(result));
    for section in &provenance.sections {
        body += &extra(section);
    }
    body += &wide("How this was made", &facts(result, provenance));
    document(&title, &format!("{STYLE}{}", residual_map::STYLE), &body)
}

/// A whole file around the body's markup.
pub(super) fn document(title: &str, style: &str, body: &str) -> String {
    let title = escape(title);
    format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\n<title>{title}</title>\n\
         <style>\n{style}</style>\n</head>\n<body>\n<main>\n{body}</main>\n</body>\n</html>\n"
    )
}

/// A section as wide as the page.
pub(super) fn wide(title: &str, content: &str) -> String {
    format!(
        "<section class=\"wide\">\n<h2>{}</h2>\n{content}</section>\n",
        escape(title)
    )
}

/// A section with a drawing.
pub(super) fn chart(title: &str, svg: &str, caption: &str) -> String {
    format!(
        "<section>\n<h2>{}</h2>\n<figure>\n{svg}<figcaption>{}</figcaption>\n</figure>\n</section>\n",
        escape(title),
        escape(caption)
    )
}

fn headline(result: &FitResult) -> String {
    let o = &result.objective;
    let mut html = String::new();
    if result.synthetic == Some(true) {
        html += "<p class=\"banner\"><strong>SYNTHETIC</strong>: these measurements were rendered, not photographed.</p>\n";
    }
    html += &format!(
        "<p class=\"lead\">With the fitted parameters the renders differ from the {} measured intensities by \
         <strong>{} ± {} %</strong> (weighted rms); measurement errors alone would leave {} %.</p>\n",
        o.n,
        number(o.weighted_rms_percent, 2),
        number(o.weighted_rms_se_percent, 1),
        number(o.measurement_rms_percent, 2),
    );
    if let Some(truth) = &result.truth {
        let (rms, se) = (truth.weighted_rms_percent, truth.weighted_rms_se_percent);
        // Near zero the unbiased estimate may even be negative: then say what is surely not exceeded.
        let distance = if rms < 2.0 * se {
            format!("less than {} %", number(rms + 2.0 * se, 2))
        } else {
            format!("{} ± {} %", number(rms, 2), number(se, 1))
        };
        html += &format!(
            "<p class=\"lead\">Against the noise-free truth of this synthetic session they are \
             <strong>{distance}</strong> off.</p>\n"
        );
    }
    let (class, word) = if result.converged {
        ("banner good", "Converged")
    } else {
        ("banner", "Not converged")
    };
    html += &format!(
        "<p class=\"{class}\"><strong>{word}</strong>: {}.</p>\n",
        escape(&result.reason)
    );
    if o.misfit_percent > 0.0 {
        html += &format!(
            "<p>The residual is larger than measurement errors explain; the intervals below include a model error of {} %.</p>\n",
            number(o.misfit_percent, 2)
        );
    }
    let asides = [
        result.gain.as_ref().map(|g| g.sentence.clone()),
        result.outliers_in_words(),
    ];
    for aside in asides.into_iter().flatten() {
        html += &format!("<p>{}.</p>\n", escape(&residual_map::sentence(&aside)));
    }
    let doubtful: Vec<String> = result
        .uncertainty
        .iter()
        .filter(|p| p.verdict != Verdict::Determined)
        .map(|p| format!("<li>{}.</li>\n", escape(&p.sentence)))
        .collect();
    if doubtful.is_empty() {
        html += "<p>All parameters are determined.</p>\n";
    } else {
        html += &format!("<ul>\n{}</ul>\n", doubtful.concat());
    }
    html
}

fn parameter_table(result: &FitResult) -> String {
    let truth = result.truth.as_ref();
    let mut html = String::from(
        "<div class=\"scroll\"><table>\n<tr><th>name</th><th>value</th><th>68 % interval</th><th>95 % interval</th>\
         <th>bounds</th><th>start</th>",
    );
    if truth.is_some() {
        html += "<th>truth</th>";
    }
    html += "<th class=\"left\">verdict</th><th class=\"left\">interval by</th></tr>\n";
    for (i, p) in result.uncertainty.iter().enumerate() {
        let unit = if p.unit == "1" { "" } else { "°" };
        let range = |r: [f64; 2]| format!("{} – {}{unit}", number(r[0], 3), number(r[1], 3));
        html += &format!(
            "<tr><td>{}</td><td><strong>{}{unit}</strong></td><td>{}</td><td>{}</td><td>{}</td><td>{}{unit}</td>",
            escape(&p.name),
            number(p.value, 4),
            range(p.interval_68),
            range(p.interval_95),
            range([p.lower_bound, p.upper_bound]),
            number(p.initial, 3),
        );
        if let Some(truth) = truth {
            let value = truth
                .values
                .get(i)
                .map_or("-".to_owned(), |v| number(*v, 4));
            html += &format!("<td>{value}{unit}</td>");
        }
        html += &format!(
            "<td class=\"left\">{}</td><td class=\"left\">{}</td></tr>\n",
            p.verdict.words(),
            p.interval_method.word()
        );
    }
    html + "</table></div>\n<p class=\"soft\">Intervals stay inside the bounds. A parameter is called determined when its 95 % \
            interval takes at most a fifth of the range (logarithmic for angles, stretched at both ends for colors), not \
            determined when it takes more than half.</p>\n"
}

fn configuration_table(result: &FitResult) -> String {
    let reach = result
        .configs
        .iter()
        .flat_map(|c| c.relative_residual)
        .flatten()
        .fold(0.02_f64, |m, r| m.max(r.abs()));
    let mut html = String::from(
        "<p class=\"soft\">Residual of the final check, percent of the configuration's brightness; polar angle / azimuth in \
         degrees.</p>\n<div class=\"scroll\"><table>\n<tr><th>config</th><th>light</th><th>camera</th><th>turn</th>\
         <th>red</th><th>green</th><th>blue</th><th>measured r, g, b</th><th>rendered r, g, b</th></tr>\n",
    );
    for c in &result.configs {
        let angles = |d: crate::math::PolarDirection| {
            format!("{:.0}° / {:.0}°", d.theta.to_degrees(), d.phi.to_degrees())
        };
        let one = |x: Option<f64>| x.map_or("-".to_owned(), |x| number(x, 3));
        let list = |v: [Option<f64>; 3]| v.map(one).join(", ");
        let pose = &c.configuration;
        html += &format!(
            "<tr><td>{}</td><td>{}</td><td>{}</td><td>{:.0}°</td>",
            pose.id,
            angles(pose.light),
            angles(pose.camera),
            pose.rotation.to_degrees()
        );
        for k in 0..3 {
            html += &charts::residual_percent(c, k).map_or_else(
                || "<td>not measured</td>".to_owned(),
                |(r, se)| {
                    let style = tint(0.01 * r / reach);
                    format!("<td style=\"{style}\">{r:+.1} ± {se:.1}</td>")
                },
            );
        }
        html += &format!(
            "<td>{}</td><td>{}</td></tr>\n",
            list(c.measured),
            list(c.rendered.map(Some))
        );
    }
    html + "</table></div>\n"
}

fn correlation_table(result: &FitResult) -> String {
    let c = &result.correlation;
    let mut html = String::from("<div class=\"scroll\"><table class=\"dense\">\n<tr><th></th>");
    for name in &c.names {
        html += &format!("<th>{}</th>", escape(name));
    }
    html += "</tr>\n";
    for (name, row) in c.names.iter().zip(&c.matrix) {
        html += &format!("<tr><th>{}</th>", escape(name));
        for value in row {
            html += &format!("<td style=\"{}\">{value:.2}</td>", tint(*value));
        }
        html += "</tr>\n";
    }
    html + "</table></div>\n<p class=\"soft\">Near 1 or −1 only a combination of the two is known.</p>\n"
}

pub(super) fn extra(section: &Section) -> String {
    let mut html = String::new();
    for text in &section.paragraphs {
        html += &format!("<p>{}</p>\n", escape(text));
    }
    if let Some(table) = &section.table {
        let row = |cells: &[String], tag: &str| -> String {
            let cells: String = cells
                .iter()
                .map(|c| format!("<{tag}>{}</{tag}>", escape(c)))
                .collect();
            format!("<tr>{cells}</tr>\n")
        };
        html += "<div class=\"scroll\"><table>\n";
        html += &row(&table.head, "th");
        html.extend(table.rows.iter().map(|r| row(r, "td")));
        html += "</table></div>\n";
    }
    if !section.pictures.is_empty() {
        html += "<div class=\"pictures\">\n";
        for picture in &section.pictures {
            let caption = escape(&picture.caption);
            html += &format!(
                "<figure><img alt=\"{caption}\" src=\"data:image/png;base64,{}\"><figcaption>{caption}</figcaption></figure>\n",
                base64(&picture.png)
            );
        }
        html += "</div>\n";
    }
    wide(&section.title, &html)
}

fn facts(result: &FitResult, provenance: &Provenance) -> String {
    let o = &result.objective;
    let versions: Vec<String> = result
        .versions
        .iter()
        .map(|(k, v)| format!("{k} {v}"))
        .collect();
    let mut rows = vec![
        ("fabric".to_owned(), result.fabric.clone()),
        ("scattering model".to_owned(), result.model.clone()),
        ("measurements".to_owned(), result.measurements.clone()),
        (
            "configurations".to_owned(),
            result.configs.len().to_string(),
        ),
        ("narrower bounds".to_owned(), result.bounds.to_string()),
        (
            "under the cloth".to_owned(),
            result.plate.clone().unwrap_or_default(),
        ),
        ("method".to_owned(), result.method.clone()),
        ("seed".to_owned(), result.seed.to_string()),
        ("camera paths".to_owned(), result.time.paths.to_string()),
        (
            "time".to_owned(),
            format!(
                "{:.1} s elapsed, {:.1} s of CPU",
                result.time.wall_s, result.time.cpu_s
            ),
        ),
        (
            "paired objective".to_owned(),
            format!(
                "{:.3e} ± {:.1e} (Khungurn 2015 eq. 18-20, tau {}; unbiased, may be negative) from {} fresh paths",
                o.paired, o.se, result.tau, o.paths
            ),
        ),
        (
            "error of the fitted means".to_owned(),
            format!(
                "{} % from Monte Carlo noise, {} % from measurement errors (weighted rms)",
                number(o.fit_monte_carlo_percent, 2),
                number(o.fit_measurement_percent, 2)
            ),
        ),
        ("program".to_owned(), versions.join(", ")),
        ("command".to_owned(), result.command.clone()),
    ];
    rows.extend(provenance.facts.iter().cloned());
    let mut html = String::from("<table class=\"facts\">\n");
    for (name, value) in rows.iter().filter(|(_, value)| !value.is_empty()) {
        let value = if name == "command" {
            format!("<code>{}</code>", escape(value))
        } else {
            escape(value)
        };
        html += &format!("<tr><td>{}</td><td>{value}</td></tr>\n", escape(name));
    }
    html + "</table>\n"
}
