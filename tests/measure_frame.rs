//! Promise: means of real RAW files agree with an independent decoder to 4 decimals; files that cannot be read are
//! refused with what to do.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

use goniofit::measure::{Crop, decode, decode_file, frame_statistics};
use goniofit::session::{BitDepth, CfaPattern, DngImage, Layout, write_dng};
use std::path::Path;

/// Reference means of three real files (LibRaw), outside the project because of their size.
#[test]
fn real_files_give_the_reference_means() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/raw");
    let Ok(mut reader) = csv::Reader::from_path(folder.join("reference.csv")) else {
        println!("skipped: {} is not there", folder.display());
        return;
    };
    let mut files = 0;
    for row in reader.records() {
        let row = row.unwrap();
        let number = |i: usize| row[i].parse::<f64>().unwrap();
        let frame = decode_file(&folder.join(&row[0])).unwrap();
        assert_eq!(format!("{}x{}", frame.width, frame.height), row[4]);
        let [top, right, bottom, left] = frame.margins;
        assert_eq!((left as f64, top as f64), (number(5), number(6)));
        let full = format!(
            "{}x{}",
            frame.width + left + right,
            frame.height + top + bottom
        );
        assert_eq!(full, row[3]);
        assert_eq!(frame.layout.to_string(), row[9]);
        assert_eq!(
            frame.black, [32.0; 4],
            "the second green has a black level too"
        );
        assert_eq!(f64::from(frame.white), number(8));
        let crop = Crop {
            x: number(10) as usize,
            y: number(11) as usize,
            width: 200,
            height: 200,
        };
        let statistics = frame_statistics(&frame, crop).unwrap();
        // The reference lists red, first green, blue, second green.
        for (channel, column) in [("R", 12), ("G1", 13), ("B", 14), ("G2", 15)] {
            let found = statistics.channels.iter().find(|c| c.channel == channel);
            let mean = found.unwrap().mean;
            assert!(
                (mean - number(column)).abs() < 0.5001e-4,
                "{} {channel}: {mean} against {}",
                &row[0],
                number(column)
            );
        }
        // The reference's extremes are those of the whole visible area.
        let whole = Crop {
            x: 0,
            y: 0,
            width: frame.width,
            height: frame.height,
        };
        let statistics = frame_statistics(&frame, whole).unwrap();
        let min = statistics.channels.iter().map(|c| c.min).min().unwrap();
        let max = statistics.channels.iter().map(|c| c.max).max().unwrap();
        assert_eq!((f64::from(min), f64::from(max)), (number(16), number(17)));
        // Negative control: without the margins, or one pixel off, the means are others.
        let shifted = frame_statistics(
            &frame,
            Crop {
                x: crop.x + 1,
                ..crop
            },
        )
        .unwrap();
        assert!((shifted.channels[0].mean - number(12)).abs() > 1e-3);
        files += 1;
    }
    assert_eq!(files, 3);
}

/// A 12-bit DNG and its values.
fn dng(width: usize, height: usize, cfa: CfaPattern, black: [f64; 4]) -> (Vec<u16>, Vec<u8>) {
    let data: Vec<u16> = (0..width * height)
        .map(|i| (i * 37 % 4001) as u16)
        .collect();
    let bytes = write_dng(&DngImage {
        width,
        height,
        data: &data,
        bits: BitDepth::Twelve,
        cfa,
        black,
        white: 4000,
        make: "goniofit",
        model: "virtual camera",
        exposure_ms: Some(12.5),
        iso: Some(100),
        date_time: Some("2024:02:29 12:34:56"),
    });
    (data, bytes.unwrap())
}

#[test]
fn a_dng_comes_back_with_its_own_black_level_at_every_place() {
    for cfa in CfaPattern::ALL {
        let black = [100.0, 101.25, 102.5, 103.0];
        let (data, bytes) = dng(23, 14, cfa, black);
        let frame = decode(&bytes).unwrap();
        assert_eq!((frame.width, frame.height), (23, 14));
        assert_eq!(
            (frame.layout, frame.black, frame.white),
            (Layout::Bayer(cfa), black, 4000)
        );
        assert!(frame.data == data);
        assert_eq!((frame.exposure_ms, frame.iso), (Some(12.5), Some(100)));
        assert!(frame.date_time.unwrap().starts_with("2024"));
    }
}

#[test]
fn statistics_count_channel_by_channel_from_any_corner() {
    let (data, bytes) = dng(24, 16, CfaPattern::Grbg, [1.0, 2.0, 3.0, 4.0]);
    let frame = decode(&bytes).unwrap();
    let crop = Crop {
        x: 3,
        y: 5,
        width: 7,
        height: 6,
    };
    let statistics = frame_statistics(&frame, crop).unwrap();
    // GRBG: red in even rows and odd columns, blue in odd rows and even columns.
    let places = [
        ("R", 0, 1, 2.0),
        ("G1", 0, 0, 1.0),
        ("G2", 1, 1, 4.0),
        ("B", 1, 0, 3.0),
    ];
    for (channel, place) in statistics.channels.iter().zip(places) {
        let values: Vec<u16> = (5..11)
            .flat_map(|y| (3..10).map(move |x| (x, y)))
            .filter(|(x, y)| (y % 2, x % 2) == (place.1, place.2))
            .map(|(x, y)| data[y * 24 + x])
            .collect();
        let mean = values.iter().map(|&v| f64::from(v)).sum::<f64>() / values.len() as f64;
        assert_eq!((channel.channel, channel.pixels), (place.0, values.len()));
        assert_eq!(channel.black, place.3);
        assert!((channel.mean - mean).abs() < 1e-9);
        assert_eq!(channel.min, *values.iter().min().unwrap());
        assert_eq!(channel.max, *values.iter().max().unwrap());
        let clipped = values.iter().filter(|&&v| v >= 4000).count();
        assert_eq!(channel.clipped, clipped);
    }
    for bad in [
        Crop { x: 18, ..crop },
        Crop {
            y: usize::MAX,
            ..crop
        },
        Crop { width: 0, ..crop },
    ] {
        let message = frame_statistics(&frame, bad).unwrap_err().report();
        assert!(message.contains("visible area of 24 x 16") && message.contains("hint:"));
    }
}

/// Where the value of a main-directory tag lies.
fn value_of(bytes: &[u8], tag: u16) -> usize {
    let count = usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let entry = (0..count).map(|i| 10 + 12 * i);
    let mut entry = entry.filter(|&e| u16::from_le_bytes([bytes[e], bytes[e + 1]]) == tag);
    entry.next().unwrap() + 8
}

#[test]
fn files_that_cannot_be_read_say_what_to_do() {
    let (_, good) = dng(24, 16, CfaPattern::Rggb, [0.0; 4]);
    let message = |bytes: &[u8]| decode(bytes).unwrap_err().report();
    let expect = |bytes: &[u8], parts: &[&str]| {
        let text = message(bytes);
        for part in parts {
            assert!(text.contains(part), "'{part}' is not in: {text}");
        }
    };
    // Torn anywhere: never zeros for pixels, never a panic.
    for cut in 0..good.len() {
        let text = message(&good[..cut]);
        assert!(
            !text.contains("panic") && text.contains("hint:"),
            "cut at {cut}: {text}"
        );
    }
    expect(
        &good[..good.len() - 1],
        &["the file ends inside the image data", "torn"],
    );
    expect(b"", &["not a RAW file"]);
    expect(
        b"nothing to see here, move along, please",
        &["not a RAW file"],
    );
    expect(
        b"\xff\xd8\xff\xe1 and so on",
        &["a JPEG image", "RAW files"],
    );
    expect(b"II\x2b\0\x08\0\0\0", &["BigTIFF", "hint:"]);
    expect(
        b"\0\0\0\x18ftypcrx \0\0\0\x01crx isom",
        &["CR3", "convert to uncompressed DNG"],
    );
    let with = |tag: u16, value: u16| {
        let mut bytes = good.clone();
        let at = value_of(&bytes, tag);
        bytes[at..at + 2].copy_from_slice(&value.to_le_bytes());
        bytes
    };
    expect(
        &with(259, 8),
        &["compression 8", "convert to uncompressed DNG"],
    );
    expect(&with(259, 34892), &["lossy", "convert to uncompressed DNG"]);
    expect(
        &with(258, 14),
        &["14 bits per sample", "16-bit uncompressed DNG"],
    );
    expect(&with(258, 10), &["10 bits per sample"]);
    expect(&with(262, 2), &["no color filter mosaic"]);
    expect(&with(277, 3), &["3 samples per pixel"]);
    expect(&with(256, 4000), &["ends inside its image"]);
    // The 2x2 pattern red, green, green, green is no Bayer array.
    let mut odd = good.clone();
    let at = value_of(&odd, 33422);
    odd[at + 3] = 1;
    expect(&odd, &["color filter array"]);
}
