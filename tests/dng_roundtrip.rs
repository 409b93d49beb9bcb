//! Promise: a DNG or TIFF file the project writes is read back by an independent decoder and EXIF reader, pixel for pixel.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

use goniofit::math::Random;
use goniofit::session::{BitDepth, CfaPattern, DngImage, Layout, TiffImage, write_dng, write_tiff};

fn random_data(width: usize, height: usize, largest: u16) -> Vec<u16> {
    let mut random = Random::keyed(&[11, width as u64, height as u64, u64::from(largest)]);
    let mut data: Vec<u16> = (0..width * height)
        .map(|_| (random.bits() as u16) & largest)
        .collect();
    data[0] = largest;
    data[width * height - 1] = largest;
    data
}

fn image<'a>(
    width: usize,
    height: usize,
    bits: BitDepth,
    cfa: CfaPattern,
    data: &'a [u16],
) -> DngImage<'a> {
    DngImage {
        width,
        height,
        data,
        bits,
        cfa,
        black: [100.0, 101.0, 102.0, 103.0],
        white: bits.largest(),
        make: "goniofit",
        model: "virtual camera",
        exposure_ms: Some(12.5),
        iso: Some(200),
        date_time: Some("2024:02:29 12:34:56"),
    }
}

/// The visible pixels rawloader returns, and its image.
fn visible(bytes: &[u8]) -> (Vec<u16>, rawloader::RawImage) {
    let raw = rawloader::decode(&mut &bytes[..]).unwrap();
    let rawloader::RawImageData::Integer(data) = &raw.data else {
        panic!("not integer data");
    };
    let [top, right, bottom, left] = raw.crops;
    let rows = data
        .chunks_exact(raw.width)
        .skip(top)
        .take(raw.height - top - bottom);
    let pixels = rows.flat_map(|r| r[left..raw.width - right].to_vec());
    (pixels.collect(), raw)
}

#[test]
fn every_pixel_survives_in_both_sample_sizes_all_phases_and_odd_sizes() {
    for bits in [BitDepth::Twelve, BitDepth::Sixteen] {
        for cfa in CfaPattern::ALL {
            for (width, height) in [(16, 10), (17, 10), (16, 11), (31, 7), (2, 2), (240, 181)] {
                let data = random_data(width, height, bits.largest());
                let bytes = write_dng(&image(width, height, bits, cfa, &data)).unwrap();
                let (pixels, raw) = visible(&bytes);
                assert!(pixels == data, "{bits:?} {cfa} {width} x {height}");
                assert_eq!(raw.cropped_cfa().to_string(), cfa.to_string());
                assert_eq!(
                    raw.blacklevels,
                    [100, 101, 102, 103],
                    "by place in the 2x2 block"
                );
                assert_eq!(raw.whitelevels, [bits.largest(); 4]);
                assert_eq!(
                    (raw.make.as_str(), raw.model.as_str()),
                    ("goniofit", "virtual camera")
                );
                // Negative control: one changed value in the file is seen.
                let mut torn = bytes.clone();
                *torn.last_mut().unwrap() ^= 1;
                assert!(bits == BitDepth::Twelve && width % 2 == 1 || visible(&torn).0 != data);
            }
        }
    }
}

#[test]
fn the_exif_reader_finds_exposure_sensitivity_and_time() {
    let data = random_data(16, 10, 4095);
    let text = |i: &DngImage<'_>, tag| {
        let bytes = write_dng(i).unwrap();
        let exif = exif::Reader::new()
            .read_from_container(&mut std::io::Cursor::new(bytes))
            .unwrap();
        let field = exif.get_field(tag, exif::In::PRIMARY).unwrap();
        match &field.value {
            exif::Value::Rational(v) => format!("{}", v[0].to_f64()),
            other => other.display_as(tag).to_string(),
        }
    };
    let mut i = image(16, 10, BitDepth::Twelve, CfaPattern::Rggb, &data);
    assert_eq!(text(&i, exif::Tag::ExposureTime), "0.0125");
    assert_eq!(text(&i, exif::Tag::PhotographicSensitivity), "200");
    assert_eq!(text(&i, exif::Tag::DateTimeOriginal), "2024-02-29 12:34:56");
    for (ms, seconds) in [(0.125, "0.000125"), (30_000.0, "30"), (5000.25, "5.00025")] {
        i.exposure_ms = Some(ms);
        assert_eq!(text(&i, exif::Tag::ExposureTime), seconds);
    }
}

#[test]
fn the_bytes_are_a_function_of_the_image() {
    let data = random_data(17, 9, 4095);
    let i = image(17, 9, BitDepth::Twelve, CfaPattern::Bggr, &data);
    assert_eq!(write_dng(&i).unwrap(), write_dng(&i).unwrap());
}

#[test]
fn any_reader_gets_the_values_of_a_tiff_frame_back() {
    let data: Vec<u16> = (0..18).map(|i| 3641 * i).collect();
    for (layout, data) in [(Layout::Mono, &data[..6]), (Layout::Rgb, &data[..])] {
        let bytes = write_tiff(&TiffImage {
            width: 3,
            height: 2,
            layout,
            data,
            white: 50_000,
            make: "goniofit",
            model: "virtual camera",
            exposure_ms: Some(12.5),
            iso: Some(100),
        });
        let bytes = bytes.unwrap();
        let format = image::ImageFormat::Tiff;
        let read = image::load_from_memory_with_format(&bytes, format).unwrap();
        assert_eq!((read.width(), read.height()), (3, 2));
        match layout {
            Layout::Rgb => assert_eq!(read.as_rgb16().unwrap().as_raw(), data),
            _ => assert_eq!(read.as_luma16().unwrap().as_raw(), data),
        }
        let exif = exif::Reader::new()
            .read_from_container(&mut std::io::Cursor::new(&bytes))
            .unwrap();
        let exposure = exif.get_field(exif::Tag::ExposureTime, exif::In::PRIMARY);
        let exif::Value::Rational(seconds) = &exposure.unwrap().value else {
            panic!("the exposure is no fraction");
        };
        assert!((seconds[0].to_f64() - 0.0125).abs() < 1e-12);
    }
}
