//! What the render commands have in common: the fabric, its parameters, the poses, and what surrounds the cloth.

use super::surroundings;
use crate::base::{Error, Result};
use crate::cli::inputs;
use crate::render::{FiberSceneOptions, Integrator, Plate, View};
use crate::rig::RigDescription;
use crate::scatter::{AnyModel, Parameters};
use crate::session::{Configuration, Plan};
use std::path::{Path, PathBuf};

/// What is rendered.
#[derive(clap::Args)]
pub(super) struct Subject {
    /// Fabric: description (TOML), fibers (.csv) or voxels (.nrrd)
    #[arg(long, value_name = "F")]
    fabric: PathBuf,
    /// Scattering model
    #[arg(long, default_value = "khungurn")]
    model: String,
    /// Model parameters (JSON, or a fit.json), for all fibers or for warp and weft; the published defaults when left out
    #[arg(long, value_name = "P.json")]
    params: Option<PathBuf>,
    #[command(flatten)]
    poses: Poses,
    /// Selects the random streams
    #[arg(long, default_value_t = 1)]
    pub(super) seed: u64,
    #[command(flatten)]
    surroundings: Surroundings,
}

/// From where it is lit and seen.
#[derive(clap::Args)]
#[group(required = true, multiple = false)]
struct Poses {
    /// Configurations to render (TOML)
    #[arg(long, value_name = "PLAN.toml")]
    plan: Option<PathBuf>,
    /// A configuration instead of a plan, degrees: "light=THETA,PHI camera=THETA,PHI rotation=R"; given again, the next
    /// (their ids count from 1)
    #[arg(long, value_name = "POSE", value_parser = pose)]
    pose: Vec<Pose>,
}

/// What surrounds the cloth.
#[derive(clap::Args)]
struct Surroundings {
    /// Rig whose light and sample square to render [default: a light of 10 cm at 61 cm, a square of 1 cm]
    #[arg(long, help_heading = "Surroundings", value_name = "RIG.toml")]
    rig: Option<PathBuf>,
    /// Side of the square light, millimeters; replaces the rig's
    #[arg(long, help_heading = "Surroundings", value_name = "MM", value_parser = length)]
    light_size: Option<f64>,
    /// From the sample's center to the light, millimeters; replaces the rig's
    #[arg(long, help_heading = "Surroundings", value_name = "MM", value_parser = length)]
    light_distance: Option<f64>,
    /// Side of the square on the sample that is averaged, millimeters; replaces the rig's
    #[arg(long, help_heading = "Surroundings", value_name = "MM", value_parser = length)]
    sample_square: Option<f64>,
    /// Under the cloth: black, open (nothing), white, or a diffuse surface of albedo A or R,G,B
    #[arg(long, help_heading = "Surroundings", default_value = "black", value_parser = plate)]
    plate: Plate,
    /// The camera's rays: ortho (parallel), or pinhole:MM (through one point at that distance from the sample's center)
    #[arg(long, help_heading = "Surroundings", default_value = "ortho", value_parser = view)]
    view: View,
}

/// A configuration as typed: polar angle and azimuth, degrees.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Pose {
    light: [f64; 2],
    camera: [f64; 2],
    rotation: f64,
}

/// A [`Subject`] that was read.
pub(super) struct Ready<S> {
    pub(super) scene: S,
    pub(super) parameters: Parameters,
    pub(super) configurations: Vec<Configuration>,
}

impl Subject {
    /// Reads all files and builds the scene.
    pub(super) fn read<S>(
        &self,
        integrator: Integrator,
        build: impl FnOnce(&Path, AnyModel, FiberSceneOptions) -> Result<S>,
    ) -> Result<Ready<S>> {
        let model = AnyModel::named(&self.model)?;
        let configurations = self.poses.configurations()?;
        let (parameters, model) = match &self.params {
            Some(path) => inputs::parameters_and_model(path, model)?,
            None => (Parameters::defaults(model.parametric()), model),
        };
        let options = FiberSceneOptions {
            integrator,
            ..self.surroundings.options()?
        };
        let scene = build(&self.fabric, model, options)?;
        Ok(Ready {
            scene,
            parameters,
            configurations,
        })
    }

    /// What a file made from it says of it.
    pub(super) fn attributes(&self, parameters: &Parameters) -> Vec<(&'static str, String)> {
        vec![
            ("fabric", self.fabric.display().to_string()),
            ("model", self.model.clone()),
            ("parameters", parameters.to_json().to_string()),
            ("seed", self.seed.to_string()),
        ]
    }
}

impl Poses {
    fn configurations(&self) -> Result<Vec<Configuration>> {
        if let Some(path) = &self.plan {
            return Ok(Plan::read(path)?.configurations);
        }
        let numbered = (1..).zip(&self.pose);
        numbered
            .map(|(id, p)| Configuration::from_degrees(id, p.light, p.camera, p.rotation))
            .collect()
    }
}

impl Surroundings {
    fn options(&self) -> Result<FiberSceneOptions> {
        let rig = self.rig.as_deref().map(RigDescription::read).transpose()?;
        let mut options = rig.map_or(Ok(FiberSceneOptions::default()), |r| surroundings(&r))?;
        let replace = |place: &mut f64, given: Option<f64>| *place = given.unwrap_or(*place);
        replace(&mut options.light.side, self.light_size);
        replace(&mut options.light.distance, self.light_distance);
        replace(&mut options.sample_square, self.sample_square);
        options.plate = self.plate;
        options.view = self.view;
        Ok(options)
    }
}

/// Parses a positive number of millimeters.
pub(super) fn length(text: &str) -> Result<f64, String> {
    match text.trim().parse::<f64>() {
        Ok(x) if x > 0.0 && x.is_finite() => Ok(x),
        _ => Err(format!("'{text}' is not a positive number of millimeters")),
    }
}

/// Parses `N` numbers with commas between them.
pub(super) fn numbers<const N: usize>(text: &str) -> Option<[f64; N]> {
    let all: Vec<f64> = text
        .split(',')
        .map(|n| n.trim().parse().ok().filter(|x: &f64| x.is_finite()))
        .collect::<Option<_>>()?;
    all.try_into().ok()
}

/// Parses what lies under the cloth.
pub(crate) fn plate(text: &str) -> Result<Plate, String> {
    let albedo = match text {
        "black" => return Ok(Plate::Black),
        "open" => return Ok(Plate::Open),
        "white" => [1.0; 3],
        _ => numbers::<3>(text)
            .or_else(|| numbers::<1>(text).map(|[a]| [a; 3]))
            .filter(|albedo| albedo.iter().all(|a| (0.0..=1.0).contains(a)))
            .ok_or_else(|| {
                format!("'{text}' is not black, open, white, or an albedo from 0 to 1 (A or R,G,B)")
            })?,
    };
    Ok(Plate::Diffuse(albedo))
}

/// What [`plate`] reads as this.
pub(crate) fn plate_in_words(plate: Plate) -> String {
    match plate {
        Plate::Black => "black".to_owned(),
        Plate::Open => "open".to_owned(),
        Plate::Diffuse([r, g, b]) => format!("{r},{g},{b}"),
    }
}

fn view(text: &str) -> Result<View, String> {
    match text.split_once(':') {
        None if text == "ortho" => Ok(View::Orthographic),
        Some(("pinhole", distance)) => length(distance).map(|distance| View::Pinhole { distance }),
        _ => Err(format!(
            "'{text}' is not ortho or pinhole:MM, as pinhole:800"
        )),
    }
}

fn pose(text: &str) -> Result<Pose, String> {
    let wrong = |what: &str| {
        format!("{what}; expected \"light=THETA,PHI camera=THETA,PHI rotation=R\" in degrees")
    };
    let (mut light, mut camera, mut rotation) = (None, None, None);
    for word in text.split_whitespace() {
        let (key, value) = word
            .split_once('=')
            .ok_or_else(|| wrong(&format!("'{word}' has no =")))?;
        let bad = || wrong(&format!("'{value}' of {key} cannot be read"));
        let place = match key {
            "light" => &mut light,
            "camera" => &mut camera,
            "rotation" => {
                let [angle] = numbers(value).ok_or_else(bad)?;
                if rotation.replace(angle).is_some() {
                    return Err(wrong("rotation occurs twice"));
                }
                continue;
            }
            _ => return Err(wrong(&format!("'{key}' is unknown"))),
        };
        if place.replace(numbers(value).ok_or_else(bad)?).is_some() {
            return Err(wrong(&format!("{key} occurs twice")));
        }
    }
    Ok(Pose {
        light: light.ok_or_else(|| wrong("light is missing"))?,
        camera: camera.ok_or_else(|| wrong("camera is missing"))?,
        rotation: rotation.unwrap_or(0.0),
    })
}

/// Reports an id that is not among the configurations.
pub(super) fn find(configurations: &[Configuration], id: u32) -> Result<Configuration> {
    let found = configurations.iter().find(|c| c.id == id).copied();
    found.ok_or_else(|| {
        let ids: Vec<_> = configurations.iter().map(|c| c.id.to_string()).collect();
        Error::new(format!("there is no configuration {id}"))
            .with_hint(format!("those that exist: {}", ids.join(", ")))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[allow(clippy::float_cmp, reason = "numbers as typed")]
    fn poses_are_read_in_any_order_and_faults_are_named() {
        let expected = Pose {
            light: [80.0, 90.0],
            camera: [32.0, -1.5],
            rotation: 45.0,
        };
        assert_eq!(
            pose("light=80,90 camera=32,-1.5 rotation=45").unwrap(),
            expected
        );
        assert_eq!(
            pose(" rotation=45  camera=32,-1.5 light=80,90").unwrap(),
            expected
        );
        assert_eq!(pose("light=1,2 camera=3,4").unwrap().rotation, 0.0);
        for (text, fault) in [
            ("", "light is missing"),
            ("light=1,2", "camera is missing"),
            ("light=1 camera=3,4", "'1' of light"),
            ("light=1,2 camera=3,nan", "'3,nan' of camera"),
            ("light=1,2 light=1,2 camera=3,4", "light occurs twice"),
            ("light=1,2 camera=3,4 turn=2", "'turn' is unknown"),
            ("light", "'light' has no ="),
        ] {
            assert!(pose(text).unwrap_err().contains(fault), "{text}");
        }
    }

    #[test]
    fn plates_and_views_are_words_or_numbers() {
        assert_eq!(plate("open").unwrap(), Plate::Open);
        assert_eq!(plate("white").unwrap(), Plate::Diffuse([1.0; 3]));
        assert_eq!(plate("0.5").unwrap(), Plate::Diffuse([0.5; 3]));
        assert_eq!(
            plate("0.1,0.2,0.3").unwrap(),
            Plate::Diffuse([0.1, 0.2, 0.3])
        );
        for bad in ["", "gray", "1.5", "0.1,0.2", "nan", "0,0,-1"] {
            assert!(plate(bad).is_err(), "{bad}");
        }
        for text in ["black", "open", "white", "0.1,0.2,0.3"] {
            let read = plate(text).unwrap();
            assert_eq!(plate(&plate_in_words(read)).unwrap(), read, "{text}");
        }
        assert_eq!(view("ortho").unwrap(), View::Orthographic);
        assert_eq!(
            view("pinhole:800").unwrap(),
            View::Pinhole { distance: 800.0 }
        );
        for bad in ["", "pinhole", "pinhole:0", "pinhole:far", "fisheye:3"] {
            assert!(view(bad).is_err(), "{bad}");
        }
    }
}
