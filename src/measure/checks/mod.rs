//! What a careful eye sees in a configuration's crop: glints, dust, shadows, the sample's edge, blur, strong vignetting.
//!
//! Only reports: nothing is left out of a mean because of what is found here. Every check compares the crop with itself, so
//! that a coarse weave is as good as a plain one; what the cloth's own pattern does at the size of the crop (a stripe, a
//! single motif) cannot be told from a shadow.

mod border;
mod evenness;
mod focus;
mod planes;
mod spots;

use super::Picture;
use super::statistics::Crop;
use crate::session::Configuration;
use planes::Plane;
use serde::Serialize;

/// From where on something is worth telling.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CheckOptions {
    /// Largest over smallest correction that the white fit or the flat field makes within the square; none: not known.
    pub vignetting: Option<f64>,
    /// A correction larger than this is told.
    pub vignetting_limit: f64,
    /// Brightness may vary this much across the square, relative: the lamp is near.
    pub slope_limit: f64,
    /// A step in brightness, or a patch, is told from this relative depth on.
    pub step_limit: f64,
    /// What lies around the square is told when it differs by more than this, relative.
    pub border_limit: f64,
    /// A spot is told when it stands off its surroundings by more than this, relative.
    pub spot_limit: f32,
    /// A third of the square is blunt when its sharpness is below this fraction of the sharpest third's.
    pub blunt_limit: f64,
}

impl Default for CheckOptions {
    fn default() -> Self {
        Self {
            vignetting: None,
            vignetting_limit: 1.25,
            slope_limit: 0.08,
            step_limit: 0.03,
            border_limit: 0.25,
            spot_limit: 0.15,
            blunt_limit: 0.4,
        }
    }
}

/// What was found in one crop.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CropChecks {
    /// Spots far brighter than their surroundings: glints.
    pub bright: Outliers,
    /// Spots far darker than their surroundings: dust, holes.
    pub dark: Outliers,
    /// Brightness across the square at large.
    pub evenness: Evenness,
    /// What lies around the square.
    pub border: Border,
    /// How sharp the cloth is.
    pub focus: Focus,
    /// Largest over smallest correction of the white fit or the flat field within the square; none: not known.
    pub vignetting: Option<f64>,
    /// From where on that is told.
    #[serde(skip)]
    pub vignetting_limit: f64,
}

/// Spots that stand out of the texture.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Outliers {
    /// Spots of touching pixels.
    pub spots: usize,
    /// Pixels in them.
    pub pixels: usize,
    /// What they add to the mean of the square, relative, per channel r, g, b (negative for dark ones).
    pub share: [f64; 3],
    /// The largest, as a box of pixels of the visible area.
    pub largest: Option<Crop>,
}

/// Brightness across the square at large.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Evenness {
    /// Range of the fitted plane over the square, relative to the mean; none when the square is too small to tell.
    pub slope: Option<f64>,
    /// True when that is more than a near lamp does.
    pub steep: bool,
    /// A part that is darker or brighter than the rest.
    pub step: Option<Step>,
}

/// A part of the square that differs from the rest.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Step {
    /// Where it lies in the image: `left`, `top right`, `middle`, ...
    pub part: &'static str,
    /// Box around it, in pixels of the visible area.
    pub region: Crop,
    /// Fraction of the square.
    pub fraction: f64,
    /// How much it differs from the rest, relative; negative: darker.
    pub depth: f64,
}

/// What lies around the square.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Border {
    /// Pixels there are beyond the square on each of its sides, in the order of the picture's corners.
    pub margin_px: [usize; 4],
    /// True when some side has too few to tell.
    pub too_small: bool,
    /// Places where the cloth seems to end.
    pub ends: Vec<BorderEnd>,
}

/// A stretch along the square's outline beyond which it looks different.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct BorderEnd {
    /// Box of pixels of the visible area beyond the outline.
    pub region: Crop,
    /// Its brightness relative to the square next to it, less one.
    pub change: f64,
}

/// How sharp the cloth is, by differences between neighbors of one color along x, noise taken off.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Focus {
    /// Mean square difference of neighbors over that of values some eight times as far apart, whole square; comparable between
    /// poses of one camera angle. None when noise or the square's size forbid to tell.
    pub sharpness: Option<f64>,
    /// Mean square difference of neighbors over the squared mean, in the far (top of the image), middle and near third.
    pub thirds: [Option<f64>; 3],
    /// The third that is much blunter than the sharpest: 0 far, 1 middle, 2 near.
    pub blunt: Option<usize>,
    /// The blunt third as a box of pixels of the visible area.
    pub region: Option<Crop>,
}

/// Looks at one configuration's crop; see [`CropChecks`].
pub fn check_crop(picture: &Picture, options: &CheckOptions) -> CropChecks {
    let mut planes = Plane::of(picture);
    let border = border::border(picture, &planes, options);
    let focus = focus::focus(picture, &planes, options);
    let [bright, dark] = spots::outliers(picture, &mut planes, options);
    CropChecks {
        bright,
        dark,
        evenness: evenness::evenness(picture, &planes, options),
        border,
        focus,
        vignetting: options.vignetting,
        vignetting_limit: options.vignetting_limit,
    }
}

impl CropChecks {
    /// One line for each thing worth telling: `title` (which configuration or frame), what, where, what to do.
    pub fn messages(&self, title: &str) -> Vec<String> {
        let bright = (
            "brighter",
            "a glint or a hot spot; look at the frame, turn or clean the sample",
        );
        let dark = ("darker", "dust or a hole; clean the sample or move it");
        let spots = [(&self.bright, bright), (&self.dark, dark)];
        let spots = spots
            .into_iter()
            .filter_map(|(found, (how, what_to_do))| found.message(how, what_to_do));
        let rest = [
            self.evenness.step.as_ref().map(Step::message),
            self.evenness.steep_message(),
            self.border.message(),
            self.focus.message(),
            self.vignetting_message(),
        ];
        spots
            .chain(rest.into_iter().flatten())
            .map(|line| format!("{title}: {line}"))
            .collect()
    }

    fn vignetting_message(&self) -> Option<String> {
        let ratio = self.vignetting.filter(|v| *v > self.vignetting_limit)?;
        Some(format!(
            "vignetting and unevenness are corrected by a factor that varies by {ratio:.2} within the square; stop the lens \
             down, or move the sample to the middle of the image"
        ))
    }
}

/// Pixels `x..x, y..y` of the visible area.
fn place(region: &Crop) -> String {
    format!(
        "pixels x {}..{}, y {}..{}",
        region.x,
        region.x + region.width,
        region.y,
        region.y + region.height
    )
}

impl Outliers {
    fn message(&self, how: &str, what_to_do: &str) -> Option<String> {
        let largest = self.largest.as_ref()?;
        let share = self
            .share
            .iter()
            .fold(0.0f64, |a, b| if b.abs() > a.abs() { *b } else { a });
        Some(format!(
            "{} {how} than the cloth around, {} pixels in all, {:+.2} % of the mean, the largest at {}; {what_to_do}",
            if self.spots == 1 {
                "a spot".to_owned()
            } else {
                format!("{} spots", self.spots)
            },
            self.pixels,
            100.0 * share,
            place(largest)
        ))
    }
}

impl Step {
    fn message(&self) -> String {
        let (how, what_to_do) = if self.depth < 0.0 {
            (
                "darker",
                "a shadow of the camera or an arm, or the end of the sample",
            )
        } else {
            ("brighter", "a reflection, or another light")
        };
        format!(
            "the {} of the square ({}, {:.0} % of it) is {:.1} % {how} than the rest: {what_to_do}; look at the frame, unless \
             the cloth has a pattern there",
            self.part,
            place(&self.region),
            100.0 * self.fraction,
            100.0 * self.depth.abs()
        )
    }
}

impl Evenness {
    fn steep_message(&self) -> Option<String> {
        let slope = self.slope.filter(|_| self.steep)?;
        Some(format!(
            "brightness varies by {:.1} % across the square, more than a lamp at its distance does; look for a soft shadow, \
             and check the lamp's place and that the sample is flat",
            100.0 * slope
        ))
    }
}

impl Border {
    fn message(&self) -> Option<String> {
        let largest = self
            .ends
            .iter()
            .max_by(|a, b| a.change.abs().total_cmp(&b.change.abs()))?;
        let how = if largest.change < 0.0 {
            "darker"
        } else {
            "brighter"
        };
        Some(format!(
            "beyond the square's outline, at {}, it is {:.0} % {how} than inside ({} stretches of the outline differ): the \
             sample or its mask ends there; center the sample, or measure a smaller square",
            place(&largest.region),
            100.0 * largest.change.abs(),
            self.ends.len()
        ))
    }
}

impl Focus {
    fn message(&self) -> Option<String> {
        let (third, region) = (self.blunt?, self.region.as_ref()?);
        let name = ["far", "middle", "near"][third];
        Some(format!(
            "the {name} third of the square ({}) is much blunter than the sharpest third: stop the lens down, or focus on \
             the middle of the sample",
            place(region)
        ))
    }
}

/// Poses that are much blunter than others at the same polar angle of the camera: one line each. `limit` as
/// [`CheckOptions::blunt_limit`]. Angles within a degree are taken as the same; at least three poses are compared.
pub fn blunt_poses(poses: &[(Configuration, Option<f64>)], limit: f64) -> Vec<String> {
    let told: Vec<(&Configuration, f64)> =
        poses.iter().filter_map(|(c, s)| Some((c, (*s)?))).collect();
    let mut messages = Vec::new();
    for (configuration, sharpness) in &told {
        let theta = configuration.camera.theta;
        let near = |c: &Configuration| (c.camera.theta - theta).abs() < 1f64.to_radians();
        let mut alike: Vec<f64> = told
            .iter()
            .filter(|(c, _)| near(c))
            .map(|(_, s)| *s)
            .collect();
        alike.sort_by(f64::total_cmp);
        let usual = alike[alike.len() / 2];
        if alike.len() >= 3 && *sharpness < limit * usual {
            messages.push(format!(
                "configuration {}: blunter than the other poses with the camera at {:.0} degrees (sharpness {sharpness:.3}, \
                 usually {usual:.3}); look at its frames for a focus that moved, or vibration",
                configuration.id,
                theta.to_degrees()
            ));
        }
    }
    messages
}
