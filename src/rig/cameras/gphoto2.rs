//! Tethered cameras through the `gphoto2` program: exposure set and read back, one RAW file per shot.
//!
//! One process at a time, one owner: each shot is one run that sets the shutter speed, releases, downloads, and reads the
//! shutter speed back. A busy camera is tried again, a lost one looked for again (its port has another name then), a
//! bounded number of times. Does not set anything else: aperture, sensitivity, RAW and mode M are the operator's, and
//! checked where the camera tells. Does not correct nominal shutter speeds (`30` may be 32 s).

use super::gphoto2_text::{
    Found, Setting, complaint, named_settings, parse_found, parse_setting_names, parse_settings,
    parse_speed, remedy,
};
use super::raw::{RawFiles, raw_files};
use super::retry::{Fault, Remedy, persist};
use super::subprocess::{Answer, Ending, Scratch, run};
use super::{CameraWiring, facts_of};
use crate::base::{Context, Error, Result};
use crate::rig::{Camera, CapturedFrame, RigDescription, Shot};
use crate::session::CameraFacts;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

/// How far the nearest shutter speed may be off what is asked for.
const NEAR: f64 = 0.15;
/// The longest a question may take, seconds: some cameras list hundreds of settings.
const ASKING: f64 = 60.0;
/// The longest a shot may take besides two exposures (the camera may take a dark frame of its own), seconds.
const SHOOTING: f64 = 60.0;
/// Settings that are looked at, if the camera has them.
const LOOKED_AT: [&str; 11] = [
    "eosserialnumber",
    "serialnumber",
    "capturetarget",
    "shutterspeed2",
    "shutterspeed",
    "imageformat",
    "imagequality",
    "expprogram",
    "autoexposuremode",
    "iso",
    "autoiso",
];

/// A connected camera.
#[derive(Debug)]
struct Attached {
    found: Found,
    serial: String,
    /// Name of the setting that is the shutter speed.
    speed_key: &'static str,
    /// Times that can be set: the camera's word for it and seconds.
    speeds: Vec<(String, f64)>,
    /// Where it stores pictures, in its own words, if it tells.
    target: String,
}

/// A camera driven by the `gphoto2` program.
pub struct Gphoto2Camera<'a> {
    program: PathBuf,
    port: Option<String>,
    facts: CameraFacts,
    wiring: CameraWiring<'a>,
    scratch: Scratch,
    /// None while the connection is lost.
    attached: Option<Attached>,
    /// What it was when it was first found; another camera is never taken for it.
    identity: Option<(String, String)>,
}

impl<'a> Gphoto2Camera<'a> {
    /// Finds the camera and checks that it can take every exposure of the rig's list as RAW. `port` is needed when
    /// there are several cameras; `program` is the path of `gphoto2`, or its name to look for.
    ///
    /// # Errors
    /// There is no such program, no camera or several, or it is not set up for measuring.
    pub fn open(
        program: impl Into<PathBuf>,
        port: Option<&str>,
        rig: &RigDescription,
        wiring: CameraWiring<'a>,
    ) -> Result<Self> {
        let mut camera = Self {
            program: program.into(),
            port: port.map(str::to_owned),
            facts: facts_of(rig, "gphoto2")?,
            wiring,
            scratch: Scratch::new()?,
            attached: None,
            identity: None,
        };
        let wiring = camera.wiring.clone();
        persist(&wiring, "the camera does not answer", || {
            camera.attach().map(drop)
        })?;
        for &exposure_ms in &rig.camera.exposures_ms {
            camera
                .nearest(exposure_ms)
                .context(|| "camera.exposures_ms")?;
        }
        Ok(camera)
    }

    /// The connected camera, looked for when there is none.
    fn attach(&mut self) -> Result<&Attached, Fault> {
        if self.attached.is_none() {
            let found = self.find()?;
            let attached = self.identify(found)?;
            let identity = (attached.found.model.clone(), attached.serial.clone());
            match &self.identity {
                Some(known) if *known != identity => {
                    return Err(Fault::new(
                        Remedy::GiveUp,
                        format!(
                            "another camera answers: {} with serial number '{}', it was {} with '{}'",
                            identity.0, identity.1, known.0, known.1
                        ),
                        "a session is taken with one camera; connect the first one again",
                    ));
                }
                Some(_) => {}
                None => self.identity = Some(identity),
            }
            self.attached = Some(attached);
        }
        self.attached.as_ref().ok_or_else(|| {
            Fault::new(
                Remedy::Reconnect,
                "the camera is not connected",
                "check its cable",
            )
        })
    }

    /// The one camera there is, or the one at the port that was asked for. After a reconnect the port has changed, so
    /// then model and serial number decide.
    fn find(&mut self) -> Result<Found, Fault> {
        let answer = self.ask(&["--auto-detect"], ASKING)?;
        let found = parse_found(&answer.stdout);
        let known = self.identity.as_ref().map(|(model, _)| model);
        let mut fitting: Vec<&Found> = match (known, &self.port) {
            (Some(model), _) => found.iter().filter(|f| f.model == *model).collect(),
            (None, Some(port)) => found.iter().filter(|f| f.port == *port).collect(),
            (None, None) => found.iter().collect(),
        };
        if let (2.., Some(port)) = (fitting.len(), &self.port)
            && fitting.iter().any(|f| f.port == *port)
        {
            fitting.retain(|f| f.port == *port);
        }
        let list: Vec<String> = found
            .iter()
            .map(|f| format!("{} at {}", f.model, f.port))
            .collect();
        let list = list.join(", ");
        match (fitting.as_slice(), &self.port) {
            ([one], _) => Ok((*one).clone()),
            ([], Some(port)) if known.is_none() && !found.is_empty() => Err(Fault::new(
                Remedy::GiveUp,
                format!("no camera at port {port}; there is {list}"),
                "port names change when a camera is plugged in; `gphoto2 --auto-detect` lists them",
            )),
            ([], _) => Err(Fault::new(
                Remedy::Reconnect,
                "gphoto2 finds no camera",
                "switch it on, connect it by USB, and set its USB mode to PTP or PC remote",
            )),
            _ => Err(Fault::new(
                Remedy::GiveUp,
                format!("gphoto2 finds several cameras: {list}"),
                "name the port, e.g. --camera gphoto2:usb:001,006",
            )),
        }
    }

    /// Reads who the camera is, what it can do, and checks what a measurement needs.
    fn identify(&mut self, found: Found) -> Result<Attached, Fault> {
        let port = ["--port", &found.port];
        let listed = self.ask(&[port[0], port[1], "--list-config"], ASKING)?;
        let names = parse_setting_names(&listed.stdout);
        let asked: Vec<&str> = LOOKED_AT
            .into_iter()
            .filter(|n| names.contains(n))
            .collect();
        let mut settings = BTreeMap::new();
        if !asked.is_empty() {
            let questions = asked.iter().flat_map(|n| ["--get-config", n]);
            let arguments: Vec<&str> = port.into_iter().chain(questions).collect();
            let answer = self.ask(&arguments, ASKING)?;
            settings = named_settings(&asked, &answer.stdout).ok_or_else(|| unclear(&answer))?;
        }
        check_settings(&settings)?;
        let speed_key = ["shutterspeed2", "shutterspeed"]
            .into_iter()
            .find(|k| settings.contains_key(*k))
            .ok_or_else(|| {
                Fault::new(
                    Remedy::GiveUp,
                    format!("{} has no shutter speed that can be set", found.model),
                    "set the camera to mode M; if that does not help, use --camera folder:PATH",
                )
            })?;
        let speed = &settings[speed_key];
        let offered = speed.choices.iter();
        let speeds: Vec<(String, f64)> = offered
            .filter_map(|c| Some((c.clone(), parse_speed(c)?)))
            .collect();
        if speed.readonly || speeds.is_empty() {
            return Err(Fault::new(
                Remedy::GiveUp,
                format!(
                    "the shutter speed of {} cannot be set, it is '{}'",
                    found.model, speed.current
                ),
                "set the camera to mode M",
            ));
        }
        let text = |keys: &[&str]| {
            let mut present = keys.iter().filter_map(|k| settings.get(*k));
            present.next().map(|s| s.current.clone())
        };
        let serial = text(&["eosserialnumber", "serialnumber"]).unwrap_or_default();
        let target = text(&["capturetarget"]).unwrap_or_default();
        Ok(Attached {
            found,
            serial,
            speed_key,
            speeds,
            target,
        })
    }

    /// The offered shutter speed nearest to an exposure, in the camera's words, and its seconds.
    fn nearest(&self, exposure_ms: f64) -> Result<(String, f64)> {
        let none = || Error::new("the camera is not connected");
        let attached = self.attached.as_ref().ok_or_else(none)?;
        let off = |seconds: f64| (seconds * 1000.0 / exposure_ms - 1.0).abs();
        let nearest = attached
            .speeds
            .iter()
            .min_by(|a, b| off(a.1).total_cmp(&off(b.1)))
            .filter(|s| off(s.1) <= NEAR);
        nearest.cloned().ok_or_else(|| {
            let words: Vec<&str> = attached.speeds.iter().map(|s| s.0.as_str()).collect();
            Error::new(format!(
                "{} has no shutter speed within {:.0} % of {exposure_ms} ms",
                attached.found.model,
                100.0 * NEAR
            ))
            .with_hint(format!("it offers {}", words.join(" ")))
        })
    }

    fn shoot(&mut self, exposure_ms: f64) -> Result<CapturedFrame, Fault> {
        self.attach()?;
        let (word, seconds) = self.nearest(exposure_ms)?;
        let folder = self.scratch.emptied("shot")?;
        let attached = self.attach()?;
        let (port, key) = (attached.found.port.clone(), attached.speed_key);
        let set = format!("{key}={word}");
        let answer = self.run_in(
            &folder,
            &[
                "--port",
                &port,
                "--force-overwrite",
                "--filename",
                "shot.%C",
                // By value: a plain --set-config takes `25` for the 25th choice.
                "--set-config-value",
                &set,
                "--capture-image-and-download",
                "--get-config",
                key,
            ],
            2.0 * seconds + SHOOTING,
        )?;
        let frame = self.take_file(&folder, &answer)?;
        let settings = parse_settings(&answer.stdout);
        let read_back = settings.last().ok_or_else(|| unclear(&answer))?;
        let actual = parse_speed(&read_back.current);
        match actual {
            // The camera's own words are compared, so that only a setting that was not taken differs.
            Some(actual) if (actual / seconds - 1.0).abs() < 0.01 => Ok(CapturedFrame {
                bytes: frame.0,
                extension: frame.1,
                exposure_ms: 1000.0 * actual,
            }),
            _ => Err(Fault::new(
                Remedy::Again,
                format!(
                    "the shutter speed was set to '{word}' and reads back '{}'",
                    read_back.current
                ),
                "set the camera to mode M and leave its dials alone",
            )),
        }
    }

    /// The one RAW file of a shot: bytes and extension.
    fn take_file(&self, folder: &Path, answer: &Answer) -> Result<(Vec<u8>, String), Fault> {
        let RawFiles { raw, others } = raw_files(folder)?;
        let name = match (raw.as_slice(), others.as_slice()) {
            ([one], _) => one,
            ([], []) => {
                let target = self.attached.as_ref().map_or("", |a| a.target.as_str());
                let what = match target {
                    "" => "the camera gave no file".to_owned(),
                    _ => format!("the camera (capturetarget '{target}') gave no file"),
                };
                return Err(failure(&what, answer));
            }
            ([], [other, ..]) => {
                return Err(Fault::new(
                    Remedy::GiveUp,
                    format!(
                        "the camera gave no RAW file but {}",
                        other.extension().unwrap_or_default().to_string_lossy()
                    ),
                    "set the camera to RAW: `gphoto2 --get-config imageformat` (or imagequality) lists what it offers",
                ));
            }
            (several, _) => {
                return Err(Fault::new(
                    Remedy::GiveUp,
                    format!("the camera gave {} RAW files for one shot", several.len()),
                    "switch off bursts, bracketing and the second card slot",
                ));
            }
        };
        let bytes = std::fs::read(name).context(|| format!("{} cannot be read", name.display()))?;
        let whole = if bytes.is_empty() {
            Err(Error::new("it is empty"))
        } else {
            (self.wiring.whole)(&bytes)
        };
        whole.map_err(|error| Fault {
            remedy: Remedy::Again,
            error: Error::new(format!(
                "the camera's file of {} bytes is not whole",
                bytes.len()
            ))
            .with_source(error),
        })?;
        let extension = name.extension().unwrap_or_default().to_string_lossy();
        Ok((bytes, extension.to_lowercase()))
    }

    /// Runs the program for its answer; anything but success is a fault.
    fn ask(&mut self, arguments: &[&str], limit: f64) -> Result<Answer, Fault> {
        let folder = self.scratch.path().to_owned();
        let answer = self.run_in(&folder, arguments, limit)?;
        match answer.ending {
            Ending::Success => Ok(answer),
            _ => Err(failure("gphoto2 failed", &answer)),
        }
    }

    /// Runs the program; it may have failed, but neither hung nor was it stopped.
    fn run_in(&mut self, folder: &Path, arguments: &[&str], limit: f64) -> Result<Answer, Fault> {
        let mut command = Command::new(&self.program);
        command
            .args(arguments)
            .current_dir(folder)
            .env("LANG", "C")
            .env("LC_ALL", "C")
            .env_remove("LANGUAGE");
        let (clock, watch) = (self.wiring.clock.as_ref(), self.wiring.watch);
        let answer = run(&mut command, limit, &self.scratch, clock, watch).map_err(|e| {
            Error::new(format!("{} cannot be run", self.program.display()))
                .with_hint("install it: `apt-get install gphoto2`")
                .with_source(e)
        })?;
        match answer.ending {
            Ending::Success | Ending::Failure => Ok(answer),
            Ending::TimedOut => Err(Fault::new(
                Remedy::Reconnect,
                format!("gphoto2 did not end within {limit:.0} s and was stopped"),
                "switch the camera off and on; `gphoto2 --reset` may help, too",
            )),
            Ending::Stopped => Err(Error::new("stopped by the operator").into()),
        }
    }
}

impl Camera for Gphoto2Camera<'_> {
    fn facts(&self) -> CameraFacts {
        self.facts.clone()
    }

    fn serial(&self) -> String {
        let identity = self.identity.as_ref();
        identity.map_or_else(String::new, |(_, serial)| serial.clone())
    }

    fn expose(&mut self, shot: &Shot) -> Result<CapturedFrame> {
        let wiring = self.wiring.clone();
        persist(&wiring, "the camera took no picture", || {
            let frame = self.shoot(shot.exposure_ms);
            if matches!(&frame, Err(fault) if fault.remedy == Remedy::Reconnect) {
                self.attached = None;
            }
            frame
        })
    }
}

/// What must not be left to the camera: the exposure mode, the sensitivity, the file format.
fn check_settings(settings: &BTreeMap<String, Setting>) -> Result<(), Fault> {
    let refuse = |key: &str, expected: &str, hint: &str| {
        let current = settings.get(key).map_or("", |s| s.current.as_str());
        Err(Fault::new(
            Remedy::GiveUp,
            format!("the camera's {key} is '{current}', expected {expected}"),
            hint,
        ))
    };
    let is = |key: &str, wrong: &dyn Fn(&str) -> bool| {
        settings
            .get(key)
            .is_some_and(|s| wrong(&s.current.to_lowercase()))
    };
    for key in ["expprogram", "autoexposuremode"] {
        if is(key, &|v| !matches!(v, "m" | "manual" | "")) {
            return refuse(key, "manual", "set the camera to mode M");
        }
    }
    if is("iso", &|v| v.contains("auto")) {
        return refuse(
            "iso",
            "a number",
            "choose a fixed sensitivity, the lowest one",
        );
    }
    if is("autoiso", &|v| matches!(v, "on" | "1")) {
        return refuse("autoiso", "off", "switch automatic sensitivity off");
    }
    for key in ["imageformat", "imagequality"] {
        let jpeg_only = |v: &str| v.contains("jpeg") && !v.contains("raw") && !v.contains("nef");
        if is(key, &jpeg_only) {
            return refuse(
                key,
                "RAW",
                "set the camera to RAW; `gphoto2 --get-config` with that name lists what it offers",
            );
        }
    }
    Ok(())
}

/// A failure in the program's own words, with what is known about it.
fn failure(what: &str, answer: &Answer) -> Fault {
    let said = complaint(&answer.stderr);
    let (remedy, hint) = remedy(&said);
    let said = if said.is_empty() {
        "gphoto2 said nothing"
    } else {
        &said
    };
    Fault::new(remedy, format!("{what}: {said}"), hint)
}

/// An answer that is not what was asked for.
fn unclear(answer: &Answer) -> Fault {
    if !complaint(&answer.stderr).is_empty() {
        return failure("gphoto2 failed", answer);
    }
    let start: String = answer.stdout.chars().take(80).collect();
    Fault::new(
        Remedy::Again,
        format!("gphoto2 did not name the settings asked for but said {start:?}"),
        "is it the gphoto2 of gphoto.org, version 2.5 or later? `gphoto2 --version` tells",
    )
}
