//! Promise: `goniofit chart` draws the course of several fits to one scale, tells them apart without color, and prints the
//! numbers it draws.
#![allow(clippy::unwrap_used, missing_docs)]

use assert_cmd::cargo::cargo_bin;
use goniofit::fit::FitResult;
use goniofit::report::{Course, CoursePoint, convergence_chart};
use serde_json::Value;
use std::process::{Command, Output};

#[path = "common/fit_list.rs"]
mod fit_list;
use fit_list::Place;

fn goniofit(place: &Place, words: &str) -> Output {
    let mut command = Command::new(cargo_bin("goniofit"));
    command.current_dir(place.at("")).args(words.split(' '));
    command.env("RAYON_NUM_THREADS", "2").output().unwrap()
}

#[test]
fn fits_are_charted_and_their_numbers_printed() {
    let place = Place::new("");
    for (method, more) in [("gauss-newton", ""), ("adam", " --iterations 9")] {
        let fit = format!(
            "fit --measurements m1.csv --fabric net.toml --method {method}{more} --paths 12000 --out {method}"
        );
        assert!(goniofit(&place, &fit).status.code() <= Some(1));
    }
    let output = goniofit(
        &place,
        "chart gauss-newton adam/fit.json --json --svg c.svg",
    );
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let all: Vec<Value> = serde_json::from_slice(&output.stdout).unwrap();
    for (chart, folder) in all.iter().zip(["gauss-newton", "adam"]) {
        let fit = FitResult::read(&place.at(&format!("{folder}/fit.json"))).unwrap();
        let points = chart["iterations"].as_array().unwrap();
        assert_eq!(points.len(), fit.history.len());
        for (point, h) in points.iter().zip(&fit.history) {
            assert_eq!(point["weighted_rms_percent"], h.weighted_rms_percent);
            let cpu_s = h.wall_s / fit.time.wall_s * fit.time.cpu_s;
            assert!((point["cpu_s"].as_f64().unwrap() / cpu_s - 1.0).abs() < 1e-9);
        }
        assert_eq!(chart["check"]["cpu_s"], fit.time.cpu_s);
    }
    let svg = place.read("c.svg");
    assert_eq!(
        svg.matches("<polyline").count(),
        4,
        "two lines, two in the legend"
    );
    for text in [
        "CPU seconds of rendering",
        "weighted rms residual, %",
        "gauss-newton (gauss-newton, seed 1): ",
        "adam/fit.json (adam, seed 1): ",
    ] {
        assert!(svg.contains(text), "{text}");
    }
    let again = goniofit(&place, "chart adam --svg c.svg");
    assert!(again.status.code() == Some(2) && place.read("c.svg") == svg);
    let csv = goniofit(&place, "chart adam");
    let csv = String::from_utf8(csv.stdout).unwrap();
    // Heading, nine iterations, the check.
    assert_eq!(csv.lines().count(), 11, "{csv}");
    let output = goniofit(&place, "chart nothing");
    assert!(output.status.code() == Some(2) && !output.stderr.is_empty());
}

#[test]
fn a_chart_of_anything_is_well_formed() {
    let point = |cpu_s, residual_percent, se_percent| CoursePoint {
        cpu_s,
        residual_percent,
        se_percent,
        accepted: cpu_s > 1.0,
    };
    // Residuals at zero, errors larger than values, names with markup, a fit without an iteration.
    let courses = [
        Course {
            name: "a<b & \"c\"".into(),
            points: vec![point(0.5, 80.0, 1.0), point(2.0, 0.0, 3.0)],
            end: point(3.0, 0.0, 0.5),
        },
        Course {
            name: "none".into(),
            points: vec![],
            end: point(900.0, 2.0, 40.0),
        },
    ];
    let svg = convergence_chart(&courses);
    assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
    assert!(svg.contains("a&lt;b &amp; &quot;c&quot;") && !svg.contains("a<b"));
    // Everything stays on the drawing.
    for part in svg.split(" x1=\"").skip(1) {
        let x: f64 = part.split('"').next().unwrap().parse().unwrap();
        assert!((0.0..=680.0).contains(&x), "{x}");
    }
    let opened = svg.matches("<text").count();
    assert_eq!(opened, svg.matches("</text>").count());
}
