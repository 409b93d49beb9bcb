//! Each fault as frames show it, and the truth.

use super::tests::{Slope, pose, shot};
use super::*;
use crate::math::statistics::Running;
use crate::session::{BitDepth, Configuration, Lens, Projection};

/// A camera without noise but rounding, in 16 bits, its black 1000 and its full scale 60000.
fn quiet(sensor: SensorModel) -> SensorModel {
    SensorModel {
        width: 60,
        height: 50,
        pixel_mm: 0.2,
        center_px: [30.0, 25.0],
        bits: BitDepth::Sixteen,
        black: [1000.0; 4],
        white: 61000,
        gain: 1e6,
        read_noise: 0.0,
        dark_current: 0.0,
        vignetting: 0.0,
        ..sensor
    }
}

/// An even picture of brightness 1.
struct Even;

impl Appearance for Even {
    fn radiance(&self, _: FrameKind, _: &Configuration, _: [f64; 2]) -> [f64; 3] {
        [1.0; 3]
    }
}

/// The raw values of a frame: the last bytes of a 16-bit file.
fn values(frame: &CapturedFrame, count: usize) -> Vec<f64> {
    let words = frame.bytes[frame.bytes.len() - 2 * count..].chunks(2);
    words
        .map(|w| f64::from(u16::from_le_bytes([w[0], w[1]])))
        .collect()
}

fn photograph(sensor: SensorModel, kind: FrameKind, exposure_ms: f64) -> Vec<f64> {
    let count = sensor.width * sensor.height;
    let mut camera = VirtualCamera::new(sensor, Box::new(Even), 2).unwrap();
    values(&camera.expose(&shot(kind, exposure_ms, 0)).unwrap(), count)
}

#[test]
fn a_camera_without_faults_gives_the_frames_it_always_gave() {
    let mut camera = VirtualCamera::new(SensorModel::default(), Box::new(Slope), 5).unwrap();
    let mut hash =
        |kind| crate::session::sha256(&camera.expose(&shot(kind, 30.0, 0)).unwrap().bytes);
    let sample = "89c492ca7f91340708e9a5a8b7f46c9e29aa1cb4504d3203e899099a01c0d2e7";
    let dark = "e34a01c3893c9e73fd21c9afc0e57f879015d9e558574f9c58e2b5059e8e814d";
    assert_eq!(hash(FrameKind::Sample), sample);
    assert_eq!(hash(FrameKind::Dark), dark);
}

#[test]
fn the_curve_of_an_exposure_series_is_the_stated_one() {
    // 750 red pixels of 42 raw values per millisecond with a noise of 1 that hides the rounding: known to 0.04.
    let [n1, n2] = [0.04, -0.015];
    let mut sensor = quiet(SensorModel::default());
    sensor.read_noise = 1.0;
    sensor.faults.nonlinearity = [n1, n2];
    for exposure_ms in [10.0, 100.0, 400.0, 1000.0, 1400.0] {
        let raw = photograph(sensor.clone(), FrameKind::Sample, exposure_ms);
        let red = (0..raw.len()).filter(|i| i / 60 % 2 == 0 && i % 2 == 0);
        let red: Vec<f64> = red.map(|i| raw[i]).collect();
        let mean = red.iter().sum::<f64>() / red.len() as f64;
        let q = 42.0 * exposure_ms;
        let expected = 1000.0 + q * (1.0 - n1 * q / 60000.0 - n2 * (q / 60000.0_f64).powi(2));
        assert!(
            (mean - expected).abs() < 0.2,
            "{exposure_ms} ms: {mean}, expected {expected}"
        );
    }
}

#[test]
fn the_same_sensor_shows_its_pattern_in_every_frame() {
    let mut sensor = quiet(SensorModel::default());
    sensor.faults.response_sd = 0.02;
    sensor.faults.hot_fraction = 0.01;
    sensor.faults.hot_per_ms = 5.0;
    sensor.optics.dust = vec![Dust {
        center_px: [20.0, 20.0],
        radius_px: 2.0,
        depth: 0.3,
    }];
    let pattern = FixedPattern::new(&sensor);
    for kind in [FrameKind::Flat, FrameKind::White, FrameKind::Chart] {
        let raw = photograph(sensor.clone(), kind, 500.0);
        for (i, &v) in raw.iter().enumerate() {
            let c = CfaPattern::Rggb.channel(i / 60, i % 60);
            let rate = SensorModel::default().responsivity[c] * pattern.light[i] + pattern.dark[i];
            assert!((v - 1000.0 - 500.0 * rate).abs() < 2.0, "value {i}: {v}");
        }
    }
    assert!(pattern.light[20 * 60 + 20] < 0.8);
    let dark = photograph(sensor.clone(), FrameKind::Dark, 500.0);
    let hot = dark.iter().filter(|&&v| v > 1010.0).count();
    assert!((15..60).contains(&hot), "{hot}");
}

#[test]
fn flicker_and_jitter_scatter_frames_as_stated() {
    // 400 frames see a standard deviation off by 13 %.
    let mut sensor = quiet(SensorModel::default());
    sensor.width = 12;
    sensor.height = 10;
    let scatter = |sensor: SensorModel, kind| {
        let mut camera = VirtualCamera::new(sensor, Box::new(Even), 2).unwrap();
        let mut means = Running::default();
        for repeat in 0..400 {
            let raw = values(&camera.expose(&shot(kind, 500.0, repeat)).unwrap(), 120);
            means.push(raw.iter().sum::<f64>() / 120.0 - 1000.0);
        }
        means.variance().sqrt() / means.mean()
    };
    let with = |flicker, shutter_jitter, dark_current| SensorModel {
        flicker,
        shutter_jitter,
        dark_current,
        ..sensor.clone()
    };
    let near = |x: f64, expected: f64| assert!((x / expected - 1.0).abs() < 0.13, "{x} {expected}");
    near(scatter(with(0.01, 0.0, 0.0), FrameKind::Sample), 0.01);
    near(scatter(with(0.003, 0.004, 0.0), FrameKind::White), 0.005);
    // Without light only the shutter is left.
    near(scatter(with(0.02, 0.006, 20.0), FrameKind::Dark), 0.006);
    assert!(scatter(with(0.02, 0.0, 20.0), FrameKind::Dark) < 1e-4);
}

/// The position of a bright spot on the sample, in the image.
fn spot(stand: impl Fn(&Shot) -> Stand + Send + Sync + 'static, lens: Lens) -> [f64; 2] {
    struct Spot;
    impl Appearance for Spot {
        fn radiance(&self, _: FrameKind, _: &Configuration, [x, y]: [f64; 2]) -> [f64; 3] {
            [(-2.0 * ((x - 1.0).powi(2) + (y - 0.5).powi(2))).exp(); 3]
        }
    }
    let mut sensor = quiet(SensorModel {
        subsamples: 6,
        ..SensorModel::default()
    });
    sensor.responsivity = [100.0; 3];
    sensor.optics.lens = lens;
    let mut camera = VirtualCamera::new(sensor, Box::new(Spot), 2)
        .unwrap()
        .with_misalignment(Box::new(stand));
    let raw = values(
        &camera.expose(&shot(FrameKind::Sample, 500.0, 0)).unwrap(),
        3000,
    );
    let (mut sum, mut moment) = (0.0, [0.0; 2]);
    for (i, v) in raw.iter().enumerate() {
        let at = [(i % 60) as f64 + 0.5, (i / 60) as f64 + 0.5];
        sum += v - 1000.0;
        moment = [0, 1].map(|k| moment[k] + (v - 1000.0) * at[k]);
    }
    moment.map(|m| m / sum)
}

#[test]
fn frames_show_where_things_stand_in_truth() {
    let lens = Lens::default();
    let nominal = spot(|s| Stand::exact(&s.pose), lens);
    let facts = quiet(SensorModel::default()).facts();
    let expected = Projection::new(&facts, &pose(3, 20.0)).to_pixel([1.0, 0.5]);
    let near = |a: [f64; 2], b: [f64; 2]| {
        assert!((a[0] - b[0]).hypot(a[1] - b[1]) < 0.01, "{a:?} {b:?}");
    };
    near(nominal, expected);
    let shifted = spot(
        |s| Stand {
            shift_px: [1.5, -2.0],
            ..Stand::exact(&s.pose)
        },
        lens,
    );
    near(shifted, [nominal[0] + 1.5, nominal[1] - 2.0]);
    // A surface 0.4 mm higher moves up in the image by 0.4 sin(theta).
    let high = spot(
        |s| Stand {
            height_mm: 0.4,
            ..Stand::exact(&s.pose)
        },
        lens,
    );
    near(
        high,
        [
            nominal[0],
            nominal[1] - 0.4 * 20.0_f64.to_radians().sin() / 0.2,
        ],
    );
    let tilted = spot(
        |s| {
            Stand::exact(&Configuration {
                rotation: s.pose.rotation + 0.1,
                ..pose(3, 30.0)
            })
        },
        lens,
    );
    let there = Configuration {
        rotation: 0.5,
        ..pose(3, 30.0)
    };
    near(tilted, Projection::new(&facts, &there).to_pixel([1.0, 0.5]));
}

#[test]
fn the_true_mean_is_the_mean_over_the_sample_whatever_the_pixels() {
    /// Waves along x, which a grazing view from the side of +x squeezes to less than a pixel.
    struct Waves;
    impl Appearance for Waves {
        fn radiance(&self, _: FrameKind, _: &Configuration, [x, y]: [f64; 2]) -> [f64; 3] {
            [
                1.0 + 0.5 * (3.0 * x + 1.0).sin(),
                2.0 + (40.0 * x).sin() * (2.0 * y).cos(),
                0.0,
            ]
        }
    }
    let analytic = |side: f64| {
        let sinc = |k: f64| (0.5 * k * side).sin() / (0.5 * k * side);
        [1.0 + 0.5 * 1.0_f64.sin() * sinc(3.0), 2.0, 0.0]
    };
    let grazing = Configuration {
        rotation: 0.0,
        ..pose(3, 80.0)
    };
    let sensor = SensorModel {
        spacing_mm: 0.04,
        ..SensorModel::default()
    };
    let mut camera = VirtualCamera::new(sensor, Box::new(Waves), 1).unwrap();
    for side in [8.0, 9.3] {
        let mean = camera.true_mean(&grazing, side).unwrap();
        for (m, expected) in mean.into_iter().zip(analytic(side)) {
            assert!(
                (m - expected).abs() <= 1e-5 * expected,
                "{mean:?} {expected}"
            );
        }
    }
    // Pixels that hang over the edge of the square make their mean another one, but not by much.
    let image = camera
        .noise_free_image(FrameKind::Sample, &grazing)
        .unwrap();
    let coverage = Projection::new(&camera.facts(), &grazing)
        .coverage(8.0)
        .unwrap();
    let pixels: f64 = coverage
        .pixels()
        .map(|(x, y, w)| w * image.pixels[y * 240 + x][0])
        .sum();
    let off = pixels / coverage.area() / analytic(8.0)[0] - 1.0;
    assert!((1e-6..5e-3).contains(&off.abs()), "{off}");
    camera.rescale_to(&grazing, 8.0, [0.3, 0.2, 0.0]).unwrap();
    let mean = camera.true_mean(&grazing, 8.0).unwrap();
    assert!((mean[0] - 0.3).abs() < 1e-12 && (mean[1] - 0.2).abs() < 1e-12);
    // A picture of rare, bright, tiny specks has no mean to be had.
    struct Steps;
    impl Appearance for Steps {
        fn radiance(&self, _: FrameKind, _: &Configuration, [x, y]: [f64; 2]) -> [f64; 3] {
            [Random::keyed(&[(x * 1e3) as i64 as u64, (y * 1e3) as i64 as u64])
                .uniform()
                .powi(4000); 3]
        }
    }
    let camera = VirtualCamera::new(SensorModel::default(), Box::new(Steps), 1).unwrap();
    let error = camera.true_mean(&grazing, 8.0).unwrap_err().report();
    assert!(
        error.contains("does not settle") && error.contains("hint:"),
        "{error}"
    );
}

#[test]
fn blooming_and_unequal_channels_show_in_frames() {
    let mut sensor = quiet(SensorModel::default());
    sensor.faults.full_well = 40_000.0;
    // Green pixels hold 40,000 of their 60,000; the red and blue above and below in their columns take the rest.
    let raw = photograph(sensor.clone(), FrameKind::Sample, 1000.0);
    let at = |x: usize, y: usize| raw[y * 60 + x] - 1000.0;
    for y in 10..40 {
        assert!((at(21, y) - 40_000.0).abs() < 1.0, "{}", at(21, y));
    }
    // Even without neighbors that overflow nothing leaves the column: red alone stays below.
    let raw = photograph(sensor, FrameKind::Sample, 650.0);
    assert!((raw[20 * 60 + 20] - 1000.0 - 650.0 * 42.0).abs() < 1.0);
    let mut sensor = quiet(SensorModel {
        gain: 2.0,
        ..SensorModel::default()
    });
    sensor.gain = 2.0;
    sensor.faults.gains = [1.0, 2.0, 1.0];
    let variance = |channel| {
        let raw = photograph(sensor.clone(), FrameKind::Sample, 500.0);
        let mut r = Running::default();
        for (i, &v) in raw.iter().enumerate() {
            if CfaPattern::Rggb.channel(i / 60, i % 60) == channel {
                r.push(v);
            }
        }
        r.variance()
    };
    // 750 red and 1500 green pixels: 5 % and 4 % each.
    assert!((variance(0) / (21_000.0 / 2.0) - 1.0).abs() < 0.2);
    assert!((variance(1) / (30_000.0 / 4.0) - 1.0).abs() < 0.15);
}

#[test]
fn sensors_without_a_mosaic_write_tiff() {
    struct Colors;
    impl Appearance for Colors {
        fn radiance(&self, _: FrameKind, _: &Configuration, _: [f64; 2]) -> [f64; 3] {
            [0.2, 0.3, 0.4]
        }
    }
    let camera = |layout| {
        let sensor = quiet(SensorModel {
            layout,
            responsivity: [10.0, 20.0, 30.0],
            ..SensorModel::default()
        });
        VirtualCamera::new(sensor, Box::new(Colors), 2).unwrap()
    };
    let near = |a: f64, b: f64| assert!((a - b).abs() < 2.0, "{a} {b}");
    let frame = camera(Layout::Rgb)
        .expose(&shot(FrameKind::Sample, 1000.0, 0))
        .unwrap();
    assert_eq!(frame.extension, "tif");
    for (i, v) in values(&frame, 9000).into_iter().enumerate() {
        near(v, [3000.0, 7000.0, 13_000.0][i % 3]);
    }
    let mut mono = camera(Layout::Mono);
    let sample = shot(FrameKind::Sample, 1000.0, 0);
    for (filter, expected) in [
        (Filter::R, 3000.0),
        (Filter::G, 7000.0),
        (Filter::B, 13_000.0),
    ] {
        let frame = mono.expose_through(&sample, filter).unwrap();
        near(values(&frame, 3000)[1234], expected);
    }
    near(
        values(&mono.expose(&sample).unwrap(), 3000)[7],
        1000.0 + 20_000.0 / 3.0,
    );
    let refused = camera(Layout::Rgb).expose_through(&sample, Filter::R);
    assert!(refused.unwrap_err().report().contains("monochrome"));
}
