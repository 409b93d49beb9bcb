//! `measurements.json`: the intensities with all that is known about them, so that the file stands by itself.

use super::measurements::checked_intensity;
use super::plan::check_ids;
use super::{Configuration, Measurements, Quantity};
use crate::base::{Context, Error, Result};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;

/// The session the frames are in.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct SessionStamp {
    /// Name of its folder.
    pub name: String,
    /// UTC start, RFC 3339.
    pub started_utc: String,
    /// Name of the rig description.
    pub rig: String,
    /// The camera.
    pub camera: String,
    /// Free text by the operator.
    pub note: String,
    /// SHA-256 of its journal, hexadecimal; the journal holds those of the frames.
    pub journal_sha256: String,
}

/// A calibration that was used.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CalibrationUsed {
    /// What it is of: `dark`, `linearity`, `flat`, ...
    pub kind: String,
    /// Name of its file.
    pub file: String,
    /// SHA-256 of the file, hexadecimal.
    pub sha256: String,
    /// UTC time of the session it was made from, RFC 3339.
    pub date_utc: String,
    /// True when no camera saw anything.
    pub synthetic: bool,
}

/// One visit of the reference pose.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LampPoint {
    /// The number in the journal.
    pub visit: u32,
    /// Stretch of work it belongs to, from 0.
    pub stretch: usize,
    /// Seconds on the journal's clock.
    pub elapsed_s: f64,
    /// Brightness relative to the first visit, r, g, b.
    pub level: [f64; 3],
    /// Its standard error.
    pub standard_error: [f64; 3],
}

/// How one configuration was measured.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RecordedConfiguration {
    /// The pose; in the file its names are those of the columns of `measurements.csv`.
    #[serde(flatten)]
    pub configuration: Configuration,
    /// How it came out, in a word: `good`, `saturated`, ...
    pub condition: String,
    /// What the operator should know.
    pub message: Option<String>,
    /// Normalized radiance, r, g, b; none when it was left out, or of a channel that was not measured.
    pub mean: Option<[Option<f64>; 3]>,
    /// Its standard error (one standard deviation).
    pub standard_error: Option<[Option<f64>; 3]>,
    /// Where the standard error comes from: one standard deviation by source, r, g, b.
    pub budget: BTreeMap<String, [f64; 3]>,
    /// Exposures used, milliseconds.
    pub exposures_ms: Vec<f64>,
    /// Pixels the sample square covers.
    pub area_px: f64,
    /// Whatever else was found out about it, by name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub details: BTreeMap<String, Value>,
}

/// The file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MeasurementRecord {
    /// Always [`MeasurementRecord::FORMAT`].
    pub format: String,
    /// Program version that wrote it.
    pub program: String,
    /// True when no camera saw any cloth.
    pub synthetic: bool,
    /// Always [`Quantity::NormalizedRadiance`], by name.
    pub quantity: String,
    /// Its unit.
    pub unit: String,
    /// What it means.
    pub definition: String,
    /// What r, g, b are: `camera` (the sensor's own channels), or a named linear space.
    pub rgb_space: String,
    /// Where the frames are.
    pub session: SessionStamp,
    /// Calibrations used; none: everything was taken from the session itself.
    pub calibrations: Vec<CalibrationUsed>,
    /// Choices of the measurement.
    pub options: BTreeMap<String, Value>,
    /// What the operator should know beside the configurations' messages.
    pub warnings: Vec<String>,
    /// The lamp over the visits of the reference pose.
    pub lamp: Vec<LampPoint>,
    /// One entry per configuration of the plan, in its order.
    pub configurations: Vec<RecordedConfiguration>,
    /// Everything else that was found out, by name.
    pub details: BTreeMap<String, Value>,
}

impl MeasurementRecord {
    /// The value of [`MeasurementRecord::format`].
    pub const FORMAT: &'static str = "goniofit-measurements-1";

    /// Parses and checks the text of a `measurements.json`.
    ///
    /// # Errors
    /// It is damaged, of another format or quantity, or repeats an id.
    pub fn from_json(text: &str) -> Result<Self> {
        let record: Self = serde_json::from_str(text).context(|| "not a measurements.json")?;
        let quantity = Quantity::NormalizedRadiance.name();
        for (what, found, expected) in [
            ("format", &record.format, Self::FORMAT),
            ("quantity", &record.quantity, quantity),
        ] {
            if found != expected {
                return Err(Error::new(format!(
                    "{what} '{found}' where '{expected}' was expected"
                )));
            }
        }
        check_ids(record.configurations.iter().map(|c| c.configuration.id))?;
        Ok(record)
    }

    /// The text of the file; numbers round-trip exactly.
    ///
    /// # Errors
    /// A number is not finite.
    pub fn to_json(&self) -> Result<String> {
        let text = serde_json::to_string_pretty(self)
            .context(|| "measurements cannot be written as JSON")?;
        Ok(text + "\n")
    }

    /// The intensities alone, of the configurations that were measured.
    ///
    /// # Errors
    /// A number is negative or not finite, or nothing was measured.
    pub fn measurements(&self) -> Result<Measurements> {
        let mut intensities = Vec::new();
        for c in &self.configurations {
            if let (Some(mean), Some(standard_error)) = (c.mean, c.standard_error) {
                intensities.push(checked_intensity(c.configuration, mean, standard_error)?);
            }
        }
        check_ids(intensities.iter().map(|i| i.configuration.id))?;
        Ok(Measurements { intensities })
    }
}
