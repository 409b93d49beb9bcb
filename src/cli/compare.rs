//! `goniofit compare`.

mod fits;
mod pictures;
mod scan;
mod stage;
mod truth;
mod words;

use super::output::data;
use super::{Outcome, fit, inputs, terminal::Terminal};
use crate::base::{Error, Result, Watch};
use crate::fabric::VoxelTile;
use crate::fit::{FittedModel, SideBySide};
use crate::render::{DEFAULT_DENSITY, Plate};
use crate::report::{ComparisonNotes, PosePictures, comparison_page};
use crate::scatter::AnyModel;
use crate::session::{Measurements, files};
use fits::{Contestant, Fits};
use pictures::Pictures;
use scan::{Finding, Radius, Scan, Scanned};
use stage::Order;
use std::path::PathBuf;
use truth::{Data, Truth, check_apart, plan, validation_plan};

/// Fit fibers, a volume with the fibers' scattering, and a volume of microflakes to the same measurements
///
/// One synthetic truth: measurements rendered from the fabric's fibers, and a virtual CT scan of them with blur and noise.
/// From the scan come the volume and the fibers found again that the three models are fitted on. Or measured data: intensities
/// and a volume.
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  goniofit compare fabrics/gabardine.toml --params fabrics/params/gabardine.json --out gabardine
  goniofit compare fabrics/silk_satin.toml --params fabrics/params/silk.json --voxel-um 2 --noise 0.1 --time 5m --out silk
  goniofit compare fabrics/bench_twill22.toml --params P.json --paths 2000000 --seed 7 --radius-um auto --out twill --json
  goniofit compare --measurements session/measurements.csv --volume cloth/oriented.nrrd --radius-um 8.7 --out cloth/models

Writes truth/, scan/, volume/, fibers/, fit-fibers/, fit-volume/, fit-microflakes/, pictures/, compare.json and report.html into
--out. What is there and was made with the same options is not made again, so that the same command goes on after an
interrupt; a fit goes on from its renders.jsonl. docs/compare.md says what is compared and what was found.")]
pub(crate) struct Arguments {
    /// Fabric description (TOML) of fibers
    #[arg(
        value_name = "FABRIC.toml",
        required_unless_present = "measurements",
        requires = "params"
    )]
    fabric: Option<PathBuf>,
    /// True parameters of the model khungurn, for all fibers or for warp and weft (JSON, or a fit.json)
    #[arg(long, value_name = "TRUTH.json", requires = "fabric")]
    params: Option<PathBuf>,
    /// Measured intensities instead of a synthetic truth
    #[arg(long, value_name = "M.csv|M.json", requires = "volume", conflicts_with_all = ["fabric", "params", "plan", "validation"])]
    measurements: Option<PathBuf>,
    /// The measured cloth: density and direction of every voxel, as goniofit ct orient writes them
    #[arg(long, value_name = "CLOTH.nrrd", requires = "measurements")]
    volume: Option<PathBuf>,
    /// Folder for everything
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Side of a voxel of the scan, micrometers; changed a little so that whole voxels make the tile
    #[arg(long, value_name = "UM", default_value_t = 5.0, value_parser = micrometers)]
    voxel_um: f64,
    /// Standard deviation of the Gaussian that blurs the scan, micrometers [default: 0.7 voxels]
    #[arg(long, value_name = "UM", value_parser = not_negative)]
    blur_um: Option<f64>,
    /// Standard deviation of the scan's noise, as a share of the step from air to fiber
    #[arg(long, value_name = "S", default_value_t = 0.05, value_parser = not_negative)]
    noise: f64,
    /// Fiber radius with which directions and fibers are looked for: micrometers, true (the mean of the fabric's, as from a
    /// microscope), or auto (found in the scan) [default: true, with --volume auto]
    #[arg(long, value_name = "R", value_parser = radius)]
    radius_um: Option<Radius>,
    /// Density of a voxel that is all fiber, 1/mm
    #[arg(long, value_name = "N", default_value_t = DEFAULT_DENSITY, value_parser = density)]
    density_per_mm: f64,
    /// Give voxels within two radii of a found fiber the fiber's direction, as published
    #[arg(long)]
    transfer: bool,
    /// Poses to measure [default: the 16 of Khungurn 2015]
    #[arg(long, value_name = "P.toml")]
    plan: Option<PathBuf>,
    /// Poses that no fit sees [default: eight in between]
    #[arg(long, value_name = "P.toml")]
    validation: Option<PathBuf>,
    /// Weighted rms standard error of the rendered measurements; those for validation, and each render that residuals come
    /// from, have twice as much
    #[arg(long, value_name = "A", default_value = "0.5%", value_parser = inputs::fraction)]
    accuracy: f64,
    /// Rendering time of each fit, e.g. 60s, 5m or 1h [default: 60s]
    #[arg(long, value_name = "T", value_parser = fit::seconds, conflicts_with = "paths")]
    time: Option<f64>,
    /// Camera paths of each fit: reproducible
    #[arg(long, value_name = "N")]
    paths: Option<u64>,
    /// Pixels along the longer side of the pictures; 0 for none
    #[arg(long, value_name = "N", default_value_t = 64)]
    picture_px: usize,
    /// Selects the random streams of measurements, noise, fits and predictions
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Make parts that were made with other options, and what follows from them, again
    #[arg(long)]
    force: bool,
    /// Print compare.json instead of a table
    #[arg(long)]
    json: bool,
}

fn number(text: &str, what: &str, fine: impl Fn(f64) -> bool) -> Result<f64, String> {
    let number = text.trim().parse().ok().filter(|x| fine(*x));
    number.ok_or_else(|| format!("'{text}' is not {what}"))
}

fn micrometers(text: &str) -> Result<f64, String> {
    number(text, "a length from 0.01 to 1000 micrometers", |x| {
        (0.01..=1000.0).contains(&x)
    })
}

fn not_negative(text: &str) -> Result<f64, String> {
    number(text, "a number from 0 to 1000", |x| {
        (0.0..=1000.0).contains(&x)
    })
}

fn density(text: &str) -> Result<f64, String> {
    number(text, "a density from 0.001 to 1000000 per mm", |x| {
        (1e-3..=1e6).contains(&x)
    })
}

fn radius(text: &str) -> Result<Radius, String> {
    match text {
        "true" => Ok(Radius::True),
        "auto" => Ok(Radius::Found),
        _ => micrometers(text)
            .map(|um| Radius::Given(1e-3 * um))
            .map_err(|fault| format!("{fault}, true or auto")),
    }
}

pub(crate) fn run(a: Arguments) -> Result<Outcome> {
    let truth = a.truth()?;
    a.check_volume()?;
    inputs::prepare_folder(&a.out)?;
    let terminal = Terminal::new()?;
    let order = Order {
        out: a.out.clone(),
        force: a.force,
        terminal: &terminal,
    };
    match a.compared(truth.as_ref(), &order) {
        Err(_) if terminal.cancelled() => {
            terminal.finish_stage();
            terminal.say("interrupted; what is finished is kept, and the same command goes on");
            Ok(Outcome::Interrupted)
        }
        done => done.map(|()| Outcome::Done),
    }
}

impl Arguments {
    /// What is rendered, read and checked; none with measured data.
    fn truth(&self) -> Result<Option<Truth>> {
        let (Some(fabric), Some(params)) = (&self.fabric, &self.params) else {
            return Ok(None);
        };
        let khungurn = AnyModel::named(fit::MODEL)?;
        let (parameters, model) = inputs::parameters_and_model(params, khungurn)?;
        if let Some(voxels) = crate::fabric::voxel_file(fabric) {
            return Err(Error::new(format!(
                "fabric {} describes voxels ({}), expected fibers",
                fabric.display(),
                voxels.display()
            ))
            .with_hint("the truth is a cloth of fibers, of which a scan is simulated"));
        }
        let (plan, validation) = (
            plan(self.plan.as_deref())?,
            validation_plan(self.validation.as_deref())?,
        );
        check_apart(&plan, &validation)?;
        Ok(Some(Truth {
            fabric: fabric.clone(),
            model,
            parameters,
            plan,
            validation,
            accuracy: self.accuracy,
            seed: self.seed,
        }))
    }

    /// Refuses a measured volume that cannot be used, before any work.
    fn check_volume(&self) -> Result<()> {
        let Some(volume) = &self.volume else {
            return Ok(());
        };
        if !VoxelTile::is_in(volume) {
            return Err(
                Error::new(format!("volume {} has no directions", volume.display()))
                    .with_hint("goniofit ct orient finds density and direction of every voxel"),
            );
        }
        match self.radius_um {
            Some(Radius::True) => Err(Error::new(
                "--radius-um true: the radius in a measured volume is not known; expected micrometers or auto",
            )),
            _ => Ok(()),
        }
    }

    /// The fabrics to fit on.
    fn scanned(&self, order: &Order<'_>) -> Result<Scanned> {
        let usual = match self.volume {
            Some(_) => Radius::Found,
            None => Radius::True,
        };
        let finding = Finding {
            radius: self.radius_um.unwrap_or(usual),
            density: self.density_per_mm,
            transfer: self.transfer,
            truth: self.fabric.clone(),
        };
        if let Some(volume) = &self.volume {
            return finding.in_volume(volume, order);
        }
        let scan = Scan {
            fabric: self.fabric.clone().unwrap_or_default(),
            voxel: 1e-3 * self.voxel_um,
            blur: 1e-3 * self.blur_um.unwrap_or(0.7 * self.voxel_um),
            noise: self.noise,
            seed: self.seed,
        };
        finding.in_scan(&scan, order)
    }

    fn contestants(&self, scanned: &Scanned) -> [Contestant; 3] {
        let one = |name: &'static str, model, (fabric, key): &(PathBuf, String)| Contestant {
            name,
            folder: self.out.join(format!("fit-{name}")),
            model,
            fabric: fabric.clone(),
            key: key.clone(),
        };
        [
            one("fibers", fit::MODEL, &scanned.fibers),
            one("volume", "khungurn-volume", &scanned.cloth),
            one("microflakes", "microflake", &scanned.cloth),
        ]
    }

    /// Does what is left to do, and reports.
    fn compared(&self, truth: Option<&Truth>, order: &Order<'_>) -> Result<()> {
        let data = match truth {
            Some(truth) => truth.rendered(order)?,
            None => Data {
                measurements: self.measurements.clone().unwrap_or_default(),
                validation: None,
            },
        };
        let (measured, synthetic) = Measurements::read_with_origin(&data.measurements)?;
        let (surroundings, session) = fit::surroundings_of(&data.measurements, Plate::Black)?;
        let scanned = self.scanned(order)?;
        let contestants = self.contestants(&scanned);
        let parameters = truth.map(|t| t.parameters.to_json());
        let fits = Fits {
            data,
            time: self.time,
            paths: self.paths,
            seed: self.seed,
            accuracy: 2.0 * self.accuracy,
            truth: parameters.clone(),
        };
        let models: Result<Vec<FittedModel>> = contestants
            .iter()
            .map(|who| fits.fitted(order, who))
            .collect();
        let cloth = self.fabric.as_ref().or(self.volume.as_ref());
        let result = SideBySide {
            format: SideBySide::FORMAT.to_owned(),
            fabric: cloth.map_or_else(String::new, |c| c.display().to_string()),
            synthetic: synthetic.or(session).unwrap_or(false),
            truth_model: truth.map(|t| t.model.parametric().name().to_owned()),
            truth: parameters,
            scan: scanned.report,
            seed: self.seed,
            command: fit::command_line(),
            models: models?,
        };
        let poses: Vec<_> = measured
            .intensities
            .iter()
            .map(|i| i.configuration)
            .collect();
        let pictures = Pictures {
            truth,
            poses: &poses,
            surroundings,
            seed: self.seed,
            models: &contestants,
            pixels: self.picture_px,
        };
        let pictures = match self.picture_px {
            0 => Vec::new(),
            _ => pictures.made(order)?,
        };
        self.report(&result, pictures, order)
    }

    fn report(
        &self,
        result: &SideBySide,
        pictures: Vec<PosePictures>,
        order: &Order<'_>,
    ) -> Result<()> {
        let [json, page] = ["compare.json", "report.html"].map(|name| self.out.join(name));
        files::write_atomic(&json, result.to_json()?.as_bytes())?;
        let notes = ComparisonNotes {
            facts: words::facts(&result.scan),
            pictures,
        };
        files::write_atomic(&page, comparison_page(result, &notes).as_bytes())?;
        if self.json {
            data!("{}", result.to_json()?.trim_end());
        } else {
            words::print_table(result);
        }
        let told = format!("wrote {} and {}", json.display(), page.display());
        order.terminal.say(told);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn radii_are_words_or_numbers() {
        assert_eq!(radius("true"), Ok(Radius::True));
        assert_eq!(radius("auto"), Ok(Radius::Found));
        assert_eq!(radius("8"), Ok(Radius::Given(0.008)));
        for bad in ["", "-1", "nan", "found"] {
            assert!(radius(bad).is_err(), "{bad}");
        }
        assert!(
            micrometers("0").is_err() && not_negative("-0.1").is_err() && density("0").is_err()
        );
    }
}
