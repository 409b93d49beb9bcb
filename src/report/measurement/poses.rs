//! What the camera saw in each configuration.

use super::tables::{angles, turn};
use super::{Histogram, Looks, figure, plus_minus};
use crate::report::html::{escape, number};
use crate::report::page::wide;
use crate::report::svg::{Axis, Drawing, Scale};
use crate::session::{MeasurementRecord, RecordedConfiguration};

/// A card per configuration; nothing when there are no pictures.
pub(super) fn section(record: &MeasurementRecord, looks: &Looks) -> String {
    if looks.frames.is_empty() && looks.crops.is_empty() && looks.histograms.is_empty() {
        return String::new();
    }
    let cards: String = record
        .configurations
        .iter()
        .map(|c| card(c, looks))
        .collect();
    let note = "<p class=\"soft\">The outline is the sample square. Pictures are brightened and coded for the eye; numbers are taken \
                from raw values. Histograms: raw values inside the square, square root of their number; dotted: black level, dashed: \
                where exposures are no longer used.</p>\n";
    wide(
        "What the camera saw",
        &format!("{note}<div class=\"poses\">\n{cards}</div>\n"),
    )
}

fn card(c: &RecordedConfiguration, looks: &Looks) -> String {
    let id = c.configuration.id;
    let mut html = format!(
        "<div class=\"pose\"><h3>Configuration {id}</h3>\n<p class=\"soft\">light {}, camera {}, turn {}</p>\n",
        angles(c.configuration.light),
        angles(c.configuration.camera),
        turn(c)
    );
    html += &match (c.mean, c.standard_error) {
        (Some(mean), Some(se)) => {
            let values: Vec<String> = (0..3).map(|k| plus_minus(mean[k], se[k])).collect();
            format!("<p>{}</p>\n", values.join(", "))
        }
        _ => format!(
            "<p>not measured: {}</p>\n",
            escape(&c.condition.replace('_', " "))
        ),
    };
    if let Some(look) = looks.frames.get(&id) {
        html += &figure(look);
    }
    if let Some(look) = looks.crops.get(&id) {
        html += &figure(look);
    }
    if let Some(histogram) = looks.histograms.get(&id) {
        html += &format!(
            "<figure>{}<figcaption>{}</figcaption></figure>\n",
            draw(histogram, id),
            escape(&histogram.caption)
        );
    }
    html + "</div>\n"
}

/// Raw values per channel between black and clip.
fn draw(h: &Histogram, id: u32) -> String {
    let mut d = Drawing::new(220.0, 150.0, &format!("Raw values in configuration {id}"));
    let highest = h.counts.iter().flatten().copied().max().unwrap_or(0).max(1);
    let axis = |low, high, from, to| Axis {
        scale: Scale::Linear,
        low,
        high,
        from,
        to,
    };
    let x = axis(h.range[0], h.range[1], 6.0, 214.0);
    let y = axis(0.0, (highest as f64).sqrt(), 126.0, 8.0);
    d.rectangle("frame", 6.0, 8.0, 208.0, 118.0);
    let width = (h.range[1] - h.range[0]) / h.counts.len().max(1) as f64;
    for channel in 0..3 {
        let points: Vec<(f64, f64)> = h
            .counts
            .iter()
            .enumerate()
            .flat_map(|(i, bin)| {
                let height = y.at((bin[channel] as f64).sqrt());
                let left = h.range[0] + width * i as f64;
                [(x.at(left), height), (x.at(left + width), height)]
            })
            .collect();
        d.polyline(&format!("hist c{channel}"), &points);
        let black = x.at(h.black[channel]);
        d.line(&format!("black c{channel}"), black, 8.0, black, 126.0);
    }
    d.line("limit", x.at(h.clip), 8.0, x.at(h.clip), 126.0);
    d.text("tick", 6.0, 141.0, "start", &number(h.range[0].max(0.0), 4));
    d.text("tick", x.at(h.clip), 141.0, "end", &number(h.clip, 4));
    d.finish()
}
