//! Disk space and clock.

use super::{Finding, Findings, Level};
use crate::rig::{CameraDescription, RigDescription};
use crate::session::Plan;
use rustix::fs::{Access, access, statvfs};
use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

/// Bytes of a frame whose size nobody knows.
const UNKNOWN_FRAME: u64 = 60_000_000;
/// Free bytes below which one should wonder when nobody knows how many frames there will be.
const LITTLE: u64 = 5_000_000_000;

pub(super) fn look(out: &Path, rig: Option<&RigDescription>, plan: Option<&Plan>) -> Vec<Finding> {
    let mut findings = Findings::new("disk");
    disk(out, rig, plan, &mut findings);
    let mut all = findings.all;
    let mut findings = Findings::new("clock");
    clock(&mut findings);
    all.extend(findings.all);
    all
}

fn disk(out: &Path, rig: Option<&RigDescription>, plan: Option<&Plan>, findings: &mut Findings) {
    if out.join("session.json").exists() {
        findings.add(
            Level::Warn,
            format!("{} already holds a session", out.display()),
            "it can only be resumed; choose another folder for a new one",
        );
    }
    let absolute = std::path::absolute(out).unwrap_or_else(|_| out.to_owned());
    let Some(folder) = absolute.ancestors().find(|f| f.is_dir()) else {
        let what = format!("{} is in no folder that exists", out.display());
        findings.add(Level::Fail, what, "choose another --out");
        return;
    };
    if access(folder, Access::WRITE_OK).is_err() {
        let what = format!("{} cannot be written", folder.display());
        findings.add(Level::Fail, what, "choose another --out");
        return;
    }
    let free = match statvfs(folder) {
        Ok(disk) => disk.f_bavail.saturating_mul(disk.f_frsize),
        Err(error) => {
            let what = format!(
                "the free space of {} is not known: {error}",
                folder.display()
            );
            findings.add(Level::Warn, what, "look with `df -h`");
            return;
        }
    };
    let needed = match (rig, plan) {
        (Some(rig), Some(plan)) => Some(frames(&rig.camera, plan) * frame_bytes(&rig.camera)),
        _ => None,
    };
    let there = format!("{} has {} free", folder.display(), gigabytes(free));
    match needed {
        Some(needed) if free < needed => findings.add(
            Level::Fail,
            format!("{there}, a capture may need {}", gigabytes(needed)),
            "make room, or choose another --out",
        ),
        Some(needed) => findings.ok(format!("{there}, a capture may need {}", gigabytes(needed))),
        None if free < LITTLE => findings.add(
            Level::Warn,
            there,
            "a raw frame takes 20 to 60 MB; give --rig and --plan to know what a capture needs",
        ),
        None => findings.ok(there),
    }
}

fn gigabytes(bytes: u64) -> String {
    format!("{:.1} GB", bytes as f64 / 1e9)
}

/// Frames a capture takes at most: the white and every configuration at all exposures with re-shots, and darks.
fn frames(camera: &CameraDescription, plan: &Plan) -> u64 {
    let exposures = camera.exposures_ms.len() as u64;
    let places = 1 + plan.configurations.len() as u64;
    let each = (exposures + u64::from(camera.reshoots)) * u64::from(camera.repeats);
    places * each + exposures * u64::from(camera.dark_repeats)
}

fn frame_bytes(camera: &CameraDescription) -> u64 {
    camera
        .size_px
        .map_or(UNKNOWN_FRAME, |[w, h]| (w as u64) * (h as u64) * 2)
}

fn clock(findings: &mut Findings) {
    let since = SystemTime::now().duration_since(UNIX_EPOCH);
    // A mean Gregorian year.
    let year = since.map_or(0, |t| 1970 + t.as_secs() / 31_556_952);
    if (2025..2100).contains(&year) {
        findings.ok(format!("the clock says {year}"));
    } else {
        findings.add(
            Level::Fail,
            format!("the clock says {year}: the session's times would be wrong"),
            "set it: sudo timedatectl set-ntp true",
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_capture_is_counted_at_its_most() {
        let rig = RigDescription::read(Path::new("rig_configs/virtual.toml")).unwrap();
        let plan = Plan::read(Path::new("rig_configs/plans/khungurn16.toml")).unwrap();
        // 17 places with 3 exposures and 2 re-shots, 3 exposures of 2 darks.
        assert_eq!(frames(&rig.camera, &plan), 17 * 5 + 6);
        let mut camera = rig.camera;
        camera.size_px = Some([6000, 4000]);
        assert_eq!(frame_bytes(&camera), 48_000_000);
    }

    #[test]
    fn a_disk_that_is_too_small_fails() {
        let mut rig = RigDescription::read(Path::new("rig_configs/virtual.toml")).unwrap();
        let plan = Plan::read(Path::new("rig_configs/plans/khungurn16.toml")).unwrap();
        let level = |rig: &RigDescription, out: &Path| {
            let mut findings = Findings::new("disk");
            disk(out, Some(rig), Some(&plan), &mut findings);
            findings.all[0].level
        };
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("not/there/yet");
        rig.camera.size_px = Some([10, 10]);
        assert_eq!(level(&rig, &out), Level::Ok);
        rig.camera.size_px = Some([100_000, 100_000]);
        rig.camera.repeats = 1000;
        assert_eq!(level(&rig, &out), Level::Fail);
    }
}
