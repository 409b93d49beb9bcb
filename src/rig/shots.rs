//! A capture as data: every shot with the axis angles it is taken at.

use super::Shot;
use super::description::RigDescription;
use super::kinematics::AxisAngles;
use crate::base::{Context, Result};
use crate::session::{FrameKind, Plan};

/// What the rig file does not say about a capture.
#[derive(Debug, Clone, PartialEq)]
pub struct CaptureOptions {
    /// Exposure bracket, milliseconds, ascending.
    pub exposures_ms: Vec<f64>,
    /// Frames per configuration and exposure.
    pub repeats: u32,
    /// Dark frames per exposure.
    pub dark_repeats: u32,
    /// White frames per exposure; 0 = none.
    pub white_repeats: u32,
    /// Operator's note.
    pub note: String,
    /// True when no camera sees any cloth.
    pub synthetic: bool,
    /// UTC start, RFC 3339; the machine's clock when absent.
    pub started_utc: Option<String>,
}

impl CaptureOptions {
    /// The exposures and repeats of the rig file; as many white frames as sample frames.
    pub fn of(rig: &RigDescription) -> Self {
        Self {
            exposures_ms: rig.camera.exposures_ms.clone(),
            repeats: rig.camera.repeats,
            dark_repeats: rig.camera.dark_repeats,
            white_repeats: rig.camera.repeats,
            note: String::new(),
            synthetic: false,
            started_utc: None,
        }
    }
}

/// One shot with the axis angles it is taken at.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedShot {
    /// What to ask the camera for.
    pub shot: Shot,
    /// Where the axes stand.
    pub angles: AxisAngles,
}

/// The whole capture as data: whites at the reference geometry, the configurations in plan order, then darks.
///
/// # Errors
/// A pose is outside the limits.
pub fn planned_shots(
    rig: &RigDescription,
    plan: &Plan,
    options: &CaptureOptions,
) -> Result<Vec<PlannedShot>> {
    let mut shots = Vec::new();
    let mut add = |kind, config, pose, angles, exposure_ms, repeats| {
        for repeat in 0..repeats {
            shots.push(PlannedShot {
                shot: Shot {
                    kind,
                    config,
                    pose,
                    exposure_ms,
                    repeat,
                    visit: 0,
                },
                angles,
            });
        }
    };
    let reference = rig.white.configuration(white_id(plan));
    let reference_angles = rig
        .angles(&reference)
        .context(|| "white reference geometry")?;
    for &exposure in &options.exposures_ms {
        add(
            FrameKind::White,
            None,
            reference,
            reference_angles,
            exposure,
            options.white_repeats,
        );
    }
    let angles = rig.plan_angles(plan)?;
    for (c, angles) in plan.configurations.iter().zip(&angles) {
        for &exposure in &options.exposures_ms {
            add(
                FrameKind::Sample,
                Some(c.id),
                *c,
                *angles,
                exposure,
                options.repeats,
            );
        }
    }
    if let (Some(c), Some(angles)) = (plan.configurations.last(), angles.last()) {
        for &exposure in &options.exposures_ms {
            add(
                FrameKind::Dark,
                None,
                *c,
                *angles,
                exposure,
                options.dark_repeats,
            );
        }
    }
    Ok(shots)
}

/// An id for the white geometry that the plan does not use.
pub fn white_id(plan: &Plan) -> u32 {
    (0..)
        .find(|id| plan.configuration(*id).is_none())
        .unwrap_or(0)
}
