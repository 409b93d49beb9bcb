//! GenICam cameras (GigE Vision, USB3 Vision) through Aravis; needs the `aravis` feature.
//!
//! Automatic exposure, gain, balance and gamma are switched off, the exposure is set and read back, and one frame per shot
//! is stored as a 16-bit DNG file. A frame that lost packets is taken again. Does not set gain, region, binning or
//! trigger lines: those stay as they are in the camera. Reads neither packed nor 8-bit formats.

use super::genicam::{Format, Frame, to_dng};
use super::retry::{Fault, Remedy, persist};
use super::subprocess::LOOK;
use super::{CameraWiring, center_of};
use crate::base::{Context, Error, Result};
use crate::rig::{Camera, CapturedFrame, RigDescription, Shot};
use crate::session::CameraFacts;
use aravis::prelude::*;
use aravis::{AcquisitionMode, Buffer, BufferStatus, GvStreamOption};

/// How far the exposure read back may be off the one asked for.
const NEAR: f64 = 0.15;
/// The longest a frame may take besides its exposure, seconds.
const READING_OUT: f64 = 10.0;
/// Settings that must not be left to the camera, and what switches them off.
const AUTOMATICS: [(&str, &str); 5] = [
    ("ExposureAuto", "Off"),
    ("GainAuto", "Off"),
    ("BalanceWhiteAuto", "Off"),
    ("BlackLevelAuto", "Off"),
    ("TriggerMode", "Off"),
];

/// A connected camera, set up.
struct Attached {
    camera: aravis::Camera,
    format: Format,
    width: usize,
    height: usize,
    vendor: String,
    model: String,
    serial: String,
}

/// A GenICam camera.
pub struct AravisCamera<'a> {
    id: Option<String>,
    facts: CameraFacts,
    serial: String,
    monochrome: bool,
    wiring: CameraWiring<'a>,
    /// None while the connection is lost.
    attached: Option<Attached>,
}

impl<'a> AravisCamera<'a> {
    /// Connects to the camera with this id (as `arv-tool-0.8` lists it, e.g. `Basler-12345678`), or to the first one, and
    /// checks that it can take every exposure of the rig's list.
    ///
    /// # Errors
    /// There is none, it is in use, or lacks what measuring needs.
    pub fn open(id: Option<&str>, rig: &RigDescription, wiring: CameraWiring<'a>) -> Result<Self> {
        let attached = persist(&wiring, "the camera does not answer", || attach(id))?;
        let bounds = attached.camera.exposure_time_bounds();
        let (shortest, longest) = bounds.context(|| "the camera does not tell its exposures")?;
        for &ms in &rig.camera.exposures_ms {
            if !(shortest..=longest).contains(&(1000.0 * ms)) {
                return Err(Error::new(format!(
                    "camera.exposures_ms: {} {} cannot expose for {ms} ms",
                    attached.vendor, attached.model
                ))
                .with_hint(format!(
                    "it takes {} to {} ms",
                    shortest / 1000.0,
                    longest / 1000.0
                )));
            }
        }
        let facts = CameraFacts {
            name: format!("{} {}", attached.vendor, attached.model),
            width: attached.width,
            height: attached.height,
            pixel_mm: rig.camera.pixel_mm,
            center_px: center_of(rig, attached.width, attached.height),
            lens: Default::default(),
        };
        Ok(Self {
            id: id.map(str::to_owned),
            facts,
            serial: attached.serial.clone(),
            monochrome: attached.format.cfa.is_none(),
            wiring,
            attached: Some(attached),
        })
    }

    fn shoot(&mut self, exposure_ms: f64) -> Result<CapturedFrame, Fault> {
        if self.attached.is_none() {
            let attached = attach(self.id.as_deref())?;
            let size = (attached.width, attached.height);
            if attached.serial != self.serial || size != (self.facts.width, self.facts.height) {
                return Err(Fault::new(
                    Remedy::GiveUp,
                    format!(
                        "another camera answers: serial number '{}', {} x {} pixels",
                        attached.serial, size.0, size.1
                    ),
                    "a session is taken with one camera; connect the first one again",
                ));
            }
            self.attached = Some(attached);
        }
        let Some(attached) = &self.attached else {
            return Err(Error::new("the camera is not connected").into());
        };
        let actual_ms = set_exposure(&attached.camera, exposure_ms)?;
        let buffer = self.acquire(&attached.camera, actual_ms / 1000.0)?;
        let bytes = to_dng(&Frame {
            format: &attached.format,
            width: attached.width,
            height: attached.height,
            bytes: &buffer.image_data(),
            vendor: &attached.vendor,
            model: &attached.model,
            exposure_ms: actual_ms,
        })?;
        Ok(CapturedFrame {
            bytes,
            extension: "dng".to_owned(),
            exposure_ms: actual_ms,
        })
    }

    /// One whole frame whose exposure begins after this call.
    fn acquire(&self, camera: &aravis::Camera, exposure: f64) -> Result<Buffer, Fault> {
        let payload = camera.payload().map_err(lost)?;
        let stream = camera.create_stream().map_err(lost)?;
        stream.push_buffer(Buffer::new_allocate(payload as usize));
        camera
            .set_acquisition_mode(AcquisitionMode::SingleFrame)
            .map_err(lost)?;
        camera.start_acquisition().map_err(lost)?;
        let buffer = self.pop(&stream, exposure + READING_OUT);
        let stopped = camera.stop_acquisition().map_err(lost);
        let buffer = buffer?;
        stopped?;
        match buffer.status() {
            BufferStatus::Success => Ok(buffer),
            status => Err(Fault::new(
                Remedy::Again,
                format!("the camera's frame is not whole: {status:?}"),
                "check the network: a port of its own, jumbo frames (MTU 9000), a larger net.core.rmem_max",
            )),
        }
    }

    fn pop(&self, stream: &aravis::Stream, limit: f64) -> Result<Buffer, Fault> {
        let clock = self.wiring.clock.as_ref();
        let until = clock.now() + limit;
        loop {
            if let Some(buffer) = stream.try_pop_buffer() {
                return Ok(buffer);
            }
            if clock.now() >= until {
                return Err(Fault::new(
                    Remedy::Reconnect,
                    format!("the camera gave no frame within {limit:.1} s"),
                    "check its cable and power, and that no firewall drops UDP from it",
                ));
            }
            self.wiring.pause(LOOK)?;
        }
    }
}

impl Camera for AravisCamera<'_> {
    fn facts(&self) -> CameraFacts {
        self.facts.clone()
    }

    fn serial(&self) -> String {
        self.serial.clone()
    }

    fn warning(&self) -> Option<String> {
        let text = "monochrome camera: red, green and blue are samples of one image";
        self.monochrome.then(|| text.to_owned())
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

/// A failure of the library is mostly a lost connection.
fn lost(error: impl std::fmt::Display) -> Fault {
    Fault::new(
        Remedy::Reconnect,
        format!("the camera does not obey: {error}"),
        "check its cable and power; only one program may control it",
    )
}

/// Finds a camera and sets it up.
fn attach(id: Option<&str>) -> Result<Attached, Fault> {
    let camera = aravis::Camera::new(id).map_err(|error| {
        Fault::new(
            Remedy::Reconnect,
            format!("no GenICam camera {}: {error}", id.unwrap_or("found")),
            "`arv-tool-0.8` lists the cameras there are; a GigE one must be in this computer's subnet",
        )
    })?;
    if camera.is_gv_device() {
        // Raw sockets, which the library prefers where it may, miss what comes over a loopback interface.
        camera.gv_set_stream_options(GvStreamOption::PACKET_SOCKET_DISABLED);
    }
    for (feature, value) in AUTOMATICS {
        if camera.is_feature_available(feature).unwrap_or(false) {
            camera.set_string(feature, value).map_err(lost)?;
        }
    }
    if camera.is_feature_available("GammaEnable").unwrap_or(false) {
        camera.set_boolean("GammaEnable", false).map_err(lost)?;
    }
    let names = camera
        .dup_available_pixel_formats_as_strings()
        .map_err(lost)?;
    let format = Format::best_of(names.iter().map(|n| n.as_str())).ok_or_else(|| {
        Fault::new(
            Remedy::GiveUp,
            format!(
                "the camera has no unpacked pixel format of 10 bits or more, only {}",
                names.join(" ")
            ),
            "8 bits are too few to measure with; take another camera",
        )
    })?;
    camera
        .set_pixel_format_from_string(&format.name)
        .map_err(lost)?;
    let (_, _, width, height) = camera.region().map_err(lost)?;
    let size = |n: i32| usize::try_from(n).map_err(|_| lost(format!("a size of {n} pixels")));
    let text = |value: Result<aravis::glib::GString, aravis::glib::Error>| {
        value.map_or_else(|_| String::new(), |v| v.to_string())
    };
    let serial = match text(camera.device_serial_number()) {
        empty if empty.is_empty() => text(camera.device_id()),
        serial => serial,
    };
    Ok(Attached {
        format,
        width: size(width)?,
        height: size(height)?,
        vendor: text(camera.vendor_name()),
        model: text(camera.model_name()),
        serial,
        camera,
    })
}

/// Sets the exposure and reads it back, milliseconds.
fn set_exposure(camera: &aravis::Camera, exposure_ms: f64) -> Result<f64, Fault> {
    camera
        .set_exposure_time(1000.0 * exposure_ms)
        .map_err(lost)?;
    let actual_ms = camera.exposure_time().map_err(lost)? / 1000.0;
    if (actual_ms / exposure_ms - 1.0).abs() <= NEAR {
        return Ok(actual_ms);
    }
    Err(Fault::new(
        Remedy::GiveUp,
        format!("the exposure was set to {exposure_ms} ms and reads back {actual_ms} ms"),
        "choose camera.exposures_ms within what the camera can do, and a frame rate that allows it",
    ))
}
