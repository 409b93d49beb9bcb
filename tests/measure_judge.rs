//! Promise: a frame just taken is judged over the crop of its pose: clipped, dim and right frames are told apart, hot
//! pixels do not count, and a frame that cannot be judged is an error that names it.
#![allow(clippy::unwrap_used, missing_docs)]

mod virtual_session;

use goniofit::math::PolarDirection;
use goniofit::measure::{FrameJudge, decode_file};
use goniofit::session::{
    BitDepth, CameraFacts, CfaPattern, Configuration, DngImage, Exposedness, FrameKind, Layout,
    Projection, TiffImage, write_dng, write_tiff,
};
use std::path::Path;
use virtual_session::{SAMPLE_SQUARE_MM, Setup, folder, record};

fn pose(theta_deg: f64, rotation_deg: f64) -> Configuration {
    Configuration {
        id: 3,
        light: PolarDirection::from_degrees(30.0, 180.0),
        camera: PolarDirection::from_degrees(theta_deg, 0.0),
        rotation: rotation_deg.to_radians(),
    }
}

const SIZE: [usize; 2] = [60, 48];

fn facts() -> CameraFacts {
    CameraFacts {
        name: "test".to_owned(),
        width: SIZE[0],
        height: SIZE[1],
        pixel_mm: 0.5,
        center_px: [30.0, 24.0],
        lens: Default::default(),
    }
}

/// The crop at normal view is columns 20 to 39 and rows 14 to 33.
fn judge() -> FrameJudge {
    FrameJudge::new(facts(), 10.0)
}

fn dng(data: &[u16]) -> Vec<u8> {
    write_dng(&DngImage {
        width: SIZE[0],
        height: SIZE[1],
        data,
        bits: BitDepth::Twelve,
        cfa: CfaPattern::Rggb,
        black: [100.0, 200.0, 200.0, 300.0],
        white: 4000,
        make: "goniofit",
        model: "test",
        exposure_ms: Some(10.0),
        iso: Some(100),
        date_time: None,
    })
    .unwrap()
}

fn look(data: &[u16], pose: &Configuration) -> Exposedness {
    let seen = judge().look(FrameKind::Sample, pose, &dng(data), "dng");
    seen.unwrap().unwrap()
}

fn expect(found: [f64; 3], wanted: [f64; 3]) {
    for (f, w) in found.iter().zip(wanted) {
        assert!((f - w).abs() < 1e-12, "{found:?} against {wanted:?}");
    }
}

#[test]
fn peak_and_mean_are_fractions_of_black_to_white_over_the_crop_alone() {
    let at = |x: usize, y: usize| y * SIZE[0] + x;
    // Half way from black to white everywhere in the crop, white all around beyond the margin.
    let half = |x: usize, y: usize| [2050, 2100, 2100, 2150][CfaPattern::position(y, x)];
    let mut data = vec![4000; SIZE[0] * SIZE[1]];
    for y in 11..37 {
        for x in 17..43 {
            data[at(x, y)] = half(x, y);
        }
    }
    let seen = look(&data, &pose(0.0, 0.0));
    expect(seen.mean, [0.5; 3]);
    expect(seen.peak, [0.5; 3]);
    // Turned by 45 degrees the square reaches beyond.
    expect(look(&data, &pose(0.0, 45.0)).peak, [1.0; 3]);
    // A hot pixel of each color stands alone and does not count.
    for hot in [at(24, 20), at(29, 20), at(29, 23)] {
        data[hot] = 4000;
    }
    expect(look(&data, &pose(0.0, 0.0)).peak, [0.5; 3]);
    // Two neighbors of a color are a highlight: as bright as the fainter of them at least.
    data[at(26, 20)] = 3900;
    let seen = look(&data, &pose(0.0, 0.0));
    expect(seen.peak, [3800.0 / 3900.0, 0.5, 0.5]);
    assert!(seen.mean[0] > 0.5 && seen.mean[0] < 0.52);
    // In the margin of one pixel, which measuring reads too; greens are neighbors along the diagonal.
    data[at(40, 13)] = 3990;
    data[at(41, 12)] = 3990;
    expect(
        look(&data, &pose(0.0, 0.0)).peak,
        [3800.0 / 3900.0, 3790.0 / 3800.0, 0.5],
    );
}

/// Half way to white in the crop, white around it beyond the margin; without filters, or in all three channels.
#[test]
fn frames_without_a_mosaic_are_judged_pixel_by_pixel() {
    for layout in [Layout::Mono, Layout::Rgb] {
        let n = layout.values_per_pixel();
        let at = |x: usize, y: usize, c: usize| n * (y * SIZE[0] + x) + c;
        let mut data = vec![4000_u16; n * SIZE[0] * SIZE[1]];
        for y in 12..36 {
            for x in 18..42 {
                for c in 0..n {
                    data[at(x, y, c)] = 2000 - 500 * c as u16;
                }
            }
        }
        let look = |data: &[u16]| {
            let bytes = write_tiff(&TiffImage {
                width: SIZE[0],
                height: SIZE[1],
                layout,
                data,
                white: 4000,
                make: "goniofit",
                model: "test",
                exposure_ms: None,
                iso: None,
            });
            let seen = judge().look(FrameKind::Sample, &pose(0.0, 0.0), &bytes.unwrap(), "tif");
            seen.unwrap().unwrap()
        };
        let half = if n == 1 { [0.5; 3] } else { [0.5, 0.375, 0.25] };
        expect(look(&data).mean, half);
        expect(look(&data).peak, half);
        // One bright pixel stands alone; two side by side are a highlight, in their channel.
        data[at(24, 20, 0)] = 3900;
        expect(look(&data).peak, half);
        data[at(25, 21, 0)] = 3800;
        let highlight = if n == 1 {
            [0.95; 3]
        } else {
            [0.95, 0.375, 0.25]
        };
        expect(look(&data).peak, highlight);
    }
}

#[test]
fn dim_right_and_clipped_virtual_frames_are_told_apart() {
    // At 64 ms the first pose clips and the third is faint.
    let setup = Setup::new(3);
    let folder = folder();
    let session = record(folder.path(), &setup);
    let plan = session.plan().unwrap();
    let manifest = session.manifest().unwrap();
    let mut judge = FrameJudge::new(setup.sensor.facts(), SAMPLE_SQUARE_MM);
    let mut judged = 0;
    for frame in session.frames().unwrap() {
        let bytes = std::fs::read(session.frame_path(&frame.file)).unwrap();
        let pose = frame.config.and_then(|c| plan.configuration(c));
        let pose = pose.unwrap_or(&manifest.white.configuration);
        let seen = judge.look(frame.kind, pose, &bytes, "dng").unwrap();
        let Some(seen) = seen else {
            assert_eq!(frame.kind, FrameKind::Dark);
            continue;
        };
        judged += 1;
        // What measuring leaves out: any pixel of the crop at 92 % of the white level.
        let raw = decode_file(&session.frame_path(&frame.file)).unwrap();
        let coverage = Projection::new(&setup.sensor.facts(), pose);
        let coverage = coverage.coverage(SAMPLE_SQUARE_MM).unwrap();
        let clipped = coverage
            .pixels()
            .any(|(x, y, _)| raw.data[y * raw.width + x] >= (0.92 * 4095.0) as u16);
        let peak = seen.peak.into_iter().fold(0.0, f64::max);
        if peak >= 0.92 {
            assert!(clipped, "{} {seen:?}", frame.file);
        }
        if clipped {
            assert!(peak >= 0.9, "{} {seen:?}", frame.file);
        }
        if frame.kind == FrameKind::Sample {
            let (_, _, truth) = setup.poses[pose.id as usize - 1];
            for (c, truth) in truth.into_iter().enumerate() {
                let light =
                    setup.sensor.responsivity[c] * truth * frame.exposure_ms / (4095.0 - 128.0);
                if !clipped {
                    assert!(
                        (seen.mean[c] - light).abs() < 0.02 * light + 3e-4,
                        "{} {seen:?} {light}",
                        frame.file
                    );
                }
                assert!(seen.peak[c] > seen.mean[c]);
            }
        }
        match (frame.config, frame.exposure_ms) {
            (Some(1), t) if t > 60.0 => assert!(clipped && peak > 0.99),
            (Some(1), t) if t > 10.0 => assert!((0.2..0.5).contains(&peak), "{seen:?}"),
            (Some(3), t) if t < 10.0 => assert!(peak < 0.01, "{seen:?}"),
            _ => {}
        }
    }
    assert_eq!(judged, 18);
}

#[test]
fn frames_that_cannot_be_judged_are_named() {
    let bytes = dng(&vec![500; SIZE[0] * SIZE[1]]);
    let torn = judge().look(FrameKind::White, &pose(0.0, 0.0), &bytes[..900], "cr2");
    let text = torn.unwrap_err().report();
    assert!(
        text.contains("the white frame (cr2) at the pose of configuration 3 cannot be decoded"),
        "{text}"
    );
    let mut other = facts();
    other.width = 6000;
    let mut other = FrameJudge::new(other, 10.0);
    let size = other.look(FrameKind::Sample, &pose(0.0, 0.0), &bytes, "dng");
    let text = size.unwrap_err().report();
    assert!(
        text.contains("60 x 48 pixels") && text.contains("6000 x 48") && text.contains("hint:"),
        "{text}"
    );
    let mut wide = FrameJudge::new(facts(), 40.0);
    let border = wide.look(FrameKind::Reference, &pose(0.0, 0.0), &bytes, "dng");
    assert!(
        border
            .unwrap_err()
            .report()
            .contains("the crop leaves the image")
    );
    // Nobody needs to look at a dark: its bytes are not even decoded.
    let dark = judge().look(FrameKind::Dark, &pose(0.0, 0.0), b"nothing", "dng");
    assert_eq!(dark.unwrap(), None);
}

/// Real files lie outside the project because of their size.
#[test]
fn real_files_are_judged() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/raw");
    let Ok(entries) = std::fs::read_dir(&folder) else {
        println!("skipped: {} is not there", folder.display());
        return;
    };
    let mut files = 0;
    for path in entries.map(|e| e.unwrap().path()) {
        if path
            .extension()
            .is_none_or(|e| e == "csv" || e == "md" || e == "txt")
        {
            continue;
        }
        let raw = decode_file(&path).unwrap();
        let facts = CameraFacts {
            name: raw.model.clone(),
            width: raw.width,
            height: raw.height,
            pixel_mm: 0.05,
            center_px: [0.5 * raw.width as f64, 0.5 * raw.height as f64],
            lens: Default::default(),
        };
        let bytes = std::fs::read(&path).unwrap();
        let extension = path.extension().unwrap().to_str().unwrap();
        let start = std::time::Instant::now();
        let seen = FrameJudge::new(facts, 20.0)
            .look(FrameKind::Sample, &pose(20.0, 30.0), &bytes, extension)
            .unwrap()
            .unwrap();
        println!(
            "{}: {seen:?}, {} x {} pixels in {:.0} ms",
            path.display(),
            raw.width,
            raw.height,
            1e3 * start.elapsed().as_secs_f64()
        );
        for c in 0..3 {
            assert!(
                (0.0..=1.1).contains(&seen.peak[c]) && seen.mean[c] <= seen.peak[c],
                "{seen:?}"
            );
        }
        files += 1;
    }
    println!("{files} files");
}

#[test]
#[ignore = "slow: 10 s; prints times"]
fn a_megapixel_is_judged_in_time() {
    let (width, height) = (1200, 900);
    let data: Vec<u16> = (0..width * height)
        .map(|i| 300 + (i * 37 % 3000) as u16)
        .collect();
    let bytes = write_dng(&DngImage {
        width,
        height,
        data: &data,
        bits: BitDepth::Twelve,
        cfa: CfaPattern::Rggb,
        black: [100.0; 4],
        white: 4000,
        make: "goniofit",
        model: "test",
        exposure_ms: Some(10.0),
        iso: None,
        date_time: None,
    })
    .unwrap();
    let facts = CameraFacts {
        name: "test".to_owned(),
        width,
        height,
        pixel_mm: 0.02,
        center_px: [600.0, 450.0],
        lens: Default::default(),
    };
    let mut judge = FrameJudge::new(facts, 10.0);
    for pose in [
        pose(0.0, 0.0),
        pose(0.0, 0.0),
        pose(0.0, 0.0),
        pose(40.0, 10.0),
    ] {
        let start = std::time::Instant::now();
        let decoded = goniofit::measure::decode(&bytes).unwrap();
        let decode_ms = 1e3 * start.elapsed().as_secs_f64();
        let start = std::time::Instant::now();
        judge.look(FrameKind::Sample, &pose, &bytes, "dng").unwrap();
        println!(
            "{} x {}: decoding {decode_ms:.1} ms, judging {:.1} ms",
            decoded.width,
            decoded.height,
            1e3 * start.elapsed().as_secs_f64()
        );
    }
}
