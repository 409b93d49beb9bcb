//! Promise: linear TIFF, PNG, FITS and DNG frames, with filters or without, come back value for value; what is not linear,
//! torn or damaged is refused with what to do, and never panics.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

mod frame_files;

use frame_files::{Card, Entry, fits, png, set_tag, tiff_with};
use goniofit::math::Random;
use goniofit::measure::{Crop, decode, frame_statistics};
use goniofit::session::{BitDepth, CfaPattern, DngImage, Layout, TiffImage, write_dng, write_tiff};

const SIZE: [usize; 2] = [23, 14];

fn values(per_pixel: usize) -> Vec<u16> {
    let count = SIZE[0] * SIZE[1] * per_pixel;
    (0..count).map(|i| (i * 37 % 40_001) as u16).collect()
}

fn tiff(layout: Layout, data: &[u16]) -> Vec<u8> {
    write_tiff(&TiffImage {
        width: SIZE[0],
        height: SIZE[1],
        layout,
        data,
        white: 40_000,
        make: "goniofit",
        model: "mono",
        exposure_ms: Some(12.5),
        iso: Some(100),
    })
    .unwrap()
}

fn dng16(cfa: CfaPattern, data: &[u16]) -> Vec<u8> {
    write_dng(&DngImage {
        width: SIZE[0],
        height: SIZE[1],
        data,
        bits: BitDepth::Sixteen,
        cfa,
        black: [100.0, 101.25, 102.5, 103.0],
        white: 40_000,
        make: "goniofit",
        model: "virtual camera",
        exposure_ms: Some(12.5),
        iso: Some(100),
        date_time: None,
    })
    .unwrap()
}

fn message(bytes: &[u8]) -> String {
    decode(bytes).unwrap_err().report()
}

fn refused(bytes: &[u8], parts: &[&str]) {
    let text = message(bytes);
    for part in parts.iter().chain(&["hint:"]) {
        assert!(text.contains(part), "'{part}' is not in: {text}");
    }
}

#[test]
fn a_tiff_frame_comes_back_with_its_levels_and_exposure() {
    for layout in [Layout::Mono, Layout::Rgb] {
        let data = values(layout.values_per_pixel());
        let frame = decode(&tiff(layout, &data)).unwrap();
        assert_eq!((frame.width, frame.height), (SIZE[0], SIZE[1]));
        assert_eq!((frame.layout, frame.margins), (layout, [0; 4]));
        assert_eq!((frame.black, frame.white), ([0.0; 4], 40_000));
        assert_eq!((frame.exposure_ms, frame.iso), (Some(12.5), Some(100)));
        assert_eq!(
            (frame.make.as_str(), frame.model.as_str()),
            ("goniofit", "mono")
        );
        assert!(frame.data == data);
    }
}

#[test]
fn other_programs_tiff_files_are_read_packed_in_strips_and_big_endian() {
    for (layout, samples) in [(Layout::Mono, 1), (Layout::Rgb, 3)] {
        let data = values(samples);
        for compression in frame_files::COMPRESSIONS {
            let bytes = frame_files::encoded_tiff(SIZE, &data, samples, compression);
            let frame = decode(&bytes).unwrap();
            assert_eq!((frame.layout, frame.white), (layout, u16::MAX));
            assert!(frame.data == data);
        }
        let frame = decode(&frame_files::big_endian_tiff(SIZE, &data, samples as u16)).unwrap();
        assert!(frame.layout == layout && frame.data == data);
    }
}

#[test]
fn tiff_files_that_are_not_linear_raw_values_are_refused() {
    let good = tiff(Layout::Mono, &values(1));
    let with = |tag: u16, value: u16| set_tag(&good, tag, value);
    assert!(decode(&with(281, 30_000)).unwrap().white == 30_000);
    refused(&with(258, 8), &["8 bits per value, expected 16"]);
    refused(&with(258, 32), &["32 bits per value, expected 16"]);
    refused(&with(339, 3), &["floating point"]);
    refused(&with(339, 2), &["signed"]);
    refused(&with(262, 0), &["white is zero"]);
    refused(&with(262, 3), &["palette"]);
    refused(&with(277, 2), &["transparency (alpha)"]);
    refused(&with(259, 7), &["cannot be read"]);
    refused(&with(281, 0), &["white level 0"]);
    let rgb = tiff(Layout::Rgb, &values(3));
    refused(&set_tag(&rgb, 284, 2), &["separate planes"]);
    refused(&set_tag(&rgb, 277, 4), &["transparency (alpha)"]);
    let data = values(1);
    let extra = |entry: Entry| tiff_with(SIZE, &data, entry);
    assert!(decode(&extra(Entry::short(274, 1))).unwrap().data == data);
    refused(
        &extra(Entry::short(301, 7)),
        &["transfer function", "not linear"],
    );
    let profile = [0; 140];
    refused(
        &extra(Entry::bytes(34675, &profile)),
        &["color profile", "not"],
    );
    assert!(decode(&extra(Entry::bytes(34675, &frame_files::linear_profile()))).is_ok());
    refused(
        &extra(Entry::srgb_exif()),
        &["sRGB-encoded values are not linear"],
    );
    assert_eq!(
        decode(&extra(Entry::short(50714, 64))).unwrap().black,
        [64.0, 0.0, 0.0, 0.0]
    );
    refused(
        &frame_files::encoded_tiff_pages(SIZE, &data),
        &["a TIFF file of 2 images"],
    );
}

#[test]
fn a_png_frame_comes_back_and_one_that_is_not_linear_is_refused() {
    for (layout, samples) in [(Layout::Mono, 1), (Layout::Rgb, 3)] {
        let data = values(samples);
        let frame = decode(&png(SIZE, &data, samples, |_| {})).unwrap();
        assert_eq!((frame.layout, frame.white), (layout, u16::MAX));
        assert_eq!((frame.exposure_ms, frame.iso), (None, None));
        assert!(frame.data == data);
    }
    let data = values(1);
    let gray = |set: fn(&mut png::Info<'_>)| png(SIZE, &data, 1, set);
    let gamma = |g: f32| Some(png::ScaledFloat::new(g));
    let linear = png(SIZE, &data, 1, |info| info.source_gamma = gamma(1.0));
    assert!(decode(&linear).unwrap().data == data);
    let encoded = png(SIZE, &data, 1, |info| info.source_gamma = gamma(1.0 / 2.2));
    refused(&encoded, &["gamma 0.45", "not linear"]);
    let srgb = png(SIZE, &data, 1, |info| {
        info.srgb = Some(png::SrgbRenderingIntent::Perceptual);
    });
    refused(&srgb, &["sRGB-encoded values are not linear"]);
    refused(
        &gray(|info| info.icc_profile = Some(vec![0; 200].into())),
        &["color profile"],
    );
    assert!(
        decode(&gray(
            |info| info.icc_profile = Some(frame_files::linear_profile().into())
        ))
        .is_ok()
    );
    for (kind, text) in [
        (png::ColorType::GrayscaleAlpha, "transparency"),
        (png::ColorType::Rgba, "transparency"),
        (png::ColorType::Grayscale, "8 bits per value"),
        (png::ColorType::Rgb, "8 bits per value"),
    ] {
        refused(&frame_files::png8(kind), &[text]);
    }
}

#[test]
fn a_fits_frame_comes_back_right_side_up_with_its_mosaic() {
    let data = values(1);
    let at = |x: usize, y: usize| data[y * SIZE[0] + x];
    let plain = decode(&fits(
        SIZE,
        1,
        &data,
        &[("EXPTIME", "0.25"), ("GAIN", "120.0")],
    ))
    .unwrap();
    assert_eq!((plain.layout, plain.white), (Layout::Mono, u16::MAX));
    assert_eq!((plain.exposure_ms, plain.iso), (Some(250.0), Some(120)));
    assert!(plain.data == data);
    for cfa in CfaPattern::ALL {
        let quoted = format!("'{cfa}    '           / Bayer color pattern");
        for (right, down) in [("0", "0"), ("1", "0"), ("0", "1"), ("-1", "3")] {
            for order in ["'TOP-DOWN'", "'BOTTOM-UP'"] {
                let cards: &[Card<'_>] = &[
                    ("EXPOSURE", "1.5D-2"),
                    ("BAYERPAT", &quoted),
                    ("XBAYROFF", right),
                    ("YBAYROFF", down),
                    ("ROWORDER", order),
                    ("SATURATE", "39000"),
                ];
                let frame = decode(&fits(SIZE, 1, &data, cards)).unwrap();
                assert_eq!((frame.exposure_ms, frame.white), (Some(15.0), 39_000));
                let [dx, dy] = [right, down].map(|o| o.parse::<i64>().unwrap().rem_euclid(2));
                let stored = cfa.shifted(dy as usize, dx as usize);
                // Every value keeps the color it was stored with.
                for y in 0..SIZE[1] {
                    let row = if order.contains("UP") {
                        SIZE[1] - 1 - y
                    } else {
                        y
                    };
                    for x in 0..SIZE[0] {
                        assert_eq!(frame.data[y * SIZE[0] + x], at(x, row));
                        let seen = frame.layout.cfa().unwrap().channel(y, x);
                        assert_eq!(seen, stored.channel(row, x));
                    }
                }
            }
        }
    }
    let planes: Vec<u16> = (0..3)
        .flat_map(|c| data.iter().map(move |v| v / 3 + 13_000 * c))
        .collect();
    let rgb = decode(&fits(SIZE, 3, &planes, &[])).unwrap();
    assert_eq!(rgb.layout, Layout::Rgb);
    for (i, value) in rgb.data.iter().enumerate() {
        assert_eq!(*value, planes[(i % 3) * data.len() + i / 3]);
    }
}

#[test]
fn fits_files_of_other_kinds_are_refused() {
    let data = values(1);
    let with = |cards: &[Card<'_>]| fits(SIZE, 1, &data, cards);
    for (bits, text) in [
        ("8", "BITPIX 8"),
        ("32", "BITPIX 32"),
        ("-32", "BITPIX -32"),
    ] {
        refused(&with(&[("BITPIX", bits)]), &[text]);
    }
    refused(&with(&[("NAXIS", "0")]), &["0 axes", "fpack"]);
    refused(&with(&[("BZERO", "100")]), &["BZERO 100"]);
    refused(&with(&[("BSCALE", "2")]), &["BSCALE 2"]);
    refused(&with(&[("BZERO", "0")]), &["negative or blank"]);
    refused(
        &with(&[("BAYERPAT", "'RGBG'")]),
        &["color filter array 'RGBG'"],
    );
    refused(
        &with(&[("BAYERPAT", "'RGGB'"), ("XBINNING", "2")]),
        &["mosaic with XBINNING"],
    );
    let text = message(&with(&[("ROWORDER", "'SIDEWAYS'")]));
    assert!(text.contains("'SIDEWAYS'"), "{text}");
    let text = message(&with(&[("EXPTIME", "'soon'")]));
    assert!(
        text.contains("keyword EXPTIME") && text.contains("'soon'"),
        "{text}"
    );
    refused(
        &fits([SIZE[0], SIZE[1] / 2], 2, &data, &[]),
        &["2 planes", "one frame"],
    );
}

#[test]
fn dng_frames_without_filters_and_with_three_values_come_back() {
    let data = values(1);
    let mosaic = dng16(CfaPattern::Gbrg, &data);
    let frame = decode(&mosaic).unwrap();
    assert_eq!(frame.layout, Layout::Bayer(CfaPattern::Gbrg));
    assert_eq!(
        (frame.black, frame.white),
        ([100.0, 101.25, 102.5, 103.0], 40_000)
    );
    assert_eq!(
        (frame.exposure_ms, frame.make.as_str()),
        (Some(12.5), "goniofit")
    );
    assert!(frame.data == data);
    // LinearRaw of one sample: the mean of the four black levels.
    let linear = decode(&set_tag(&mosaic, 262, 34892)).unwrap();
    assert_eq!(
        (linear.layout, linear.black),
        (Layout::Mono, [101.6875, 0.0, 0.0, 0.0])
    );
    assert!(linear.data == data);
    // A mosaic that names no filters: the tag of the pattern renamed to one nobody knows.
    let nameless = frame_files::rename_tag(&mosaic, 33422, 33420);
    assert_eq!(decode(&nameless).unwrap().layout, Layout::Mono);
    // Three samples: a third of the columns.
    let rgb = set_tag(&set_tag(&mosaic, 262, 34892), 277, 3);
    let rgb = frame_files::rename_tag(&set_tag(&rgb, 256, 7), 50829, 50830);
    let rgb = frame_files::rename_tag(&rgb, 50714, 50712 + 90);
    let frame = decode(&rgb).unwrap();
    assert_eq!((frame.layout, frame.width), (Layout::Rgb, 7));
    assert!(frame.data == data[..7 * 3 * SIZE[1]]);
    // An active area is cut out, in all layouts.
    for bytes in [&mosaic, &set_tag(&mosaic, 262, 34892)] {
        let cut = frame_files::set_longs(bytes, 50829, &[2, 3, 12, 20]);
        let frame = decode(&cut).unwrap();
        assert_eq!(
            (frame.width, frame.height, frame.margins),
            (17, 10, [2, 3, 2, 3])
        );
        assert_eq!(frame.data[17 * 4 + 5], data[(2 + 4) * SIZE[0] + 3 + 5]);
    }
}

#[test]
fn statistics_name_the_channels_of_every_layout() {
    let crop = Crop {
        x: 3,
        y: 5,
        width: 7,
        height: 6,
    };
    for (layout, names) in [
        (Layout::Mono, vec!["Y"]),
        (Layout::Rgb, vec!["R", "G", "B"]),
    ] {
        let samples = layout.values_per_pixel();
        let data = values(samples);
        let frame = decode(&tiff(layout, &data)).unwrap();
        let statistics = frame_statistics(&frame, crop).unwrap();
        let found: Vec<_> = statistics.channels.iter().map(|c| c.channel).collect();
        assert_eq!(found, names);
        for (c, channel) in statistics.channels.iter().enumerate() {
            let wanted: Vec<f64> = (5..11)
                .flat_map(|y| (3..10).map(move |x| (y * SIZE[0] + x) * samples + c))
                .map(|i| f64::from(data[i]))
                .collect();
            let mean = wanted.iter().sum::<f64>() / 42.0;
            assert_eq!(channel.pixels, 42);
            assert!((channel.mean - mean).abs() < 1e-9);
        }
    }
}

/// Fields are looked for at the start of a file first: behind a large image they must be found too.
#[test]
fn exif_behind_a_large_image_is_found() {
    let size = [512, 400];
    let data: Vec<u16> = (0..size[0] * size[1]).map(|i| i as u16).collect();
    let bytes = tiff_with(size, &data, Entry::srgb_exif());
    assert!(bytes.len() > 400_000);
    refused(
        &bytes,
        &["sRGB-encoded values are not linear (so says EXIF)"],
    );
}

/// One file of each kind that is read, with the values it holds.
fn files() -> Vec<(&'static str, Vec<u8>, Vec<u16>)> {
    let (one, three) = (values(1), values(3));
    let cards: &[Card<'_>] = &[("EXPTIME", "0.25"), ("BAYERPAT", "'RGGB'")];
    vec![
        ("TIFF", tiff(Layout::Mono, &one), one.clone()),
        ("RGB TIFF", tiff(Layout::Rgb, &three), three.clone()),
        (
            "packed TIFF",
            frame_files::encoded_tiff(SIZE, &one, 1, frame_files::COMPRESSIONS[2]),
            one.clone(),
        ),
        ("PNG", png(SIZE, &one, 1, |_| {}), one.clone()),
        ("FITS", fits(SIZE, 1, &one, cards), one.clone()),
        ("DNG", dng16(CfaPattern::Rggb, &one), one.clone()),
        (
            "LinearRaw DNG",
            set_tag(&dng16(CfaPattern::Rggb, &one), 262, 34892),
            one,
        ),
    ]
}

#[test]
fn torn_files_are_refused_or_whole() {
    for (kind, bytes, data) in files() {
        for cut in (0..bytes.len()).step_by(7).chain([bytes.len() - 1]) {
            match decode(&bytes[..cut]) {
                // What is missing was no part of the image: padding, directories behind it.
                Ok(frame) => assert!(frame.data == data, "{kind} cut at {cut}"),
                Err(e) => assert!(
                    !e.report().contains("panic"),
                    "{kind} cut at {cut}: {}",
                    e.report()
                ),
            }
        }
    }
    // As large as files are: at every kilobyte.
    let big: Vec<u16> = (0..512 * 512).map(|i| (i * 31 % 65_521) as u16).collect();
    for bytes in [
        fits([512, 512], 1, &big, &[]),
        png([512, 512], &big, 1, |_| {}),
        frame_files::encoded_tiff([512, 512], &big, 1, frame_files::COMPRESSIONS[0]),
        frame_files::encoded_tiff([512, 512], &big, 1, frame_files::COMPRESSIONS[2]),
    ] {
        for cut in (0..bytes.len()).step_by(1024) {
            if let Ok(frame) = decode(&bytes[..cut]) {
                assert!(frame.data == big, "cut at {cut} of {}", bytes.len());
            }
        }
    }
}

/// Bytes changed, doubled, taken out: never a panic (the decoder of camera RAW files catches its own), never another
/// number of values than the size says.
#[test]
fn damaged_files_never_panic() {
    let seed = std::env::var("SEED").map_or(7, |s| s.parse().unwrap());
    for (number, (kind, good, _)) in files().into_iter().enumerate() {
        for round in 0..1500 {
            let mut random = Random::keyed(&[seed, number as u64, round]);
            let mut bytes = good.clone();
            let mut below = |n: usize| (random.bits() % n as u64) as usize;
            // The header is where damage does most; the image's own bytes are plain values.
            let head = if below(4) > 0 {
                bytes.len().min(1200)
            } else {
                bytes.len()
            };
            for _ in 0..=below(4) {
                let at = below(head.min(bytes.len()));
                match below(6) {
                    0 => bytes[at] = 0,
                    1 => bytes[at] = 255,
                    2 => bytes[at] ^= 1 << below(8),
                    3 => bytes[at] = below(256) as u8,
                    4 => drop(bytes.remove(at)),
                    _ => bytes.insert(at, below(256) as u8),
                }
            }
            if let Ok(frame) = decode(&bytes) {
                let values = frame.width * frame.height * frame.layout.values_per_pixel();
                assert_eq!(frame.data.len(), values, "{kind}, round {round}");
            }
        }
    }
}

/// Every 16-bit field of the first directory at its extremes.
#[test]
fn every_field_of_a_directory_may_be_wrong() {
    for (kind, good, _) in files() {
        if !good.starts_with(b"II") {
            continue;
        }
        let start = u32::from_le_bytes([good[4], good[5], good[6], good[7]]) as usize;
        for at in (start..(start + 400).min(good.len() - 4)).step_by(2) {
            for value in [0_u32, 1, 0xff, 0x7fff, 0xffff, 0x7fff_ffff, 0xffff_ffff] {
                for width in [2, 4] {
                    let mut bytes = good.clone();
                    bytes[at..at + width].copy_from_slice(&value.to_le_bytes()[..width]);
                    if let Ok(frame) = decode(&bytes) {
                        let values = frame.width * frame.height * frame.layout.values_per_pixel();
                        assert_eq!(frame.data.len(), values, "{kind}, {at}");
                    }
                }
            }
        }
    }
}

/// Where the time of a frame goes.
#[test]
#[ignore = "slow: 20 s; prints times"]
fn decoding_times() {
    let ms = |work: &mut dyn FnMut()| {
        let best = (0..7).map(|_| {
            let start = std::time::Instant::now();
            work();
            1e3 * start.elapsed().as_secs_f64()
        });
        best.fold(f64::INFINITY, f64::min)
    };
    let (width, height) = (4752, 3168);
    let data: Vec<u16> = (0..width * height)
        .map(|i| (i * 31 % 16_381) as u16)
        .collect();
    let dng = |bits: BitDepth, data: &[u16]| {
        write_dng(&DngImage {
            width,
            height,
            data,
            bits,
            cfa: CfaPattern::Rggb,
            black: [512.0; 4],
            white: if bits == BitDepth::Twelve {
                4095
            } else {
                16_383
            },
            make: "goniofit",
            model: "times",
            exposure_ms: Some(10.0),
            iso: None,
            date_time: None,
        })
        .unwrap()
    };
    let dim: Vec<u16> = data.iter().map(|v| v / 4).collect();
    let size = [width, height];
    let mut files = vec![
        ("16-bit DNG".to_owned(), dng(BitDepth::Sixteen, &data)),
        ("12-bit DNG".to_owned(), dng(BitDepth::Twelve, &dim)),
        (
            "TIFF".to_owned(),
            frame_files::encoded_tiff(size, &data, 1, frame_files::COMPRESSIONS[0]),
        ),
        ("PNG".to_owned(), png(size, &data, 1, |_| {})),
        ("FITS".to_owned(), fits(size, 1, &data, &[])),
    ];
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/raw");
    for entry in std::fs::read_dir(folder).into_iter().flatten() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|e| e == "CRW" || e == "crw") {
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            files.push((name, std::fs::read(&path).unwrap()));
        }
    }
    for (name, bytes) in files {
        let decoding = ms(&mut || drop(decode(&bytes).unwrap()));
        let hash = ms(&mut || drop(goniofit::session::sha256(&bytes)));
        let library = ms(&mut || drop(rawloader::decode(&mut &bytes[..])));
        let fields = ms(&mut || {
            let mut cursor = std::io::Cursor::new(&bytes);
            drop(exif::Reader::new().read_from_container(&mut cursor));
        });
        println!(
            "{name}: {:.1} MB; decode {decoding:.1} ms; alone: SHA-256 {hash:.1}, rawloader {library:.1}, EXIF {fields:.1}",
            bytes.len() as f64 / 1e6
        );
    }
}
