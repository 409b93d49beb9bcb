//! Looks on while a session is measured: thumbnails and histograms for the page, linear crops as OpenEXR.

use crate::base::{Error, Result};
use crate::measure::{CropRule, Footprint, Picture, RawFrame, Viewer};
use crate::report::linear_picture;
use crate::report::measurement::{Histogram, Look, Looks};
use crate::report::preview;
use crate::session::{CameraFacts, Configuration, Coverage, FrameKind, FrameRecord, Layout, files};
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::sync::Mutex;

/// Widest thumbnail, pixels.
const THUMBNAIL: usize = 320;

/// Bins of a histogram.
const BINS: usize = 64;

/// What to look for.
pub(crate) struct Wanted {
    /// The session's camera, as calibrated.
    pub(crate) camera: CameraFacts,
    /// Where the mean is taken.
    pub(crate) crop: CropRule,
    /// Side of the sample square, millimeters.
    pub(crate) sample_square_mm: f64,
    /// The plan's configurations.
    pub(crate) configurations: Vec<Configuration>,
    /// An exposure is used up to this fraction of the white level.
    pub(crate) usable_fraction: f64,
    /// Keep pictures for the page.
    pub(crate) pictures: bool,
    /// Folder for `config_01.exr`, ...; none: no such files.
    pub(crate) exr_folder: Option<PathBuf>,
    /// Attributes every such file has: name and text.
    pub(crate) attributes: Vec<(&'static str, String)>,
}

/// A small linear picture, 1 = white level or normalized radiance 1.
struct Small {
    size: [usize; 2],
    linear: Vec<[f64; 3]>,
    /// Size in the outline's units.
    full: [f64; 2],
    outline: Vec<[f64; 2]>,
    caption: String,
}

#[derive(Default)]
struct Seen {
    frames: BTreeMap<u32, Small>,
    crops: BTreeMap<u32, Small>,
    histograms: BTreeMap<u32, Histogram>,
}

/// The [`Viewer`] of `goniofit measure session`.
pub(crate) struct Gallery {
    wanted: Wanted,
    /// One frame of each configuration, by file name.
    chosen: BTreeSet<String>,
    seen: Mutex<Seen>,
}

impl Gallery {
    /// Will look at the middle exposure of each configuration among these frames.
    pub(crate) fn new(wanted: Wanted, frames: &[FrameRecord]) -> Self {
        let chosen = if wanted.pictures {
            middle_exposures(frames)
        } else {
            BTreeSet::new()
        };
        Self {
            wanted,
            chosen,
            seen: Mutex::default(),
        }
    }

    fn with_seen<T>(&self, act: impl FnOnce(&mut Seen) -> T) -> Result<T> {
        let mut seen = self
            .seen
            .lock()
            .map_err(|_| Error::new("a thread that made pictures failed"))?;
        Ok(act(&mut seen))
    }

    /// Pictures for the page; `gains` make a white sample gray in frames, whose channels differ in sensitivity.
    pub(crate) fn looks(&self, gains: [f64; 3]) -> Result<Looks> {
        self.with_seen(|seen| -> Result<Looks> {
            let encode = |all: &BTreeMap<u32, Small>, gains| -> Result<BTreeMap<u32, Look>> {
                let looks = all
                    .iter()
                    .map(|(id, small)| Ok((*id, small.encoded(gains)?)));
                looks.collect()
            };
            Ok(Looks {
                frames: encode(&seen.frames, gains)?,
                crops: encode(&seen.crops, [1.0; 3])?,
                histograms: seen.histograms.clone(),
                ..Looks::default()
            })
        })?
    }

    fn footprint(&self, id: u32) -> Result<Option<Footprint>> {
        let wanted = &self.wanted;
        let configuration = wanted.configurations.iter().find(|c| c.id == id);
        let of = |c| Footprint::of(wanted.crop, &wanted.camera, c, wanted.sample_square_mm);
        configuration.map(of).transpose()
    }
}

/// The file of the middle exposure (the shorter of two) of each configuration.
fn middle_exposures(frames: &[FrameRecord]) -> BTreeSet<String> {
    let mut samples: BTreeMap<u32, Vec<&FrameRecord>> = BTreeMap::new();
    for frame in frames.iter().filter(|f| f.kind == FrameKind::Sample) {
        if let Some(id) = frame.config {
            samples.entry(id).or_default().push(frame);
        }
    }
    samples
        .into_values()
        .filter_map(|mut list| {
            list.sort_by(|a, b| a.exposure_ms.total_cmp(&b.exposure_ms));
            list.get((list.len() - 1) / 2).map(|f| f.file.clone())
        })
        .collect()
}

impl Viewer for Gallery {
    fn frame(&self, record: &FrameRecord, frame: &RawFrame) -> Result<()> {
        let Some(id) = record.config.filter(|_| self.chosen.contains(&record.file)) else {
            return Ok(());
        };
        let Some(footprint) = self.footprint(id)? else {
            return Ok(());
        };
        let small = Small {
            full: [frame.width as f64, frame.height as f64],
            outline: footprint.corners.clone(),
            caption: format!("{}, {} ms", record.file, record.exposure_ms),
            ..shrink_frame(frame)
        };
        let histogram = Histogram {
            caption: format!("raw values at {} ms", record.exposure_ms),
            clip: self.wanted.usable_fraction * f64::from(frame.white),
            ..histogram(frame, &footprint.coverage)
        };
        self.with_seen(|seen| {
            seen.frames.insert(id, small);
            seen.histograms.insert(id, histogram);
        })
    }

    fn crop(&self, configuration: &Configuration, picture: &Picture) -> Result<()> {
        let planes = Planes::of(picture)?;
        if let Some(folder) = &self.wanted.exr_folder {
            let mut attributes = attributes(configuration);
            attributes.extend(self.wanted.attributes.iter().cloned());
            let bytes = linear_picture::exr(planes.size, &planes.channels(), &attributes)?;
            let path = folder.join(format!("config_{:02}.exr", configuration.id));
            files::write_atomic(&path, &bytes)?;
        }
        if !self.wanted.pictures {
            return Ok(());
        }
        let [left, top] = picture.origin.map(|o| o as f64);
        let small = Small {
            full: picture.size.map(|s| s as f64),
            outline: picture
                .corners
                .iter()
                .map(|[x, y]| [x - left, y - top])
                .collect(),
            caption: "merged exposures".to_owned(),
            ..planes.shrunk()
        };
        self.with_seen(|seen| {
            seen.crops.insert(configuration.id, small);
        })
    }
}

/// How many pixels are averaged so that a side of `length` fits a thumbnail; even, so that blocks of a mosaic are whole.
fn block(length: usize) -> usize {
    2 * length.div_ceil(2 * THUMBNAIL).max(1)
}

/// Mean of each channel over blocks of pixels, black at 0 and white level at 1.
fn shrink_frame(frame: &RawFrame) -> Small {
    let step = block(frame.width.max(frame.height));
    let size = [(frame.width / step).max(1), (frame.height / step).max(1)];
    let scale = |place: usize, value: u16| {
        let black = frame.black[place];
        (f64::from(value) - black) / (f64::from(frame.white) - black)
    };
    let mean = |column: usize, row: usize, channel: usize| {
        let (mut sum, mut n) = (0.0, 0.0);
        for y in (row * step..(row + 1) * step).take_while(|y| *y < frame.height) {
            for x in (column * step..(column + 1) * step).take_while(|x| *x < frame.width) {
                if let Some(i) = frame.layout.index(frame.width, x, y, channel) {
                    sum += scale(frame.layout.place(frame.width, i), frame.data[i]);
                    n += 1.0;
                }
            }
        }
        if n > 0.0 { sum / n } else { 0.0 }
    };
    let linear = (0..size[1])
        .flat_map(|row| (0..size[0]).map(move |column| (column, row)))
        .map(|(column, row)| [0, 1, 2].map(|channel| mean(column, row, channel)))
        .collect();
    Small {
        size,
        linear,
        full: [0.0; 2],
        outline: Vec::new(),
        caption: String::new(),
    }
}

/// Raw values of the pixels that lie in the crop by more than half.
fn histogram(frame: &RawFrame, coverage: &Coverage) -> Histogram {
    let high = f64::from(frame.white) + 1.0;
    let mut counts = vec![[0_u64; 3]; BINS];
    for (x, y, weight) in coverage.pixels() {
        for channel in 0..3 {
            if let Some(i) = frame.layout.index(frame.width, x, y, channel)
                && weight > 0.5
            {
                let bin = BINS as f64 * f64::from(frame.data[i]) / high;
                counts[(bin as usize).min(BINS - 1)][channel] += 1;
            }
        }
    }
    let black = [0, 1, 2].map(|channel| {
        let places = (0..4).filter_map(|p| frame.layout.index(2, p % 2, p / 2, channel));
        let levels: Vec<f64> = places
            .map(|i| frame.black[frame.layout.place(2, i)])
            .collect();
        levels.iter().sum::<f64>() / levels.len().max(1) as f64
    });
    Histogram {
        range: [0.0, high],
        counts,
        black,
        ..Histogram::default()
    }
}

/// A picture with all channels at every pixel: a mosaic by 2x2 blocks.
struct Planes {
    size: [usize; 2],
    /// Names of the channels: R, G, B, or Y.
    names: &'static [[&'static str; 2]],
    /// Values, by channel; 0 where none is kept.
    values: Vec<Vec<f32>>,
    /// Standard deviations from noise, by channel.
    noise: Vec<Vec<f32>>,
    covered: Vec<f32>,
    /// 1 where every channel has a value, else 0.
    kept: Vec<f32>,
}

impl Planes {
    fn of(picture: &Picture) -> Result<Self> {
        let [width, height] = picture.size;
        let n = width * height;
        let per_pixel = picture.layout.values_per_pixel();
        let numbers = [
            picture.values.len(),
            picture.noise.len(),
            picture.kept.len(),
            picture.covered.len() * per_pixel,
        ];
        if numbers.iter().any(|l| *l != n * per_pixel) {
            return Err(Error::new(format!(
                "a crop of {width} x {height} pixels has {numbers:?} values, noise, flags and weights"
            )));
        }
        let (step, names): (usize, &'static [[&'static str; 2]]) = match picture.layout {
            Layout::Bayer(_) => (2, &RGB),
            Layout::Rgb => (1, &RGB),
            Layout::Mono => (1, &MONO),
        };
        let size = [width / step, height / step];
        if size.contains(&0) {
            return Err(Error::new(format!(
                "a crop of {width} x {height} pixels is too small for a picture"
            )));
        }
        let mut planes = Self {
            size,
            names,
            values: vec![Vec::new(); names.len()],
            noise: vec![Vec::new(); names.len()],
            covered: Vec::new(),
            kept: Vec::new(),
        };
        for row in 0..size[1] {
            for column in 0..size[0] {
                planes.push(picture, [column * step, row * step], step);
            }
        }
        Ok(planes)
    }

    fn push(&mut self, picture: &Picture, [left, top]: [usize; 2], step: usize) {
        let width = picture.size[0];
        let places = || (0..step * step).map(|i| (left + i % step, top + i / step));
        let mut whole = true;
        for channel in 0..self.names.len() {
            let indices = places().filter_map(|(x, y)| picture.layout.index(width, x, y, channel));
            let kept: Vec<usize> = indices.filter(|&i| picture.kept[i]).collect();
            let n = kept.len().max(1) as f32;
            let sum: f32 = kept.iter().map(|&i| picture.values[i]).sum();
            let variance: f32 = kept.iter().map(|&i| picture.noise[i].powi(2)).sum();
            self.values[channel].push(sum / n);
            self.noise[channel].push(variance.sqrt() / n);
            whole &= !kept.is_empty();
        }
        let covered: f32 = places().map(|(x, y)| picture.covered[y * width + x]).sum();
        self.covered.push(covered / (step * step) as f32);
        self.kept.push(if whole { 1.0 } else { 0.0 });
    }

    /// The channels of the file.
    fn channels(&self) -> Vec<linear_picture::Channel> {
        let mut channels = Vec::new();
        for (k, [value, noise]) in self.names.iter().enumerate() {
            channels.push((*value, self.values[k].clone()));
            channels.push((*noise, self.noise[k].clone()));
        }
        channels.push(("covered", self.covered.clone()));
        channels.push(("kept", self.kept.clone()));
        channels
    }

    fn shrunk(&self) -> Small {
        let step = self.size[0].max(self.size[1]).div_ceil(THUMBNAIL).max(1);
        let size = self.size.map(|s| (s / step).max(1));
        let mean = |column: usize, row: usize, channel: usize| {
            let plane = &self.values[channel.min(self.values.len() - 1)];
            let (mut sum, mut n) = (0.0, 0.0);
            for y in (row * step..(row + 1) * step).take_while(|y| *y < self.size[1]) {
                for x in (column * step..(column + 1) * step).take_while(|x| *x < self.size[0]) {
                    let i = y * self.size[0] + x;
                    sum += f64::from(self.kept[i]) * f64::from(plane[i]);
                    n += f64::from(self.kept[i]);
                }
            }
            if n > 0.0 { sum / n } else { 0.0 }
        };
        let linear = (0..size[1])
            .flat_map(|row| (0..size[0]).map(move |column| (column, row)))
            .map(|(column, row)| [0, 1, 2].map(|channel| mean(column, row, channel)))
            .collect();
        Small {
            size,
            linear,
            full: [0.0; 2],
            outline: Vec::new(),
            caption: String::new(),
        }
    }
}

/// What the file of a picture says of the configuration it shows, in normalized radiance.
pub(crate) fn attributes(c: &Configuration) -> Vec<(&'static str, String)> {
    let degrees = |a: f64| format!("{:.6}", a.to_degrees());
    let quantity = "normalized radiance pi L / E_normal, linear";
    vec![
        ("config", c.id.to_string()),
        ("quantity", quantity.to_owned()),
        ("unit", "1".to_owned()),
        ("light_theta_deg", degrees(c.light.theta)),
        ("light_phi_deg", degrees(c.light.phi)),
        ("camera_theta_deg", degrees(c.camera.theta)),
        ("camera_phi_deg", degrees(c.camera.phi)),
        ("rotation_deg", degrees(c.rotation)),
    ]
}

const RGB: [[&str; 2]; 3] = [["R", "noise.R"], ["G", "noise.G"], ["B", "noise.B"]];
const MONO: [[&str; 2]; 1] = [["Y", "noise.Y"]];

impl Small {
    /// A picture for the eye: the brightest hundredth is white.
    fn encoded(&self, gains: [f64; 3]) -> Result<Look> {
        let balanced = self
            .linear
            .iter()
            .map(|p| [0, 1, 2].map(|k| p[k] * gains[k]));
        let balanced: Vec<[f64; 3]> = balanced.collect();
        let scale = preview::exposure(&balanced);
        let shown: Vec<[f64; 3]> = balanced.iter().map(|p| p.map(|v| v * scale)).collect();
        Ok(Look {
            png: preview::png(self.size[0] as u32, self.size[1] as u32, &shown)?,
            size: self.full,
            outline: self.outline.clone(),
            caption: format!("{}, times {scale:.3}", self.caption),
        })
    }
}

#[cfg(test)]
mod tests;
