//! Cameras: one module each, chosen by a text.
//!
//! | text | camera |
//! |---|---|
//! | `gphoto2`, `gphoto2:PORT` | tethered through the `gphoto2` program |
//! | `folder:PATH` | any, whose tethering program stores RAW files in that folder |
//! | `aravis`, `aravis:ID` | GenICam (GigE, USB3 Vision); feature `aravis` |
//! | `uvc`, `uvc:N` | webcam, for preview only; feature `uvc` |
//! | `replay:SESSION` | the frames of a recorded session |

#[cfg(feature = "aravis")]
mod aravis;
mod folder;
#[cfg(any(test, feature = "aravis"))]
mod genicam;
mod gphoto2;
mod gphoto2_text;
mod raw;
mod replay;
mod retry;
mod subprocess;
#[cfg(feature = "uvc")]
mod uvc;

#[cfg(feature = "aravis")]
pub use aravis::AravisCamera;
pub use folder::FolderCamera;
pub use gphoto2::Gphoto2Camera;
pub use replay::ReplayCamera;
#[cfg(feature = "uvc")]
pub use uvc::UvcCamera;

use super::transport::Clock;
use super::{Camera, RigDescription};
use crate::base::{Error, Result, Watch};
use crate::session::CameraFacts;
use std::path::Path;
use std::sync::Arc;

/// What a camera needs of the program around it.
#[derive(Clone)]
pub struct CameraWiring<'a> {
    /// Time.
    pub clock: Arc<dyn Clock>,
    /// Who may ask to stop. A shot under way ends on [`Watch::urgent`] only.
    pub watch: &'a dyn Watch,
    /// Whether the bytes of a RAW file are a whole frame; decoding frames is not the rig's business.
    pub whole: &'a dyn Fn(&[u8]) -> Result<()>,
    /// Tells the operator something.
    pub say: &'a dyn Fn(&str),
}

impl CameraWiring<'_> {
    /// Lets `seconds` pass.
    ///
    /// # Errors
    /// The operator asks to stop now.
    fn pause(&self, seconds: f64) -> Result<()> {
        let until = self.clock.now() + seconds;
        loop {
            if self.watch.urgent() {
                return Err(Error::new("stopped by the operator"));
            }
            let left = until - self.clock.now();
            if left <= 0.0 {
                return Ok(());
            }
            self.clock.sleep(left.min(subprocess::LOOK));
        }
    }
}

/// Opens the camera a text names; see the module's table.
///
/// # Errors
/// The text names none, this program was built without it, or the camera itself is not there or not set up.
pub fn open_camera<'a>(
    text: &str,
    rig: &RigDescription,
    wiring: CameraWiring<'a>,
) -> Result<Box<dyn Camera + 'a>> {
    let (kind, rest) = match text.split_once(':') {
        Some((kind, rest)) => (kind, Some(rest)),
        None => (text, None),
    };
    match (kind, rest) {
        (_, Some("")) => Err(unknown(text)),
        ("gphoto2", port) => Ok(Box::new(Gphoto2Camera::open("gphoto2", port, rig, wiring)?)),
        ("folder", Some(path)) => Ok(Box::new(FolderCamera::open(Path::new(path), rig, wiring)?)),
        ("replay", Some(session)) => Ok(Box::new(ReplayCamera::open(Path::new(session))?)),
        ("aravis", id) => open_aravis(id, rig, wiring),
        ("uvc", None) => open_uvc(0, rig),
        ("uvc", Some(number)) => open_uvc(number.parse().map_err(|_| unknown(text))?, rig),
        _ => Err(unknown(text)),
    }
}

fn unknown(text: &str) -> Error {
    Error::new(format!("unknown camera '{text}'")).with_hint(
        "cameras are gphoto2, gphoto2:PORT, folder:PATH, aravis, aravis:ID, uvc, uvc:N and replay:SESSION; \
         see docs/cameras.md",
    )
}

#[cfg(feature = "aravis")]
fn open_aravis<'a>(
    id: Option<&str>,
    rig: &RigDescription,
    wiring: CameraWiring<'a>,
) -> Result<Box<dyn Camera + 'a>> {
    Ok(Box::new(AravisCamera::open(id, rig, wiring)?))
}

#[cfg(not(feature = "aravis"))]
fn open_aravis<'a>(
    _id: Option<&str>,
    _rig: &RigDescription,
    _wiring: CameraWiring<'a>,
) -> Result<Box<dyn Camera + 'a>> {
    Err(
        Error::new("this program was built without GenICam cameras").with_hint(
            "install libaravis-dev and build with `cargo build --release --features aravis`",
        ),
    )
}

#[cfg(feature = "uvc")]
fn open_uvc<'a>(index: u32, rig: &RigDescription) -> Result<Box<dyn Camera + 'a>> {
    Ok(Box::new(UvcCamera::open(index, rig.camera.pixel_mm)?))
}

#[cfg(not(feature = "uvc"))]
fn open_uvc<'a>(_index: u32, _rig: &RigDescription) -> Result<Box<dyn Camera + 'a>> {
    Err(Error::new("this program was built without UVC cameras")
        .with_hint("install libclang-dev and build with `cargo build --release --features uvc`"))
}

/// The facts of a camera that cannot tell them, from the rig file.
///
/// # Errors
/// The rig file does not say the image's size.
fn facts_of(rig: &RigDescription, kind: &str) -> Result<CameraFacts> {
    let camera = &rig.camera;
    let [width, height] = camera.size_px.ok_or_else(|| {
        Error::new(format!(
            "rig {}: camera.size_px is missing, and a {kind} camera cannot tell it",
            rig.name
        ))
        .with_hint(
            "write the visible size of its RAW images under [camera], e.g. size_px = [6000, 4000]; add center_px \
             where the sample's center is not in the middle",
        )
    })?;
    Ok(CameraFacts {
        name: camera.name.clone(),
        width,
        height,
        pixel_mm: camera.pixel_mm,
        center_px: center_of(rig, width, height),
        lens: Default::default(),
    })
}

/// Where the sample's center is in the image: as the rig file says, else the middle.
fn center_of(rig: &RigDescription, width: usize, height: usize) -> [f64; 2] {
    let middle = [width, height].map(|n| n as f64 / 2.0);
    rig.camera.center_px.unwrap_or(middle)
}
