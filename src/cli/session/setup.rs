//! What is known of the setup that took the frames.

use crate::base::{Context, Error, Result};
use crate::rig::{LightSource, RigDescription, White};
use crate::session::files;
use serde::Deserialize;
use std::path::Path;

/// What is known of the setup.
pub(super) struct Setup {
    pub(super) name: String,
    pub(super) camera: Camera,
    pub(super) white: White,
    /// The file's text, which goes into the session folder.
    pub(super) text: String,
}

/// The camera, as a camera file has it.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Camera {
    pub(super) name: String,
    pub(super) pixel_mm: f64,
    pub(super) sample_square_mm: f64,
    #[serde(default)]
    pub(super) center_px: Option<[f64; 2]>,
    /// Only a rig file states it.
    #[serde(skip)]
    pub(super) size_px: Option<[usize; 2]>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CameraFile {
    name: String,
    camera: Camera,
    white: White,
    #[serde(default)]
    light: Option<LightSource>,
}

impl Setup {
    /// Reads a rig file, or a camera file.
    pub(super) fn read(rig: Option<&Path>, camera: Option<&Path>) -> Result<Self> {
        if let Some(path) = rig {
            let rig = RigDescription::read(path)?;
            return Ok(Self {
                name: rig.name,
                camera: Camera {
                    name: rig.camera.name,
                    pixel_mm: rig.camera.pixel_mm,
                    sample_square_mm: rig.camera.sample_square_mm,
                    center_px: rig.camera.center_px,
                    size_px: rig.camera.size_px,
                },
                white: rig.white,
                text: rig.text,
            });
        }
        let path = camera.ok_or_else(|| Error::new("--rig or --camera is needed"))?;
        let what = || format!("camera file {}", path.display());
        let text = files::read_text(path)?;
        let file: CameraFile = toml::from_str(&text)
            .context(what)
            .map_err(|e| e.with_hint("`goniofit session import --help` shows a camera file"))?;
        let positive = |name: &str, value: f64| {
            if value > 0.0 && value.is_finite() {
                return Ok(());
            }
            Err(Error::new(format!(
                "{}: {name} is {value}, expected more than 0",
                what()
            )))
        };
        if let Some(light) = &file.light {
            positive("light.size_mm", light.size_mm[0].min(light.size_mm[1]))?;
            positive("light.distance_mm", light.distance_mm)?;
        }
        Ok(Self {
            name: file.name,
            camera: file.camera,
            white: file.white,
            text,
        })
    }
}
