//! Linear pictures with named channels, as OpenEXR.

use crate::base::{Context, Error, Result};
use exr::meta::attribute::AttributeValue;
use exr::prelude::{AnyChannel, AnyChannels, FlatSamples, Image, Text, WritableImage};

/// One channel: its name, and `width * height` values row by row.
pub type Channel = (&'static str, Vec<f32>);

/// The bytes of an OpenEXR file with these channels (32-bit floats) and text attributes (name and value).
///
/// # Errors
/// There is no channel, a channel has another number of values, or an attribute cannot be written.
pub fn exr(
    [width, height]: [usize; 2],
    channels: &[Channel],
    attributes: &[(&str, String)],
) -> Result<Vec<u8>> {
    for (name, values) in channels {
        if values.len() != width * height || values.is_empty() {
            return Err(Error::new(format!(
                "channel {name}: {} values for a picture of {width} x {height} pixels",
                values.len()
            )));
        }
    }
    if channels.is_empty() {
        return Err(Error::new("a picture without channels"));
    }
    let list = channels
        .iter()
        .map(|(name, values)| AnyChannel::new(*name, FlatSamples::F32(values.clone())))
        .collect();
    let mut image = Image::from_channels((width, height), AnyChannels::sort(list));
    for (name, value) in attributes {
        let text = |t: &str| {
            Text::new_or_none(t)
                .ok_or_else(|| Error::new(format!("attribute {name} cannot be written: {t}")))
        };
        image
            .attributes
            .other
            .insert(text(name)?, AttributeValue::Text(text(value)?));
    }
    let mut bytes = std::io::Cursor::new(Vec::new());
    image
        .write()
        .to_buffered(&mut bytes)
        .context(|| "the picture cannot be encoded")?;
    Ok(bytes.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn channels_and_attributes_survive() {
        let channels = [
            ("R", vec![0.5, 1.0, 1e-4, 7.0, 0.0, 2.0]),
            ("noise.R", vec![0.25; 6]),
        ];
        let unit = [("unit", "1".to_owned())];
        let bytes = exr([3, 2], &channels, &unit).unwrap();
        use ::exr::prelude::*;
        let read = read()
            .no_deep_data()
            .largest_resolution_level()
            .all_channels()
            .all_layers()
            .all_attributes()
            .from_buffered(std::io::Cursor::new(bytes))
            .unwrap();
        let list = &read.layer_data[0].channel_data.list;
        for (name, values) in &channels {
            let found = list.iter().find(|c| c.name == **name).unwrap();
            assert_eq!(
                &found.sample_data.values_as_f32().collect::<Vec<_>>(),
                values
            );
        }
        let attribute = read.layer_data[0]
            .attributes
            .other
            .get(&Text::from("unit"))
            .unwrap();
        assert_eq!(attribute, &AttributeValue::Text(Text::from("1")));
        assert!(exr([3, 3], &channels, &unit).is_err());
        assert!(exr([3, 2], &[], &unit).is_err());
        assert!(exr([3, 2], &channels, &[("a", "\u{4e2d}".to_owned())]).is_err());
    }
}
