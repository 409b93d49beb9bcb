//! The flat field's map: OpenEXR beside the JSON file.

use super::files::AGAIN;
use super::{FlatField, Value};
use crate::base::{Context, Error, Result};
use crate::session::files;
use exr::prelude::{AnyChannel, AnyChannels, FlatSamples, Image, WritableImage};
use std::path::Path;

const CHANNELS: [&str; 2] = ["response", "response_se"];

impl Value for FlatField {
    fn write_beside(&mut self, folder: &Path, stem: &str, size_px: [usize; 2]) -> Result<()> {
        self.file = format!("{stem}.exr");
        self.write_map(folder, size_px)
    }
}

impl FlatField {
    /// Reads the map from the folder of the calibration file, for frames of this visible size.
    ///
    /// # Errors
    /// It is missing, changed, or of another size.
    pub(super) fn read_map(&mut self, folder: &Path, size_px: [usize; 2]) -> Result<()> {
        let path = folder.join(&self.file);
        let what = || format!("flat field {} cannot be read", path.display());
        let bytes = std::fs::read(&path)
            .context(what)
            .map_err(|e| e.with_hint(AGAIN))?;
        if files::sha256(&bytes) != self.sha256 {
            return Err(Error::new(format!(
                "flat field {} is not the one its calibration was written with",
                path.display()
            ))
            .with_hint("restore it from a copy, or calibrate the flat field again"));
        }
        let image = exr::prelude::read_all_flat_layers_from_file(&path).context(what)?;
        let layer = image.layer_data.first();
        let map = |name: &str| -> Result<Vec<f32>> {
            let channel = layer
                .and_then(|l| l.channel_data.list.iter().find(|c| c.name == *name))
                .ok_or_else(|| Error::new(format!("{}: no channel '{name}'", path.display())))?;
            Ok(channel.sample_data.values_as_f32().collect())
        };
        [self.response, self.response_se] = [map(CHANNELS[0])?, map(CHANNELS[1])?];
        let pixels = size_px[0] * size_px[1];
        for values in [&self.response, &self.response_se] {
            if values.len() != pixels && values.len() != 3 * pixels {
                return Err(Error::new(format!(
                    "flat field {} has {} values for frames of {} x {} pixels",
                    path.display(),
                    values.len(),
                    size_px[0],
                    size_px[1]
                ))
                .with_hint(AGAIN));
            }
            if !values.iter().all(|v| (0.0..1e3).contains(v)) {
                return Err(Error::new(format!(
                    "flat field {} holds values that are negative or not finite",
                    path.display()
                ))
                .with_hint(AGAIN));
            }
        }
        Ok(())
    }

    /// Writes the map as `self.file` into a folder and fills in its hash. Frames with three values per pixel make a map
    /// three times as wide.
    ///
    /// # Errors
    /// The map is not of this size, or the disk refuses.
    pub fn write_map(&mut self, folder: &Path, size_px: [usize; 2]) -> Result<()> {
        let path = folder.join(&self.file);
        let width = self.response.len() / size_px[1].max(1);
        if width * size_px[1] != self.response.len()
            || self.response_se.len() != self.response.len()
        {
            return Err(Error::new(format!(
                "a flat field of {} values for frames of {} x {} pixels",
                self.response.len(),
                size_px[0],
                size_px[1]
            )));
        }
        let channel =
            |name: &str, values: &[f32]| AnyChannel::new(name, FlatSamples::F32(values.to_vec()));
        let channels = AnyChannels::sort(
            [
                channel(CHANNELS[0], &self.response),
                channel(CHANNELS[1], &self.response_se),
            ]
            .into_iter()
            .collect(),
        );
        let mut bytes = std::io::Cursor::new(Vec::new());
        Image::from_channels((width, size_px[1]), channels)
            .write()
            .to_buffered(&mut bytes)
            .context(|| format!("flat field {} cannot be written", path.display()))?;
        let bytes = bytes.into_inner();
        self.sha256 = files::sha256(&bytes);
        files::write_atomic(&path, &bytes)
    }
}
