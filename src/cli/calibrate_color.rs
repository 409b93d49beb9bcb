//! `goniofit calibrate color`: from the camera's colors to a stated space, from a chart.

use super::Outcome;
use super::calibrate::{Common, Work};
use super::output::data;
use crate::base::Result;
use crate::measure::calibrate::{ColorOptions, ColorReport, color};
use crate::measure::calibration::ColorMatrix;
use clap::Args;
use std::path::PathBuf;

/// Matrix from the camera's red, green, blue to a color space, from a chart in the sample's place
#[derive(Args)]
#[command(
    after_help = "Lay a color chart flat in the sample's place and capture chart frames (two exposures, so that no patch is clipped or
dark), white frames, and darks of all exposures. The chart's file is CSV:

  patch,x_mm,y_mm,width_mm,height_mm,X,Y,Z
  red,-2.0,1.5,0.8,0.8,0.214,0.121,0.052

x_mm, y_mm: middle of the patch on the sample plane, in the sample's axes; give sizes a little smaller than the patches.
References are X, Y, Z (illuminant D65, white has Y = 1) or linear r, g, b of the space.

Examples:
  goniofit calibrate color sessions/chart --chart chart.csv
  goniofit calibrate color sessions/chart --chart chart.csv --space rec2020 --json"
)]
pub(super) struct ColorArguments {
    #[command(flatten)]
    common: Common,
    /// The chart: where its patches are and what they reflect
    #[arg(long, value_name = "FILE.csv")]
    chart: PathBuf,
    /// Name of the linear space of the references
    #[arg(long, value_name = "NAME", default_value = "srgb")]
    space: String,
}

pub(super) fn run(arguments: &ColorArguments) -> Result<Outcome> {
    let work = Work::begin(&arguments.common)?;
    let options = ColorOptions {
        chart: arguments.chart.clone(),
        space: arguments.space.clone(),
    };
    let (made, report) = color(&work.session, &work.known, &options, &work.terminal)?;
    work.end(made, |c: &ColorMatrix| print(c, &report))
}

fn print(c: &ColorMatrix, report: &ColorReport) {
    data!(
        "linear {} = matrix * camera (white: {})",
        c.space,
        report.scale
    );
    for (row, name) in ["r", "g", "b"].iter().enumerate() {
        let cells = [0, 1, 2].map(|k| {
            let se = c.covariance[row][k][k].sqrt();
            format!("{:>9.5} +- {se:.5}", c.matrix[row][k])
        });
        let residual = 100.0 * c.residual[row];
        data!("{name}  {}   residual {residual:.2} %", cells.join("  "));
    }
    if let Some([mean, largest]) = report.delta_e {
        data!("color difference (CIE 1976) mean {mean:.2}, largest {largest:.2}");
    }
    data!("patch             reference                  fitted                delta E");
    for p in &report.patches {
        let triple = |v: [f64; 3]| format!("{:>7.4} {:>7.4} {:>7.4}", v[0], v[1], v[2]);
        let delta_e = p.delta_e.map_or(String::new(), |d| format!("{d:.2}"));
        let (reference, fitted) = (triple(p.reference), triple(p.fitted));
        data!("{:<12}  {reference}   {fitted}   {delta_e:>6}", p.patch);
    }
}
