//! Promise: media keep their laws by quadrature, and return exact derivatives, at the edges of their domains too.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

#[path = "common/scatter_laws.rs"]
mod scatter_laws;

#[path = "common/media.rs"]
mod media_cases;

use glam::DVec3;
use goniofit::scatter::albedo::SphereRule;
use goniofit::scatter::media::{KhungurnVolume, Medium, MediumModel, Microflake, model, models};
use goniofit::scatter::{Khungurn, Model, Parameters, fiber_direction};
use media_cases::{flake_integral, hostile, microflake, volume};
use scatter_laws::{direction_deg, five_points, khungurn, stream};
use serde_json::json;
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::f64::consts::{FRAC_PI_2, TAU};
use std::rc::Rc;

#[test]
fn microflake_phase_functions_integrate_to_one() {
    for gamma in [0.005, 0.013, 0.1, 0.5, 1.5, 20.0] {
        let medium = Microflake
            .prepare(&microflake([1.0, 0.5, 0.0], gamma))
            .unwrap();
        for theta in [0.0, 33.0, -70.0, 88.0, 90.0] {
            let wo = direction_deg(theta, 20.0);
            let total = flake_integral(wo, gamma, |wi| medium.evaluate(wi, wo).value);
            assert!((total[0] - 1.0).abs() < 1e-8, "{gamma} {theta}: {total:?}");
            assert!(
                (total[1] - 0.5).abs() < 1e-8 && total[2] == 0.0,
                "{total:?}"
            );
        }
    }
}

/// `int f dwi` for the lobes of the volume BCSDF.
fn sphere(narrowest_deg: f64, f: impl Fn(DVec3) -> [f64; 3]) -> [f64; 3] {
    let rule = SphereRule::new(narrowest_deg.to_radians());
    rule.integrate(|theta, phi| f(fiber_direction(theta, phi)).map(|v| v * theta.cos()))
}

#[test]
fn volume_phase_functions_integrate_to_one_in_every_channel() {
    for (widths, narrowest) in [
        ([5.0, 10.0, 10.0], 5.0),
        ([1.0, 10.0, 45.0], 1.0),
        ([10.0, 45.0, 1.0], 1.0),
        ([70.0, 120.0, 100.0], 10.0),
    ] {
        let (c_r, c_tt) = ([0.001, 0.999, 0.3], [0.999, 0.001, 1.0]);
        let medium = KhungurnVolume
            .prepare(&volume(c_r, c_tt, widths, [1.0, 0.5, 0.001]))
            .unwrap();
        for theta in [0.0, -50.0, 83.0, 89.9] {
            let wo = direction_deg(theta, 0.0);
            let total = sphere(narrowest, |wi| medium.evaluate(wi, wo).value);
            for (c, expected) in [1.0, 0.5, 0.001].into_iter().enumerate() {
                assert!(
                    (total[c] / expected - 1.0).abs() < 1e-8,
                    "{widths:?} {theta}: {total:?}"
                );
            }
        }
    }
    // Control: without its normalizer the function integrates to something else.
    let fiber = Khungurn
        .prepare(&khungurn([0.1; 3], [0.85; 3], [5.0, 10.0, 10.0]))
        .unwrap();
    let wo = direction_deg(-50.0, 0.0);
    let bare = sphere(5.0, |wi| fiber.evaluate(wi, wo, 0.0).value);
    assert!((bare[0] - 1.0).abs() > 0.1, "{bare:?}");
}

#[test]
fn microflakes_are_reciprocal_and_the_volume_bcsdf_is_not() {
    let mut random = stream(30, 0);
    let mut direction = || {
        let sin: f64 = 2.0 * random.uniform() - 1.0;
        fiber_direction(sin.asin(), TAU * random.uniform())
    };
    for gamma in [0.013, 0.3, 1.5] {
        let medium = Microflake.prepare(&microflake([0.7; 3], gamma)).unwrap();
        for _ in 0..500 {
            let (a, b) = (direction(), direction());
            let ab = medium.extinction(b) * medium.evaluate(a, b).value[0];
            let ba = medium.extinction(a) * medium.evaluate(b, a).value[0];
            assert!((ab - ba).abs() <= 1e-9 * ba + 1e-30, "{ab} {ba}");
        }
    }
    let medium = KhungurnVolume
        .prepare(&Parameters::defaults(&KhungurnVolume))
        .unwrap();
    let kernel = |a: DVec3, b: DVec3| medium.extinction(b) * medium.evaluate(a, b).value[0];
    let ratios = [(0.0, 5.0), (45.0, -40.0), (80.0, -70.0)].map(|(theta_i, theta_o)| {
        let (wi, wo) = (direction_deg(theta_i, 0.0), direction_deg(theta_o, 143.0));
        kernel(wi, wo) / kernel(wo, wi)
    });
    println!("{ratios:?}");
    let close = |(found, expected): (f64, f64)| (found / expected - 1.0).abs() < 1e-3;
    assert!(
        ratios
            .into_iter()
            .zip([0.98497, 1.38047, 19.3734])
            .all(close),
        "{ratios:?}"
    );
}

/// What a beam from `wi` leaves with, over what it met: `int e(wo) p(wi | wo) dwo / e(wi)`.
fn kept(
    medium: &dyn Medium,
    theta_i: f64,
    integral: impl Fn(&dyn Fn(DVec3) -> [f64; 3]) -> f64,
) -> f64 {
    let wi = direction_deg(theta_i, 0.0);
    let at = |wo: DVec3| {
        let e = medium.extinction(wo);
        medium.evaluate(wi, wo).value.map(|v| v * e)
    };
    integral(&at) / medium.extinction(wi)
}

#[test]
fn white_microflakes_keep_a_beam_and_the_volume_bcsdf_does_not() {
    for gamma in [0.013, 0.3, 1.5] {
        let medium = Microflake.prepare(&microflake([1.0; 3], gamma)).unwrap();
        for theta in [0.0, 60.0, 88.0] {
            let wi = direction_deg(theta, 0.0);
            let k = kept(medium.as_ref(), theta, |f| flake_integral(wi, gamma, f)[0]);
            assert!((k - 1.0).abs() < 1e-8, "{gamma} {theta}: {k}");
        }
    }
    let widths = [5.0, 10.0, 10.0];
    let medium = KhungurnVolume
        .prepare(&volume([0.1; 3], [0.85; 3], widths, [1.0; 3]))
        .unwrap();
    let beams = [0.0, 60.0, 80.0, 88.0].map(|t| kept(medium.as_ref(), t, |f| sphere(5.0, f)[0]));
    println!("{beams:?}");
    let close = |(found, expected): (f64, f64)| (found / expected - 1.0).abs() < 1e-3;
    assert!(
        beams
            .into_iter()
            .zip([0.94753, 1.15278, 2.23855, 9.11849])
            .all(close),
        "{beams:?}"
    );
}

#[test]
fn no_direction_passes_the_majorant_and_opposite_ones_are_alike() {
    for (name, medium) in media_cases::media() {
        let (mut most, mut random) = (0.0_f64, stream(31, 0));
        for k in 0..2000 {
            let theta = if k == 0 {
                0.0
            } else {
                FRAC_PI_2 * (2.0 * random.uniform() - 1.0)
            };
            let w = fiber_direction(theta, TAU * random.uniform());
            let e = medium.extinction(w);
            assert!(
                (0.0..=medium.majorant() * (1.0 + 1e-12)).contains(&e),
                "{name} {w}: {e}"
            );
            assert_eq!(e, medium.extinction(-w));
            most = most.max(e);
        }
        assert!(
            (most / medium.majorant() - 1.0).abs() < 1e-12,
            "{name}: {most}"
        );
    }
}

// ---- derivatives ---------------------------------------------------------------------------------------------------

/// What the five-point differences allow.
const TOLERANCE: f64 = 1e-6;

/// Media with one parameter moved by so many steps; none where the model refuses.
struct Moved<'a> {
    model: &'a dyn MediumModel,
    parameters: &'a Parameters,
    slot: usize,
    step: f64,
    made: RefCell<BTreeMap<i64, Option<Rc<dyn Medium>>>>,
}

impl Moved<'_> {
    fn at(&self, steps: f64) -> Option<Rc<dyn Medium>> {
        let make = || {
            let mut values = self.parameters.values().to_vec();
            values[self.slot] += steps * self.step;
            let moved = self.model.prepare(&self.parameters.with_values(values));
            moved.ok().map(Rc::from)
        };
        let mut made = self.made.borrow_mut();
        made.entry(steps as i64).or_insert_with(make).clone()
    }
}

/// Largest difference between stated derivatives and finite differences, of `alpha p` and of the extinction, over all parameters,
/// channels and pairs of directions, relative to max(|f|/range, |df|); stated ones are multiplied by `factor`.
fn derivative_error(model: &dyn MediumModel, parameters: &Parameters, factor: f64) -> f64 {
    let medium = model.prepare(parameters).unwrap();
    let mut worst = 0.0_f64;
    for (slot, (row, _)) in parameters.places().into_iter().enumerate() {
        let info = &parameters.infos()[row];
        let range = info.upper - info.lower;
        let x = parameters.values()[slot];
        let step = 2e-4 * if x > 0.0 { x.min(range) } else { range };
        let made = RefCell::default();
        let moved = Moved {
            model,
            parameters,
            slot,
            step,
            made,
        };
        for (wi, wo) in pairs() {
            let (found, slopes) = (medium.evaluate(wi, wo), medium.extinction_slopes(wo));
            let phase = five_points(&|k| Some(moved.at(k)?.evaluate(wi, wo).value), step);
            let extinction = five_points(&|k| Some([moved.at(k)?.extinction(wo); 3]), step);
            let mut see = |value: f64, stated: f64, slope: f64| {
                let scale = (value.abs() / range).max(slope.abs()) + 1e-30;
                let error = (factor * stated - slope).abs() / scale;
                let context = format!("{} at {wi}, {wo}: {stated} {slope}", info.name);
                assert!(error.is_finite(), "{context}");
                assert!(
                    factor > 1.0 || error < TOLERANCE,
                    "{context}: {parameters:?}"
                );
                worst = worst.max(error);
            };
            see(medium.extinction(wo), slopes[row], extinction[0]);
            for c in 0..3 {
                if parameters.slot(row, c) == slot {
                    see(found.value[c], found.derivative[row][c], phase[c]);
                }
            }
        }
    }
    worst
}

fn pairs() -> Vec<(DVec3, DVec3)> {
    [
        (0.0, 0.0, 0.0, 170.0),
        (0.0, 0.0, 1.0, 179.5),
        (30.0, 10.0, -31.0, 189.0),
        (-70.0, 0.0, 68.5, 181.0),
        (89.5, 20.0, -89.0, 199.5),
        (-90.0, 0.0, 89.9, 180.0),
        (-89.9, 0.0, 90.0, 180.0),
        (45.0, 0.0, -44.0, 0.0),
    ]
    .map(|(ti, pi, to, po)| (direction_deg(ti, pi), direction_deg(to, po)))
    .into()
}

fn all_models() -> Vec<&'static dyn MediumModel> {
    let names = [
        "microflake",
        "microflake-density",
        "khungurn-volume",
        "khungurn-volume-density",
    ];
    names.map(|name| model(name).unwrap()).into()
}

#[test]
fn derivatives_at_the_defaults_and_at_every_bound() {
    for model in all_models() {
        let defaults = Parameters::defaults(model);
        let mut sets = vec![defaults.values().to_vec()];
        for (slot, (row, _)) in defaults.places().into_iter().enumerate() {
            let info = &defaults.infos()[row];
            // What comes before the density is tested without it.
            if model.name().ends_with("-density") && info.name != "density_scale" {
                continue;
            }
            for bound in [info.lower, info.upper] {
                let mut values = defaults.values().to_vec();
                values[slot] = bound;
                sets.push(values);
            }
        }
        let error = |values| derivative_error(model, &defaults.with_values(values), 1.0);
        let largest = sets.into_iter().map(error).fold(0.0, f64::max);
        println!("{}: largest error {largest:.1e}", model.name());
    }
}

#[test]
fn derivatives_at_the_corners_and_where_colors_are_zero_and_one() {
    let mut sets: Vec<(&dyn MediumModel, Parameters)> = Vec::new();
    for gamma in [0.001, 0.005, 0.6, 1.5, 100.0] {
        sets.push((&Microflake, microflake([0.0, 0.5, 1.0], gamma)));
    }
    for widths in [[1.0, 10.0, 1.0], [10.0, 45.0, 45.0], [1.0, 45.0, 20.0]] {
        let colors = ([0.0, 0.5, 1.0], [1.0, 0.0, 0.5]);
        sets.push((
            &KhungurnVolume,
            volume(colors.0, colors.1, widths, [0.0, 1.0, 0.5]),
        ));
        let colors = ([0.001, 0.999, 0.3], [0.999, 0.001, 0.9]);
        sets.push((
            &KhungurnVolume,
            volume(colors.0, colors.1, widths, [0.999, 0.001, 1.0]),
        ));
    }
    for (model, parameters) in &sets {
        derivative_error(*model, parameters, 1.0);
    }
}

#[test]
fn control_derivatives_off_by_a_thousandth_fail() {
    for model in all_models() {
        let error = derivative_error(model, &Parameters::defaults(model), 1.001);
        assert!(error > 10.0 * TOLERANCE, "{}: {error:.1e}", model.name());
    }
}

#[test]
fn an_albedo_of_zero_has_a_derivative_and_is_followed() {
    for (name, medium) in [
        (
            "microflake",
            Microflake.prepare(&microflake([0.0; 3], 0.1)).unwrap(),
        ),
        (
            "volume",
            KhungurnVolume
                .prepare(&volume([0.1; 3], [0.85; 3], [5.0, 10.0, 10.0], [0.0; 3]))
                .unwrap(),
        ),
    ] {
        let (wi, wo) = pairs()[2];
        let e = medium.evaluate(wi, wo);
        let row = if name == "microflake" { 0 } else { 5 };
        assert!(
            e.value == [0.0; 3] && e.derivative[row][0] > 0.0,
            "{name}: {e:?}"
        );
        let (value, pdf) = medium.importance(wi, &medium.outgoing(wo, [1.0; 3]));
        assert!(value[0] > 0.0 && pdf > 0.0, "{name}");
    }
}

// ---- where directions and parameters degenerate --------------------------------------------------------------------

#[test]
fn everything_stays_finite_along_the_axis_and_at_the_ends_of_every_range() {
    for (name, medium) in media_cases::media() {
        let mut random = stream(32, 0);
        for (wi, wo) in hostile()
            .into_iter()
            .flat_map(|i| hostile().map(|o| (i, o)))
        {
            let e = medium.evaluate(wi, wo);
            let o = medium.outgoing(wo, [1.0, 0.0, 0.5]);
            let (value, pdf) = medium.importance(wi, &o);
            let sampled = medium.sample(&o, &mut random);
            let slopes = medium.extinction_slopes(wo);
            let all = (e.value.iter().chain(&value).chain(&slopes))
                .chain(e.derivative.iter().flatten())
                .chain(&sampled.weight)
                .chain([
                    &pdf,
                    &sampled.pdf,
                    &sampled.wi.x,
                    &sampled.wi.y,
                    &sampled.wi.z,
                ]);
            for x in all {
                assert!(
                    x.is_finite(),
                    "{name}, wi {wi:?}, wo {wo:?}: {e:?}, {sampled:?}"
                );
            }
            assert!(e.value.iter().chain(&value).all(|&v| v >= 0.0) && pdf >= 0.0);
            assert!(sampled.pdf > 0.0 && (sampled.wi.length() - 1.0).abs() < 1e-14);
        }
    }
}

#[test]
fn a_direction_that_is_not_a_number_is_not_hidden() {
    for (name, medium) in media_cases::media() {
        let nan = medium.outgoing(DVec3::NAN, [1.0; 3]);
        let sampled = medium.sample(&nan, &mut stream(33, 0));
        let fine = medium.outgoing(DVec3::Y, [1.0; 3]);
        let all = [
            medium.extinction(DVec3::NAN),
            medium.evaluate(DVec3::NAN, DVec3::Y).value[0],
            medium.evaluate(DVec3::Y, DVec3::NAN).value[1],
            medium.importance(DVec3::NAN, &fine).1,
            medium.importance(DVec3::Y, &nan).1,
            sampled.wi.x,
            sampled.pdf,
        ];
        assert!(all.iter().all(|x| x.is_nan()), "{name}: {all:?}");
    }
}

// ---- parameters ----------------------------------------------------------------------------------------------------

#[test]
fn parameters_are_read_by_name_and_the_density_is_one_if_asked_for() {
    for plain in models() {
        let dense = model(&format!("{}-density", plain.name())).unwrap();
        let (own, all) = (Parameters::defaults(*plain), Parameters::defaults(dense));
        assert_eq!(
            Parameters::from_json(*plain, &own.to_json())
                .unwrap()
                .to_json(),
            own.to_json()
        );
        assert_eq!(all.flat_names().last().unwrap(), "density_scale");
        assert_eq!(own.flat_names()[..], all.flat_names()[..own.values().len()]);
        let mut values = all.values().to_vec();
        *values.last_mut().unwrap() = 2.5;
        let scaled = dense.prepare(&all.with_values(values)).unwrap();
        let once = plain.prepare(&own).unwrap();
        let (wi, wo) = pairs()[3];
        assert_eq!(scaled.extinction(wo), 2.5 * once.extinction(wo));
        assert_eq!(scaled.majorant(), 2.5 * once.majorant());
        assert_eq!(scaled.evaluate(wi, wo).value, once.evaluate(wi, wo).value);
        let row = dense.parameters().len() - 1;
        assert_eq!(scaled.extinction_slopes(wo)[row], once.extinction(wo));
    }
    assert_eq!(Parameters::defaults(&KhungurnVolume).values().len(), 12);
    let texts = [
        (json!({"albedo": [0.5, 0.5, 0.5]}), "'gamma' is missing"),
        (
            json!({"albedo": 0.5, "gamma": 0.1}),
            "'albedo': expected a list of 3 numbers",
        ),
        (
            json!({"albedo": [0.5, 0.5, 0.5], "gama": 0.1}),
            "unknown key 'gama' for model microflake",
        ),
    ];
    for (object, expected) in texts {
        let error = Parameters::from_json(&Microflake, &object).unwrap_err();
        assert!(error.to_string().contains(expected), "{error}");
    }
}

#[test]
fn meaningless_parameters_are_refused_and_say_what_is_expected() {
    let refused = |model: &dyn MediumModel, parameters: &Parameters, expected: &str| {
        let error = model.prepare(parameters).err().unwrap();
        assert!(error.to_string().contains(expected), "{error}");
    };
    for gamma in [0.0, -0.1, 1e-4, 101.0, f64::NAN] {
        let expected = "expected 0.001 to 100";
        refused(&Microflake, &microflake([0.5; 3], gamma), expected);
    }
    refused(
        &Microflake,
        &microflake([0.5, 1.1, 0.5], 0.1),
        "microflake: 'albedo' is 1.1, expected 0 to 1",
    );
    let widths = [5.0, 10.0, 10.0];
    refused(
        &KhungurnVolume,
        &volume([0.5; 3], [0.5; 3], [5.0, 0.0, 10.0], [0.5; 3]),
        "khungurn-volume: 'beta_tt_deg' is 0, expected 0.01 to 360",
    );
    refused(
        &KhungurnVolume,
        &volume([0.5, 0.0, 0.5], [0.5, 0.0, 0.5], widths, [0.5; 3]),
        "leave no light to scatter",
    );
    refused(
        &KhungurnVolume,
        &volume([0.5; 3], [0.5; 3], widths, [f64::NAN; 3]),
        "'albedo' is NaN",
    );
    let error = model("microflak").err().unwrap();
    assert!(
        error
            .to_string()
            .contains("unknown model of media 'microflak'"),
        "{error}"
    );
}
