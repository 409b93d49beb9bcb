//! The rig's solid parts as spheres and capsules, and the clearance they must keep.
//!
//! Every carrier's frame has its origin at the sample center (docs/clearance.md). Nothing here moves or measures.

use super::description::AxisName;
use crate::base::{Context, Error, Result};
use serde::Deserialize;

/// What a body is bolted to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Carrier {
    /// The laboratory: nothing moves it.
    Base,
    /// The turntable, turned about z.
    Turntable,
    /// The camera's azimuth stage, turned about z.
    CameraAzimuth,
    /// The camera's arm: +z of its frame points from the sample to the camera.
    Camera,
    /// The light's azimuth stage, turned about z.
    LightAzimuth,
    /// The light's arm: +z of its frame points from the sample to the light.
    Light,
}

impl Carrier {
    /// The axis that turns it about the vertical.
    pub fn azimuth(self) -> Option<AxisName> {
        match self {
            Self::Base => None,
            Self::Turntable => Some(AxisName::Turntable),
            Self::CameraAzimuth | Self::Camera => Some(AxisName::CameraAzimuth),
            Self::LightAzimuth | Self::Light => Some(AxisName::LightAzimuth),
        }
    }

    /// The axis that tips it away from the sample normal.
    pub fn elevation(self) -> Option<AxisName> {
        match self {
            Self::Camera => Some(AxisName::CameraElevation),
            Self::Light => Some(AxisName::LightElevation),
            _ => None,
        }
    }
}

/// A solid part: all points within `radius_mm` of a straight piece (a capsule) or of a point (a sphere).
#[derive(Debug, Clone, PartialEq)]
pub struct Body {
    /// Unique.
    pub name: String,
    /// What it is bolted to.
    pub on: Carrier,
    /// One end of the piece in the carrier's frame, millimeters.
    pub from_mm: [f64; 3],
    /// Its other end; the same for a sphere.
    pub to_mm: [f64; 3],
    /// Millimeters.
    pub radius_mm: f64,
    /// Bodies of other carriers that may come as near as they like.
    pub may_touch: Vec<String>,
}

/// All bodies, and how near they may come to each other.
#[derive(Debug, Clone, PartialEq)]
pub struct Clearance {
    /// Smallest distance between the surfaces of two bodies on different carriers, millimeters.
    pub margin_mm: f64,
    /// At least one.
    pub bodies: Vec<Body>,
}

/// The table `[clearance]` of a rig file.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ClearanceFile {
    margin_mm: f64,
}

/// One `[[bodies]]` of a rig file.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct BodyFile {
    name: String,
    on: Carrier,
    sphere: Option<SphereFile>,
    capsule: Option<CapsuleFile>,
    #[serde(default)]
    may_touch: Vec<String>,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct SphereFile {
    center_mm: [f64; 3],
    radius_mm: f64,
}

#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct CapsuleFile {
    from_mm: [f64; 3],
    to_mm: [f64; 3],
    radius_mm: f64,
}

/// The longest length in a rig file, millimeters.
const LARGEST_MM: f64 = 1e5;

impl BodyFile {
    fn checked(self) -> Result<Body> {
        let (from_mm, to_mm, radius_mm) = match (self.sphere, self.capsule) {
            (Some(s), None) => (s.center_mm, s.center_mm, s.radius_mm),
            (None, Some(c)) => (c.from_mm, c.to_mm, c.radius_mm),
            _ => {
                return Err(
                    Error::new("expected exactly one of sphere and capsule").with_hint(
                        "sphere = { center_mm, radius_mm } or capsule = { from_mm, to_mm, radius_mm }",
                    ),
                );
            }
        };
        for place in from_mm.iter().chain(&to_mm) {
            if !(-LARGEST_MM..=LARGEST_MM).contains(place) {
                return Err(Error::new(format!(
                    "a coordinate is {place}, expected -{LARGEST_MM} to {LARGEST_MM} mm"
                )));
            }
        }
        positive("radius_mm", radius_mm)?;
        Ok(Body {
            name: self.name,
            on: self.on,
            from_mm,
            to_mm,
            radius_mm,
            may_touch: self.may_touch,
        })
    }
}

fn positive(key: &str, value: f64) -> Result<()> {
    if value > 0.0 && value <= LARGEST_MM {
        return Ok(());
    }
    Err(Error::new(format!(
        "{key} is {value}, expected above 0 and at most {LARGEST_MM}"
    )))
}

/// What `[clearance]` and `[[bodies]]` say together; none when a rig file has neither.
pub(super) fn checked(
    clearance: Option<ClearanceFile>,
    bodies: Vec<BodyFile>,
) -> Result<Option<Clearance>> {
    let Some(ClearanceFile { margin_mm }) = clearance else {
        if bodies.is_empty() {
            return Ok(None);
        }
        return Err(Error::new("bodies without a margin").with_hint(
            "add [clearance] with margin_mm, the smallest distance two bodies may come to",
        ));
    };
    positive("clearance.margin_mm", margin_mm)?;
    if bodies.is_empty() {
        return Err(Error::new("clearance without bodies")
            .with_hint("add [[bodies]], or leave [clearance] out: clearance is then not checked"));
    }
    let mut known: Vec<Body> = Vec::new();
    for file in bodies {
        let name = file.name.clone();
        let body = file.checked().context(|| format!("body '{name}'"))?;
        if name.is_empty() || known.iter().any(|b| b.name == name) {
            return Err(Error::new(format!(
                "body '{name}': names must be unique and not empty"
            )));
        }
        known.push(body);
    }
    for body in &known {
        for other in &body.may_touch {
            if *other == body.name || !known.iter().any(|b| b.name == *other) {
                return Err(Error::new(format!(
                    "body '{}': may_touch names '{other}', expected another body",
                    body.name
                )));
            }
        }
    }
    Ok(Some(Clearance {
        margin_mm,
        bodies: known,
    }))
}
