//! `goniofit scatter`: list the models, evaluate one, integrate its albedos.

use super::{Outcome, inputs, output};
use crate::base::{Context, Error, Result};
use crate::scatter::albedo::{SphereRule, directional_albedo, reverse_albedo};
use crate::scatter::{
    CHANNELS, Model, ParameterInfo, Parameters, Scattering, Unit, fiber_direction, model, models,
};
use serde_json::{Value, json};
use std::io::Read;
use std::path::{Path, PathBuf};

/// Evaluate a scattering model
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  goniofit scatter list
  goniofit scatter eval --model khungurn --params fabrics/params/gabardine.json --directions D.csv --derivatives
  goniofit scatter albedo --model khungurn --params fabrics/params/gabardine.json")]
pub(crate) struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(clap::Subcommand)]
enum Command {
    List(ListArguments),
    Eval(EvalArguments),
    Albedo(AlbedoArguments),
}

/// List the models with their parameters, published ranges and defaults
#[derive(clap::Args)]
#[command(after_help = "Examples:
  goniofit scatter list
  goniofit scatter list --json")]
struct ListArguments {
    /// Print JSON instead of a table; `defaults` in it is a valid parameter file
    #[arg(long)]
    json: bool,
}

/// Evaluate a model at given directions: CSV in, CSV out
#[derive(clap::Args)]
#[command(after_help = "\
D.csv has the columns theta_i_deg, phi_i_deg, theta_o_deg, phi_o_deg in any order
(others are ignored): the longitudinal angle in [-90, 90], 0 being perpendicular to
the fiber, and the azimuth around the fiber, of the direction toward the light (i)
and toward the camera (o). A column h, for near-field models (chiang), says where
across the fiber the camera meets it: the sine of the azimuth from the outward normal
there to the camera, in [-1, 1]; 0, the middle, when left out.

The output has one row per input row: s_r,s_g,s_b in 1/sr, without any cosine; with
--derivatives also d_PARAMETER_{r,g,b}: by each channel's own value for colors, per
radian for angles.

Examples:
  goniofit scatter eval --model khungurn --params P.json --directions D.csv
  goniofit scatter eval --model khungurn --params P.json --directions D.csv --derivatives > S.csv
  P.json: {\"c_r\": [0.1, 0.1, 0.1], \"c_tt\": [0.85, 0.85, 0.85],
           \"beta_r_deg\": 5, \"beta_tt_deg\": 10, \"gamma_tt_deg\": 10}
  goniofit scatter eval --model chiang --params Q.json --directions D.csv
  Q.json: {\"color\": [0.8, 0.5, 0.2], \"beta_m\": 0.3, \"beta_n\": 0.3}")]
struct EvalArguments {
    #[command(flatten)]
    which: Which,
    /// CSV file of directions; `-` reads stdin
    #[arg(long, value_name = "D.csv")]
    directions: PathBuf,
    /// Add the derivatives by every parameter
    #[arg(long)]
    derivatives: bool,
}

/// Integrate the directional albedo and the reverse albedo of one fiber against the angle
#[derive(clap::Args)]
#[command(after_help = "\
albedo_*: int S(wi, wo) cos(theta_o) dwo, the share of the light from theta that
leaves again (at most 1).
reverse_*: int S(wi, wo) cos(theta_i) dwi, the radiance toward theta in uniform light.
Models that are not reciprocal let it differ from albedo and exceed 1 (khungurn).
Near-field models (chiang) are averaged over where across the fiber they are met.

Examples:
  goniofit scatter albedo --model khungurn --params P.json
  goniofit scatter albedo --model khungurn --params P.json --step-deg 1 --json")]
struct AlbedoArguments {
    #[command(flatten)]
    which: Which,
    /// Angle between rows, degrees; rows run from 0 to 90 (0 to 89.9 for the last)
    #[arg(long, default_value_t = 5.0)]
    step_deg: f64,
    /// Print JSON instead of CSV
    #[arg(long)]
    json: bool,
}

#[derive(clap::Args)]
struct Which {
    /// Name of the model (see `goniofit scatter list`)
    #[arg(long)]
    model: String,
    /// JSON file of the model's parameters
    #[arg(long, value_name = "P.json")]
    params: PathBuf,
}

impl Which {
    fn load(&self) -> Result<(&'static dyn Model, Parameters, Box<dyn Scattering>)> {
        let model = model(&self.model)?;
        let parameters = inputs::parameters(&self.params, model)?;
        let scattering = model
            .prepare(&parameters)
            .context(|| format!("parameters {}", self.params.display()))?;
        Ok((model, parameters, scattering))
    }
}

pub(crate) fn run(arguments: Arguments) -> Result<Outcome> {
    let text = match arguments.command {
        Command::List(a) => list(&a)?,
        Command::Eval(a) => eval(&a)?,
        Command::Albedo(a) => albedo(&a)?,
    };
    output::write(format_args!("{text}"));
    Ok(Outcome::Done)
}

// ---- list ----------------------------------------------------------------------------------------------------------

fn list(arguments: &ListArguments) -> Result<String> {
    if arguments.json {
        let all: Vec<Value> = models().iter().map(|m| describe(*m)).collect();
        return Ok(format!("{:#}\n", json!({ "models": all })));
    }
    let mut text = String::new();
    for model in models() {
        text += &format!("{}\n", model.name());
        text += &format!(
            "  {:14} {:>9} {:>9} {:>9}  {}\n",
            "parameter", "lower", "upper", "default", "values"
        );
        for p in model.parameters() {
            let [lower, upper, default] = [p.lower, p.upper, p.default].map(|v| in_file(p, v));
            let values = if p.per_channel { "r, g, b" } else { "one" };
            text += &format!(
                "  {:14} {lower:>9} {upper:>9} {default:>9}  {values}\n",
                p.file_key()
            );
        }
    }
    Ok(text)
}

fn describe(model: &dyn Model) -> Value {
    let parameters: Vec<Value> = model
        .parameters()
        .iter()
        .map(|p| {
            json!({
                "name": p.name,
                "key": p.file_key(),
                "per_channel": p.per_channel,
                "unit": match p.unit { Unit::One => "1", Unit::Angle => "deg" },
                "lower": in_file(p, p.lower),
                "upper": in_file(p, p.upper),
                "default": in_file(p, p.default),
            })
        })
        .collect();
    let defaults: serde_json::Map<String, Value> = model
        .parameters()
        .iter()
        .map(|p| {
            let value = in_file(p, p.default);
            let value = if p.per_channel {
                json!(vec![value; CHANNELS])
            } else {
                json!(value)
            };
            (p.file_key(), value)
        })
        .collect();
    json!({ "name": model.name(), "parameters": parameters, "defaults": defaults })
}

/// The number as files show it: degrees for angles, without the digits that the way through radians left behind.
fn in_file(info: &ParameterInfo, value: f64) -> f64 {
    match info.unit {
        Unit::One => value,
        Unit::Angle => (value.to_degrees() * 1e9).round() / 1e9,
    }
}

// ---- eval ----------------------------------------------------------------------------------------------------------

fn eval(arguments: &EvalArguments) -> Result<String> {
    let (model, _, scattering) = arguments.which.load()?;
    let shown = arguments.directions.display();
    let pairs = read_directions(&arguments.directions)
        .context(|| format!("directions {shown} cannot be used"))?;
    let rows = if arguments.derivatives {
        model.parameters()
    } else {
        &[]
    };
    let mut header: Vec<String> = ["r", "g", "b"].map(|c| format!("s_{c}")).into();
    for p in rows {
        header.extend(["r", "g", "b"].map(|c| format!("d_{}_{c}", p.name)));
    }
    let mut text = header.join(",") + "\n";
    for pair in pairs {
        let [theta_i, phi_i, theta_o, phi_o] = pair.angles.map(f64::to_radians);
        let e = scattering.evaluate(
            fiber_direction(theta_i, phi_i),
            fiber_direction(theta_o, phi_o),
            pair.h,
        );
        let numbers = e
            .value
            .iter()
            .chain(e.derivative[..rows.len()].iter().flatten());
        // The debug form is the shortest that reads back to the same f64.
        let cells: Vec<String> = numbers.map(|x| format!("{x:?}")).collect();
        text += &(cells.join(",") + "\n");
    }
    Ok(text)
}

const COLUMNS: [&str; 4] = ["theta_i_deg", "phi_i_deg", "theta_o_deg", "phi_o_deg"];

/// One row of a file of directions.
struct Pair {
    /// In the order of [`COLUMNS`], degrees.
    angles: [f64; 4],
    /// Where across the fiber, see [`Scattering`].
    h: f64,
}

fn read_directions(path: &Path) -> Result<Vec<Pair>> {
    let source: Box<dyn Read> = if path.as_os_str() == "-" {
        Box::new(std::io::stdin().lock())
    } else {
        Box::new(std::fs::File::open(path).context(|| "the file cannot be opened")?)
    };
    let mut reader = csv::ReaderBuilder::new()
        .trim(csv::Trim::All)
        .comment(Some(b'#'))
        .from_reader(source);
    let header = reader
        .headers()
        .context(|| "the header cannot be read")?
        .clone();
    let mut places = [0; 4];
    for (place, name) in places.iter_mut().zip(COLUMNS) {
        *place = header.iter().position(|h| h == name).ok_or_else(|| {
            Error::new(format!("column '{name}' is missing"))
                .with_hint(format!("expected the columns {}", COLUMNS.join(",")))
        })?;
    }
    let place_of_h = header.iter().position(|h| h == "h");
    let mut pairs = Vec::new();
    for record in reader.records() {
        let row = pairs.len() + 1;
        let record = record.context(|| format!("row {row} cannot be read"))?;
        let mut angles = [0.0; 4];
        for k in 0..4 {
            angles[k] = read_angle(COLUMNS[k], &record[places[k]], row)?;
        }
        let h = place_of_h.map_or(Ok(0.0), |p| read_h(&record[p], row))?;
        pairs.push(Pair { angles, h });
    }
    Ok(pairs)
}

fn read_h(cell: &str, row: usize) -> Result<f64> {
    cell.parse::<f64>()
        .ok()
        .filter(|h| (-1.0..=1.0).contains(h))
        .ok_or_else(|| {
            Error::new(format!(
                "row {row}: h is '{cell}', expected a number from -1 to 1"
            ))
            .with_hint("rows are counted from 1 below the header; leave the column out for the middle of the fiber")
        })
}

fn read_angle(column: &str, cell: &str, row: usize) -> Result<f64> {
    let limit = if column.starts_with("theta") {
        90.0
    } else {
        f64::MAX
    };
    cell.parse::<f64>()
        .ok()
        .filter(|x| (-limit..=limit).contains(x))
        .ok_or_else(|| {
            let expected = if column.starts_with("theta") {
                "a longitudinal angle from -90 to 90 degrees"
            } else {
                "a finite number of degrees"
            };
            Error::new(format!(
                "row {row}: {column} is '{cell}', expected {expected}"
            ))
            .with_hint("rows are counted from 1 below the header")
        })
}

// ---- albedo --------------------------------------------------------------------------------------------------------

fn albedo(arguments: &AlbedoArguments) -> Result<String> {
    let (_, _, scattering) = arguments.which.load()?;
    let step = arguments.step_deg;
    if !(0.1..=90.0).contains(&step) {
        return Err(Error::new(format!(
            "--step-deg is {step}, expected 0.1 to 90"
        )));
    }
    let narrowest = scattering.narrowest();
    if narrowest < 0.25_f64.to_radians() {
        return Err(Error::new(
            "a lobe is narrower than 0.25 degrees: its albedo would take minutes",
        )
        .with_hint("the directional albedo changes little below 1 degree; use a wider lobe"));
    }
    let rule = SphereRule::new(narrowest);
    let steps = (90.0 / step + 1e-9).floor() as usize;
    let rows = (0..=steps).map(|k| {
        let theta_deg = (step * k as f64).min(89.9);
        let theta = theta_deg.to_radians();
        let forward = directional_albedo(scattering.as_ref(), theta, &rule);
        let reverse = reverse_albedo(scattering.as_ref(), theta, &rule);
        (theta_deg, forward, reverse)
    });
    if arguments.json {
        let list: Vec<Value> = rows
            .map(|(theta, a, r)| json!({ "theta_deg": theta, "albedo": a, "reverse": r }))
            .collect();
        return Ok(format!("{:#}\n", json!({ "rows": list })));
    }
    let mut text =
        "theta_deg,albedo_r,albedo_g,albedo_b,reverse_r,reverse_g,reverse_b\n".to_owned();
    for (theta, a, r) in rows {
        let cells: Vec<String> = a.iter().chain(&r).map(|x| format!("{x:.7}")).collect();
        text += &format!("{theta},{}\n", cells.join(","));
    }
    Ok(text)
}
