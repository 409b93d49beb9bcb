//! The files and the summary of `goniofit render image`.

use super::{TABLE_HEAD, derivative_row, table_row};
use crate::base::Result;
use crate::cli::crops;
use crate::cli::output::data;
use crate::render::{Layer, Picture};
use crate::report::linear_picture::{self, Channel};
use crate::report::{contact_sheet, diverging, preview};
use crate::scatter::{CHANNELS, ParameterInfo, Unit};
use crate::session::Configuration;
use serde_json::{Map, Value, json};
use std::path::{Path, PathBuf};

/// How bright a picture is shown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Exposure {
    /// The brightest hundredth of all pictures is white.
    Common,
    /// The brightest hundredth of each picture is white.
    Each,
    /// Normalized radiance times this.
    Factor(f64),
}

/// A derivative that is pictured.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Derivative {
    /// As asked for, `c_tt` or `c_tt.g`.
    pub(super) name: String,
    pub(super) info: ParameterInfo,
    /// Place among a picture's derivatives.
    pub(super) layer: usize,
    /// Only this channel.
    pub(super) channel: Option<usize>,
}

impl Derivative {
    fn channels(&self) -> Vec<usize> {
        self.channel.map_or((0..CHANNELS).collect(), |c| vec![c])
    }

    fn unit(&self) -> &'static str {
        match self.info.unit {
            Unit::One => "1",
            Unit::Angle => "1/rad",
        }
    }

    fn quantity(&self) -> String {
        let own = if self.info.per_channel {
            ", each channel by its own value"
        } else {
            ""
        };
        format!(
            "derivative of normalized radiance by {}{own}, linear",
            self.info.name
        )
    }

    /// The one number of each pixel that is shown in color: the channel's, or the mean of all.
    fn shown(&self, picture: &Picture) -> Vec<f64> {
        let channels = self.channels();
        let mean = |v: &[f32; CHANNELS]| {
            channels.iter().map(|&c| f64::from(v[c])).sum::<f64>() / channels.len() as f64
        };
        picture.derivatives[self.layer]
            .value
            .iter()
            .map(mean)
            .collect()
    }
}

/// What a file shows.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Content {
    /// The numbers of a picture (by index) or of one of its derivatives.
    Numbers(usize, Option<usize>),
    /// All pictures, or one derivative of each, for the eye.
    Sheet(Option<usize>),
}

/// A file to write.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Output {
    pub(super) path: PathBuf,
    content: Content,
}

impl Output {
    /// All files of these configurations and derivatives whose names begin with `stem`.
    pub(super) fn all(
        stem: &Path,
        configurations: &[Configuration],
        derivatives: &[Derivative],
    ) -> Vec<Self> {
        let file = |middle: String, ending: &str, content| {
            let mut path = stem.as_os_str().to_owned();
            path.push(middle);
            path.push(ending);
            Self {
                path: path.into(),
                content,
            }
        };
        let layers = || std::iter::once(None).chain((0..derivatives.len()).map(Some));
        let of =
            |d: Option<usize>| d.map_or(String::new(), |d| format!(".d_{}", derivatives[d].name));
        let mut all = Vec::new();
        for (i, c) in configurations.iter().enumerate() {
            let which = match configurations.len() {
                1 => String::new(),
                _ => format!(".config_{:02}", c.id),
            };
            all.extend(
                layers().map(|d| file(which.clone() + &of(d), ".exr", Content::Numbers(i, d))),
            );
        }
        all.extend(layers().map(|d| file(of(d), ".png", Content::Sheet(d))));
        all
    }
}

/// Rendered pictures with how they are shown.
pub(super) struct Pictures<'a> {
    configurations: &'a [Configuration],
    pictures: &'a [Picture],
    derivatives: &'a [Derivative],
    /// Per picture.
    exposures: Vec<f64>,
    /// Per derivative: what full color means.
    scales: Vec<f64>,
    attributes: Vec<(&'static str, String)>,
}

impl<'a> Pictures<'a> {
    /// `pictures` in the order of `configurations`; `attributes` go into every file.
    pub(super) fn new(
        configurations: &'a [Configuration],
        pictures: &'a [Picture],
        derivatives: &'a [Derivative],
        exposure: Exposure,
        attributes: Vec<(&'static str, String)>,
    ) -> Self {
        let linear: Vec<Vec<[f64; 3]>> = pictures.iter().map(|p| radiance(p, 1.0)).collect();
        let exposures = match exposure {
            Exposure::Factor(factor) => vec![factor; pictures.len()],
            Exposure::Common => vec![preview::exposure(&linear.concat()); pictures.len()],
            Exposure::Each => linear.iter().map(|p| preview::exposure(p)).collect(),
        };
        let scale = |d: &Derivative| {
            let shown: Vec<Vec<f64>> = pictures.iter().map(|p| d.shown(p)).collect();
            diverging::scale(&shown.concat())
        };
        Self {
            configurations,
            pictures,
            derivatives,
            exposures,
            scales: derivatives.iter().map(scale).collect(),
            attributes,
        }
    }

    /// The bytes of a file.
    pub(super) fn encode(&self, output: &Output) -> Result<Vec<u8>> {
        match output.content {
            Content::Numbers(picture, derivative) => self.exr(picture, derivative),
            Content::Sheet(None) => self.sheet(),
            Content::Sheet(Some(d)) => self.derivative_sheet(d),
        }
    }

    fn exr(&self, index: usize, derivative: Option<usize>) -> Result<Vec<u8>> {
        let picture = &self.pictures[index];
        let mut attributes = crops::attributes(&self.configurations[index]);
        attributes.extend(self.about());
        attributes.push(("paths_per_pixel", picture.paths.to_string()));
        let (layer, channels) = match derivative.map(|d| &self.derivatives[d]) {
            None => (&picture.radiance, (0..CHANNELS).collect()),
            Some(d) => {
                // Of two attributes of one name the later one stays.
                attributes.push(("quantity", d.quantity()));
                attributes.push(("unit", d.unit().to_owned()));
                (&picture.derivatives[d.layer], d.channels())
            }
        };
        linear_picture::exr(picture.resolution, &planes(layer, &channels), &attributes)
    }

    fn sheet(&self) -> Result<Vec<u8>> {
        let shown: Vec<_> = self
            .pictures
            .iter()
            .zip(&self.exposures)
            .map(|(p, &exposure)| radiance(p, exposure))
            .collect();
        let (size, all) = contact_sheet::arrange(self.resolution(), &shown, [1.0; 3])?;
        let mut notes = self.notes();
        let exposures: Vec<String> = self.exposures.iter().map(|e| format!("{e:.6e}")).collect();
        notes.push((
            "quantity",
            "normalized radiance times the exposure, sRGB".to_owned(),
        ));
        notes.push(("exposure", exposures.join(" ")));
        preview::annotated_png(size, &all, &notes)
    }

    fn derivative_sheet(&self, d: usize) -> Result<Vec<u8>> {
        let (derivative, scale) = (&self.derivatives[d], self.scales[d]);
        let shown: Vec<_> = self.pictures.iter().map(|p| derivative.shown(p)).collect();
        let (size, all) = contact_sheet::arrange(self.resolution(), &shown, 0.0)?;
        let mut notes = self.notes();
        notes.push((
            "quantity",
            format!("{}; {}", derivative.quantity(), shown_channels(derivative)),
        ));
        notes.push(("unit", derivative.unit().to_owned()));
        notes.push((
            "scale",
            format!("blue -{scale:.6e}, white 0, red {scale:.6e}"),
        ));
        diverging::png(size, &all, scale, &notes)
    }

    fn resolution(&self) -> [usize; 2] {
        self.pictures[0].resolution
    }

    /// What every file says.
    fn about(&self) -> Vec<(&'static str, String)> {
        let [left, right, low, high] = self.region();
        let mut about = self.attributes.clone();
        about.push((
            "region_mm",
            format!("x {left} to {right}, y {low} to {high}, sample frame"),
        ));
        about.push((
            "program",
            format!("goniofit {} render image", env!("CARGO_PKG_VERSION")),
        ));
        about
    }

    fn notes(&self) -> Vec<(&'static str, String)> {
        let ids: Vec<String> = self
            .configurations
            .iter()
            .map(|c| c.id.to_string())
            .collect();
        let mut notes = self.about();
        notes.push(("config", ids.join(" ")));
        notes
    }

    /// Least and greatest x, least and greatest y, millimeters.
    fn region(&self) -> [f64; 4] {
        let region = &self.pictures[0].region;
        let [x, y] = [0, 1].map(|k| [-0.5, 0.5].map(|s| region.center[k] + s * region.size[k]));
        [x[0], x[1], y[0], y[1]]
    }

    /// The summary for programs.
    pub(super) fn as_json(&self, outputs: &[Output]) -> Value {
        let path = |content: Content| {
            let found = outputs.iter().find(|o| o.content == content);
            found.map(|o| &o.path)
        };
        let configs = self.pictures.iter().enumerate().map(|(i, p)| {
            let (mean, se) = p.radiance.mean();
            let derivatives = self.derivatives.iter().enumerate().map(|(k, d)| {
                let (mean, se) = p.derivatives[d.layer].mean();
                let pick =
                    |v: [f64; CHANNELS]| d.channels().into_iter().map(|c| v[c]).collect::<Vec<_>>();
                let exr = path(Content::Numbers(i, Some(k)));
                (
                    d.name.clone(),
                    json!({"mean": pick(mean), "se": pick(se), "exr": exr}),
                )
            });
            json!({
                "config": p.config,
                "mean": mean,
                "se": se,
                "paths_per_pixel": p.paths,
                "exposure": self.exposures[i],
                "exr": path(Content::Numbers(i, None)),
                "derivatives": derivatives.collect::<Map<_, _>>(),
            })
        });
        let pictured = self.derivatives.iter().enumerate().map(|(k, d)| {
            let picture = json!({
                "png": path(Content::Sheet(Some(k))),
                "scale": self.scales[k],
                "unit": d.unit(),
                "channels": d.channels().into_iter().map(|c| ["r", "g", "b"][c]).collect::<Vec<_>>(),
            });
            (d.name.clone(), picture)
        });
        json!({
            "configs": configs.collect::<Vec<_>>(),
            "size": self.resolution(),
            "region_mm": self.region(),
            "png": path(Content::Sheet(None)),
            "derivatives": pictured.collect::<Map<_, _>>(),
        })
    }

    /// The summary for people.
    pub(super) fn print(&self) {
        data!("{TABLE_HEAD} exposure");
        for (p, exposure) in self.pictures.iter().zip(&self.exposures) {
            let (mean, se) = p.radiance.mean();
            let paths = p.paths * (p.resolution[0] * p.resolution[1]) as u64;
            data!("{} {exposure:8.4}", table_row(p.config, mean, se, paths));
            for d in self.derivatives {
                let (mean, _) = p.derivatives[d.layer].mean();
                let values: Vec<f64> = d.channels().into_iter().map(|c| mean[c]).collect();
                data!("{}", derivative_row(&d.name, &values));
            }
        }
        for (d, scale) in self.derivatives.iter().zip(&self.scales) {
            data!(
                "d/d {}: full red is {scale:.4e}, unit {}, {}",
                d.name,
                d.unit(),
                shown_channels(d)
            );
        }
    }
}

fn shown_channels(d: &Derivative) -> &'static str {
    match d.channel {
        Some(c) => ["red channel", "green channel", "blue channel"][c],
        None => "mean of the channels",
    }
}

/// Linear values times `exposure`.
fn radiance(picture: &Picture, exposure: f64) -> Vec<[f64; CHANNELS]> {
    let exposed = |v: &[f32; CHANNELS]| v.map(|x| f64::from(x) * exposure);
    picture.radiance.value.iter().map(exposed).collect()
}

/// A layer's planes with those of its standard errors.
fn planes(layer: &Layer, channels: &[usize]) -> Vec<Channel> {
    const NAMES: [[&str; 2]; CHANNELS] = [["R", "se.R"], ["G", "se.G"], ["B", "se.B"]];
    let mut planes = Vec::new();
    for &c in channels {
        let plane = |values: &[[f32; CHANNELS]]| values.iter().map(|v| v[c]).collect();
        planes.push((NAMES[c][0], plane(&layer.value)));
        planes.push((NAMES[c][1], plane(&layer.standard_error)));
    }
    planes
}
