//! Parameter values by name: the one form in which fits, renderers and files exchange them.

use super::{CHANNELS, Parametric, YARN_SYSTEMS, has_per_system};
use crate::base::{Context, Error, Result};
use serde_json::{Map, Value, json};

/// What a parameter's number means.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unit {
    /// A pure number.
    One,
    /// Radians inside, degrees in files (where the name gets the suffix `_deg`).
    Angle,
}

/// Name, unit and published range of one model parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ParameterInfo {
    /// Code name, e.g. `beta_tt`, or `weft.beta_tt` where each yarn system has its own.
    pub name: &'static str,
    /// True when each color channel has its own value.
    pub per_channel: bool,
    /// Unit of the value and of the bounds (radians for angles).
    pub unit: Unit,
    /// Lower bound of the published domain.
    pub lower: f64,
    /// Upper bound of the published domain.
    pub upper: f64,
    /// Published default.
    pub default: f64,
}

impl ParameterInfo {
    /// The key in parameter files: the name without its yarn system, which has an object of its own there, with `_deg` for
    /// angles.
    pub fn file_key(&self) -> String {
        let name = self.own_name();
        match self.unit {
            Unit::One => name.to_owned(),
            Unit::Angle => format!("{name}_deg"),
        }
    }

    /// The name without its yarn system.
    pub fn own_name(&self) -> &'static str {
        self.name.rsplit('.').next().unwrap_or(self.name)
    }

    /// The yarn system whose fibers it describes; none when it describes all.
    pub fn system(&self) -> Option<&'static str> {
        self.name.split_once('.').map(|(system, _)| system)
    }

    /// How many numbers it is: 3 when per channel, else 1.
    pub fn len(&self) -> usize {
        if self.per_channel { CHANNELS } else { 1 }
    }

    /// Never true; pairs with [`ParameterInfo::len`].
    pub fn is_empty(&self) -> bool {
        false
    }
}

/// Values of a model's parameters as one flat vector: per-channel parameters take three consecutive places (r, g, b).
///
/// Row `j` of a derivative belongs to [`Parameters::infos`]`()[j]`; [`Parameters::slot`] tells which flat place a row
/// and a channel share. Khungurn 2015: rows c_r, c_tt, beta_r, beta_tt, gamma_tt; 9 flat places.
#[derive(Debug, Clone, PartialEq)]
pub struct Parameters {
    infos: &'static [ParameterInfo],
    values: Vec<f64>,
}

impl Parameters {
    /// The published defaults of `model`.
    pub fn defaults(model: &dyn Parametric) -> Self {
        let infos = model.parameters();
        let values = infos
            .iter()
            .flat_map(|p| std::iter::repeat_n(p.default, p.len()))
            .collect();
        Self { infos, values }
    }

    /// The same parameters with other values (flat, radians).
    ///
    /// # Panics
    /// When the count differs: that is a fault of the program, not of its input.
    #[must_use]
    pub fn with_values(&self, values: Vec<f64>) -> Self {
        assert_eq!(values.len(), self.values.len(), "flat parameter count");
        Self {
            infos: self.infos,
            values,
        }
    }

    /// The descriptions, one per row.
    pub fn infos(&self) -> &'static [ParameterInfo] {
        self.infos
    }

    /// The flat values, radians for angles.
    pub fn values(&self) -> &[f64] {
        &self.values
    }

    /// The flat place of `row` in `channel`.
    pub fn slot(&self, row: usize, channel: usize) -> usize {
        let start: usize = self.infos[..row].iter().map(ParameterInfo::len).sum();
        if self.infos[row].per_channel {
            start + channel
        } else {
            start
        }
    }

    /// One (row, channel within the row) per flat place.
    pub fn places(&self) -> Vec<(usize, usize)> {
        (0..self.infos.len())
            .flat_map(|row| (0..self.infos[row].len()).map(move |c| (row, c)))
            .collect()
    }

    /// Names of the flat places: `c_r.r`, `c_r.g`, ..., `beta_r`.
    pub fn flat_names(&self) -> Vec<String> {
        self.places()
            .into_iter()
            .map(|(row, c)| {
                let info = &self.infos[row];
                if info.per_channel {
                    format!("{}.{}", info.name, ["r", "g", "b"][c])
                } else {
                    info.name.to_owned()
                }
            })
            .collect()
    }

    /// The value(s) of the row named `name` for each channel (a scalar is repeated).
    ///
    /// # Panics
    /// When the model has no such parameter: a fault of the program.
    pub fn channels(&self, name: &str) -> [f64; CHANNELS] {
        let row = self.infos.iter().position(|p| p.name == name);
        let row = row.unwrap_or_else(|| panic!("no parameter named {name}"));
        std::array::from_fn(|c| self.values[self.slot(row, c)])
    }

    /// The value of the scalar parameter `name`; see [`Parameters::channels`].
    pub fn scalar(&self, name: &str) -> f64 {
        self.channels(name)[0]
    }

    /// Reads a parameter file's object: `{"c_r": [3], ..., "beta_r_deg": 5.0, ...}`. For a model with parameters per yarn
    /// system `{"warp": {...}, "weft": {...}}` with one such object for each, or one object that serves all.
    ///
    /// # Errors
    /// A key is missing, unknown (a near name is suggested), of the wrong shape, or not finite.
    pub fn from_json(model: &dyn Parametric, object: &Value) -> Result<Self> {
        let (infos, systems) = (model.parameters(), model.systems());
        if !systems.iter().any(|s| object.get(s).is_some()) {
            let rows = &infos[..infos.len() / systems.len().max(1)];
            let per_system = has_per_system(model.name());
            let set = read_set(model.name(), per_system, rows, object)?;
            let values = set.repeat(systems.len().max(1));
            return Ok(Self { infos, values });
        }
        let unknown = |key: &&String| !systems.contains(&key.as_str());
        if let Some(key) = object.as_object().and_then(|m| m.keys().find(unknown)) {
            return Err(Error::new(format!(
                "parameters: unknown key '{key}' beside those of yarn systems"
            ))
            .with_hint(systems_hint(infos)));
        }
        let mut values = Vec::new();
        for (system, rows) in systems
            .iter()
            .zip(infos.chunks(infos.len() / systems.len()))
        {
            let own = object.get(system).ok_or_else(|| {
                Error::new(format!("parameters: '{system}' is missing"))
                    .with_hint(systems_hint(infos))
            })?;
            let set = read_set(model.name(), true, rows, own);
            values.extend(set.context(|| format!("yarn system {system}"))?);
        }
        Ok(Self { infos, values })
    }

    /// The parameter file's object; angles in degrees.
    pub fn to_json(&self) -> Value {
        let mut map = Map::new();
        let mut start = 0;
        for info in self.infos {
            let numbers: Vec<f64> = self.values[start..start + info.len()]
                .iter()
                .map(|&v| to_file(info, v))
                .collect();
            start += info.len();
            let number = if info.per_channel {
                json!(numbers)
            } else {
                json!(numbers[0])
            };
            match info.system() {
                Some(system) => {
                    let own = map.entry(system).or_insert_with(|| json!({}));
                    own[info.file_key()] = number;
                }
                None => {
                    map.insert(info.file_key(), number);
                }
            }
        }
        Value::Object(map)
    }
}

/// One set of values, flat: what an object of a parameter file says about `infos`. `per_system`: whether there is a model with a
/// set for each yarn system.
fn read_set(
    model: &str,
    per_system: bool,
    infos: &[ParameterInfo],
    object: &Value,
) -> Result<Vec<f64>> {
    let map = object.as_object().ok_or_else(|| {
        Error::new("parameters: expected a JSON object").with_hint(example_hint(infos))
    })?;
    if let Some(unknown) = map
        .keys()
        .find(|k| infos.iter().all(|p| p.file_key() != **k))
    {
        let hint = match per_system && YARN_SYSTEMS.contains(&unknown.as_str()) {
            true => format!("these are parameters per yarn system: model {model}-per-system"),
            false => example_hint(infos),
        };
        return Err(Error::new(format!(
            "parameters: unknown key '{unknown}' for model {model}"
        ))
        .with_hint(hint));
    }
    let mut values = Vec::new();
    for info in infos {
        let key = info.file_key();
        let value = map.get(&key).ok_or_else(|| {
            Error::new(format!("parameters: '{key}' is missing")).with_hint(example_hint(infos))
        })?;
        values.extend(read_value(info, &key, value)?);
    }
    Ok(values)
}

fn to_file(info: &ParameterInfo, value: f64) -> f64 {
    match info.unit {
        Unit::One => value,
        Unit::Angle => value.to_degrees(),
    }
}

fn read_value(info: &ParameterInfo, key: &str, value: &Value) -> Result<Vec<f64>> {
    let wrong = || {
        let expected = if info.per_channel {
            "a list of 3 numbers"
        } else {
            "one number"
        };
        Error::new(format!(
            "parameters: '{key}': expected {expected}, found {value}"
        ))
    };
    let numbers: Vec<f64> = match (value, info.per_channel) {
        (Value::Array(list), true) if list.len() == CHANNELS => list
            .iter()
            .map(Value::as_f64)
            .collect::<Option<_>>()
            .ok_or_else(wrong)?,
        (Value::Number(n), false) => vec![n.as_f64().ok_or_else(wrong)?],
        _ => return Err(wrong()),
    };
    Ok(numbers
        .into_iter()
        .map(|v| {
            if info.unit == Unit::Angle {
                v.to_radians()
            } else {
                v
            }
        })
        .collect())
}

fn systems_hint(infos: &[ParameterInfo]) -> String {
    let mut systems: Vec<&str> = infos.iter().filter_map(ParameterInfo::system).collect();
    systems.dedup();
    let parts: Vec<String> = systems
        .iter()
        .map(|s| format!("\"{s}\": {{...}}"))
        .collect();
    format!("expected {{{}}}", parts.join(", "))
}

fn example_hint(infos: &[ParameterInfo]) -> String {
    let parts: Vec<String> = infos
        .iter()
        .map(|p| {
            let d = to_file(p, p.default);
            if p.per_channel {
                format!("\"{}\": [{d}, {d}, {d}]", p.file_key())
            } else {
                format!("\"{}\": {d}", p.file_key())
            }
        })
        .collect();
    format!("expected {{{}}}", parts.join(", "))
}
