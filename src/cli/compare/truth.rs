//! The measurements that all models are fitted to: rendered from the fabric's own fibers.

use super::stage::{Order, RECORD, Stage, hash};
use crate::base::{Error, Result};
use crate::cli::render;
use crate::fabric::fiber_file;
use crate::render::{Effort, Estimate, FiberSceneOptions, Request};
use crate::scatter::{AnyModel, Parameters};
use crate::session::{Configuration, Intensity, Measurements, Plan, Quantity, files, protocols};
use serde_json::json;
use std::path::{Path, PathBuf};

/// What is to be rendered.
pub(super) struct Truth {
    pub(super) fabric: PathBuf,
    pub(super) model: AnyModel,
    pub(super) parameters: Parameters,
    pub(super) plan: Plan,
    pub(super) validation: Plan,
    /// Weighted rms standard error of the rendered measurements; those for validation have twice as much.
    pub(super) accuracy: f64,
    pub(super) seed: u64,
}

/// Where the measurements lie.
#[derive(Debug, Clone)]
pub(super) struct Data {
    pub(super) measurements: PathBuf,
    /// At poses that no fit sees.
    pub(super) validation: Option<PathBuf>,
}

impl Truth {
    /// Renders what is not there yet.
    pub(super) fn rendered(&self, order: &Order<'_>) -> Result<Data> {
        let folder = order.out.join("truth");
        let data = Data {
            measurements: folder.join("measurements.csv"),
            validation: Some(folder.join("validation.csv")),
        };
        let stage = Stage {
            folder,
            record: RECORD,
            title: "truth: rendering the measurements from the fabric's own fibers".to_owned(),
            asked: json!({
                "fabric": fabric_hash(&self.fabric)?,
                "model": self.model.parametric().name(),
                "parameters": self.parameters.to_json(),
                "plan": self.plan.configurations,
                "validation": self.validation.configurations,
                "accuracy": self.accuracy,
                "seed": self.seed,
            }),
        };
        stage.made(order, |folder| {
            let text = format!("{:#}\n", self.parameters.to_json());
            files::write_atomic(&folder.join("params.json"), text.as_bytes())?;
            let scene = render::scene(&self.fabric, self.model, FiberSceneOptions::default())?;
            let parts = [
                (&self.plan, 1.0, "measurements.csv"),
                (&self.validation, 2.0, "validation.csv"),
            ];
            let mut paths = 0;
            for (stream, (plan, factor, name)) in (0..).zip(parts) {
                let request = Request {
                    configurations: &plan.configurations,
                    parameters: &self.parameters,
                    effort: Effort::Accuracy(factor * self.accuracy),
                    seed: self.seed,
                    stream,
                };
                let estimates = scene.estimate(&request, order.terminal)?.configurations;
                paths += estimates.iter().map(|e| e.paths).sum::<u64>();
                let table = measured(&plan.configurations, &estimates);
                let csv = table.to_stated_csv(Quantity::NormalizedRadiance, true)?;
                files::write_atomic(&folder.join(name), csv.as_bytes())?;
            }
            Ok(json!({ "paths": paths }))
        })?;
        Ok(data)
    }
}

fn measured(poses: &[Configuration], estimates: &[Estimate]) -> Measurements {
    let rows = poses.iter().zip(estimates);
    let intensity = |(configuration, e): (&Configuration, &Estimate)| Intensity {
        configuration: *configuration,
        mean: e.mean,
        standard_error: e.standard_error,
        present: [true; 3],
    };
    Measurements {
        intensities: rows.map(intensity).collect(),
    }
}

/// SHA-256 of a description and of the fibers it points to.
pub(super) fn fabric_hash(fabric: &Path) -> Result<String> {
    let own = hash(fabric)?;
    match fiber_file(fabric) {
        Some(fibers) => Ok(files::sha256((own + &hash(&fibers)?).as_bytes())),
        None => Ok(own),
    }
}

/// The plan in a file, or the published 16 poses.
pub(super) fn plan(path: Option<&Path>) -> Result<Plan> {
    path.map_or_else(protocols::khungurn16, Plan::read)
}

/// Light and camera (polar angle and azimuth) and rotation of poses that the published 16 lack, degrees.
const OTHERS: [([f64; 2], [f64; 2], f64); 8] = [
    ([45.0, 180.0], [45.0, 0.0], 0.0),
    ([20.0, 180.0], [60.0, 0.0], 0.0),
    ([72.0, 180.0], [72.0, 0.0], 0.0),
    ([60.0, 90.0], [20.0, 0.0], 0.0),
    ([30.0, 0.0], [50.0, 0.0], 45.0),
    ([70.0, 180.0], [55.0, 0.0], 45.0),
    ([75.0, 270.0], [60.0, 0.0], 90.0),
    ([72.0, 180.0], [72.0, 0.0], 90.0),
];

/// The plan in a file, or a few poses in between the published ones.
pub(super) fn validation_plan(path: Option<&Path>) -> Result<Plan> {
    if let Some(path) = path {
        return Plan::read(path);
    }
    let pose = |(id, (light, camera, rotation)): (u32, &([f64; 2], [f64; 2], f64))| {
        Configuration::from_degrees(id, *light, *camera, *rotation)
    };
    let configurations = (101..).zip(&OTHERS).map(pose).collect::<Result<Vec<_>>>()?;
    Ok(Plan {
        name: "validation".to_owned(),
        description: "poses in between those of Khungurn 2015".to_owned(),
        configurations,
        ..protocols::khungurn16()?
    })
}

/// Refuses poses for validation that the fits see.
pub(super) fn check_apart(plan: &Plan, validation: &Plan) -> Result<()> {
    let place = |c: &Configuration| [c.light_in_sample().vector(), c.camera_in_sample().vector()];
    for other in &validation.configurations {
        let [light, camera] = place(other);
        let near = |c: &&Configuration| {
            let [l, k] = place(c);
            l.distance(light) < 1e-6 && k.distance(camera) < 1e-6
        };
        if let Some(c) = plan.configurations.iter().find(near) {
            return Err(Error::new(format!(
                "configuration {} of the validation plan is the pose of configuration {} of the plan: it would prove nothing",
                other.id, c.id
            ))
            .with_hint("validate at poses that the fits do not see"));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_for_validation_are_others() {
        let plan = plan(None).unwrap();
        let validation = validation_plan(None).unwrap();
        check_apart(&plan, &validation).unwrap();
        let error = check_apart(&plan, &plan).unwrap_err().report();
        assert!(
            error.contains("configuration 1 of the validation plan") && error.contains("hint:")
        );
    }
}
