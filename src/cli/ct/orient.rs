//! `goniofit ct orient`.

use super::{Source, argument, inside, micrometers, numbers, report_json};
use crate::base::{Context, Error, Result};
use crate::cli::inputs;
use crate::cli::output::data;
use crate::cli::terminal::Terminal;
use crate::fabric::ct::{Filter, Gray, Method, OrientReport, Orienting, orient};
use crate::session::files;
use clap::{Parser, ValueEnum};
use std::path::PathBuf;

/// Find density and fiber direction of every voxel of a prepared volume
#[derive(Parser)]
#[command(
    after_help = "Examples:\n  goniofit ct orient cloth --radius-um 8 --out cloth\n  \
                  goniofit ct orient cloth/volume.nrrd --out other --eps-d 0.45 --drop-percent 2\n  \
                  goniofit ct orient cloth --method filter --filter 1,2,16 --eps-j -25 --out published\n\n\
                  Writes oriented.nrrd (density and direction, for 3D Slicer too) and orient.json (what was done, and what other thresholds would keep).\n\
                  docs/ct.md compares the methods: the structure tensor is the most accurate and the fastest."
)]
pub(super) struct Arguments {
    #[command(flatten)]
    source: Source,
    /// Folder for the result
    #[arg(long)]
    out: PathBuf,
    /// How directions are found: structure tensor, the published filter along lines, or the published filter
    #[arg(long, value_enum, default_value = "tensor")]
    method: MethodName,
    /// Filter and line: search from coarse to fine (the usual)
    #[arg(long, conflicts_with = "exact")]
    fast: bool,
    /// Filter and line: try all 3072 directions
    #[arg(long)]
    exact: bool,
    /// Expected fiber radius, micrometers: sets the widths of the structure tensor
    #[arg(long, value_parser = micrometers)]
    radius_um: Option<f64>,
    /// Widths of the tensor's derivatives and window in voxels, GRADIENT,WINDOW
    #[arg(long)]
    widths: Option<String>,
    /// The published filter's s,t,h in voxels
    #[arg(long)]
    filter: Option<String>,
    /// Least density; without it Otsu's threshold
    #[arg(long)]
    eps_d: Option<f64>,
    /// Least value of the filter along the direction, at most 0, on the scale that s, t and h give
    #[arg(long, allow_hyphen_values = true)]
    eps_j: Option<f64>,
    /// Least confidence, 0 to 1; hardly depends on how densely fibers are packed
    #[arg(long, default_value_t = 0.0)]
    min_confidence: f64,
    /// Drop this many percent of the voxels, those of least confidence
    #[arg(long, default_value_t = 0.0)]
    drop_percent: f64,
    /// The volume repeats in x and y (a virtual scan, or whole repeats that fit)
    #[arg(long)]
    periodic: bool,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
    /// Replace results that exist
    #[arg(long)]
    force: bool,
}

#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
enum MethodName {
    Tensor,
    Line,
    Filter,
}

pub(super) fn run(arguments: &Arguments, terminal: &Terminal) -> Result<()> {
    let options = arguments.options()?;
    let [oriented, json_file] = ["oriented.nrrd", "orient.json"].map(|n| arguments.out.join(n));
    for file in [&oriented, &json_file] {
        inputs::refuse_overwriting(file, arguments.force)?;
    }
    inputs::prepare_folder(&arguments.out)?;
    let path = inside(&arguments.source.volume, "volume.nrrd");
    let volume = arguments
        .source
        .open_file(&path, &arguments.out, terminal)?;
    let what = || format!("volume {} cannot be oriented", path.display());
    let mut gray = Gray::read(&volume, arguments.source.memory(), terminal).context(what)?;
    gray.periodic = arguments.periodic;
    let (tile, report) = orient(gray, &options, terminal).context(what)?;
    tile.write(&oriented)?;
    let mut json = report_json("goniofit-ct-oriented-1", &report)?;
    json["volume"] = serde_json::json!(path);
    files::write_atomic(&json_file, format!("{json:#}\n").as_bytes())?;
    terminal.say(in_words(&report));
    if arguments.json {
        data!("{json:#}");
    } else {
        data!("{}", oriented.display());
    }
    Ok(())
}

impl Arguments {
    fn options(&self) -> Result<Orienting> {
        let method = match self.method {
            MethodName::Tensor => Method::Tensor,
            MethodName::Line => Method::Line,
            MethodName::Filter => Method::Filter,
        };
        if method == Method::Tensor && (self.exact || self.fast) {
            return Err(Error::new(
                "--fast and --exact: expected with --method filter or line",
            ));
        }
        let widths = self.widths.as_deref().map(|text| {
            let widths: Result<[f64; 2], String> = numbers(text, "GRADIENT,WINDOW in voxels");
            argument("--widths", widths)
        });
        let widths = widths.transpose()?;
        let filter = self.filter.as_deref().map(filter).transpose()?;
        Ok(Orienting {
            exact: self.exact,
            fiber_radius: self.radius_um.map(|um| 1e-3 * um),
            gradient: widths.map(|w| w[0]),
            window: widths.map(|w| w[1]),
            filter,
            eps_d: self.eps_d,
            eps_j: self.eps_j,
            least_confidence: self.min_confidence,
            drop_share: 0.01 * self.drop_percent,
            ..Orienting::new(method)
        })
    }
}

fn filter(text: &str) -> Result<Filter> {
    let expected = "s,t,h: two numbers and a whole one, such as 1,2,16";
    let [s, t, h] = argument("--filter", numbers(text, expected))?;
    if !((1.0..=1e3).contains(&h) && h.fract().abs() < 1e-12) {
        return Err(Error::new(format!("--filter {text}: expected {expected}")));
    }
    Ok(Filter {
        s,
        t,
        h: h as usize,
    })
}

fn in_words(r: &OrientReport) -> String {
    let percent = |n: usize| 100.0 * n as f64 / r.solid.max(1) as f64;
    let mut lines = vec![format!(
        "{:.2} % of {} voxels reach eps_d = {:.4}; {:.2} % of these are kept ({:.2} % lack confidence, {:.2} % the filter's value)",
        100.0 * r.solid as f64 / r.voxels as f64,
        r.voxels,
        r.eps_d,
        percent(r.kept),
        percent(r.dropped_by_confidence),
        percent(r.dropped_by_fit)
    )];
    let shares: Vec<String> = r
        .density_choices
        .iter()
        .map(|c| format!("{:.3}: {:.1} %", c.eps_d, 100.0 * c.share))
        .collect();
    lines.push(format!("eps_d would keep  {}", shares.join("   ")));
    let list = |quantiles: &[(f64, f64)]| {
        let some: Vec<String> = quantiles
            .iter()
            .map(|(share, value)| format!("{:.0} %: {value:.3}", 100.0 * share))
            .collect();
        some.join("   ")
    };
    lines.push(format!(
        "--min-confidence would drop  {}",
        list(&r.confidence_quantiles)
    ));
    if !r.fit_quantiles.is_empty() {
        lines.push(format!("--eps-j would drop  {}", list(&r.fit_quantiles)));
    }
    let [x, y, z] = r.axis_shares.map(|s| 100.0 * s);
    lines.push(format!(
        "{x:.1} % of the fiber runs along x most of all, {y:.1} % along y, {z:.1} % along z"
    ));
    lines.join("\n")
}
