//! Mean intensities with standard errors, and `measurements.csv`.

use super::files;
use super::plan::{Configuration, ConfigurationRow, check_ids};
use crate::base::{Context, Error, Result};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// The mean intensity of the sample square in one configuration: normalized radiance `M = pi L / E_normal` in r, g, b,
/// where `E_normal` is the light's irradiance at normal incidence at the sample center.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intensity {
    /// Where light, camera and turntable stood.
    pub configuration: Configuration,
    /// Normalized radiance per channel.
    pub mean: [f64; 3],
    /// Standard error of each mean (one standard deviation).
    pub standard_error: [f64; 3],
}

/// All intensities of a session, one per configuration.
#[derive(Debug, Clone, PartialEq)]
pub struct Measurements {
    /// At least one; configuration ids unique.
    pub intensities: Vec<Intensity>,
}

#[derive(Serialize, Deserialize)]
struct Row {
    config: u32,
    light_theta_deg: f64,
    light_phi_deg: f64,
    camera_theta_deg: f64,
    camera_phi_deg: f64,
    rotation_deg: f64,
    r: f64,
    g: f64,
    b: f64,
    r_se: f64,
    g_se: f64,
    b_se: f64,
}

impl From<&Intensity> for Row {
    fn from(i: &Intensity) -> Self {
        let c = ConfigurationRow::from(i.configuration);
        let ([r, g, b], [r_se, g_se, b_se]) = (i.mean, i.standard_error);
        Self {
            config: c.config,
            light_theta_deg: c.light_theta_deg,
            light_phi_deg: c.light_phi_deg,
            camera_theta_deg: c.camera_theta_deg,
            camera_phi_deg: c.camera_phi_deg,
            rotation_deg: c.rotation_deg,
            r,
            g,
            b,
            r_se,
            g_se,
            b_se,
        }
    }
}

impl Row {
    fn checked(self) -> Result<Intensity> {
        let configuration = ConfigurationRow {
            config: self.config,
            light_theta_deg: self.light_theta_deg,
            light_phi_deg: self.light_phi_deg,
            camera_theta_deg: self.camera_theta_deg,
            camera_phi_deg: self.camera_phi_deg,
            rotation_deg: self.rotation_deg,
        }
        .checked()?;
        let mean = [self.r, self.g, self.b];
        let standard_error = [self.r_se, self.g_se, self.b_se];
        for (name, value) in ["r", "g", "b", "r_se", "g_se", "b_se"]
            .iter()
            .zip(mean.iter().chain(&standard_error))
        {
            if !(0.0..1e6).contains(value) {
                return Err(Error::new(format!(
                    "configuration {}: {name} is {value}, expected a finite number >= 0",
                    self.config
                ))
                .with_hint("intensities are normalized radiance, pi L / E_normal; leave out a configuration that was not measured"));
            }
        }
        Ok(Intensity {
            configuration,
            mean,
            standard_error,
        })
    }
}

impl Measurements {
    /// Reads and checks `measurements.csv` (columns `config, light_theta_deg, light_phi_deg, camera_theta_deg,
    /// camera_phi_deg, rotation_deg, r, g, b, r_se, g_se, b_se`, by name, in any order).
    ///
    /// # Errors
    /// The file cannot be read, a column or number is missing, an id is repeated, an angle is out of range, or an
    /// intensity is negative or not finite.
    pub fn read(path: &Path) -> Result<Self> {
        Self::from_csv(&files::read_text(path)?)
            .context(|| format!("measurements {}", path.display()))
    }

    /// Parses and checks the text of a `measurements.csv`; see [`Measurements::read`].
    ///
    /// # Errors
    /// As [`Measurements::read`].
    pub fn from_csv(text: &str) -> Result<Self> {
        let mut reader = csv::ReaderBuilder::new()
            .trim(csv::Trim::All)
            .comment(Some(b'#'))
            .from_reader(text.as_bytes());
        let mut intensities = Vec::new();
        for (i, row) in reader.deserialize::<Row>().enumerate() {
            let row = row.context(|| format!("row {}", i + 1))?;
            intensities.push(row.checked().context(|| format!("row {}", i + 1))?);
        }
        check_ids(intensities.iter().map(|i: &Intensity| i.configuration.id))?;
        Ok(Self { intensities })
    }

    /// The text of `measurements.csv`; numbers round-trip exactly.
    ///
    /// # Errors
    /// Only if the CSV writer fails.
    pub fn to_csv(&self) -> Result<String> {
        let mut writer = csv::Writer::from_writer(Vec::new());
        for intensity in &self.intensities {
            writer
                .serialize(Row::from(intensity))
                .context(|| "measurements cannot be written as CSV")?;
        }
        let bytes = writer
            .into_inner()
            .context(|| "measurements cannot be written as CSV")?;
        String::from_utf8(bytes).context(|| "measurements cannot be written as CSV")
    }

    /// The poses of all rows, in order.
    pub fn configurations(&self) -> Vec<Configuration> {
        self.intensities.iter().map(|i| i.configuration).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEAD: &str = "config,light_theta_deg,light_phi_deg,camera_theta_deg,camera_phi_deg,rotation_deg,r,g,b,r_se,g_se,b_se\n";
    const ROW: &str = "1,80,180,80,0,0,0.123456789012345678,0.2,0.3,0.001,0.002,0.003\n";

    #[test]
    fn measurements_survive_the_round_trip_bit_for_bit() {
        let m = Measurements::from_csv(&format!("{HEAD}{ROW}")).unwrap();
        let text = m.to_csv().unwrap();
        assert!(text.starts_with(HEAD), "{text}");
        assert_eq!(Measurements::from_csv(&text).unwrap(), m);
    }

    #[test]
    fn bad_measurements_are_refused_with_the_place() {
        let error = |text: String| Measurements::from_csv(&text).unwrap_err().report();
        assert!(
            error(format!("{HEAD}{}", ROW.replace("0.2,", "NaN,")))
                .contains("row 1: configuration 1: g is NaN")
        );
        assert!(error(format!("{HEAD}{}", ROW.replace("0.3,", "-0.3,"))).contains("b is -0.3"));
        assert!(error(format!("{HEAD}1,80,180\n")).contains("row 1"));
        assert!(error(HEAD.to_owned()).contains("no configurations"));
        assert!(error(format!("{HEAD}{ROW}{ROW}")).contains("occurs twice"));
        assert!(error(format!("{}{ROW}", HEAD.replace("r_se", "x"))).contains("r_se"));
    }
}
