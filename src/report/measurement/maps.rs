//! Maps of the incident hemisphere, one per exitant direction: for plans of many configurations.

use super::plus_minus;
use crate::report::html::{escape, number};
use crate::report::page::wide;
use crate::report::svg::Drawing;
use crate::session::{MeasurementRecord, RecordedConfiguration};
use std::collections::BTreeMap;
use std::f64::consts::PI;

/// Dark violet to yellow, as steps of a perceptually even scale (the five stops of viridis).
const STOPS: [[f64; 3]; 5] = [
    [68.0, 1.0, 84.0],
    [59.0, 82.0, 139.0],
    [33.0, 145.0, 140.0],
    [94.0, 201.0, 98.0],
    [253.0, 231.0, 37.0],
];

/// The color at 0..=1 of the scale.
fn color(t: f64) -> String {
    let at = t.clamp(0.0, 1.0) * (STOPS.len() - 1) as f64;
    let i = (at.floor() as usize).min(STOPS.len() - 2);
    let f = at - i as f64;
    let [r, g, b] = [0, 1, 2].map(|k| (1.0 - f) * STOPS[i][k] + f * STOPS[i + 1][k]);
    format!("rgb({r:.0},{g:.0},{b:.0})")
}

/// BRDF, mean of the channels measured.
fn brightness(c: &RecordedConfiguration) -> Option<f64> {
    let mean: Vec<f64> = c.mean?.into_iter().flatten().collect();
    let cos = c.configuration.light.theta.cos();
    (!mean.is_empty()).then(|| mean.iter().sum::<f64>() / (mean.len() as f64 * PI * cos))
}

/// Configurations by exitant direction in the sample frame, rounded to a tenth of a degree.
fn groups(record: &MeasurementRecord) -> BTreeMap<(i64, i64), Vec<&RecordedConfiguration>> {
    let mut groups: BTreeMap<(i64, i64), Vec<&RecordedConfiguration>> = BTreeMap::new();
    for c in &record.configurations {
        let camera = c.configuration.camera_in_sample();
        let tenths = |a: f64| (10.0 * a.to_degrees()).round() as i64;
        let theta = tenths(camera.theta);
        let phi = if theta == 0 {
            0
        } else {
            tenths(camera.phi).rem_euclid(3600)
        };
        groups.entry((theta, phi)).or_default().push(c);
    }
    groups
}

/// The section with all maps and their scale.
pub(super) fn section(record: &MeasurementRecord) -> String {
    let values = record.configurations.iter().filter_map(brightness);
    let (low, high) = values
        .filter(|v| *v > 0.0)
        .fold((f64::INFINITY, 0.0_f64), |(l, h), v| (l.min(v), h.max(v)));
    if low > high {
        return String::new();
    }
    let mut maps = String::new();
    for ((theta, phi), members) in groups(record) {
        let title = format!("camera {}° / {}°", theta as f64 / 10.0, phi as f64 / 10.0);
        maps += &format!(
            "<figure>{}<figcaption>{} ({} directions)</figcaption></figure>\n",
            map(&members, [low, high], &title),
            escape(&title),
            members.len()
        );
    }
    let stops: Vec<String> = (0..STOPS.len())
        .map(|i| color(i as f64 / (STOPS.len() - 1) as f64))
        .collect();
    let html = format!(
        "<p class=\"soft\">One map per exitant direction (polar angle / azimuth, sample frame); each point is an incident direction: \
         normal in the middle, grazing at the rim, azimuth 0 to the right. Color: BRDF in 1/sr, mean of the channels, logarithmic; \
         rings of points that were not measured are empty.</p>\n\
         <p><span class=\"share\" style=\"background:linear-gradient(90deg,{})\"></span></p>\n\
         <p class=\"soft\">{} to {} 1/sr</p>\n<div class=\"maps\">\n{maps}</div>\n",
        stops.join(","),
        number(low, 3),
        number(high, 3)
    );
    wide("BRDF by exitant direction", &html)
}

fn map(members: &[&RecordedConfiguration], [low, high]: [f64; 2], title: &str) -> String {
    const SIZE: f64 = 220.0;
    let rim = 0.5 * SIZE - 4.0;
    let mut d = Drawing::new(
        SIZE,
        SIZE,
        &format!("BRDF against incident direction, {title}"),
    );
    for degrees in [30.0, 60.0, 90.0] {
        d.raw(&format!(
            "<circle class=\"rim\" cx=\"{0}\" cy=\"{0}\" r=\"{1:.1}\"/>",
            0.5 * SIZE,
            rim * degrees / 90.0
        ));
    }
    // Points just touch when they fill the disk evenly.
    let radius = (0.8 * rim / (members.len().max(1) as f64).sqrt()).clamp(1.5, 9.0);
    for c in members {
        let light = c.configuration.light_in_sample();
        let r = rim * light.theta / (0.5 * PI);
        let x = 0.5 * SIZE + r * light.phi.cos();
        let y = 0.5 * SIZE - r * light.phi.sin();
        let (fill, title) = match (brightness(c), c.mean, c.standard_error) {
            (Some(v), Some(mean), Some(se)) => {
                let t = if high > low {
                    (v / low).ln() / (high / low).ln()
                } else {
                    0.5
                };
                let numbers: Vec<String> = (0..3).map(|k| plus_minus(mean[k], se[k])).collect();
                (color(t), numbers.join(", "))
            }
            _ => ("none".to_owned(), "not measured".to_owned()),
        };
        d.raw(&format!(
            "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius:.1}\" fill=\"{fill}\"><title>{}: {}</title></circle>",
            c.configuration.id,
            escape(&title)
        ));
    }
    d.finish()
}
