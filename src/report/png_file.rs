//! The bytes of a PNG file.

use crate::base::{Context, Result};
use image::RgbImage;

/// Encodes a picture; `notes` (keyword and text) become text chunks, which image viewers show as the file's properties.
pub(super) fn encode(image: &RgbImage, notes: &[(&str, String)]) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    (|| {
        let mut encoder = png::Encoder::new(&mut bytes, image.width(), image.height());
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        for (keyword, text) in notes {
            encoder.add_itxt_chunk((*keyword).to_owned(), text.clone())?;
        }
        let mut writer = encoder.write_header()?;
        writer.write_image_data(image.as_raw())?;
        writer.finish()
    })()
    .context(|| "the picture cannot be encoded")?;
    Ok(bytes)
}
