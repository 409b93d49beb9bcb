//! A session's frames to its intensities.

use super::calibration::{Calibrations, Header};
use super::checks::{CheckOptions, blunt_poses};
use super::dark::Darks;
use super::field::{Weights, Window};
use super::frames::{Loader, Taken, taken, title};
use super::geometry::GeometryErrors;
use super::lamp::Lamp;
use super::linear::Response;
use super::noise::{self, Cell, NoiseReport, Scatter};
use super::reading::{Footprint, Reader, Reading};
use super::reduce::Reducer;
use super::repeat::{Deviation, between_frames, deviations};
use super::report::{MeasureOptions, MeasureReport};
use super::stack::{Target, read_stacks};
use super::visit::read_lamp;
use super::white::{Flat, White, WhitePlace};
use super::{Unviewed, Viewer};
use crate::base::{Context, Error, Result, Watch};
use crate::session::{
    CameraFacts, Configuration, Event, FrameKind, Layout, Manifest, Measurements, Plan,
    SessionFolder, WhiteReference, read_journal,
};
use rayon::prelude::*;

/// Pixels around a crop that are read with it: interpolation, texture and blooming look that far.
const MARGIN: usize = 6;

/// What lies around the square is looked at, too, over this part of its side.
const SURROUNDINGS: f64 = 0.04;

/// Shot noise is taken as this, (raw value)^2 per raw value, where nothing is known yet; it steers weights only.
const SLOPE_GUESS: f64 = 0.3;

/// Measures a session: the mean normalized radiance of the sample square in every configuration, with standard errors.
///
/// docs/measure.md has the equations. Configurations that are saturated or were not captured are left out and reported;
/// a result depends on the files alone, not on the number of threads.
///
/// # Errors
/// When a journaled frame is missing, changed, of another size, exposure or camera; there is no white frame, or no dark
/// of some exposure; a dark is brighter than a frame; a crop leaves the image; a calibration is of another camera; noise
/// cannot be estimated; the work was interrupted; or no configuration is left.
pub fn measure_session(
    session: &SessionFolder,
    options: &MeasureOptions,
    watch: &dyn Watch,
) -> Result<(Measurements, MeasureReport)> {
    measure_viewed(session, options, &Unviewed, watch)
}

/// As [`measure_session`], with somebody looking on.
///
/// # Errors
/// As [`measure_session`], or what the viewer returns.
pub fn measure_viewed(
    session: &SessionFolder,
    options: &MeasureOptions,
    viewer: &dyn Viewer,
    watch: &dyn Watch,
) -> Result<(Measurements, MeasureReport)> {
    let manifest = session.manifest()?;
    let plan = session.plan()?;
    let journal = read_journal(&session.journal_path())?;
    let finished = journal.iter().any(|e| e.event == Event::Finished);
    let mut frames = taken(journal);
    // What calibrations are made from says nothing of the sample.
    frames.retain(|f| {
        !matches!(
            f.record.kind,
            FrameKind::Flat | FrameKind::Chart | FrameKind::Board
        )
    });
    let known = &options.calibrations;
    check_calibrations(known, &manifest)?;
    let needs_white = known.white.is_none();
    check_frames(&frames, finished, needs_white, |id| {
        plan.configuration(id).is_some()
    })?;
    let loader = Loader::new(session, &manifest, &frames, watch)?.viewed_by(viewer);
    let work = Work {
        manifest: &manifest,
        plan: &plan,
        options,
        frames: &frames,
        loader: &loader,
        viewer,
        camera: options.camera(&manifest.camera),
    };
    work.measure()
}

/// One session being measured.
struct Work<'a> {
    manifest: &'a Manifest,
    plan: &'a Plan,
    options: &'a MeasureOptions,
    frames: &'a [Taken],
    loader: &'a Loader<'a>,
    viewer: &'a dyn Viewer,
    camera: CameraFacts,
}

impl Work<'_> {
    fn of_kind(&self, kind: FrameKind) -> Vec<&Taken> {
        let of_kind = |f: &&Taken| f.record.kind == kind;
        self.frames.iter().filter(of_kind).collect()
    }

    fn crop(&self, configuration: &Configuration) -> Result<Footprint> {
        let side_mm = self.manifest.sample_square_mm;
        Footprint::of(self.options.crop, &self.camera, configuration, side_mm)
    }

    fn measure(&self) -> Result<(Measurements, MeasureReport)> {
        let options = self.options;
        let known = &options.calibrations;
        let configurations = &self.plan.configurations;
        // Only their boxes are kept: there may be thousands.
        let boxes: Vec<Result<[usize; 4]>> = configurations
            .par_iter()
            .map(|c| Ok(self.crop(c)?.coverage.bounds()))
            .collect();
        let boxes = boxes.into_iter().collect::<Result<Vec<_>>>()?;
        let reference = self.white_reference()?;
        let layout = self.loader.layout(self.frames)?;
        let filtered = self.frames.iter().any(|f| f.record.filter.is_some());
        let gray = layout == Layout::Mono && !filtered;
        if gray && options.color {
            return Err(
                Error::new("a monochrome camera without filters has no colors to convert")
                    .with_hint(
                        "leave out --color, or shoot through a red, a green and a blue filter",
                    ),
            );
        }
        let reference_crop = self
            .crop(&reference.configuration)
            .context(|| "reference geometry")?;
        let errors = GeometryErrors::new(known.geometry.as_ref().map(|g| &g.value), options.pose);
        let side_px = self.manifest.sample_square_mm / self.camera.pixel_mm;
        let around = MARGIN.max((SURROUNDINGS * side_px).clamp(0.0, 1e3) as usize);
        let margin = around + errors.margin(&self.camera, self.manifest.sample_square_mm);
        let size = [self.camera.width, self.camera.height];
        let reference_box = reference_crop.coverage.bounds();
        let all = boxes.into_iter().chain([reference_box]);
        let field = Window::around(all, margin, size, layout);
        let mut darks = Darks::read(
            self.loader,
            &self.of_kind(FrameKind::Dark),
            field,
            Response::new(known.linearity.as_ref().map(|l| &l.value)),
            known.dark.as_ref().map(|d| &d.value),
            options.hot_sigma,
        )?;
        let flat_map = known.flat.as_ref().map(|f| &f.value);
        let values = size[0] * size[1] * layout.values_per_pixel();
        if flat_map.is_some_and(|f| f.response.len() != values) {
            return Err(Error::new(format!(
                "the flat field calibration is of frames with another number of values per pixel than the session's ({layout})"
            ))
            .with_hint("calibrate the flat field with frames of the session's kind"));
        }
        if let Some(flat) = Flat::of(flat_map, &field) {
            darks.leave_out_blind(&flat);
        }

        let on_reference = Window::around([reference_box], margin, size, field.layout);
        let hot = darks.hot_on(&on_reference);
        let reference_weights = Weights::covered(&reference_crop.coverage, &on_reference, &hot);
        let reference_target = Target {
            window: on_reference,
            weights: &reference_weights,
            hot: &hot,
        };
        let references = self.of_kind(FrameKind::Reference);
        let (mut lamp, mut cells) = if references.is_empty() {
            (Lamp::default(), Vec::new())
        } else {
            read_lamp(self.loader, &references, &reference_target, &darks, options)?
        };
        let whites = self.of_kind(FrameKind::White);
        lamp.note_white(&whites);

        let whole = Weights::whole(&field, &darks.hot);
        let flat = Flat::of(flat_map, &on_reference);
        let place = WhitePlace {
            target: match flat {
                Some(_) => reference_target,
                None => Target {
                    window: field,
                    weights: &whole,
                    hot: &darks.hot,
                },
            },
            flat: flat.as_ref(),
            center: self.camera.center_px,
        };
        let mut scattering = Vec::new();
        let mut white = match (&known.white, whites.is_empty()) {
            (Some(known), true) => White::known(&known.value, &place),
            _ => {
                let target = &place.target;
                let read = read_stacks(self.loader, &whites, target, &darks, &lamp, options)?;
                let (stacks, more) = read;
                cells.extend(more);
                scattering.extend(deviations(&stacks, target.weights));
                White::fit(&reference, &place, &stacks, &darks.response)?
            }
        };

        if gray {
            white.gray();
        }

        let reader = Reader {
            loader: self.loader,
            frames: self.frames,
            camera: &self.camera,
            side_mm: self.manifest.sample_square_mm,
            darks: &darks,
            lamp: &lamp,
            white: &white,
            errors,
            margin,
            scatter: Scatter {
                slope: self.slope_beforehand(&cells, &white),
                between_frames: 0.0,
            },
            options,
            viewer: self.viewer,
        };
        let read = configurations.par_iter().map(|c| reader.read(c));
        let read: Vec<Result<Reading>> = read.collect();
        let readings = read.into_iter().collect::<Result<Vec<_>>>()?;

        cells.extend(readings.iter().flat_map(|r| &r.cells));
        let noise = self.noise(&cells, &white, &darks)?;
        scattering.extend(readings.iter().flat_map(|r| &r.deviations));
        let between = self.between_frames(&scattering, noise.variance_per_signal);
        let reducer = Reducer {
            white: &white,
            white_flat: flat.as_ref(),
            white_pose: &reference.configuration,
            lamp: &lamp,
            response: &darks.response,
            errors,
            scatter: Scatter {
                slope: noise.variance_per_signal,
                between_frames: between.unwrap_or(0.0),
            },
            color: known
                .color
                .as_ref()
                .filter(|_| options.color)
                .map(|c| &c.value),
            options,
        };
        let mut intensities = Vec::new();
        let mut reports = Vec::new();
        for reading in &readings {
            let (intensity, report) = reducer.reduce(reading)?;
            intensities.extend(intensity);
            reports.push(report);
        }
        let scatter = reducer.scatter;
        let own_slope = noise::slope(&cells);
        let mut warnings = self.warnings(&darks, &noise, &white, &scatter, between);
        let lit = self
            .frames
            .iter()
            .filter(|f| f.record.kind != FrameKind::Dark);
        warnings.extend(own_slope.and_then(|own| gain_changed(own, &noise)));
        warnings.extend(lamp.warnings(lit.map(|f| f.moment)));
        let sharpness = |r: &Reading| {
            let sharpness = r.checks.as_ref().and_then(|c| c.focus.sharpness);
            (r.configuration, sharpness)
        };
        let poses: Vec<_> = readings.iter().map(sharpness).collect();
        warnings.extend(blunt_poses(&poses, CheckOptions::default().blunt_limit));
        let report = MeasureReport {
            synthetic: self.manifest.synthetic,
            rgb: reducer
                .color
                .map_or("camera".to_owned(), |c| c.space.clone()),
            calibrations: used(known, options),
            warnings,
            lamp: lamp.report(&scatter),
            white: white.report(&scatter),
            noise,
            between_frames: between,
            hot_pixels: darks.hot.iter().filter(|&&h| h).count() / field.layout.values_per_pixel(),
            frames: self.frames.len(),
            configurations: reports,
        };
        if intensities.is_empty() {
            return Err(nothing_left(&report));
        }
        Ok((Measurements { intensities }, report))
    }

    /// The white standard as the session states it, or as a calibration knows it better.
    fn white_reference(&self) -> Result<WhiteReference> {
        let mut reference = self.manifest.white.clone();
        let Some(known) = self.options.calibrations.white.as_ref().map(|w| &w.value) else {
            return Ok(reference);
        };
        let pose = &reference.configuration;
        let apart = |a: f64, b_deg: f64| (a.to_degrees() - b_deg).abs() > 0.5;
        let between = |a: f64, b: f64| {
            let apart = (a - b).rem_euclid(360.0);
            apart.min(360.0 - apart)
        };
        let azimuth = between(pose.light.phi.to_degrees(), pose.camera.phi.to_degrees());
        let known_azimuth = between(known.light_phi_deg, known.camera_phi_deg);
        let slanted = known.light_theta_deg.min(known.camera_theta_deg) > 0.5;
        if apart(pose.light.theta, known.light_theta_deg)
            || apart(pose.camera.theta, known.camera_theta_deg)
            || (slanted && (azimuth - known_azimuth).abs() > 0.5)
        {
            return Err(Error::new(format!(
                "the white calibration of '{}' is for light {} and camera {} degrees, {known_azimuth:.1} degrees of azimuth apart; the session's white standard was shot at light {} and camera {} degrees, {azimuth:.1} apart",
                known.panel,
                known.light_theta_deg,
                known.camera_theta_deg,
                pose.light.theta.to_degrees(),
                pose.camera.theta.to_degrees()
            ))
            .with_hint("a panel is not equally white at all angles: calibrate it at the session's reference geometry"));
        }
        reference.reflectance_factor = known.reflectance_factor;
        reference.reflectance_factor_se = known.reflectance_factor_se;
        Ok(reference)
    }

    /// What is known of shot noise before the samples are read.
    fn slope_beforehand(&self, cells: &[Cell], white: &White) -> [f64; 3] {
        if let Some(known) = &self.options.calibrations.linearity {
            return known.value.transfer.variance_per_signal;
        }
        let guess = noise::slope(cells).or_else(|| noise::slope(&white.residual_cells()));
        let positive = guess.map(|g| g.0).filter(|&slope| slope > 0.0);
        [positive.unwrap_or(SLOPE_GUESS); 3]
    }

    fn noise(&self, cells: &[Cell], white: &White, darks: &Darks) -> Result<NoiseReport> {
        let dark_sigma = darks
            .masters
            .iter()
            .map(|d| (d.exposure_ms, d.variance.sqrt()))
            .collect();
        if let Some(known) = &self.options.calibrations.linearity {
            let transfer = &known.value.transfer;
            return Ok(NoiseReport {
                variance_per_signal: transfer.variance_per_signal,
                variance_per_signal_se: transfer.variance_per_signal_se,
                source: "calibration",
                cells: transfer.points.len(),
                dark_sigma,
            });
        }
        let residuals = white.residual_cells();
        let (cells, source) = if cells.is_empty() {
            (&residuals[..], "white residuals")
        } else {
            (cells, "frame pairs")
        };
        let (slope, se) = noise::slope(cells).ok_or_else(|| {
            Error::new("the noise of the frames cannot be estimated")
                .with_hint("take every shot twice, or at two exposures that are not saturated")
        })?;
        Ok(NoiseReport {
            variance_per_signal: [slope; 3],
            variance_per_signal_se: [se; 3],
            source,
            cells: cells.len(),
            dark_sigma,
        })
    }

    /// The scatter from frame to frame: of this session if it shows, or else as a calibration says.
    fn between_frames(&self, deviations: &[Deviation], slope: [f64; 3]) -> Option<f64> {
        let own = between_frames(deviations, slope).map(|(sd, _)| sd);
        let known = || {
            self.options
                .calibrations
                .drift
                .as_ref()
                .map(|d| d.value.flicker)
        };
        own.filter(|sd| *sd > 0.0).or_else(known).or(own)
    }

    fn warnings(
        &self,
        darks: &Darks,
        noise: &NoiseReport,
        white: &White,
        scatter: &Scatter,
        between: Option<f64>,
    ) -> Vec<String> {
        let mut warnings = Vec::new();
        let known = &self.options.calibrations;
        if darks.masters.iter().any(|d| !d.from_repeats) && known.dark.is_none() {
            warnings.push(
                "only one dark frame of some exposure: its read noise is the scatter over pixels"
                    .to_owned(),
            );
        }
        if noise.source == "white residuals" {
            warnings.push(
                "no two frames show the same thing unsaturated: shot noise is the scatter of the white panel's image"
                    .to_owned(),
            );
        }
        if white.from_calibration {
            warnings.push(
                "no white frames: the lamp is taken to be as bright as when the white standard was calibrated, +- 2 %"
                    .to_owned(),
            );
            if known.flat.is_none() {
                warnings.push(
                    "no white frames and no flat field: vignetting is not corrected".to_owned(),
                );
            }
        }
        if between.is_none() {
            warnings.push(
                "too few repeats to tell how much lamp and shutter differ from frame to frame: shoot every frame twice"
                    .to_owned(),
            );
        }
        let missing = self.loader.without_exif();
        if missing > 0 {
            warnings.push(format!(
                "{missing} frames do not say how long they were exposed: the journal's times are believed"
            ));
        }
        if known.geometry.is_none() && self.options.pose.is_none() {
            warnings.push(
                "no geometry calibration and no stated pose errors: the budget counts none of pointing, scale and angles"
                    .to_owned(),
            );
        }
        let chi_square = white.report(scatter).chi_square_per_pixel;
        let worst = chi_square.into_iter().fold(0.0, f64::max);
        if worst > 1.5 {
            warnings.push(format!(
                "the white panel is uneven: its image scatters {:.1} times as much as noise explains; standard errors are widened",
                worst.sqrt()
            ));
        }
        warnings
    }
}

/// The headers of the calibrations that are used.
fn used(known: &Calibrations, options: &MeasureOptions) -> Vec<Header> {
    let color = known.color.as_ref().filter(|_| options.color);
    let headers = [
        known.dark.as_ref().map(|d| &d.header),
        known.linearity.as_ref().map(|d| &d.header),
        known.flat.as_ref().map(|d| &d.header),
        known.white.as_ref().map(|d| &d.header),
        known.geometry.as_ref().map(|d| &d.header),
        known.drift.as_ref().map(|d| &d.header),
        color.map(|d| &d.header),
    ];
    headers.into_iter().flatten().cloned().collect()
}

fn check_calibrations(known: &Calibrations, manifest: &Manifest) -> Result<()> {
    let all = MeasureOptions {
        color: true,
        ..MeasureOptions::default()
    };
    let camera = &manifest.camera;
    for header in used(known, &all) {
        let here = [camera.width, camera.height];
        if header.size_px != here || header.camera != camera.name {
            return Err(Error::new(format!(
                "the {} calibration of {} is of camera '{}' with {} x {} pixels, the session's is '{}' with {} x {}",
                header.kind.name(),
                header.date_utc,
                header.camera,
                header.size_px[0],
                header.size_px[1],
                camera.name,
                camera.width,
                camera.height
            ))
            .with_hint("give the calibration folder of the rig the session was captured with"));
        }
    }
    Ok(())
}

/// Told when the session's own frames scatter otherwise than the photon transfer that was calibrated.
fn gain_changed((slope, se): (f64, f64), noise: &NoiseReport) -> Option<String> {
    let known = noise.variance_per_signal;
    let (low, high) = known
        .iter()
        .fold((f64::MAX, 0.0_f64), |(l, h), &k| (l.min(k), h.max(k)));
    let changed = !(0.9 * low - 4.0 * se..=1.1 * high + 4.0 * se).contains(&slope);
    (noise.source == "calibration" && changed).then(|| {
        format!(
            "the session's own frames have {slope:.3} +- {se:.3} (raw value)^2 of shot noise per raw value where the linearity calibration has {low:.3} to {high:.3}: was it made at another ISO?"
        )
    })
}

fn nothing_left(report: &MeasureReport) -> Error {
    let reasons: Vec<&str> = report
        .configurations
        .iter()
        .filter_map(|c| c.message.as_deref())
        .collect();
    Error::new(format!(
        "no configuration could be measured: {}",
        reasons.join("; ")
    ))
    .with_hint(
        "choose exposures so that the brightest pixel of the crop stays below the white level",
    )
}

/// True for frames that numbers are made of.
fn measured(kind: FrameKind) -> bool {
    matches!(
        kind,
        FrameKind::Sample | FrameKind::White | FrameKind::Reference
    )
}

fn check_frames(
    frames: &[Taken],
    finished: bool,
    needs_white: bool,
    known: impl Fn(u32) -> bool,
) -> Result<()> {
    let records = || frames.iter().map(|f| &f.record);
    for record in records().filter(|r| r.kind == FrameKind::Sample) {
        if !record.config.is_some_and(&known) {
            return Err(Error::new(format!(
                "frame {} belongs to no configuration of the plan",
                record.file
            ))
            .with_hint("journal.jsonl and plan.toml are not of the same session"));
        }
    }
    let lit = || records().filter(|r| measured(r.kind));
    if let (Some(with), Some(without)) = (
        lit().find(|r| r.filter.is_some()),
        lit().find(|r| r.filter.is_none()),
    ) {
        return Err(Error::new(format!(
            "{} was shot without a filter, {} through one",
            title(without),
            title(with)
        ))
        .with_hint("name the filter of every sample, white and reference frame, or of none"));
    }
    for kind in [FrameKind::Sample, FrameKind::White, FrameKind::Dark] {
        if kind == FrameKind::White && !needs_white {
            continue;
        }
        if !records().any(|r| r.kind == kind) {
            return Err(Error::new(format!(
                "the session has no {} frames",
                kind.name()
            ))
            .with_hint(if finished {
                "a session needs sample frames, white frames (or a white calibration), and dark frames of every exposure used"
            } else {
                "the capture did not finish: go on with it (`goniofit capture --resume DIR`), then measure"
            }));
        }
    }
    Ok(())
}
