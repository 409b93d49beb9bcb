//! Where the residuals lie: mean signed relative residuals of groups of numbers, with their errors.
//!
//! A group's error is that of [`Residuals::standard_error`]: what errors alone would leave of its mean after the fit has
//! taken its part. A group is called significant when its mean would be rare among *all* groups looked at (Sidak 1967).
//! Says nothing of why; a wrong model is spread by the fit over groups that are not to blame.

use super::goodness::{Residuals, normal_above};
use super::objective::Objective;
use super::result::Pattern;
use crate::math::statistics::sidak_level;
use crate::scatter::CHANNELS;
use crate::session::Configuration;

/// Probability that any group of a right model is called significant.
const FAMILY_LEVEL: f64 = 0.01;
/// From here on a direction is grazing, degrees.
const GRAZING_DEG: f64 = 60.0;
/// Camera and lamp are in one plane with the normal within this, degrees.
const IN_PLANE_DEG: f64 = 10.0;
const NAMES: [&str; CHANNELS] = ["red", "green", "blue"];

/// Numbers that are looked at together.
struct Group {
    name: String,
    /// Subject and verb of a sentence.
    subject: String,
    numbers: Vec<usize>,
}

/// Name, words and members of one side of a distinction.
type Side<'a> = (&'a str, &'a str, &'a dyn Fn(&Configuration) -> bool);

/// All groups, in a fixed order.
pub(super) fn patterns(residuals: &Residuals, objective: &Objective) -> Vec<Pattern> {
    let mut groups = groups(&objective.configurations());
    for group in &mut groups {
        group.numbers.retain(|&m| residuals.present[m]);
    }
    groups.retain(|g| !g.numbers.is_empty());
    let weights = objective.weights().as_flattened();
    let level = sidak_level(FAMILY_LEVEL, groups.len().max(1));
    let one = |group: Group| {
        let mut a = vec![0.0; residuals.residual.len()];
        for &m in &group.numbers {
            a[m] = weights[m].sqrt() / group.numbers.len() as f64;
        }
        let mean: f64 = a.iter().zip(&residuals.residual).map(|(a, e)| a * e).sum();
        let se = residuals.standard_error(&a);
        let probability = if se > 0.0 {
            2.0 * normal_above((mean / se).abs())
        } else {
            1.0
        };
        let significant = probability < level;
        let sign = if mean < 0.0 { "under" } else { "over" };
        Pattern {
            sentence: format!(
                "{} {sign}-predicted by {} +- {} %",
                group.subject,
                digits(100.0 * mean.abs(), 100.0 * se),
                digits(100.0 * se, 100.0 * se)
            ),
            name: group.name,
            numbers: group.numbers.len(),
            mean_percent: 100.0 * mean,
            se_percent: 100.0 * se,
            probability,
            significant,
        }
    };
    groups.into_iter().map(one).collect()
}

/// As many decimals as the error deserves.
fn digits(x: f64, se: f64) -> String {
    let decimals = if se >= 0.95 {
        0
    } else if se >= 0.095 {
        1
    } else {
        2
    };
    format!("{x:.decimals$}")
}

fn groups(configurations: &[Configuration]) -> Vec<Group> {
    let mut groups = vec![of(configurations, "all", "", |_| true)];
    let grazing = GRAZING_DEG.to_radians() - 1e-9;
    let camera = |c: &Configuration| c.camera.theta >= grazing;
    let lamp = |c: &Configuration| c.light.theta >= grazing;
    let sides: [Side<'_>; 6] = [
        (
            "camera grazing",
            " with the camera beyond 60 degrees",
            &camera,
        ),
        ("camera steep", " with the camera within 60 degrees", &|c| {
            !camera(c)
        }),
        ("lamp grazing", " with the lamp beyond 60 degrees", &lamp),
        ("lamp steep", " with the lamp within 60 degrees", &|c| {
            !lamp(c)
        }),
        ("in plane", " in the plane of incidence", &in_plane),
        ("out of plane", " out of the plane of incidence", &|c| {
            !in_plane(c)
        }),
    ];
    for (name, words, belongs) in sides {
        groups.push(of(configurations, name, words, belongs));
    }
    let degrees = |c: &Configuration| c.rotation.to_degrees().round() as i64;
    let mut rotations: Vec<i64> = configurations.iter().map(degrees).collect();
    rotations.sort_unstable();
    rotations.dedup();
    // Many turns are no pattern but a scan.
    for turn in rotations
        .into_iter()
        .filter(|_| configurations.len() > 1)
        .take(8)
    {
        groups.push(of(
            configurations,
            &format!("rotation {turn}"),
            &format!(" at rotation {turn} degrees"),
            |c| degrees(c) == turn,
        ));
    }
    // A group of everything is already the first one.
    let whole = CHANNELS * configurations.len();
    let mut first = true;
    groups.retain(|g| {
        let kept = !g.numbers.is_empty() && (first || g.numbers.len() < whole);
        first = false;
        kept
    });
    for (c, name) in NAMES.iter().enumerate() {
        groups.push(Group {
            name: (*name).to_owned(),
            subject: format!("the {name} intensities are"),
            numbers: (0..configurations.len())
                .map(|i| CHANNELS * i + c)
                .collect(),
        });
    }
    groups
}

fn of(
    configurations: &[Configuration],
    name: &str,
    words: &str,
    belongs: impl Fn(&Configuration) -> bool,
) -> Group {
    let members: Vec<usize> = (configurations.iter().enumerate())
        .filter(|(_, c)| belongs(c))
        .map(|(i, _)| i)
        .collect();
    let subject = match members.len() {
        1 => format!("the one configuration{words} is"),
        n if words.is_empty() => format!("all {n} configurations are"),
        n => format!("the {n} configurations{words} are"),
    };
    Group {
        name: name.to_owned(),
        subject,
        numbers: members
            .iter()
            .flat_map(|i| (0..CHANNELS).map(move |c| CHANNELS * i + c))
            .collect(),
    }
}

/// Are lamp, normal and camera in one plane?
fn in_plane(c: &Configuration) -> bool {
    let upright = 1.0_f64.to_radians();
    let apart = (c.camera.phi - c.light.phi).sin().abs();
    c.camera.theta < upright || c.light.theta < upright || apart < IN_PLANE_DEG.to_radians().sin()
}
