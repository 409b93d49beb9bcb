//! A folder into which any tethering program stores RAW files.
//!
//! Waits for one new file per shot and copies it; never moves, changes or deletes anything there. The exposure cannot be
//! set: it is asked for, and taken as asked for unless an XMP sidecar says otherwise (measuring compares it with the
//! file's own EXIF). Does not release the shutter.

use super::gphoto2_text::parse_speed;
use super::raw::raw_files;
use super::subprocess::LOOK;
use super::{CameraWiring, facts_of};
use crate::base::{Context, Error, Result};
use crate::rig::{Camera, CapturedFrame, RigDescription, Shot};
use crate::session::CameraFacts;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// How long a file must not have changed to be taken as complete, seconds.
const STABLE: f64 = 1.0;
/// The longest wait for a file besides two exposures, seconds.
const WAIT: f64 = 300.0;
/// How far a sidecar's exposure may be off the one asked for.
const NEAR: f64 = 0.15;

/// A watched folder.
pub struct FolderCamera<'a> {
    folder: PathBuf,
    facts: CameraFacts,
    wiring: CameraWiring<'a>,
}

/// What a growing file looks like from outside.
#[derive(Debug, Clone, PartialEq)]
struct Look {
    bytes: u64,
    modified: Option<SystemTime>,
}

/// A file on its way, and since when it has looked as it does.
struct Arriving {
    path: PathBuf,
    look: Look,
    since: f64,
    /// Why it was no whole frame when it last looked complete.
    not_whole: Option<Error>,
}

impl<'a> FolderCamera<'a> {
    /// Watches `folder`.
    ///
    /// # Errors
    /// It is no folder, or the rig file does not tell the image's size.
    pub fn open(folder: &Path, rig: &RigDescription, wiring: CameraWiring<'a>) -> Result<Self> {
        if !folder.is_dir() {
            return Err(Error::new(format!("{} is no folder", folder.display()))
                .with_hint("make it, and let the tethering program store its RAW files there"));
        }
        raw_files(folder)?;
        Ok(Self {
            folder: folder.to_owned(),
            facts: facts_of(rig, "folder")?,
            wiring,
        })
    }

    /// The one new RAW file that is not among `old`, as soon as it is whole.
    fn wait_for_file(&self, old: &BTreeSet<PathBuf>, limit: f64) -> Result<(PathBuf, Vec<u8>)> {
        let until = self.wiring.clock.now() + limit;
        let mut arriving: Option<Arriving> = None;
        loop {
            let mut new = raw_files(&self.folder)?.raw;
            new.retain(|p| !old.contains(p));
            match new.as_slice() {
                [] => arriving = None,
                [path] => {
                    if let Some(bytes) = self.look_at(path, &mut arriving)? {
                        return Ok((path.clone(), bytes));
                    }
                }
                several => return Err(self.too_many(several)),
            }
            if self.wiring.clock.now() >= until {
                return Err(self.nothing(old, arriving, limit));
            }
            self.wiring.pause(LOOK)?;
        }
    }

    /// The bytes of a file that has not changed for a while and is whole.
    fn look_at(&self, path: &Path, arriving: &mut Option<Arriving>) -> Result<Option<Vec<u8>>> {
        let now = self.wiring.clock.now();
        // A file that vanishes was a temporary one.
        let Ok(metadata) = std::fs::metadata(path) else {
            *arriving = None;
            return Ok(None);
        };
        let look = Look {
            bytes: metadata.len(),
            modified: metadata.modified().ok(),
        };
        let file = match arriving {
            Some(file) if file.path == path && file.look == look => file,
            _ => {
                *arriving = Some(Arriving {
                    path: path.to_owned(),
                    look,
                    since: now,
                    not_whole: None,
                });
                return Ok(None);
            }
        };
        if now - file.since < STABLE || file.look.bytes == 0 || file.not_whole.is_some() {
            return Ok(None);
        }
        let bytes = std::fs::read(path).context(|| format!("{} cannot be read", path.display()))?;
        match (self.wiring.whole)(&bytes) {
            Ok(()) => Ok(Some(bytes)),
            Err(error) => {
                file.not_whole = Some(error);
                Ok(None)
            }
        }
    }

    fn too_many(&self, new: &[PathBuf]) -> Error {
        let names: Vec<String> = new.iter().map(|p| name_of(p)).collect();
        Error::new(format!(
            "{} new RAW files in {} for one shot: {}",
            new.len(),
            self.folder.display(),
            names.join(", ")
        ))
        .with_hint("take one picture each time it is asked for; switch off bursts and bracketing")
    }

    fn nothing(&self, old: &BTreeSet<PathBuf>, arriving: Option<Arriving>, limit: f64) -> Error {
        let folder = self.folder.display();
        let Some(file) = arriving else {
            return Error::new(format!("no new RAW file in {folder} within {limit:.0} s")).with_hint(format!(
                "{} RAW files were there before; the tethering program must store RAW, not JPEG, each under a new name",
                old.len()
            ));
        };
        let error = Error::new(format!(
            "{} in {folder}, {} bytes, did not become a whole RAW file within {limit:.0} s",
            name_of(&file.path),
            file.look.bytes
        ))
        .with_hint("check the tethering program and the disk it stores on");
        match file.not_whole {
            Some(cause) => error.with_source(cause),
            None => error,
        }
    }
}

/// An exposure time as cameras write it.
fn shutter(exposure_ms: f64) -> String {
    if exposure_ms < 400.0 {
        format!("1/{:.0} s", 1000.0 / exposure_ms)
    } else {
        format!("{} s", exposure_ms / 1000.0)
    }
}

impl Camera for FolderCamera<'_> {
    fn facts(&self) -> CameraFacts {
        self.facts.clone()
    }

    fn expose(&mut self, shot: &Shot) -> Result<CapturedFrame> {
        let old: BTreeSet<PathBuf> = raw_files(&self.folder)?.raw.into_iter().collect();
        (self.wiring.say)(&format!(
            "take one RAW picture of {} at {} ms ({}) now; it is awaited in {}, where the {} files there are ignored",
            shot.kind.name(),
            shot.exposure_ms,
            shutter(shot.exposure_ms),
            self.folder.display(),
            old.len()
        ));
        let limit = WAIT + 2.0 * shot.exposure_ms / 1000.0;
        let (path, bytes) = self.wait_for_file(&old, limit)?;
        let exposure_ms = match sidecar_exposure_ms(&path)? {
            None => shot.exposure_ms,
            Some(told) if (told / shot.exposure_ms - 1.0).abs() <= NEAR => told,
            Some(told) => {
                return Err(Error::new(format!(
                    "{} was exposed for {told} ms by its sidecar, expected {} ms",
                    name_of(&path),
                    shot.exposure_ms
                ))
                .with_hint("set the exposure that is asked for before each picture"));
            }
        };
        let extension = path.extension().unwrap_or_default().to_string_lossy();
        Ok(CapturedFrame {
            bytes,
            extension: extension.to_lowercase(),
            exposure_ms,
        })
    }
}

fn name_of(path: &Path) -> String {
    let name = path.file_name().unwrap_or_default();
    name.to_string_lossy().into_owned()
}

/// The exposure in the XMP sidecar of a RAW file, `NAME.xmp` or `NAME.cr2.xmp`; none when there is none that tells.
fn sidecar_exposure_ms(raw: &Path) -> Result<Option<f64>> {
    let mut full = raw.as_os_str().to_owned();
    full.push(".xmp");
    for path in [raw.with_extension("xmp"), PathBuf::from(full)] {
        if !path.is_file() {
            continue;
        }
        let bytes =
            std::fs::read(&path).context(|| format!("{} cannot be read", path.display()))?;
        if let Some(seconds) = xmp_exposure(&String::from_utf8_lossy(&bytes)) {
            return Ok(Some(1000.0 * seconds));
        }
    }
    Ok(None)
}

/// Seconds of `exif:ExposureTime`, as attribute or element.
fn xmp_exposure(xmp: &str) -> Option<f64> {
    let after = xmp.split_once("exif:ExposureTime")?.1;
    let value = after.trim_start_matches(['=', '"', '\'', '>']);
    let end = value.find(['"', '\'', '<'])?;
    parse_speed(&value[..end])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sidecars_tell_the_exposure_as_attribute_or_element() {
        let near = |xmp: &str, s: f64| xmp_exposure(xmp).is_some_and(|v| (v - s).abs() < 1e-12);
        assert!(near(
            "<rdf exif:ExposureTime=\"1/50\" exif:FNumber=\"8/1\"/>",
            0.02
        ));
        assert!(near("<exif:ExposureTime>13/10</exif:ExposureTime>", 1.3));
        assert_eq!(xmp_exposure("<exif:ExposureTime>"), None);
        assert_eq!(xmp_exposure("<exif:FNumber>8/1</exif:FNumber>"), None);
    }
}
