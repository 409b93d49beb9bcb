//! Pictures of the truth and of the models, lit and seen alike.

use super::fits::Contestant;
use super::stage::{Order, RECORD, Stage, hash};
use super::truth::{Truth, fabric_hash};
use crate::base::{Context, Result};
use crate::cli::{inputs, render};
use crate::render::{FiberSceneOptions, Picture, PictureEffort, PictureRequest, Region};
use crate::report::{PosePictures, preview};
use crate::scatter::AnyModel;
use crate::session::{Configuration, files};
use serde_json::json;
use std::path::{Path, PathBuf};

/// Camera paths per pixel.
const PATHS: u64 = 48;
/// Poses pictured: the first of the plan, which in the published one are the four pairs of elevations.
const POSES: usize = 4;

/// Pictures of one tile.
pub(super) struct Pictures<'a> {
    /// What the measurements were rendered from, if they were.
    pub(super) truth: Option<&'a Truth>,
    /// The poses measured.
    pub(super) poses: &'a [Configuration],
    /// Light and sample of the measurements.
    pub(super) surroundings: FiberSceneOptions,
    pub(super) seed: u64,
    pub(super) models: &'a [Contestant],
    /// Pixels along the longer side.
    pub(super) pixels: usize,
}

/// Something to be pictured: its name, fabric, model, and the file with its parameters.
struct Subject {
    name: &'static str,
    fabric: PathBuf,
    model: AnyModel,
    parameters: PathBuf,
}

impl Pictures<'_> {
    /// Renders what is not there yet; the pictures by pose.
    pub(super) fn made(&self, order: &Order<'_>) -> Result<Vec<PosePictures>> {
        let subjects = self.subjects(order)?;
        let parameters: Result<Vec<String>> =
            subjects.iter().map(|s| hash(&s.parameters)).collect();
        let fabrics: Vec<&str> = self.models.iter().map(|m| m.key.as_str()).collect();
        let stage = Stage {
            folder: order.out.join("pictures"),
            record: RECORD,
            title: format!("pictures: one tile in {} poses", self.poses().len()),
            asked: json!({
                "truth": self.truth.map(|t| fabric_hash(&t.fabric)).transpose()?,
                "fabrics": fabrics,
                "parameters": parameters?,
                "poses": self.poses(),
                "pixels": self.pixels,
                "paths": PATHS,
                "seed": self.seed,
            }),
        };
        stage.made(order, |folder| {
            let all: Result<Vec<_>> = subjects.iter().map(|s| self.pictures(s, order)).collect();
            let all = all?;
            for (k, pose) in self.poses().iter().enumerate() {
                // The exposure of the first, the truth where there is one, serves all.
                let exposure = preview::exposure(&linear(&all[0][k], 1.0));
                for (subject, pictures) in subjects.iter().zip(&all) {
                    let shown = linear(&pictures[k], exposure);
                    let note = [("exposure", format!("{exposure:.6e}"))];
                    let png = preview::annotated_png(pictures[k].resolution, &shown, &note)?;
                    files::write_atomic(&file(folder, pose, subject.name), &png)?;
                }
            }
            Ok(json!({}))
        })?;
        self.read(&stage.folder, &subjects)
    }

    fn poses(&self) -> &[Configuration] {
        &self.poses[..self.poses.len().min(POSES)]
    }

    fn subjects(&self, order: &Order<'_>) -> Result<Vec<Subject>> {
        let truth = |truth: &Truth| {
            Ok(Subject {
                name: "truth",
                fabric: truth.fabric.clone(),
                model: truth.model,
                parameters: order.out.join("truth").join("params.json"),
            })
        };
        let model = |who: &Contestant| -> Result<Subject> {
            Ok(Subject {
                name: who.name,
                fabric: who.fabric.clone(),
                model: AnyModel::named(who.model)?,
                parameters: who.fit_file(),
            })
        };
        let models = self.models.iter().map(model);
        self.truth.into_iter().map(truth).chain(models).collect()
    }

    fn pictures(&self, subject: &Subject, order: &Order<'_>) -> Result<Vec<Picture>> {
        let parameters = inputs::parameters(&subject.parameters, subject.model.parametric())?;
        let request = |region: Region| {
            let longer = region.size[0].max(region.size[1]);
            let along = |s: f64| ((self.pixels as f64 * s / longer).round() as usize).max(1);
            PictureRequest {
                configurations: self.poses(),
                parameters: &parameters,
                region,
                resolution: region.size.map(along),
                effort: PictureEffort::PathsPerPixel(PATHS),
                derivatives: &[],
                seed: self.seed,
            }
        };
        let scene = render::scene(&subject.fabric, subject.model, self.surroundings)?;
        scene.pictures(&request(scene.tile()), order.terminal)
    }

    fn read(&self, folder: &Path, subjects: &[Subject]) -> Result<Vec<PosePictures>> {
        let of_pose = |pose: &Configuration| -> Result<PosePictures> {
            let one = |s: &Subject| {
                let path = file(folder, pose, s.name);
                std::fs::read(&path).context(|| format!("{} cannot be read", path.display()))
            };
            Ok(PosePictures {
                configuration: *pose,
                pngs: subjects.iter().map(one).collect::<Result<_>>()?,
            })
        };
        self.poses().iter().map(of_pose).collect()
    }
}

fn file(folder: &Path, pose: &Configuration, name: &str) -> PathBuf {
    folder.join(format!("config_{:02}-{name}.png", pose.id))
}

fn linear(picture: &Picture, exposure: f64) -> Vec<[f64; 3]> {
    let pixels = picture.radiance.value.iter();
    pixels.map(|v| v.map(|x| exposure * f64::from(x))).collect()
}
