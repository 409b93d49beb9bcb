//! Promise: reflectance models keep their laws, return exact derivatives by every parameter, and refuse what has no meaning.
#![allow(
    clippy::unwrap_used,
    clippy::float_cmp,
    clippy::print_stdout,
    missing_docs
)]

#[path = "common/woven.rs"]
mod woven_cases;

use glam::DVec3;
use goniofit::scatter::surface::woven::{
    Layout, Quality, RUNGS, Rung, Segment, SegmentType, Shape, Weights, segment_frame,
};
use goniofit::scatter::surface::{Ggx, SurfaceModel, Woven, directional_albedo, model, models};
use goniofit::scatter::{CHANNELS, Parameters, Parametric, Unit};
use serde_json::json;
use std::f64::consts::{FRAC_1_PI, FRAC_PI_2};
use woven_cases::{above, stream};

fn layout() -> Layout {
    // A 3/1 twill: long warp segments, short weft segments, four of each in 4 x 4 crossings of 0.4 mm.
    let types = vec![
        SegmentType {
            system: 0,
            width: 0.4,
            length: 1.2,
            count: 4.0,
        },
        SegmentType {
            system: 1,
            width: 0.4,
            length: 0.4,
            count: 4.0,
        },
    ];
    Layout::new(types, 2.56).unwrap()
}

/// Parameters inside their ranges, away from the ends.
fn inside(model: &dyn SurfaceModel, key: u64) -> Parameters {
    let mut random = stream(key);
    let defaults = Parameters::defaults(model);
    let values = defaults
        .places()
        .into_iter()
        .map(|(row, _)| {
            let info = model.parameters()[row];
            let (low, high) = match info.own_name() {
                name if name.ends_with("k_s") => (0.1, 0.6),
                name if name.ends_with("forward") => (0.5, 8.0),
                name if name.ends_with("curvature") => (-0.6, 1.5),
                name if name.ends_with("inclination") => (0.3, 1.0),
                _ => (info.lower, info.upper),
            };
            low + (high - low) * (0.05 + 0.9 * random.uniform())
        })
        .collect();
    defaults.with_values(values)
}

#[test]
fn the_ladder_has_3_7_9_11_and_19_numbers() {
    let found: Vec<_> = models(&layout())
        .iter()
        .map(|m| (m.name(), Parameters::defaults(&**m).values().len()))
        .collect();
    let expected = [
        ("lambert", 3),
        ("ggx", 7),
        ("woven-9", 9),
        ("woven-11", 11),
        ("woven-19", 19),
    ];
    assert_eq!(found, expected);
    for m in models(&layout()) {
        assert_eq!(
            Parameters::from_json(&*m, &Parameters::defaults(&*m).to_json())
                .unwrap()
                .to_json(),
            Parameters::defaults(&*m).to_json()
        );
        for info in m.parameters() {
            assert!(
                (info.lower..=info.upper).contains(&info.default),
                "{info:?}"
            );
        }
    }
}

#[test]
fn models_are_reciprocal_not_negative_and_dark_below_the_surface() {
    for (key, m) in models(&layout()).iter().enumerate() {
        let surface = m.prepare(&inside(m.as_ref(), 10 + key as u64)).unwrap();
        let mut random = stream(20);
        for _ in 0..300 {
            let (wi, wr) = (above(&mut random), above(&mut random));
            let (ab, ba) = (surface.value(wi, wr), surface.value(wr, wi));
            for c in 0..CHANNELS {
                assert!(ab[c] >= 0.0 && ab[c].is_finite());
                assert!((ab[c] - ba[c]).abs() <= 1e-15 * ab[c], "{}", m.name());
            }
            let below = DVec3::new(wi.x, wi.y, -wi.z);
            assert_eq!(surface.value(below, wr), [0.0; CHANNELS]);
            assert_eq!(surface.evaluate(wr, below).value, [0.0; CHANNELS]);
        }
        assert!(
            surface
                .value(DVec3::NAN, DVec3::Z)
                .iter()
                .all(|v| v.is_nan())
        );
        assert!(surface.evaluate(DVec3::Z, DVec3::NAN).value[1].is_nan());
    }
}

#[test]
fn a_cloth_looks_the_same_after_half_a_turn_but_not_after_a_quarter() {
    let turn = |w: DVec3| DVec3::new(-w.x, -w.y, w.z);
    let quarter = |w: DVec3| DVec3::new(-w.y, w.x, w.z);
    for rung in RUNGS {
        let m = Woven::new(rung, layout()).with_quality(Quality::Report);
        let mut values = inside(&m, 30).values().to_vec();
        values[..3].fill(0.0);
        let surface = m
            .prepare(&Parameters::defaults(&m).with_values(values))
            .unwrap();
        let mut random = stream(31);
        let (mut half, mut other) = (0.0_f64, 0.0_f64);
        for _ in 0..200 {
            let (wi, wr) = (above(&mut random), above(&mut random));
            let value = surface.value(wi, wr)[0];
            half = half.max((surface.value(turn(wi), turn(wr))[0] - value).abs() / value.max(1e-9));
            other = other
                .max((surface.value(quarter(wi), quarter(wr))[0] - value).abs() / value.max(1e-3));
        }
        assert!(half < 1e-6 && other > 0.1, "{}: {half} {other}", m.name());
    }
}

#[test]
fn albedos_are_k_d_and_at_most_what_facets_and_fibers_return() {
    let wi = |theta: f64| DVec3::new(theta.sin() * 0.6, theta.sin() * 0.8, theta.cos());
    let albedo = |m: &dyn SurfaceModel, values: Vec<f64>, theta: f64, points: usize| {
        let surface = m
            .prepare(&Parameters::defaults(m).with_values(values))
            .unwrap();
        directional_albedo(surface.as_ref(), wi(theta), points)[1]
    };
    let lambert = model("lambert", &layout()).unwrap();
    let found = albedo(lambert.as_ref(), vec![0.1, 0.37, 0.2], 1.0, 4);
    assert!((found - 0.37).abs() < 1e-14, "{found}");
    for roughness in [0.2, 0.5, 1.0] {
        for theta in [0.0, 0.8, 1.4] {
            let values =
                |k_d: f64, k_s: f64| [[k_d; 3].as_slice(), &[k_s; 3], &[roughness]].concat();
            let facets = albedo(&Ggx, values(0.0, 1.0), theta, 64);
            assert!(
                (0.3..=1.0 + 1e-4).contains(&facets),
                "{roughness} {theta}: {facets}"
            );
            // Linear in its colors.
            let both = albedo(&Ggx, values(0.2, 0.5), theta, 64);
            assert!((both - 0.2 - 0.5 * facets).abs() < 1e-12, "{both} {facets}");
        }
    }
    // At normal incidence the facets steeper than 45 degrees, a^2/(1 + a^2) of them, send light below; masking takes a little more.
    let flat = albedo(
        &Ggx,
        [[0.0; 3].as_slice(), &[1.0; 3], &[0.2]].concat(),
        0.0,
        64,
    );
    assert!((0.94..0.9615).contains(&flat), "{flat}");
    println!("albedo of woven-9 at k_s = 1, k_d = 0, by theta 0, 45, 80 degrees, 32 and 48 points");
    let m = Woven::new(Rung::Nine, Layout::plain(0.4).unwrap());
    for (twist, inclination, forward) in [(-30.0, 30.0, 4.0), (60.0, 40.0, 1.0), (30.0, 20.0, 8.0)]
    {
        for theta in [0.0_f64, 45.0, 80.0] {
            let angles = [twist, inclination].map(f64::to_radians);
            let values = [[0.0; 3].as_slice(), &[1.0; 3], &angles, &[forward]].concat();
            let [coarse, fine] =
                [32, 48].map(|n| albedo(&m, values.clone(), theta.to_radians(), n));
            println!("{twist:>5} {inclination:>5} {forward:>3} {theta:>5}: {coarse:.6} {fine:.6}");
            assert!((coarse / fine - 1.0).abs() < 2e-2, "{coarse} {fine}");
            assert!((0.001..1.0).contains(&fine), "{fine}");
        }
    }
}

#[test]
fn derivatives_agree_with_differences_for_every_model() {
    for (key, m) in models(&layout()).iter().enumerate() {
        let mut random = stream(40);
        let (mut worst, mut seen, mut control) = (0.0_f64, 0, 0);
        for round in 0..12 {
            let parameters = inside(m.as_ref(), 50 + 100 * key as u64 + round);
            let (wi, wr) = (above(&mut random), above(&mut random));
            let exact = precise(m.name());
            let e = exact.prepare(&parameters).unwrap().evaluate(wi, wr);
            for (place, (row, c)) in parameters.places().into_iter().enumerate() {
                let channel = if m.parameters()[row].per_channel {
                    c
                } else {
                    2
                };
                let step = 1e-5;
                let at = |n: f64| {
                    let mut values = parameters.values().to_vec();
                    values[place] += n * step;
                    let surface = exact.prepare(&parameters.with_values(values)).unwrap();
                    surface.value(wi, wr)[channel]
                };
                let expected = (8.0 * (at(1.0) - at(-1.0)) - (at(2.0) - at(-2.0))) / (12.0 * step);
                let scale = expected.abs().max(e.value[channel]);
                let found = e.derivative[row][channel];
                worst = worst.max((found - expected).abs() / scale);
                seen += 1;
                control += usize::from((1.01 * found - expected).abs() / scale > 1e-3);
            }
            for row in m.parameters().len()..e.derivative.len() {
                assert_eq!(e.derivative[row], [0.0; CHANNELS]);
            }
        }
        println!("{}: {worst:.1e}", m.name());
        // Converged to 1e-6, differences at steps of 1e-5 see that as up to 1e-2 where an interval has just been halved.
        assert!(
            worst < 1e-3 && control > seen / 4,
            "{}: {worst} {control}",
            m.name()
        );
    }
}

/// The model by name at the quality of reports.
fn precise(name: &str) -> Box<dyn SurfaceModel> {
    match RUNGS
        .map(|r| Woven::new(r, layout()).with_quality(Quality::Report))
        .into_iter()
        .find(|m| m.name() == name)
    {
        Some(woven) => Box::new(woven),
        None => model(name, &layout()).unwrap(),
    }
}

#[test]
fn colors_are_linear_and_the_richest_rung_contains_the_others() {
    let (nine, nineteen) = (
        Woven::new(Rung::Nine, layout()),
        Woven::new(Rung::Nineteen, layout()),
    );
    let p = inside(&nine, 60);
    let v = p.values();
    let yarn = [v[3], v[4], v[5], v[6], v[7], 0.0, 0.01, v[8]];
    let same = [&v[..3], &yarn, &yarn].concat();
    let rich = nineteen
        .prepare(&Parameters::defaults(&nineteen).with_values(same))
        .unwrap();
    let poor = nine.prepare(&p).unwrap();
    let mut random = stream(61);
    for _ in 0..50 {
        let (wi, wr) = (above(&mut random), above(&mut random));
        let (a, b) = (poor.evaluate(wi, wr), rich.value(wi, wr));
        for c in 0..CHANNELS {
            assert!((a.value[c] - b[c]).abs() < 1e-14);
            let colors = poor.colors(wi, wr);
            let linear = colors[0] * v[c] + colors[1] * v[3 + c];
            assert!(colors[2..].iter().all(|x| *x == 0.0));
            assert!((linear - a.value[c]).abs() < 1e-14);
        }
    }
}

#[test]
fn the_three_conventions_of_k_s_differ_by_their_stated_factors() {
    let values = [[0.2; 3].as_slice(), &[1.0; 3], &[-0.5, 0.5, 4.0]].concat();
    let (wi, wr) = (
        DVec3::new(0.3, 0.2, 0.8).normalize(),
        DVec3::new(-0.2, -0.3, 0.9).normalize(),
    );
    let shape = |width: f64, length: f64| Shape {
        twist: -0.5,
        inclination: 0.5,
        width,
        length,
        ..Shape::default()
    };
    let f = |system: usize, length: f64| {
        let [i, r] = [wi, wr].map(|w| segment_frame(system, w));
        Segment::new(shape(0.4, length))
            .unwrap()
            .value(i, r, Quality::Fit)
    };
    let (warp, weft) = (f(0, 1.2), f(1, 0.4));
    for (weights, expected) in [
        (Weights::Count, (4.0 * warp + 4.0 * weft) / 2.56),
        (Weights::Area, 0.75 * warp + 0.25 * weft),
        (Weights::Sum, warp + weft),
    ] {
        let m = Woven::new(Rung::Nine, layout().with_weights(weights));
        let surface = m
            .prepare(&Parameters::defaults(&m).with_values(values.clone()))
            .unwrap();
        let found = surface.value(wi, wr)[0] - 0.2 * FRAC_1_PI;
        assert!(
            (found - expected).abs() < 1e-14,
            "{weights:?}: {found} {expected}"
        );
    }
}

// ---- edges ---------------------------------------------------------------------------------------------------------

/// Directions where formulas have poles: nearly opposite, grazing, along the yarn, across it, equal.
fn hostile() -> Vec<DVec3> {
    let mut list = vec![DVec3::Z];
    for tilt in [1e-100, 1e-16, 1e-8, 1e-3, 0.3] {
        for (x, y) in [
            (1.0, 0.0),
            (-1.0, 0.0),
            (0.0, 1.0),
            (0.0, -1.0),
            (0.6, 0.8),
            (-0.6, -0.8),
        ] {
            list.push(DVec3::new(x, y, tilt).normalize());
        }
    }
    list
}

#[test]
fn nothing_is_infinite_at_the_edges_of_the_domain() {
    let mut count = 0;
    for twist in [0.0, -0.0, 1e-300, 1e-9, -1e-3, 0.5, FRAC_PI_2, -FRAC_PI_2] {
        for inclination in [1e-4, 0.5, 1.2, FRAC_PI_2] {
            for (curvature, smoothing) in [(-0.999, 0.0), (0.0, 0.5), (100.0, 1.0)] {
                let shape = Shape {
                    twist,
                    inclination,
                    curvature,
                    smoothing,
                    ..Shape::default()
                };
                let segment = Segment::new(shape).unwrap();
                for wi in hostile() {
                    for wr in hostile() {
                        let (value, slopes) = segment.slopes(wi, wr, Quality::Fit);
                        let report = segment.estimate(wi, wr, 1e-6);
                        let trapezoid = segment.value(wi, wr, Quality::Published(11));
                        let all = [value, report.value, report.error, trapezoid];
                        assert!(
                            all.iter().all(|x| x.is_finite() && *x >= 0.0)
                                && slopes.iter().all(|s| s.is_finite()),
                            "{shape:?} {wi:?} {wr:?}: {all:?} {slopes:?}"
                        );
                        count += 1;
                    }
                }
            }
        }
    }
    println!("{count} cases");
}

#[test]
fn a_twist_of_zero_is_the_limit_of_small_ones() {
    let mut random = stream(70);
    let (mut worst, mut control) = (0.0_f64, 0.0_f64);
    for _ in 0..300 {
        let (wi, wr) = (above(&mut random), above(&mut random));
        let shape = |twist: f64| Shape {
            twist,
            smoothing: 0.8,
            inclination: 0.7,
            ..Shape::default()
        };
        let value = |twist: f64| {
            let segment = Segment::new(shape(twist)).unwrap();
            segment.estimate(wi, wr, 1e-10).value
        };
        let zero = value(0.0);
        let slope = Segment::new(shape(0.0))
            .unwrap()
            .slopes(wi, wr, Quality::Report)
            .1[0];
        for twist in [1e-6, -1e-6] {
            let linear = zero + slope * twist;
            worst = worst.max((value(twist) - linear).abs() / zero.max(1e-3));
        }
        control = control.max((value(0.1) - zero).abs() / zero.max(1e-3));
    }
    println!("{worst:.1e}, control {control:.1e}");
    assert!(worst < 1e-8 && control > 0.1);
}

#[test]
fn meaningless_values_are_refused_with_what_is_expected() {
    let refused = |shape: Shape, expected: &str| {
        let error = Segment::new(shape).unwrap_err().report();
        assert!(
            error.contains(expected) && error.contains("hint:"),
            "{error}"
        );
    };
    let good = Shape::default();
    refused(
        Shape { twist: 1.7, ..good },
        "'twist' is 1.7, expected -1.57",
    );
    refused(
        Shape {
            curvature: -1.0,
            ..good
        },
        "'curvature' is -1, expected -0.99",
    );
    refused(
        Shape {
            inclination: 0.0,
            ..good
        },
        "'inclination' is 0",
    );
    refused(
        Shape {
            smoothing: f64::NAN,
            ..good
        },
        "'smoothing' is NaN",
    );
    refused(
        Shape {
            length: 0.15,
            ..good
        },
        "a length of 0.15 mm is too short",
    );
    let m = Woven::new(Rung::Nine, layout());
    let mut values = Parameters::defaults(&m).values().to_vec();
    values[0] = -0.1;
    let error = m
        .prepare(&Parameters::defaults(&m).with_values(values))
        .err()
        .unwrap();
    assert!(
        error
            .to_string()
            .contains("woven-9: 'k_d' is -0.1, expected 0 to"),
        "{error}"
    );
    let error = Layout::new(vec![], 1.0).unwrap_err().report();
    assert!(error.contains("expected at least one"), "{error}");
    let error = model("woven-12", &layout()).err().unwrap().report();
    assert!(
        error.contains("known models: lambert, ggx, woven-9"),
        "{error}"
    );
    let error = Parameters::from_json(&m, &json!({"k_d": [0.1, 0.1, 0.1]})).unwrap_err();
    assert!(error.to_string().contains("'k_s' is missing"), "{error}");
    assert_eq!(m.parameters()[2].unit, Unit::Angle);
}
