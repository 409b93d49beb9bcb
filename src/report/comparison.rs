//! The page of several models fitted to the same measurements, as Khungurn 2015 Figures 18 to 20 and Table IV show them.

mod charts;

use super::html::{base64, escape, number};
use super::page::{STYLE, chart, document, wide};
use crate::fit::{FittedModel, FittedParameter, Residuals, SideBySide, Verdict};
use crate::session::Configuration;

/// What the page shows besides the comparison itself.
#[derive(Debug, Clone, Default)]
pub struct ComparisonNotes {
    /// Rows for the table of how it was made: name and value.
    pub facts: Vec<(String, String)>,
    /// Pictures of the truth and of the models.
    pub pictures: Vec<PosePictures>,
}

/// Pictures of one pose.
#[derive(Debug, Clone)]
pub struct PosePictures {
    /// The pose.
    pub configuration: Configuration,
    /// PNG files: of the truth if there is one, then of the models in the order of the comparison.
    pub pngs: Vec<Vec<u8>>,
}

const OWN_STYLE: &str = "\
:root{--k0:#2f5d8a;--k1:#b3641c;--k2:#7a4a9e}
@media(prefers-color-scheme:dark){:root{--k0:#7fb2e5;--k1:#f0a45c;--k2:#c79be8}}
.k0{fill:var(--k0)}.k1{fill:var(--k1)}.k2{fill:var(--k2)}
.four{display:grid;grid-template-columns:repeat(4,minmax(0,1fr));gap:6px;margin:.3em 0 1em}
.four figcaption{font-size:.78rem;overflow-wrap:anywhere}
td.words{white-space:normal;text-align:left;min-width:9em}
";

/// The whole page.
pub fn comparison_page(result: &SideBySide, notes: &ComparisonNotes) -> String {
    let title = format!("Three models of {}", result.fabric);
    let mut body = format!("<h1>{}</h1>\n", escape(&title));
    if result.synthetic {
        let scan = match result.truth {
            Some(_) => {
                ": the measurements were rendered from the fabric's own fibers, and the scan was simulated from them."
            }
            None => ": these measurements were rendered, not photographed.",
        };
        body += &format!("<p class=\"banner\"><strong>SYNTHETIC</strong>{scan}</p>\n");
    }
    body += &wide("How well, and at what cost", &summary(result));
    body += "<div class=\"grid\">\n";
    body += &chart(
        "Brightness by pose",
        &charts::brightness(result),
        "How much too bright a model is, percent of the pose's brightness (mean of the channels); whiskers are one standard \
         error of render and measurement.",
    );
    for model in &result.models {
        body += &chart(
            title_of(&model.name),
            &charts::scatter(model),
            "On the dashed line prediction and measurement agree. Large marks: poses of the fit; small: poses it has not seen.",
        );
    }
    body += "</div>\n";
    if !notes.pictures.is_empty() {
        body += &wide("One tile, lit and seen alike", &pictures(result, notes));
    }
    body += &wide("Residual by pose", &residuals(result, |m| Some(&m.fitted)));
    if result.models.iter().any(|m| m.validation.is_some()) {
        body += &wide(
            "Poses that no fit has seen",
            &residuals(result, |m| m.validation.as_ref()),
        );
    }
    body += &wide("Parameters", &parameters(result));
    body += &wide("How this was made", &facts(result, notes));
    document(&title, &format!("{STYLE}{OWN_STYLE}"), &body)
}

/// A model's name for people.
fn title_of(name: &str) -> &str {
    match name {
        "fibers" => "Fibers found in the scan, BCSDF",
        "volume" => "Volume, BCSDF",
        "microflakes" => "Volume, microflakes",
        other => other,
    }
}

fn plus_minus(value: f64, se: f64) -> String {
    // A standard error of zero decimals is no help.
    let decimals = if se < 0.095 { 2 } else { 1 };
    format!("{value:.decimals$} ± {se:.decimals$}")
}

fn rms(r: &Residuals) -> String {
    plus_minus(r.weighted_rms_percent, r.weighted_rms_se_percent)
}

fn summary(result: &SideBySide) -> String {
    let mut html = String::from(
        "<div class=\"scroll\"><table>\n<tr><th>model</th><th>residual, %</th><th>at unseen poses, %</th><th>fit, s</th>\
         <th>fit, CPU s</th><th>paths, M</th><th class=\"left\">at bounds</th><th class=\"left\">not determined</th></tr>\n",
    );
    for m in &result.models {
        let list = |verdicts: &[Verdict]| match m.named(verdicts).as_slice() {
            [] => "-".to_owned(),
            names => names.join(", "),
        };
        html += &format!(
            "<tr><td>{}</td><td><strong>{}</strong></td><td>{}</td><td>{}</td><td>{}</td><td>{}</td><td class=\"words\">{}</td>\
             <td class=\"words\">{}</td></tr>\n",
            escape(title_of(&m.name)),
            rms(&m.fitted),
            m.validation.as_ref().map_or("-".to_owned(), rms),
            number(m.wall_s, 3),
            number(m.cpu_s, 3),
            number(1e-6 * m.paths as f64, 3),
            escape(&list(&[Verdict::AtLowerBound, Verdict::AtUpperBound])),
            escape(&list(&[Verdict::NotDetermined])),
        );
    }
    html += "</table></div>\n<p class=\"soft\">Weighted rms residual of fresh renders (Khungurn 2015 eq. 18-20), with the renders' \
             standard error.</p>\n<ul>\n";
    for m in &result.models {
        html += &format!(
            "<li>{}: {}{}.</li>\n",
            escape(title_of(&m.name)),
            if m.converged { "" } else { "not converged: " },
            escape(&m.reason)
        );
    }
    html + "</ul>\n"
}

/// A pose in words.
fn pose(c: &Configuration) -> String {
    let angles = |d: crate::math::PolarDirection| {
        format!("{:.0}° / {:.0}°", d.theta.to_degrees(), d.phi.to_degrees())
    };
    format!(
        "light {}, camera {}, turned {:.0}°",
        angles(c.light),
        angles(c.camera),
        c.rotation.to_degrees()
    )
}

fn pictures(result: &SideBySide, notes: &ComparisonNotes) -> String {
    let names = result.models.iter().map(|m| title_of(&m.name));
    let truth = result.truth.is_some().then_some("Truth");
    let names: Vec<&str> = truth.into_iter().chain(names).collect();
    let mut html = String::from(
        "<p class=\"soft\">Foreshortening is taken out; in each row the first picture's brightest hundredth is white. Polar angle / \
         azimuth.</p>\n",
    );
    for row in &notes.pictures {
        let id = row.configuration.id;
        html += &format!(
            "<p>Configuration {id}: {}</p>\n<div class=\"four\">\n",
            pose(&row.configuration)
        );
        for (name, png) in names.iter().zip(&row.pngs) {
            let name = escape(name);
            html += &format!(
                "<figure><img alt=\"{name}, configuration {id}\" src=\"data:image/png;base64,{}\"><figcaption>{name}</figcaption></figure>\n",
                base64(png)
            );
        }
        html += "</div>\n";
    }
    html
}

fn residuals<'a>(
    result: &'a SideBySide,
    of: impl Fn(&'a FittedModel) -> Option<&'a Residuals>,
) -> String {
    let mut html = String::from(
        "<p class=\"soft\">Of each model, percent of the pose's brightness: how much too bright (mean of the channels), and the \
         weighted rms of the channels, which is 0 where renders and measurement agree within their noise; ± one standard \
         error.</p>\n<div class=\"scroll\"><table>\n<tr><th>config</th><th>light</th><th>camera</th><th>turn</th><th>measured r, g, b</th>",
    );
    for m in &result.models {
        html += &format!("<th>{0} too bright</th><th>{0} rms</th>", escape(&m.name));
    }
    html += "</tr>\n";
    let lists: Vec<&Residuals> = result.models.iter().filter_map(of).collect();
    let rows = lists.first().map_or(&[][..], |r| &r.configs);
    for (i, row) in rows.iter().enumerate() {
        let c = &row.configuration;
        let angles = |d: crate::math::PolarDirection| {
            format!("{:.0}° / {:.0}°", d.theta.to_degrees(), d.phi.to_degrees())
        };
        let one = |x: Option<f64>| x.map_or("-".to_owned(), |x| number(x, 3));
        html += &format!(
            "<tr><td>{}</td><td>{}</td><td>{}</td><td>{:.0}°</td><td>{}</td>",
            c.id,
            angles(c.light),
            angles(c.camera),
            c.rotation.to_degrees(),
            row.measured.map(one).join(", ")
        );
        for r in lists.iter().filter_map(|l| l.configs.get(i)) {
            html += &format!(
                "<td>{}</td><td>{}</td>",
                plus_minus(r.brightness_percent, r.brightness_se_percent),
                plus_minus(r.rms_percent, r.rms_se_percent)
            );
        }
        html += "</tr>\n";
    }
    html + "</table></div>\n"
}

fn parameters(result: &SideBySide) -> String {
    let mut names: Vec<&str> = Vec::new();
    for p in result.models.iter().flat_map(|m| &m.parameters) {
        if !names.contains(&p.name.as_str()) {
            names.push(&p.name);
        }
    }
    let mut html = String::from("<div class=\"scroll\"><table>\n<tr><th>name</th><th>truth</th>");
    for m in &result.models {
        html += &format!("<th class=\"left\">{}</th>", escape(title_of(&m.name)));
    }
    html += "</tr>\n";
    for name in names {
        let of = |m: &'_ FittedModel| m.parameters.iter().position(|p| p.name == name);
        let found: Vec<Option<&FittedParameter>> = result
            .models
            .iter()
            .map(|m| of(m).map(|i| &m.parameters[i]))
            .collect();
        let truth = found
            .iter()
            .flatten()
            .find_map(|p| Some((p.truth?, unit(p))));
        html += &format!(
            "<tr><td>{}</td><td>{}</td>",
            escape(name),
            truth.map_or("-".to_owned(), |(t, unit)| number(t, 3) + unit)
        );
        for p in found {
            html += &format!("<td class=\"left\">{}</td>", p.map_or("-".to_owned(), cell));
        }
        html += "</tr>\n";
    }
    html + "</table></div>\n<p class=\"soft\">In parentheses 95 % intervals, which know of measurement errors and render noise but \
            not of a wrong geometry. The truth is that of fibers; in a volume C_R and C_TT only say how the lobes share the light, and albedo \
            how much of it stays.</p>\n"
}

fn unit(p: &FittedParameter) -> &'static str {
    if p.unit == "1" { "" } else { "°" }
}

fn cell(p: &FittedParameter) -> String {
    let [low, high] = p.interval_95;
    let verdict = match p.verdict {
        Verdict::Determined => String::new(),
        other => format!(" <span class=\"soft\">{}</span>", other.words()),
    };
    format!(
        "<strong>{}{}</strong> ({} – {}){verdict}",
        number(p.value, 3),
        unit(p),
        number(low, 3),
        number(high, 3)
    )
}

fn facts(result: &SideBySide, notes: &ComparisonNotes) -> String {
    let own = [
        ("fabric", result.fabric.clone()),
        (
            "rendered with",
            result.truth_model.clone().unwrap_or_default(),
        ),
        ("seed", result.seed.to_string()),
    ];
    let own = own.map(|(name, value)| (name.to_owned(), value));
    let mut html = String::from("<table class=\"facts\">\n");
    for (name, value) in own
        .iter()
        .chain(&notes.facts)
        .filter(|(_, v)| !v.is_empty())
    {
        html += &format!(
            "<tr><td>{}</td><td>{}</td></tr>\n",
            escape(name),
            escape(value)
        );
    }
    html += &format!(
        "<tr><td>command</td><td><code>{}</code></td></tr>\n</table>\n",
        escape(&result.command)
    );
    html
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::PoseResidual;

    fn model(name: &str) -> FittedModel {
        let configuration =
            Configuration::from_degrees(7, [80.0, 180.0], [32.0, 0.0], 90.0).unwrap();
        let row = PoseResidual {
            configuration,
            measured: [Some(0.1), None, Some(0.3)],
            measured_se: [Some(0.001), None, Some(0.001)],
            predicted: [0.12, 0.2, 0.29],
            predicted_se: [0.002; 3],
            relative_percent: [Some(10.0), None, Some(-5.0)],
            relative_se_percent: [Some(1.0), None, Some(1.0)],
            brightness_percent: 2.5,
            brightness_se_percent: 1.0,
            rms_percent: 7.9,
            rms_se_percent: 0.05,
        };
        let residuals = Residuals {
            weighted_rms_percent: 7.9,
            weighted_rms_se_percent: 0.05,
            rms_z: 3.0,
            configs: vec![row],
        };
        FittedModel {
            name: name.to_owned(),
            model: "m<1>".to_owned(),
            fabric: "f".to_owned(),
            converged: false,
            reason: "a < b".to_owned(),
            wall_s: 1.0,
            cpu_s: 2.0,
            paths: 3_000_000,
            parameters: vec![FittedParameter {
                name: "beta_r".to_owned(),
                unit: "degrees".to_owned(),
                value: 1.0,
                interval_95: [1.0, 9.0],
                verdict: Verdict::AtLowerBound,
                truth: Some(5.5),
            }],
            fitted: residuals.clone(),
            validation: Some(residuals),
        }
    }

    #[test]
    fn the_page_has_every_part_and_escapes_text() {
        let result = SideBySide {
            format: SideBySide::FORMAT.to_owned(),
            fabric: "<fabric>.toml".to_owned(),
            synthetic: true,
            truth_model: Some("khungurn".to_owned()),
            truth: Some(serde_json::json!({})),
            scan: serde_json::Value::Null,
            seed: 1,
            command: "goniofit compare".to_owned(),
            models: ["fibers", "volume", "microflakes"].map(model).into(),
        };
        let notes = ComparisonNotes {
            facts: vec![("scan".to_owned(), "5 um".to_owned())],
            pictures: vec![PosePictures {
                configuration: result.models[0].fitted.configs[0].configuration,
                pngs: vec![vec![1, 2, 3]; 4],
            }],
        };
        let html = comparison_page(&result, &notes);
        for part in [
            "Three models of &lt;fabric&gt;.toml",
            "SYNTHETIC",
            "7.90 ± 0.05",
            "2.5 ± 1.0",
            "0.100, -, 0.300",
            "not converged: a &lt; b",
            "at its lower bound",
            "<td>5.50°</td>",
            "Poses that no fit has seen",
            "light 80° / 180°, camera 32° / 0°, turned 90°",
        ] {
            assert!(html.contains(part), "{part}: {html}");
        }
        assert_eq!(html.matches("data:image/png;base64,AQID").count(), 4);
        assert_eq!(html.matches("<svg").count(), 4);
        assert!(!html.contains("<script") && !html.contains("http"));
    }
}
