//! USB video class cameras (webcams, USB microscopes) for preview and alignment.
//!
//! Not radiometric: 8 bits, automatic exposure, an unknown transfer curve; the requested exposure is not applied and
//! cannot be read back. Its frames are pictures (`jpg` as the camera compresses them, or `ppm`), which the measuring half
//! refuses. Needs the `uvc` feature.

use crate::base::{Context, Error, Result};
use crate::rig::{Camera, CapturedFrame, Shot};
use crate::session::CameraFacts;
use nokhwa::pixel_format::RgbFormat;
use nokhwa::utils::{ApiBackend, CameraIndex, FrameFormat, RequestedFormat, RequestedFormatType};

/// A UVC camera with its stream open.
pub struct UvcCamera {
    camera: nokhwa::Camera,
    pixel_mm: f64,
}

impl UvcCamera {
    /// Opens the camera with this number (0 = first) at its highest resolution.
    ///
    /// # Errors
    /// There is none, or it is in use.
    pub fn open(index: u32, pixel_mm: f64) -> Result<Self> {
        let found = nokhwa::query(ApiBackend::Auto)
            .context(|| "the system's list of video cameras cannot be read")?;
        if found.is_empty() {
            return Err(Error::new("no UVC camera found")
                .with_hint("plug one in; you must be in the `video` group to use it"));
        }
        let format =
            RequestedFormat::new::<RgbFormat>(RequestedFormatType::AbsoluteHighestResolution);
        let mut camera = nokhwa::Camera::new(CameraIndex::Index(index), format)
            .context(|| format!("UVC camera {index} cannot be opened"))?;
        camera
            .open_stream()
            .context(|| format!("UVC camera {index} gives no pictures"))?;
        Ok(Self { camera, pixel_mm })
    }
}

impl Camera for UvcCamera {
    fn facts(&self) -> CameraFacts {
        let size = self.camera.resolution();
        CameraFacts {
            name: format!("{} (UVC, not radiometric)", self.camera.info().human_name()),
            width: size.width() as usize,
            height: size.height() as usize,
            pixel_mm: self.pixel_mm,
            center_px: [
                f64::from(size.width()) / 2.0,
                f64::from(size.height()) / 2.0,
            ],
            lens: Default::default(),
        }
    }

    fn warning(&self) -> Option<String> {
        let text = "UVC preview frames: 8 bits, automatic exposure, not radiometric";
        Some(text.to_owned())
    }

    /// Takes the next picture of the stream; `exposure_ms` is the requested one, as nothing better is known.
    fn expose(&mut self, shot: &Shot) -> Result<CapturedFrame> {
        let frame = self
            .camera
            .frame()
            .context(|| "the UVC camera gave no picture")?;
        let (bytes, extension) = if frame.source_frame_format() == FrameFormat::MJPEG {
            (frame.buffer().to_vec(), "jpg")
        } else {
            let picture = frame
                .decode_image::<RgbFormat>()
                .context(|| "the UVC camera's picture cannot be decoded")?;
            let size = frame.resolution();
            let mut bytes = format!("P6\n{} {}\n255\n", size.width(), size.height()).into_bytes();
            bytes.extend(picture.into_raw());
            (bytes, "ppm")
        };
        Ok(CapturedFrame {
            bytes,
            extension: extension.to_owned(),
            exposure_ms: shot.exposure_ms,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_machine_without_a_camera_gets_a_clean_error() {
        if std::path::Path::new("/dev/video0").exists() {
            println!("skipped: this machine has a camera");
            return;
        }
        let error = UvcCamera::open(0, 0.1).map(|_| ()).unwrap_err().report();
        assert!(
            error.contains("hint:") || error.contains("video cameras"),
            "{error}"
        );
    }
}
