//! Bounds of parameters narrower than the model's own, by name.
//!
//! Khungurn 2015 fits black velvet with C_R >= 0.04, for one. A name means every flat place it fits: `c_r` all channels,
//! `c_r.g` one, and where each yarn system has its own parameters `c_r` those of both and `warp.c_r` those of one. All bounds
//! that name a place hold together, and the model's own with them: nothing here widens a range. The coordinates of the
//! search stay those of the model's range; only its box becomes smaller.

use super::certainty::three_digits;
use crate::base::{Error, Result};
use crate::scatter::{ParameterInfo, Parameters, Unit};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::fmt;

/// The least that bounds may leave, as a share of the model's range.
const LEAST: f64 = 1e-3;

/// Lower and upper bounds by name, angles in degrees as in files; none where the model's own are to hold alone.
#[derive(Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Bounds(BTreeMap<String, [f64; 2]>);

impl Bounds {
    /// Reads `NAME=LOW..HIGH`, any number of them.
    ///
    /// # Errors
    /// When one is of another form, or no range.
    pub fn parse(texts: &[String]) -> Result<Self> {
        let mut all = BTreeMap::new();
        for text in texts {
            let (name, [low, high]) = read(text).ok_or_else(|| {
                Error::new(format!(
                    "bound '{text}' is not NAME=LOW..HIGH with numbers LOW < HIGH"
                ))
                .with_hint("write e.g. c_r=0.04..1 or beta_r=2..8 (angles in degrees)")
            })?;
            let both = all.entry(name.to_owned()).or_insert([low, high]);
            *both = [both[0].max(low), both[1].min(high)];
        }
        Ok(Self(all))
    }

    /// Whether the model's own bounds hold alone.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The bounds of every flat place of `parameters`' model, radians for angles.
    ///
    /// # Errors
    /// When a name is no parameter of the model, or hardly anything of its range is left.
    pub fn over(&self, parameters: &Parameters) -> Result<Vec<[f64; 2]>> {
        let (infos, names) = (parameters.infos(), parameters.flat_names());
        let places = parameters.places();
        let rows = || places.iter().map(|(row, _)| &infos[*row]).zip(&names);
        if let Some(unknown) =
            (self.0.keys()).find(|name| !rows().any(|(info, flat)| means(name, info, flat)))
        {
            let known: Vec<&str> = infos.iter().map(|p| p.name).collect();
            return Err(
                Error::new(format!("bound {unknown}: the model has no such parameter")).with_hint(
                    format!(
                        "its parameters: {}; a channel of a color: c_r.g",
                        known.join(", ")
                    ),
                ),
            );
        }
        rows().map(|(info, flat)| self.of(info, flat)).collect()
    }

    /// The bounds of one flat place.
    fn of(&self, info: &ParameterInfo, flat: &str) -> Result<[f64; 2]> {
        let [mut low, mut high] = [info.lower, info.upper];
        for (_, range) in self.0.iter().filter(|(name, _)| means(name, info, flat)) {
            let [from, to] = range.map(|x| from_file(info, x));
            (low, high) = (low.max(from), high.min(to));
        }
        if high - low >= LEAST * (info.upper - info.lower) {
            return Ok([low, high]);
        }
        let [low, high, least, most] = [low, high, info.lower, info.upper].map(|x| shown(info, x));
        Err(Error::new(format!(
            "the bounds of {flat} leave {low} to {high} of the model's {least} to {most}, expected at least a thousandth of it"
        ))
        .with_hint("bounds hold together with the model's own (docs/models.md); angles are in degrees"))
    }

    /// What these bounds change without being told apart from others: where the model's own hold instead, and where a fit from
    /// `start` begins elsewhere, inside.
    ///
    /// # Errors
    /// As [`Bounds::over`].
    pub fn notes(&self, start: &Parameters) -> Result<Vec<String>> {
        let (infos, names) = (start.infos(), start.flat_names());
        let infos: Vec<_> = (start.places().iter())
            .map(|(row, _)| &infos[*row])
            .collect();
        let mut notes = Vec::new();
        for (name, range) in &self.0 {
            let mut places = infos.iter().zip(&names);
            let Some((info, _)) = places.find(|(info, flat)| means(name, info, flat)) else {
                continue;
            };
            let [low, high] = range.map(|x| from_file(info, x));
            for (beyond, side, limit) in [
                (low < info.lower, "lower", info.lower),
                (high > info.upper, "upper", info.upper),
            ] {
                if beyond {
                    let limit = shown(info, limit);
                    notes.push(format!(
                        "bound {name}: the model's own {side} bound {limit} holds"
                    ));
                }
            }
        }
        let places = infos.iter().zip(&names).zip(start.values());
        for (((info, flat), value), [low, high]) in places.zip(self.over(start)?) {
            // One outside the model's own bounds is refused by the fit.
            let inside = value.clamp(low, high);
            if (inside - value).abs() > 1e-9 && (info.lower..=info.upper).contains(value) {
                notes.push(format!(
                    "{flat}: the start {} is outside the bounds, so the fit begins at {}",
                    shown(info, *value),
                    shown(info, inside)
                ));
            }
        }
        Ok(notes)
    }
}

/// As they are asked for; nothing when there are none.
impl fmt::Display for Bounds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let one = |(name, [low, high]): (&String, &[f64; 2])| format!("{name}={low}..{high}");
        let all: Vec<String> = self.0.iter().map(one).collect();
        f.write_str(&all.join(", "))
    }
}

/// On one line: journals compare options by their text.
impl fmt::Debug for Bounds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Bounds({self})")
    }
}

fn read(text: &str) -> Option<(&str, [f64; 2])> {
    let (name, range) = text.split_once('=')?;
    let (low, high) = range.split_once("..")?;
    let number = |x: &str| x.trim().parse().ok().filter(|x: &f64| x.is_finite());
    let range = [number(low)?, number(high)?];
    (!name.trim().is_empty() && range[0] < range[1]).then_some((name.trim(), range))
}

/// Whether a bound of this name is one of the flat place called `flat`.
fn means(name: &str, info: &ParameterInfo, flat: &str) -> bool {
    let name = match info.unit {
        Unit::Angle => name.strip_suffix("_deg").unwrap_or(name),
        Unit::One => name,
    };
    // Without its yarn system a name means both.
    let whole = [flat, info.name];
    let own = whole.map(|full| match info.system() {
        Some(system) => &full[system.len() + 1..],
        None => full,
    });
    whole.contains(&name) || own.contains(&name)
}

fn from_file(info: &ParameterInfo, value: f64) -> f64 {
    match info.unit {
        Unit::One => value,
        Unit::Angle => value.to_radians(),
    }
}

fn shown(info: &ParameterInfo, value: f64) -> String {
    match info.unit {
        Unit::One => three_digits(value),
        Unit::Angle => format!("{} degrees", three_digits(value.to_degrees())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scatter::{Khungurn, Model, per_system};

    fn bounds(texts: &[&str]) -> Result<Bounds> {
        Bounds::parse(&texts.iter().map(|t| (*t).to_owned()).collect::<Vec<_>>())
    }

    fn over(model: &dyn Model, texts: &[&str]) -> Result<Vec<[f64; 2]>> {
        bounds(texts)?.over(&Parameters::defaults(model))
    }

    #[test]
    fn names_mean_channels_and_yarn_systems() {
        let all = over(&Khungurn, &["c_r=0.04..1", "c_r.g=0.1..0.5", "beta_r=2..8"]).unwrap();
        assert_eq!(all[..3], [[0.04, 0.999], [0.1, 0.5], [0.04, 0.999]]);
        assert_eq!(all[3..6], [[0.001, 0.999]; 3]);
        assert!((all[6][0].to_degrees() - 2.0).abs() < 1e-12, "{all:?}");
        assert!((all[6][1].to_degrees() - 8.0).abs() < 1e-12, "{all:?}");
        // In any order, and with the key of parameter files.
        let turned = ["beta_r_deg=2..8", "c_r.g=0.1..0.5", "c_r=0.04..1"];
        assert_eq!(over(&Khungurn, &turned).unwrap(), all);
        let two = per_system(&Khungurn).unwrap();
        let all = over(two, &["c_r=0.04..0.9", "weft.c_r.b=0.2..0.3"]).unwrap();
        assert_eq!(all[..3], [[0.04, 0.9]; 3]);
        assert_eq!(all[9..12], [[0.04, 0.9], [0.04, 0.9], [0.2, 0.3]]);
        assert_eq!(
            over(&Khungurn, &[]).unwrap(),
            over(&Khungurn, &["c_tt=0..1"]).unwrap()
        );
    }

    #[test]
    fn faults_are_named() {
        for (texts, fault) in [
            (&["c_r"][..], "bound 'c_r' is not NAME=LOW..HIGH"),
            (&["c_r=0.1"], "is not NAME=LOW..HIGH"),
            (&["=0.1..1"], "is not NAME=LOW..HIGH"),
            (&["c_r=0.5..0.1"], "is not NAME=LOW..HIGH"),
            (&["c_r=0.5..0.5"], "is not NAME=LOW..HIGH"),
            (&["c_r=nan..1"], "is not NAME=LOW..HIGH"),
            (&["c_r=0..inf"], "is not NAME=LOW..HIGH"),
            (
                &["c_x=0.1..1"],
                "bound c_x: the model has no such parameter",
            ),
            (&["c_r.x=0.1..1"], "bound c_r.x: the model has no"),
            (&["c_r_deg=0.1..1"], "bound c_r_deg: the model has no"),
            (&["warp.c_r=0.1..1"], "bound warp.c_r: the model has no"),
            (&["c_r=2..3"], "the bounds of c_r.r leave 2.00 to 0.999"),
            (
                &["c_r=0.1..0.2", "c_r.b=0.3..1"],
                "the bounds of c_r.b leave 0.300 to 0.200",
            ),
            (&["beta_r=5..5.001"], "leave 5.00 degrees to 5.00 degrees"),
        ] {
            let report = over(&Khungurn, texts).unwrap_err().report();
            assert!(report.contains(fault), "{texts:?}: {report}");
        }
    }

    #[test]
    fn what_changes_is_told_and_nothing_else() {
        let start = Parameters::defaults(&Khungurn);
        let notes = |texts: &[&str]| bounds(texts).unwrap().notes(&start).unwrap();
        assert_eq!(notes(&["c_r=0.04..0.5", "beta_tt=10..20"]), [""; 0]);
        assert_eq!(
            notes(&["c_r=0.04..1", "gamma_tt=12..20", "c_tt.g=0.1..0.5"]),
            [
                "bound c_r: the model's own upper bound 0.999 holds",
                "c_tt.g: the start 0.850 is outside the bounds, so the fit begins at 0.500",
                "gamma_tt: the start 10.0 degrees is outside the bounds, so the fit begins at 12.0 degrees",
            ]
        );
    }
}
