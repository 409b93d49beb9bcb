//! The commands that move.

use super::{Answer, Desk, Terminal, axis_named};
use crate::base::{Context, Error, Result};
use crate::cli::Outcome;
use crate::math::PolarDirection;
use crate::rig::{Axis, AxisAngles, AxisName, Homing, Leg, Rig, RigDescription, Step};
use crate::session::{Configuration, Plan};
use serde_json::json;
use std::path::PathBuf;

/// The most an axis is jogged, degrees.
const JOG_DEG: f64 = 5.0;
/// The most an axis is jogged whose position is not known, degrees.
const UNHOMED_JOG_DEG: f64 = 2.0;

#[derive(clap::Args)]
#[command(after_help = "Examples:
  goniofit rig move --rig R.toml light_elevation=45 turntable=90
      the other axes stay where they are; one that stands at its switch goes to its nearest limit
  goniofit rig move --rig R.toml --pose 45,180,0,0,0
      light_theta,light_phi,camera_theta,camera_phi,rotation in degrees, as in plans and measurements.csv
  goniofit rig move --rig R.toml --plan P.toml --config 7 --dry-run
      print the way to configuration 7 from the parking place; opens no port")]
pub(super) struct MoveArguments {
    /// Angles of single axes, degrees
    #[arg(value_name = "AXIS=DEG", required_unless_present_any = ["pose", "config"], conflicts_with_all = ["pose", "config"])]
    axes: Vec<String>,
    /// light_theta,light_phi,camera_theta,camera_phi,rotation in degrees
    #[arg(long, allow_hyphen_values = true, conflicts_with = "config")]
    pose: Option<String>,
    /// A configuration of a plan
    #[arg(long, value_name = "ID", requires = "plan")]
    config: Option<u32>,
    /// The plan
    #[arg(long, value_name = "P.toml", requires = "config")]
    plan: Option<PathBuf>,
    /// With --dry-run: where the axes stand; those not named are at their parking place
    #[arg(long, value_name = "AXIS=DEG", requires = "dry_run", num_args = 1..)]
    from: Vec<String>,
}

#[derive(clap::Args)]
#[command(after_help = "Examples:
  goniofit rig jog --rig R.toml turntable +2.5
  goniofit rig jog --rig R.toml light_elevation -1
      at most 5 degrees, inside the limits, when the boards say they are homed
  goniofit rig jog --rig R.toml camera_azimuth 1.5 --unhomed
      free an axis from its switch: at most 2 degrees, slowly, no limit is checked; asks first")]
pub(super) struct JogArguments {
    /// Axis name
    axis: String,
    /// How far, degrees
    #[arg(allow_negative_numbers = true, value_name = "+-DEG")]
    degrees: f64,
    /// Although the position is not known
    #[arg(long)]
    unhomed: bool,
}

/// Where a move shall go.
enum Wanted {
    /// These axes; the others stay.
    Axes(Vec<(AxisName, f64)>),
    /// All of them.
    Pose(AxisAngles),
}

impl Wanted {
    fn of(rig: &RigDescription, a: &MoveArguments) -> Result<Self> {
        if let Some(text) = &a.pose {
            return Ok(Self::Pose(rig.angles(&pose(text)?)?));
        }
        if let (Some(id), Some(path)) = (a.config, &a.plan) {
            let plan = Plan::read(path)?;
            let c = plan.configuration(id).ok_or_else(|| {
                Error::new(format!("{} has no configuration {id}", path.display()))
                    .with_hint("`goniofit capture --dry-run` lists them")
            })?;
            return Ok(Self::Pose(rig.angles(c)?));
        }
        Ok(Self::Axes(checked_axes(rig, &a.axes)?))
    }

    fn from(&self, from: &AxisAngles) -> AxisAngles {
        match self {
            Self::Pose(to) => *to,
            Self::Axes(axes) => with_axes(from, axes),
        }
    }
}

fn with_axes(from: &AxisAngles, axes: &[(AxisName, f64)]) -> AxisAngles {
    let mut to = *from;
    for (name, deg) in axes {
        to.0[*name as usize] = *deg;
    }
    to
}

/// `AXIS=DEG` words, each inside the limits of the rig file.
fn checked_axes(rig: &RigDescription, words: &[String]) -> Result<Vec<(AxisName, f64)>> {
    let mut axes: Vec<(AxisName, f64)> = Vec::new();
    for word in words {
        let (name, deg) = word
            .split_once('=')
            .and_then(|(name, deg)| Some((name, deg.parse::<f64>().ok()?)))
            .ok_or_else(|| {
                Error::new(format!("'{word}' is not AXIS=DEG"))
                    .with_hint("for example light_elevation=45")
            })?;
        let name = axis_named(name)?;
        if axes.iter().any(|a| a.0 == name) {
            return Err(Error::new(format!("axis {} is named twice", name.name())));
        }
        reachable(rig, name, deg)?;
        axes.push((name, deg));
    }
    Ok(axes)
}

fn reachable(rig: &RigDescription, name: AxisName, deg: f64) -> Result<()> {
    match rig.axis(name) {
        Axis::Fixed { angle_deg, .. } => Err(Error::new(format!(
            "axis {} has no motor, it is fixed at {angle_deg} degrees",
            name.name()
        ))),
        Axis::Motor(m) if !(m.min_deg..=m.max_deg).contains(&deg) => Err(Error::new(format!(
            "axis {}: {deg} degrees is outside its limits, {} to {}",
            name.name(),
            m.min_deg,
            m.max_deg
        ))
        .with_hint("change the limits in the rig file if the axis really reaches there")),
        Axis::Motor(_) => Ok(()),
    }
}

fn pose(text: &str) -> Result<Configuration> {
    let numbers: Option<Vec<f64>> = text.split(',').map(|n| n.trim().parse().ok()).collect();
    let numbers: Option<[f64; 5]> = numbers.and_then(|n| n.try_into().ok());
    let good = numbers.filter(|n| {
        n.iter().all(|v| v.is_finite()) && [n[0], n[2]].iter().all(|t| (0.0..90.0).contains(t))
    });
    let [light_theta, light_phi, camera_theta, camera_phi, rotation] = good.ok_or_else(|| {
        Error::new(format!("--pose {text}: expected five angles in degrees, thetas in 0 to 90"))
            .with_hint("light_theta,light_phi,camera_theta,camera_phi,rotation: for example --pose 45,180,0,0,0")
    })?;
    Ok(Configuration {
        id: 0,
        light: PolarDirection::from_degrees(light_theta, light_phi),
        camera: PolarDirection::from_degrees(camera_theta, camera_phi),
        rotation: rotation.to_radians(),
    })
}

/// The parking place, with `given` instead where it says something.
fn assumed_start(rig: &RigDescription, given: &[(AxisName, f64)]) -> Result<AxisAngles> {
    let mut start = AxisAngles([0.0; 5]);
    for name in AxisName::ALL {
        let known = given.iter().find(|a| a.0 == name).map(|a| a.1);
        let known = known.or_else(|| match rig.axis(name) {
            Axis::Fixed { angle_deg, .. } => Some(*angle_deg),
            Axis::Motor(_) => rig.park_deg.get(&name).copied(),
        });
        start.0[name as usize] = known.ok_or_else(|| {
            Error::new(format!(
                "--dry-run does not know where axis {} stands",
                name.name()
            ))
            .with_hint(format!(
                "it has no parking place; add --from {}=DEG",
                name.name()
            ))
        })?;
    }
    Ok(start)
}

/// About how long a leg takes, seconds.
fn seconds(rig: &RigDescription, from: &AxisAngles, to: &AxisAngles) -> f64 {
    AxisName::ALL
        .iter()
        .map(|name| match rig.axis(*name) {
            Axis::Fixed { .. } => 0.0,
            Axis::Motor(m) => {
                let way = (from.get(*name) - to.get(*name)).abs();
                let ramps = m.speed_deg_per_s / m.acceleration_deg_per_s2;
                if way > 0.0 {
                    way / m.speed_deg_per_s + ramps
                } else {
                    0.0
                }
            }
        })
        .fold(0.0, f64::max)
}

/// A checked way, told.
struct Way {
    from: AxisAngles,
    legs: Vec<Leg>,
    expected_s: f64,
}

impl Way {
    fn checked(rig: &RigDescription, from: AxisAngles, to: &AxisAngles) -> Result<Self> {
        let legs = rig.path(&from, to)?;
        let mut last = from;
        let mut expected_s = 0.0;
        for leg in &legs {
            expected_s += seconds(rig, &last, &leg.to);
            last = leg.to;
        }
        Ok(Self {
            from,
            legs,
            expected_s,
        })
    }

    fn answer(&self, end: Option<&AxisAngles>) -> Answer {
        let heads: Vec<&str> = AxisName::ALL.iter().map(|a| a.name()).collect();
        let row = |what: &str, angles: &AxisAngles| {
            let angles: Vec<String> = AxisName::ALL
                .iter()
                .map(|a| format!("{:>w$.3}", angles.get(*a), w = a.name().len()))
                .collect();
            format!("{what:<6}  {}", angles.join("  "))
        };
        let mut lines = vec![format!("        {}", heads.join("  "))];
        lines.push(row("from", &self.from));
        let legs = self.legs.iter().enumerate();
        lines.extend(legs.map(|(i, leg)| row(&format!("leg {}", i + 1), &leg.to)));
        if let Some(end) = end {
            lines.push(row("now", end));
        }
        lines.push(format!("about {:.0} s", self.expected_s));
        let legs: Vec<_> = self.legs.iter().map(|l| l.to.by_name()).collect();
        Answer {
            text: lines.join("\n"),
            json: json!({
                "from_deg": self.from.by_name(), "legs_deg": legs, "expected_s": self.expected_s,
                "now_deg": end.map(AxisAngles::by_name), "dry_run": end.is_none(),
            }),
        }
    }
}

/// Makes the position known, by the boards' word where they give it, else by homing.
fn ensure_homed(desk: &Desk, rig: &mut Rig<'_>, terminal: &Terminal) -> Step {
    if rig.take_homing_as_said()? {
        terminal.say("the boards say they are homed");
        return Ok(());
    }
    home_all(desk, rig, terminal)
}

fn home_all(desk: &Desk, rig: &mut Rig<'_>, terminal: &Terminal) -> Step {
    let description = &desk.description;
    let asks = description
        .boards
        .iter()
        .any(|b| b.homing == Homing::ByHand);
    let longest = AxisName::ALL.iter().map(|n| match description.axis(*n) {
        Axis::Motor(m) => (m.max_deg - m.min_deg) / m.speed_deg_per_s,
        Axis::Fixed { .. } => 0.0,
    });
    // No bar while somebody is asked.
    let expected_s = if asks {
        0.0
    } else {
        longest.fold(5.0, f64::max)
    };
    terminal.say("homing");
    terminal.with_progress("homing", expected_s, || {
        rig.home(&mut |question| terminal.confirm(question, desk.yes))
    })
}

/// Axes that stand outside their limits, as they do at their switches, and the nearest angle inside.
fn strays(rig: &RigDescription, at: &AxisAngles) -> Vec<(AxisName, f64)> {
    let stray = |name: AxisName| match rig.axis(name) {
        Axis::Motor(m) if !(m.min_deg..=m.max_deg).contains(&at.get(name)) => {
            Some((name, at.get(name).clamp(m.min_deg, m.max_deg)))
        }
        _ => None,
    };
    AxisName::ALL.into_iter().filter_map(stray).collect()
}

/// Moves; axes that are not named stay, unless they stand outside their limits.
fn go(desk: &Desk, rig: &mut Rig<'_>, terminal: &Terminal, wanted: &Wanted) -> Step<Answer> {
    let from = rig.angles()?;
    let to = wanted.from(&with_axes(&from, &strays(&desk.description, &from)));
    let way = Way::checked(&desk.description, from, &to)?;
    let now = terminal.with_progress("moving", way.expected_s, || rig.move_to(&to))?;
    Ok(way.answer(Some(&now)))
}

pub(super) fn home(desk: &Desk) -> Result<Outcome> {
    if desk.dry_run {
        let boards = desk.description.boards.iter().map(|b| match b.homing {
            Homing::Cycle => format!("run board '{}' to its switches", b.name),
            Homing::ByHand => format!("ask whether board '{}' stands at its zero marks", b.name),
        });
        return desk.rehearse(&boards.collect::<Vec<_>>().join("; "));
    }
    desk.drive(|rig, terminal| {
        home_all(desk, rig, terminal)?;
        let now = rig.angles()?;
        let shown: Vec<String> = now
            .by_name()
            .iter()
            .map(|(name, deg)| format!("{name} {deg:.3}"))
            .collect();
        Ok(Answer {
            text: format!("homed: {}", shown.join(", ")),
            json: json!({"homed": rig.is_homed(), "now_deg": now.by_name()}),
        })
    })
}

pub(super) fn move_to(desk: &Desk, arguments: &MoveArguments) -> Result<Outcome> {
    let rig = &desk.description;
    let wanted = Wanted::of(rig, arguments)?;
    if desk.dry_run {
        let from = assumed_start(rig, &checked_axes(rig, &arguments.from)?)?;
        let way = Way::checked(rig, from, &wanted.from(&from))?;
        way.answer(None).print(desk.json);
        return Ok(Outcome::Done);
    }
    desk.drive(|rig, terminal| {
        ensure_homed(desk, rig, terminal)?;
        go(desk, rig, terminal, &wanted)
    })
}

pub(super) fn park(desk: &Desk) -> Result<Outcome> {
    let places: Vec<(AxisName, f64)> = desk.description.park_deg.clone().into_iter().collect();
    if places.is_empty() {
        return Err(Error::new("the rig file names no parking place")
            .with_hint("add a [park] table with the angle of each axis"));
    }
    if desk.dry_run {
        let shown: Vec<String> = places
            .iter()
            .map(|(name, deg)| format!("{}={deg}", name.name()))
            .collect();
        return desk.rehearse(&format!("move to {}", shown.join(" ")));
    }
    desk.drive(|rig, terminal| {
        ensure_homed(desk, rig, terminal)?;
        go(desk, rig, terminal, &Wanted::Axes(places))
    })
}

pub(super) fn jog(desk: &Desk, arguments: &JogArguments) -> Result<Outcome> {
    let name = axis_named(&arguments.axis)?;
    let degrees = arguments.degrees;
    let most = if arguments.unhomed {
        UNHOMED_JOG_DEG
    } else {
        JOG_DEG
    };
    if !(degrees.abs() > 0.0 && degrees.abs() <= most) {
        return Err(Error::new(format!(
            "a jog of {degrees} degrees, expected at most {most} either way"
        ))
        .with_hint("`goniofit rig move` goes further, along a checked way"));
    }
    if let Axis::Fixed { angle_deg, .. } = desk.description.axis(name) {
        reachable(&desk.description, name, *angle_deg)?;
    }
    if desk.dry_run {
        return desk.rehearse(&format!("move {} by {degrees} degrees", name.name()));
    }
    if arguments.unhomed {
        return nudge(desk, name, degrees);
    }
    desk.drive(|rig, terminal| {
        if !rig.take_homing_as_said()? {
            return Err(Error::new("the boards do not say that they are homed")
                .with_hint("`goniofit rig home` first; to free an axis that stands on its switch, --unhomed")
                .into());
        }
        let at = rig.angles()?;
        if let Some((stray, _)) = strays(&desk.description, &at).first() {
            return Err(Error::new(format!(
                "axis {} stands at {:.3} degrees, outside its limits, as after homing",
                stray.name(),
                at.get(*stray)
            ))
            .with_hint("`goniofit rig move` or `goniofit rig park` brings every axis inside first")
            .into());
        }
        let to = at.get(name) + degrees;
        reachable(&desk.description, name, to).context(|| "the jog is refused")?;
        go(desk, rig, terminal, &Wanted::Axes(vec![(name, to)]))
    })
}

fn nudge(desk: &Desk, name: AxisName, degrees: f64) -> Result<Outcome> {
    desk.drive(|rig, terminal| {
        let axis = name.name();
        let question = format!(
            "move {axis} by {degrees} degrees although its position is not known: is its way free?"
        );
        rig.ask(&mut |q| terminal.confirm(q, desk.yes), &question)?;
        let moved = rig.nudge(name, degrees)?;
        Ok(Answer {
            text: format!("{axis} moved by {moved:.3} degrees; home before moving further"),
            json: json!({"axis": axis, "moved_deg": moved, "homed": false}),
        })
    })
}
