//! What `goniofit measure session` writes: the intensities in several formats, linear crops, and the page.

use super::crops::{Gallery, Wanted};
use super::inputs;
use crate::base::{Context, Result};
use crate::measure::calibration::{Calibrations, Header};
use crate::measure::{ConfigurationReport, MeasureOptions, MeasureReport};
use crate::report::measurement::{
    LinearityPoint, Look, Looks, MOST_POSES, Transfer, measurement_page,
};
use crate::report::preview;
use crate::session::{
    CalibrationUsed, Intensity, LampPoint, MeasurementRecord, Measurements, Quantity,
    RecordedConfiguration, SessionFolder, SessionStamp, alta_text, astm_standard_errors, astm_text,
    brdf_tables, files,
};
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// What can be written beside CSV and JSON.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, clap::ValueEnum)]
pub(crate) enum Export {
    /// BRDF as text after ASTM E1392-96: FILE.astm, standard errors in FILE_se.astm
    Astm,
    /// BRDF as an ALTA data file with intervals of two standard errors
    Alta,
    /// BRDF tables, one CSV per exitant direction
    BrdfCsv,
    /// Linear crop of every configuration as OpenEXR
    Exr,
    /// The HTML page (written by default)
    Page,
    /// All of them
    All,
    /// Nothing but CSV and JSON, not even the page
    None,
}

/// Where the outputs go, and which are wanted.
pub(crate) struct Outputs {
    /// Path and beginning of the name of every file; none: the usual names in the folder.
    stem: Option<PathBuf>,
    folder: PathBuf,
    exports: BTreeSet<Export>,
    quantity: Quantity,
    symmetry_180: bool,
}

impl Outputs {
    /// `out` is a stem, `STEM` or `STEM.csv`; without one the usual names in `folder`.
    pub(crate) fn new(
        folder: &Path,
        out: Option<&Path>,
        exports: &[Export],
        quantity: Quantity,
        symmetry_180: bool,
    ) -> Self {
        let stem = out.map(|o| match o.extension().and_then(|e| e.to_str()) {
            Some("csv" | "json" | "html" | "astm" | "alta") => o.with_extension(""),
            _ => o.to_owned(),
        });
        let mut exports: BTreeSet<Export> = exports.iter().copied().collect();
        if exports.contains(&Export::All) {
            exports.extend([
                Export::Astm,
                Export::Alta,
                Export::BrdfCsv,
                Export::Exr,
                Export::Page,
            ]);
        } else if !exports.contains(&Export::None) {
            exports.insert(Export::Page);
        }
        Self {
            stem,
            folder: folder.to_owned(),
            exports,
            quantity,
            symmetry_180,
        }
    }

    /// A file: `usual` in the folder, or the stem and `ending`.
    fn place(&self, usual: &str, ending: &str) -> PathBuf {
        match &self.stem {
            None => self.folder.join(usual),
            Some(stem) => {
                let mut name = stem.as_os_str().to_owned();
                name.push(ending);
                PathBuf::from(name)
            }
        }
    }

    /// The table.
    pub(crate) fn csv(&self) -> PathBuf {
        self.place("measurements.csv", ".csv")
    }

    fn json(&self) -> PathBuf {
        self.place("measurements.json", ".json")
    }

    /// The place of an export: a file, or a folder.
    fn export(&self, export: Export) -> Option<PathBuf> {
        if !self.exports.contains(&export) {
            return None;
        }
        match export {
            Export::Astm => Some(self.place("measurements.astm", ".astm")),
            Export::Alta => Some(self.place("measurements.alta", ".alta")),
            Export::BrdfCsv => Some(self.place("brdf", "_brdf")),
            Export::Exr => Some(self.place("crops", "_crops")),
            Export::Page => Some(self.place("measurement.html", ".html")),
            Export::All | Export::None => None,
        }
    }

    fn astm_errors(&self) -> PathBuf {
        self.place("measurements_se.astm", "_se.astm")
    }

    /// Fails when something would be overwritten; before any long work.
    pub(crate) fn refuse_overwriting(&self, force: bool) -> Result<()> {
        let exports = self.exports.iter().filter_map(|e| self.export(*e));
        let errors = self.exports.contains(&Export::Astm);
        let errors = errors.then(|| self.astm_errors());
        for path in [self.csv(), self.json()]
            .into_iter()
            .chain(exports)
            .chain(errors)
        {
            inputs::refuse_overwriting(&path, force)?;
        }
        Ok(())
    }

    /// Who looks on while the session is measured; makes the folder for the crops.
    pub(crate) fn gallery(
        &self,
        session: &SessionFolder,
        options: &MeasureOptions,
    ) -> Result<Gallery> {
        let manifest = session.manifest()?;
        let configurations = session.plan()?.configurations;
        let exr_folder = self.export(Export::Exr);
        if let Some(folder) = &exr_folder {
            inputs::prepare_folder(folder)?;
        }
        let latin = |text: &str| -> String {
            text.chars()
                .map(|c| if c.is_ascii() { c } else { '?' })
                .collect()
        };
        let wanted = Wanted {
            pictures: self.exports.contains(&Export::Page) && configurations.len() <= MOST_POSES,
            exr_folder,
            camera: options.camera(&manifest.camera),
            crop: options.crop,
            sample_square_mm: manifest.sample_square_mm,
            configurations,
            usable_fraction: options.usable_fraction,
            attributes: vec![
                ("session", latin(&session_name(session))),
                ("synthetic", manifest.synthetic.to_string()),
            ],
        };
        Ok(Gallery::new(wanted, &session.frames()?))
    }

    /// Writes everything; returns what was written.
    pub(crate) fn write(
        &self,
        measurements: &Measurements,
        record: &MeasurementRecord,
        looks: &Looks,
    ) -> Result<Vec<PathBuf>> {
        let synthetic = record.synthetic;
        let stamp = &record.session;
        let csv = measurements.to_stated_csv(self.quantity, synthetic)?;
        let mut texts = vec![(self.csv(), csv), (self.json(), record.to_json()?)];
        if let Some(path) = self.export(Export::Astm) {
            texts.push((path, astm_text(measurements, stamp, synthetic)));
            let errors = astm_standard_errors(measurements, stamp, synthetic);
            texts.push((self.astm_errors(), errors));
        }
        if let Some(path) = self.export(Export::Alta) {
            texts.push((path, alta_text(measurements, stamp, synthetic)));
        }
        if let Some(folder) = self.export(Export::BrdfCsv) {
            inputs::prepare_folder(&folder)?;
            for table in brdf_tables(measurements, self.symmetry_180) {
                let path = folder.join(format!("{}.csv", table.name()));
                texts.push((path, table.to_csv(synthetic)));
            }
        }
        if let Some(path) = self.export(Export::Page) {
            texts.push((path, measurement_page(record, looks)));
        }
        for (path, text) in &texts {
            files::write_atomic(path, text.as_bytes())?;
        }
        let mut written: Vec<PathBuf> = texts.into_iter().map(|(path, _)| path).collect();
        written.extend(self.export(Export::Exr));
        Ok(written)
    }
}

/// The name of a session's folder.
fn session_name(session: &SessionFolder) -> String {
    let root = std::fs::canonicalize(session.root());
    let root = root.unwrap_or_else(|_| session.root().to_owned());
    let name = root.file_name().unwrap_or(root.as_os_str());
    name.to_string_lossy().into_owned()
}

/// All that is known about a measurement.
pub(crate) fn record(
    session: &SessionFolder,
    options: &MeasureOptions,
    calibrations: Vec<CalibrationUsed>,
    measurements: &Measurements,
    report: &MeasureReport,
) -> Result<MeasurementRecord> {
    let manifest = session.manifest()?;
    let plan = session.plan()?;
    let journal = session.journal_path();
    let bytes = std::fs::read(&journal)
        .context(|| format!("journal {} cannot be read", journal.display()))?;
    let quantity = Quantity::NormalizedRadiance;
    let configurations = plan
        .configurations
        .iter()
        .filter_map(|c| {
            let found = report.configurations.iter().find(|r| r.config == c.id)?;
            let intensity = measurements
                .intensities
                .iter()
                .find(|i| i.configuration.id == c.id);
            Some(configuration(*c, found, intensity))
        })
        .collect::<Result<_>>()?;
    let mut details = object(report)?;
    for told in [
        "synthetic",
        "rgb",
        "calibrations",
        "warnings",
        "lamp",
        "configurations",
    ] {
        details.remove(told);
    }
    let lamp = report.lamp.visits.iter().map(|v| LampPoint {
        visit: v.visit,
        stretch: v.stretch,
        elapsed_s: v.elapsed_s,
        level: v.level,
        standard_error: v.standard_error,
    });
    Ok(MeasurementRecord {
        format: MeasurementRecord::FORMAT.to_owned(),
        program: format!("goniofit {}", env!("CARGO_PKG_VERSION")),
        synthetic: report.synthetic,
        quantity: quantity.name().to_owned(),
        unit: quantity.unit().to_owned(),
        definition: quantity.definition().to_owned(),
        rgb_space: report.rgb.clone(),
        session: SessionStamp {
            name: session_name(session),
            started_utc: manifest.started_utc,
            rig: manifest.rig,
            camera: manifest.camera.name,
            note: manifest.note,
            journal_sha256: files::sha256(&bytes),
        },
        calibrations,
        options: [
            ("usable_fraction", options.usable_fraction),
            ("underexposed", options.underexposed),
            ("hot_sigma", options.hot_sigma),
        ]
        .map(|(name, value)| (name.to_owned(), Value::from(value)))
        .into(),
        warnings: told(report),
        lamp: lamp.collect(),
        configurations,
        details,
    })
}

/// All that the operator should know beside why a configuration was left out.
fn told(report: &MeasureReport) -> Vec<String> {
    let notes = report.configurations.iter().flat_map(|c| &c.notes);
    report.warnings.iter().chain(notes).cloned().collect()
}

/// What `value` looks like as a JSON object.
fn object(value: &impl serde::Serialize) -> Result<BTreeMap<String, Value>> {
    let value = serde_json::to_value(value).context(|| "the report cannot be written as JSON")?;
    match value {
        Value::Object(map) => Ok(map.into_iter().collect()),
        _ => Ok(BTreeMap::new()),
    }
}

fn configuration(
    configuration: crate::session::Configuration,
    report: &ConfigurationReport,
    intensity: Option<&Intensity>,
) -> Result<RecordedConfiguration> {
    let mut budget: BTreeMap<String, [f64; 3]> = BTreeMap::new();
    for (channel, parts) in report.budget.iter().enumerate() {
        for (source, sd) in object(parts)? {
            if let Some(sd) = sd.as_f64() {
                budget.entry(source).or_default()[channel] = sd;
            }
        }
    }
    let mut details = object(report)?;
    let condition = details.get("condition").and_then(Value::as_str);
    let condition = condition.unwrap_or("unknown").to_owned();
    for told in [
        "config",
        "condition",
        "measured",
        "message",
        "exposures_ms",
        "area_px",
        "budget",
        "notes",
    ] {
        details.remove(told);
    }
    Ok(RecordedConfiguration {
        configuration,
        condition,
        message: report.message.clone(),
        mean: intensity.map(|i| i.where_present(i.mean)),
        standard_error: intensity.map(|i| i.where_present(i.standard_error)),
        budget,
        exposures_ms: report.exposures_ms.clone(),
        area_px: report.area_px,
        details,
    })
}

/// The files in a calibration folder that [`Calibrations::read`] took: the newest of each kind.
pub(crate) fn calibrations_used(
    folder: &Path,
    calibrations: &Calibrations,
) -> Result<Vec<CalibrationUsed>> {
    let c = calibrations;
    let headers = [
        c.dark.as_ref().map(|d| &d.header),
        c.linearity.as_ref().map(|d| &d.header),
        c.flat.as_ref().map(|d| &d.header),
        c.white.as_ref().map(|d| &d.header),
        c.color.as_ref().map(|d| &d.header),
        c.geometry.as_ref().map(|d| &d.header),
        c.drift.as_ref().map(|d| &d.header),
    ];
    let what = || format!("calibration folder {} cannot be read", folder.display());
    let mut names = Vec::new();
    for entry in std::fs::read_dir(folder).context(what)? {
        let name = entry.context(what)?.file_name();
        names.push(name.to_string_lossy().into_owned());
    }
    names.sort();
    let used = headers.into_iter().flatten().map(|header: &Header| {
        let end = format!("_{}.json", header.kind.name());
        let newest = names.iter().rev().find(|n| n.ends_with(&end));
        let file = newest.cloned().unwrap_or_default();
        let bytes = std::fs::read(folder.join(&file)).context(what)?;
        Ok(CalibrationUsed {
            kind: header.kind.name().to_owned(),
            sha256: files::sha256(&bytes),
            file,
            date_utc: header.date_utc.clone(),
            synthetic: header.synthetic,
        })
    });
    used.collect()
}

/// Factors that make red and blue of a white sample as bright as green in raw frames.
pub(crate) fn gains(record: &MeasurementRecord) -> [f64; 3] {
    let white = record.details.get("white");
    let responsivity = white.and_then(|w| w.get("responsivity"));
    let value = |k: usize| responsivity.and_then(|r| r.get(k)).and_then(Value::as_f64);
    match (value(0), value(1), value(2)) {
        (Some(r), Some(g), Some(b)) if r > 0.0 && g > 0.0 && b > 0.0 => [g / r, 1.0, g / b],
        _ => [1.0; 3],
    }
}

/// Adds the curves and the flat field of the calibrations to the page's pictures.
pub(crate) fn add_calibrations(looks: &mut Looks, calibrations: &Calibrations) -> Result<()> {
    if let Some(linearity) = &calibrations.linearity {
        let value = &linearity.value;
        let points = value.points.iter().map(|p| LinearityPoint {
            channel: p.channel,
            level: p.signal / value.full_scale,
            residual: p.residual,
            residual_se: p.signal_se / p.signal,
        });
        looks.linearity = points.collect();
        let t = &value.transfer;
        looks.transfer = Some(Transfer {
            points: t
                .points
                .iter()
                .map(|p| (p.channel, [p.signal, p.variance, p.variance_se]))
                .collect(),
            slope: t.variance_per_signal,
            read_noise: t.read_noise,
            source: format!("the linearity calibration of {}", linearity.header.date_utc),
        });
    }
    if let Some(flat) = &calibrations.flat {
        let [width, height] = flat.header.size_px;
        looks.flat = Some(flat_picture(&flat.value.response, [width, height])?);
    }
    Ok(())
}

/// The flat field in gray, darkest value to brightest.
fn flat_picture(response: &[f32], [width, height]: [usize; 2]) -> Result<Look> {
    let per_pixel = (response.len() / (width * height).max(1)).max(1);
    let step = 2 * width.max(height).div_ceil(800).max(1);
    let size = [(width / step).max(1), (height / step).max(1)];
    let mean = |column: usize, row: usize| {
        let rows = (row * step..(row + 1) * step).take_while(|y| *y < height);
        let values = rows.flat_map(|y| {
            let first = (y * width + column * step) * per_pixel;
            let last = (y * width + ((column + 1) * step).min(width)) * per_pixel;
            response.get(first..last).unwrap_or_default()
        });
        let (sum, n) = values.fold((0.0, 0.0), |(s, n), v| (s + f64::from(*v), n + 1.0));
        if n > 0.0 { sum / n } else { 0.0 }
    };
    let blocks: Vec<f64> = (0..size[1])
        .flat_map(|row| (0..size[0]).map(move |column| (column, row)))
        .map(|(column, row)| mean(column, row))
        .collect();
    let low = blocks.iter().copied().fold(f64::INFINITY, f64::min);
    let high = blocks.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let spread = (high - low).max(1e-9);
    let gray: Vec<[f64; 3]> = blocks.iter().map(|v| [(v - low) / spread; 3]).collect();
    Ok(Look {
        png: preview::png(size[0] as u32, size[1] as u32, &gray)?,
        size: [width as f64, height as f64],
        outline: Vec::new(),
        caption: format!("response of the pixels, black {low:.4} to white {high:.4}"),
    })
}
