//! Promise: the page of a measurement shows the numbers of `measurements.json` and nothing else, says when it is synthetic, loads
//! nothing, and keeps its size for long plans.
#![allow(clippy::unwrap_used, missing_docs)]

mod markup;

use goniofit::math::PolarDirection;
use goniofit::report::measurement::{
    Histogram, LinearityPoint, Look, Looks, Transfer, measurement_page,
};
use goniofit::session::protocols::irawan;
use goniofit::session::{
    CalibrationUsed, Configuration, LampPoint, MeasurementRecord, Quantity, RecordedConfiguration,
    SessionStamp,
};
use markup::check_nesting;
use std::collections::BTreeMap;

fn configuration(id: u32, mean: [f64; 3], se: [f64; 3]) -> RecordedConfiguration {
    let part = |x: f64| se.map(|s| s * x);
    RecordedConfiguration {
        configuration: Configuration {
            id,
            light: PolarDirection::from_degrees(30.0 + f64::from(id), 180.0),
            camera: PolarDirection::from_degrees(10.5, 0.0),
            rotation: 90_f64.to_radians(),
        },
        condition: "good".to_owned(),
        message: None,
        mean: Some(mean.map(Some)),
        standard_error: Some(se.map(Some)),
        budget: [("shot", 0.6), ("white", 0.8), ("read", 0.0)]
            .map(|(n, x)| (n.to_owned(), part(x)))
            .into(),
        exposures_ms: vec![4.0, 45.5],
        area_px: 1234.4,
        details: BTreeMap::new(),
    }
}

fn record() -> MeasurementRecord {
    let quantity = Quantity::NormalizedRadiance;
    MeasurementRecord {
        format: MeasurementRecord::FORMAT.to_owned(),
        program: "goniofit 9.9".to_owned(),
        synthetic: true,
        quantity: quantity.name().to_owned(),
        unit: quantity.unit().to_owned(),
        definition: quantity.definition().to_owned(),
        rgb_space: "camera".to_owned(),
        session: SessionStamp {
            name: "bench <1> & \"co\"".to_owned(),
            journal_sha256: "0a1b".to_owned(),
            ..SessionStamp::default()
        },
        calibrations: vec![CalibrationUsed {
            kind: "dark".to_owned(),
            file: "2026-01-02_dark.json".to_owned(),
            sha256: "77aa".to_owned(),
            date_utc: "2026-01-02T03:04:05Z".to_owned(),
            synthetic: true,
        }],
        options: [("usable_fraction".to_owned(), 0.92.into())].into(),
        warnings: vec!["something <odd>".to_owned()],
        lamp: [(0, 0, 1.0), (1, 0, 0.98), (2, 1, 0.97)]
            .map(|(visit, stretch, level)| LampPoint {
                visit,
                stretch,
                elapsed_s: 100.0 * f64::from(visit),
                level: [level, 0.99 * level, 1.01 * level],
                standard_error: [0.001, 0.002, 0.003],
            })
            .to_vec(),
        configurations: vec![
            configuration(
                1,
                [0.123_456, 0.223_456, 0.323_456],
                [0.001_2, 0.002_3, 0.003_4],
            ),
            configuration(2, [0.51, 0.052, 0.0053], [0.01, 0.002, 0.0003]),
            RecordedConfiguration {
                condition: "saturated".to_owned(),
                message: Some("configuration 3 is saturated".to_owned()),
                mean: None,
                standard_error: None,
                ..configuration(3, [0.1; 3], [0.1; 3])
            },
        ],
        details: [("hot_pixels".to_owned(), 17.into())].into(),
    }
}

fn looks() -> Looks {
    let look = |caption: &str| Look {
        png: vec![1, 2, 3],
        size: [40.0, 30.0],
        outline: vec![[1.0, 2.0], [30.0, 2.5], [29.0, 28.0]],
        caption: caption.to_owned(),
    };
    Looks {
        frames: [(1, look("frame <one>"))].into(),
        crops: [(1, look("crop one")), (2, look("crop two"))].into(),
        histograms: [(
            1,
            Histogram {
                range: [0.0, 1024.0],
                counts: vec![[0, 1, 4], [9, 0, 1]],
                black: [64.0, 65.0, 66.0],
                clip: 941.2,
                caption: "raw values at 45 ms".to_owned(),
            },
        )]
        .into(),
        linearity: vec![LinearityPoint {
            channel: 1,
            level: 0.25,
            residual: 0.0031,
            residual_se: 0.0007,
        }],
        transfer: Some(Transfer {
            points: vec![(0, [100.0, 40.0, 2.0]), (2, [1000.0, 390.0, 9.0])],
            slope: [0.401, 0.402, 0.403],
            read_noise: 2.17,
            source: "a series".to_owned(),
        }),
        flat: Some(look("flat")),
    }
}

/// The cells of the rows of a table, tags removed.
fn cells(html: &str, heading: &str) -> Vec<Vec<String>> {
    let start = html.find(&format!("<h2>{heading}</h2>")).unwrap();
    let table = &html[start..];
    let table = &table[..table.find("</table>").unwrap()];
    let text = |cell: &str| {
        let mut inside = false;
        let shown = cell.chars().filter(|c| {
            inside = match c {
                '<' => true,
                '>' => {
                    inside = false;
                    return false;
                }
                _ => inside,
            };
            !inside
        });
        shown.collect::<String>()
    };
    let rows = table.split("<tr").skip(2);
    rows.map(|row| {
        let cells = row.split("<td").skip(1);
        cells
            .map(|c| text(&c[c.find('>').unwrap() + 1..]).trim().to_owned())
            .collect()
    })
    .collect()
}

#[test]
fn the_tables_hold_exactly_the_numbers_of_the_record() {
    let html = measurement_page(&record(), &looks());
    let rows = cells(&html, "Intensities");
    let expected: [&[&str]; 3] = [
        &[
            "1",
            "31° / 180°",
            "10.5° / 0°",
            "90°",
            "0.1235 ± 0.0012",
            "0.2235 ± 0.0023",
            "0.3235 ± 0.0034",
            "1.1 %",
            "4, 45.5",
            "1234",
        ],
        &[
            "2",
            "32° / 180°",
            "10.5° / 0°",
            "90°",
            "0.510 ± 0.010",
            "0.0520 ± 0.0020",
            "0.00530 ± 0.00030",
            "5.7 %",
            "4, 45.5",
            "1234",
        ],
        &[
            "3",
            "33° / 180°",
            "10.5° / 0°",
            "90°",
            "not measured: saturated",
            "4, 45.5",
            "1234",
        ],
    ];
    assert_eq!(rows, expected);
    let rows = cells(&html, "Where the errors come from");
    // By share: white 0.64, shot 0.36, read 0.
    assert_eq!(rows.len(), 6);
    assert_eq!(
        rows[0],
        ["1", "red", "0.97 %", "", "0.78 %", "0.58 %", "0 %"]
    );
    assert_eq!(rows[5], ["2", "blue", "5.7 %", "", "4.5 %", "3.4 %", "0 %"]);
    let bars = html.matches("class=\"s0\" style=\"width:64.00%\"").count();
    assert_eq!(bars, 6);
}

#[test]
fn whatever_changes_in_the_data_changes_on_the_page() {
    let base = measurement_page(&record(), &looks());
    let mut changed = Vec::new();
    for k in 0..3 {
        let mut other = record();
        *other.configurations[1].mean.as_mut().unwrap()[k]
            .as_mut()
            .unwrap() *= 1.3;
        changed.push((other, looks()));
        let mut other = record();
        let se = other.configurations[1].standard_error.as_mut().unwrap();
        *se[k].as_mut().unwrap() *= 1.3;
        changed.push((other, looks()));
        let mut other = record();
        other.configurations[0].budget.get_mut("shot").unwrap()[k] *= 1.3;
        changed.push((other, looks()));
        let mut other = record();
        other.lamp[1].level[k] *= 1.001;
        changed.push((other, looks()));
        let mut other = looks();
        other.histograms.get_mut(&1).unwrap().counts[1][k] += 3;
        changed.push((record(), other));
        let mut other = looks();
        other.histograms.get_mut(&1).unwrap().black[k] += 30.0;
        changed.push((record(), other));
        let mut other = looks();
        other.transfer.as_mut().unwrap().slope[k] *= 1.1;
        changed.push((record(), other));
    }
    let mut other = looks();
    other.linearity[0].residual *= 1.5;
    changed.push((record(), other));
    let mut other = looks();
    other.histograms.get_mut(&1).unwrap().clip -= 50.0;
    changed.push((record(), other));
    let mut other = looks();
    other.frames.get_mut(&1).unwrap().outline[2][0] -= 5.0;
    changed.push((record(), other));
    let mut other = record();
    other.calibrations[0].sha256.push('f');
    changed.push((other, looks()));
    let mut other = record();
    other.details.insert("hot_pixels".to_owned(), 18.into());
    changed.push((other, looks()));
    for (i, (record, looks)) in changed.iter().enumerate() {
        assert!(
            measurement_page(record, looks) != base,
            "change {i} is not shown"
        );
    }
}

#[test]
fn the_page_is_well_formed_loads_nothing_and_escapes() {
    let html = measurement_page(&record(), &looks());
    assert!(check_nesting(&html) > 200);
    assert!(!html.contains("http://") && !html.contains("https://") && !html.contains("<script"));
    for odd in ["<1>", "<odd>", "<one>"] {
        assert!(!html.contains(odd), "{odd}");
    }
    for part in [
        "<strong>2 of 3</strong>",
        "SYNTHETIC",
        "something &lt;odd&gt;",
        "configuration 3 is saturated",
        "2026-01-02_dark.json",
        "77aa",
        "0a1b",
        "<h2>Lamp</h2>",
        "<h2>Linearity</h2>",
        "<h2>Photon transfer</h2>",
        "<h2>Flat field</h2>",
        "0.401, 0.402, 0.403",
        "points=\"1.00,2.00 30.00,2.50 29.00,28.00\"",
        "&quot;hot_pixels&quot;: 17",
    ] {
        assert!(html.contains(part), "{part}");
    }
    // A line for each of two stretches and three channels.
    assert_eq!(html.matches("<polyline class=\"course").count(), 6 + 3);
}

#[test]
fn what_is_not_there_is_not_shown() {
    let mut plain = record();
    plain.synthetic = false;
    plain.lamp.clear();
    plain.calibrations.clear();
    plain.warnings.clear();
    plain.configurations.truncate(2);
    plain.details.clear();
    let html = measurement_page(&plain, &Looks::default());
    check_nesting(&html);
    for part in [
        "SYNTHETIC",
        "<h2>Lamp",
        "What the camera saw",
        "Photon",
        "<img",
        "<image",
    ] {
        assert!(!html.contains(part), "{part}");
    }
    assert!(html.contains("No warnings.") && html.contains("No calibration files"));
}

#[test]
fn a_long_plan_gets_maps_instead_of_pictures() {
    let plan = irawan(75.0).unwrap();
    let mut long = record();
    long.configurations = plan
        .configurations
        .iter()
        .map(|c| RecordedConfiguration {
            configuration: *c,
            ..configuration(
                c.id,
                [0.3, 0.2, 0.1].map(|m| m * c.light.theta.cos()),
                [0.001; 3],
            )
        })
        .collect();
    let html = measurement_page(&long, &looks());
    check_nesting(&html);
    assert!(!html.contains("What the camera saw"));
    assert_eq!(html.matches("(225 directions)").count(), 7);
    let dots = html.matches("<circle cx=").count();
    assert_eq!(dots, 1575);
    for part in [
        "camera 60° / 135°",
        "camera 30° / 90°",
        "every configuration",
    ] {
        assert!(html.contains(part), "{part}");
    }
    assert!(html.len() < 8_000_000, "{}", html.len());
}
