//! Mean intensities with standard errors, and `measurements.csv`.

use super::files;
use super::plan::{Configuration, ConfigurationRow, check_ids};
use super::quantity::Quantity;
use super::record::MeasurementRecord;
use crate::base::{Context, Error, Result};
use serde::{Deserialize, Serialize};
use std::f64::consts::PI;
use std::path::Path;

/// The mean intensity of the sample square in one configuration: normalized radiance `M = pi L / E_normal` in r, g, b,
/// where `E_normal` is the light's irradiance at normal incidence at the sample center.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intensity {
    /// Where light, camera and turntable stood.
    pub configuration: Configuration,
    /// Normalized radiance per channel; of one that is not `present` without meaning.
    pub mean: [f64; 3],
    /// Standard error of each mean (one standard deviation).
    pub standard_error: [f64; 3],
    /// Which channels were measured; at least one.
    pub present: [bool; 3],
}

impl Intensity {
    /// Something per channel, where the channel was measured.
    pub fn where_present<T: Copy>(&self, of: [T; 3]) -> [Option<T>; 3] {
        std::array::from_fn(|c| self.present[c].then_some(of[c]))
    }

    /// The same with zeros for numbers that were not measured: whatever stood there cannot enter a sum.
    #[must_use]
    pub fn cleared(&self) -> Self {
        let clear = |x: [f64; 3]| self.where_present(x).map(|x| x.unwrap_or(0.0));
        Self {
            mean: clear(self.mean),
            standard_error: clear(self.standard_error),
            ..*self
        }
    }
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
    r: Option<f64>,
    g: Option<f64>,
    b: Option<f64>,
    r_se: Option<f64>,
    g_se: Option<f64>,
    b_se: Option<f64>,
}

/// The columns of a [`Row`]: those of the pose, then each channel's two.
const POSE_COLUMNS: [&str; 6] = [
    "config",
    "light_theta_deg",
    "light_phi_deg",
    "camera_theta_deg",
    "camera_phi_deg",
    "rotation_deg",
];
const CHANNEL_COLUMNS: [[&str; 2]; 3] = [["r", "r_se"], ["g", "g_se"], ["b", "b_se"]];

impl From<&Intensity> for Row {
    fn from(i: &Intensity) -> Self {
        let c = ConfigurationRow::from(i.configuration);
        let [r, g, b] = i.where_present(i.mean);
        let [r_se, g_se, b_se] = i.where_present(i.standard_error);
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
        checked_intensity(configuration, mean, standard_error)
    }
}

/// An intensity from numbers of which some may not have been measured.
///
/// # Errors
/// A number cannot be an intensity or its standard error, one stands without the other, or there is none.
pub(super) fn checked_intensity(
    configuration: Configuration,
    mean: [Option<f64>; 3],
    standard_error: [Option<f64>; 3],
) -> Result<Intensity> {
    let config = configuration.id;
    for (c, [name, se_name]) in CHANNEL_COLUMNS.into_iter().enumerate() {
        for (name, value) in [(name, mean[c]), (se_name, standard_error[c])] {
            if let Some(value) = value.filter(|v| !(0.0..1e6).contains(v)) {
                return Err(Error::new(format!(
                    "configuration {config}: {name} is {value}, expected a finite number >= 0"
                ))
                .with_hint("intensities are normalized radiance, pi L / E_normal; leave the cells of a channel that was not measured empty"));
            }
        }
        let (lacking, given) = match (mean[c], standard_error[c]) {
            (Some(_), None) => (se_name, name),
            (None, Some(_)) => (name, se_name),
            _ => continue,
        };
        return Err(Error::new(format!(
            "configuration {config}: {given} is given but {lacking} is missing"
        ))
        .with_hint("give both, or neither where the channel was not measured"));
    }
    if mean == [None; 3] {
        return Err(
            Error::new(format!("configuration {config}: no channel was measured"))
                .with_hint("leave out a configuration that was not measured"),
        );
    }
    Ok(Intensity {
        configuration,
        mean: mean.map(|m| m.unwrap_or(0.0)),
        standard_error: standard_error.map(|s| s.unwrap_or(0.0)),
        present: mean.map(|m| m.is_some()),
    })
}

/// Fails where a channel has no columns and a column has no meaning: that is a misspelled name rather than a camera with fewer
/// channels.
fn check_columns(header: &csv::StringRecord) -> Result<()> {
    let has = |name: &str| header.iter().any(|h| h == name);
    let lacking = CHANNEL_COLUMNS
        .iter()
        .find(|pair| !pair.iter().any(|n| has(n)));
    let known = |h: &str| POSE_COLUMNS.contains(&h) || CHANNEL_COLUMNS.as_flattened().contains(&h);
    match (lacking, header.iter().find(|h| !known(h))) {
        (Some([name, _]), Some(strange)) => Err(Error::new(format!(
            "there is no column {name}, and the column '{strange}' has no meaning"
        ))
        .with_hint("the channels are r, g and b, each with its standard error (r_se, ..); leave out those not measured")),
        _ => Ok(()),
    }
}

impl Measurements {
    /// Reads and checks `measurements.csv` (columns `config, light_theta_deg, light_phi_deg, camera_theta_deg,
    /// camera_phi_deg, rotation_deg, r, g, b, r_se, g_se, b_se`, by name, in any order), or `measurements.json`
    /// ([`super::MeasurementRecord`]), which begins with a brace. A table of another quantity says so in a comment
    /// (`# quantity: brdf`) and is converted back.
    ///
    /// A channel that was not measured in a configuration has empty cells (`null` in JSON), one that was never measured may
    /// have no columns: a camera with one channel writes `g, g_se` only (or that of its filter).
    ///
    /// # Errors
    /// The file cannot be read, a pose is not whole, a configuration has no number, a number no standard error, an id is
    /// repeated, an angle is out of range, or an intensity is negative or not finite.
    pub fn read(path: &Path) -> Result<Self> {
        Ok(Self::read_with_origin(path)?.0)
    }

    /// As [`Measurements::read`]; also what the file says of its origin: true when no camera saw any cloth, none when it
    /// does not say.
    ///
    /// # Errors
    /// As [`Measurements::read`].
    pub fn read_with_origin(path: &Path) -> Result<(Self, Option<bool>)> {
        let text = files::read_text(path)?;
        let what = || format!("measurements {}", path.display());
        if text.trim_start().starts_with('{') {
            let record = MeasurementRecord::from_json(&text).context(what)?;
            return Ok((record.measurements().context(what)?, Some(record.synthetic)));
        }
        let measurements = Self::from_csv(&text).context(what)?;
        let synthetic = comments(&text).any(|c| c == "synthetic");
        Ok((measurements, synthetic.then_some(true)))
    }

    /// Parses and checks the text of a `measurements.csv`; see [`Measurements::read`].
    ///
    /// # Errors
    /// As [`Measurements::read`].
    pub fn from_csv(text: &str) -> Result<Self> {
        let stated = comments(text).find_map(|c| c.strip_prefix("quantity:"));
        let quantity = stated.map(|q| q.split(',').next().unwrap_or(q).trim());
        let quantity = Quantity::named(quantity.unwrap_or(Quantity::default().name()))?;
        let mut reader = csv::ReaderBuilder::new()
            .trim(csv::Trim::All)
            .comment(Some(b'#'))
            .from_reader(text.as_bytes());
        check_columns(reader.headers().context(|| "not a table")?)?;
        let mut intensities = Vec::new();
        for (i, row) in reader.deserialize::<Row>().enumerate() {
            let row = row.context(|| format!("row {}", i + 1))?;
            let mut found = row.checked().context(|| format!("row {}", i + 1))?;
            let factor = quantity.factor(&found.configuration);
            if quantity != Quantity::NormalizedRadiance {
                found.mean = found.mean.map(|m| m / factor);
                found.standard_error = found.standard_error.map(|s| s / factor);
            }
            intensities.push(found);
        }
        check_ids(intensities.iter().map(|i: &Intensity| i.configuration.id))?;
        Ok(Self { intensities })
    }

    /// The text of `measurements.csv`, without comments; numbers round-trip exactly.
    ///
    /// # Errors
    /// Only if the CSV writer fails.
    pub fn to_csv(&self) -> Result<String> {
        self.rows(Quantity::NormalizedRadiance)
    }

    /// As [`Measurements::to_csv`], in any quantity, with comments that say which, and whether it is synthetic.
    ///
    /// # Errors
    /// Only if the CSV writer fails.
    pub fn to_stated_csv(&self, quantity: Quantity, synthetic: bool) -> Result<String> {
        let flag = if synthetic { "# synthetic\n" } else { "" };
        Ok(format!(
            "{flag}# quantity: {}, unit {}\n# {}; columns _se: standard errors (one standard deviation)\n{}",
            quantity.name(),
            quantity.unit(),
            quantity.definition(),
            self.rows(quantity)?
        ))
    }

    fn rows(&self, quantity: Quantity) -> Result<String> {
        let mut writer = csv::Writer::from_writer(Vec::new());
        for intensity in &self.intensities {
            let (mean, standard_error) = quantity.of(intensity);
            let row = Intensity {
                mean,
                standard_error,
                ..*intensity
            };
            writer
                .serialize(Row::from(&row))
                .context(|| "measurements cannot be written as CSV")?;
        }
        let bytes = writer
            .into_inner()
            .context(|| "measurements cannot be written as CSV")?;
        String::from_utf8(bytes).context(|| "measurements cannot be written as CSV")
    }

    /// How many numbers were measured.
    pub fn n_numbers(&self) -> usize {
        let present = self.intensities.iter().flat_map(|i| i.present);
        present.filter(|p| *p).count()
    }

    /// The poses of all rows, in order.
    pub fn configurations(&self) -> Vec<Configuration> {
        self.intensities.iter().map(|i| i.configuration).collect()
    }
}

/// An azimuth in 0 <= azimuth < 2 pi; what rounding leaves just below a full turn is 0.
pub(super) fn tidy_azimuth(phi: f64) -> f64 {
    let turn = 2.0 * PI;
    let phi = phi.rem_euclid(turn);
    if phi > turn - 1e-9 { 0.0 } else { phi }
}

/// Polar angle and azimuth toward the light, then toward the camera, radians, in the sample frame.
pub(super) fn sample_angles(configuration: &Configuration) -> [f64; 4] {
    let light = configuration.light_in_sample();
    let camera = configuration.camera_in_sample();
    [
        light.theta,
        tidy_azimuth(light.phi),
        camera.theta,
        tidy_azimuth(camera.phi),
    ]
}

/// The texts of a file's comment lines.
fn comments(text: &str) -> impl Iterator<Item = &str> {
    text.lines()
        .filter_map(|l| l.trim_start().strip_prefix('#'))
        .map(str::trim)
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
    fn every_quantity_reads_back_as_normalized_radiance() {
        let m = Measurements::from_csv(&format!("{HEAD}{ROW}")).unwrap();
        let cos = 80_f64.to_radians().cos();
        for (quantity, r) in [
            (Quantity::NormalizedRadiance, 0.123_456_789_012_345_68),
            (Quantity::RadianceFactor, 0.123_456_789_012_345_68 / cos),
            (
                Quantity::Brdf,
                0.123_456_789_012_345_68 / (std::f64::consts::PI * cos),
            ),
        ] {
            let text = m.to_stated_csv(quantity, true).unwrap();
            let head = format!("# synthetic\n# quantity: {}, unit ", quantity.name());
            assert!(text.starts_with(&head), "{text}");
            let plain = text.replace("quantity:", "");
            let written = Measurements::from_csv(&plain).unwrap().intensities[0];
            assert!((written.mean[0] / r - 1.0).abs() < 1e-12, "{text}");
            let back = Measurements::from_csv(&text).unwrap().intensities[0];
            for k in 0..3 {
                assert!((back.mean[k] / m.intensities[0].mean[k] - 1.0).abs() < 1e-12);
                let se = m.intensities[0].standard_error[k];
                assert!((back.standard_error[k] / se - 1.0).abs() < 1e-12);
            }
        }
        let error = Measurements::from_csv(&format!("# quantity: btdf, unit 1\n{HEAD}{ROW}"));
        assert!(error.unwrap_err().report().contains("'btdf'"));
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
        let other = HEAD.replace("r,g", "red,g").replace("r_se", "red_se");
        assert!(error(format!("{other}{ROW}")).contains("no column r, and the column 'red'"));
        let no_se = ROW.replace("0.002,", ",");
        assert!(error(format!("{HEAD}{no_se}")).contains("g is given but g_se is missing"));
        let pose = "1,80,180,80,0,0";
        assert!(error(format!("{HEAD}{pose},,,,,,\n")).contains("configuration 1: no channel"));
    }

    #[test]
    fn empty_cells_and_absent_columns_are_numbers_that_were_not_measured() {
        let empty = ROW.replace("0.2,", ",").replace("0.002,", ",");
        let m = Measurements::from_csv(&format!("{HEAD}{empty}")).unwrap();
        assert_eq!(m.intensities[0].present, [true, false, true]);
        assert_eq!(m.n_numbers(), 2);
        let text = m.to_csv().unwrap();
        assert!(text.contains(",0.3,0.001,,0.003"), "{text}");
        assert_eq!(Measurements::from_csv(&text).unwrap(), m);
        let head = HEAD.replace("r,g,b,r_se,g_se,b_se", "g,g_se");
        let one = Measurements::from_csv(&format!("{head}1,80,180,80,0,0,0.2,0.002\n")).unwrap();
        assert_eq!(one.intensities[0].present, [false, true, false]);
        assert!((one.intensities[0].mean[1] - 0.2).abs() < 1e-15);
        assert_eq!(Measurements::from_csv(&one.to_csv().unwrap()).unwrap(), one);
    }
}
