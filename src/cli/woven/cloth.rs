//! Which cloth a command is about: a published fabric, a weave by name, or a WIF file.

use crate::base::{Context, Error, Result};
use crate::fabric::Draft;
use crate::scatter::surface::woven::{Placed, Preset, Repeat, Shape, preset};
use std::path::PathBuf;

#[derive(clap::Args)]
pub(super) struct Cloth {
    /// A published fabric (see `goniofit woven list`)
    #[arg(long, conflicts_with_all = ["weave", "wif"])]
    fabric: Option<String>,
    /// A weave: plain, 2/1 twill, 5-end satin, ...
    #[arg(long, conflicts_with = "wif")]
    weave: Option<String>,
    /// A draft of a weaving program
    #[arg(long, value_name = "DRAFT.wif")]
    wif: Option<PathBuf>,
    /// Distance of warp and of weft yarns, millimeters; for --weave and --wif
    #[arg(long, value_name = "WARP,WEFT", value_parser = pitches, default_value = "0.4,0.4")]
    pitch_mm: [f64; 2],
    /// Filament smoothing, 0 to 1: 0 for staple, 0.5 for filament yarns; for --weave and --wif
    #[arg(long, default_value_t = 0.0)]
    smoothing: f64,
}

fn pitches(text: &str) -> Result<[f64; 2], String> {
    let numbers: Vec<f64> = text
        .split(',')
        .filter_map(|p| p.trim().parse().ok())
        .collect();
    match numbers[..] {
        [warp, weft] if [warp, weft].iter().all(|p| (1e-3..=100.0).contains(p)) => Ok([warp, weft]),
        _ => Err(format!(
            "'{text}': expected two distances of 0.001 to 100 mm, such as 0.4,0.35"
        )),
    }
}

impl Cloth {
    /// The published fabric, if it is one.
    pub(super) fn published(&self) -> Result<Option<&'static Preset>> {
        self.fabric.as_deref().map(preset).transpose()
    }

    /// The filament smoothing.
    pub(super) fn smoothing(&self) -> Result<f64> {
        Ok(self
            .published()?
            .map_or(self.smoothing, |p| p.shape(0).smoothing))
    }

    /// The visible segments.
    pub(super) fn repeat(&self) -> Result<Repeat> {
        if let Some(preset) = self.published()? {
            return Ok(preset.repeat());
        }
        let draft = match (&self.weave, &self.wif) {
            (Some(name), _) => Draft::named(name)?,
            (_, Some(path)) => {
                let what = || format!("{}", path.display());
                let bytes = std::fs::read(path).context(|| format!("{} cannot be read", what()))?;
                Draft::from_wif(&String::from_utf8_lossy(&bytes)).context(what)?
            }
            _ => {
                return Err(Error::new("no cloth: expected --fabric, --weave or --wif")
                    .with_hint("goniofit woven picture --fabric denim --out denim.png"));
            }
        };
        Ok(segments(&draft, self.pitch_mm))
    }

    /// The shape of a yarn system's segments: that of the published fabric, or the defaults.
    pub(super) fn shape(&self, system: usize) -> Result<Shape> {
        let default = Shape {
            smoothing: self.smoothing,
            ..Shape::default()
        };
        Ok(self.published()?.map_or(default, |p| p.shape(system)))
    }
}

/// The visible segments of a draft: each as wide as the distance of its yarns, and as long as the crossings it covers.
pub(in crate::cli) fn segments(draft: &Draft, [warp, weft]: [f64; 2]) -> Repeat {
    let place = |s: crate::fabric::VisibleSegment| Placed {
        system: s.system,
        center: [s.center[0] * warp, s.center[1] * weft],
        width: if s.system == 0 { warp } else { weft },
        length: s.length as f64 * if s.system == 0 { weft } else { warp },
    };
    Repeat {
        size: [draft.columns() as f64 * warp, draft.rows() as f64 * weft],
        segments: draft.visible_segments().into_iter().map(place).collect(),
    }
}
