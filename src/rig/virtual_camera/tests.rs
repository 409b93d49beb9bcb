//! The whole camera.

use super::*;
use crate::math::PolarDirection;
use crate::math::statistics::{Running, sidak_level};
use crate::session::Configuration;
use statrs::distribution::{ContinuousCDF, Normal};

pub(in crate::rig::virtual_camera) fn seed(default: u64) -> u64 {
    std::env::var("SEED").map_or(default, |s| s.parse().unwrap())
}

/// A gradient that depends on where the sample points.
pub(super) struct Slope;

impl Appearance for Slope {
    fn radiance(&self, _: FrameKind, _: &Configuration, [x, y]: [f64; 2]) -> [f64; 3] {
        [0.5 + 0.02 * x, 0.3 + 0.01 * y, 0.2]
    }
}

pub(super) fn pose(id: u32, theta_deg: f64) -> Configuration {
    Configuration {
        id,
        light: PolarDirection::from_degrees(45.0, 180.0),
        camera: PolarDirection::from_degrees(theta_deg, 0.0),
        rotation: 0.4,
    }
}

pub(super) fn shot(kind: FrameKind, exposure_ms: f64, repeat: u32) -> Shot {
    Shot {
        kind,
        config: (kind == FrameKind::Sample).then_some(3),
        pose: pose(3, 20.0),
        exposure_ms,
        repeat,
        visit: 0,
    }
}

#[test]
fn a_rescaled_picture_has_the_stated_mean() {
    let mut camera = VirtualCamera::new(SensorModel::default(), Box::new(Slope), 1).unwrap();
    let before = camera.true_mean(&pose(3, 70.0), 8.0).unwrap();
    assert!((before[0] - 0.5).abs() < 1e-3, "{before:?}");
    let target = [0.123, 0.456, 0.0];
    camera.rescale_to(&pose(3, 70.0), 8.0, target).unwrap();
    let mean = camera.true_mean(&pose(3, 70.0), 8.0).unwrap();
    for c in 0..3 {
        assert!((mean[c] - target[c]).abs() < 1e-14, "{mean:?}");
    }
    // Twice is as once, and other poses keep their picture.
    camera.rescale_to(&pose(3, 70.0), 8.0, target).unwrap();
    let again = camera.true_mean(&pose(3, 70.0), 8.0).unwrap();
    assert!((again[0] - target[0]).abs() < 1e-14);
    assert!((camera.true_mean(&pose(4, 70.0), 8.0).unwrap()[2] - 0.2).abs() < 1e-12);
    assert!(
        camera
            .rescale_to(&pose(3, 70.0), 8.0, [f64::NAN, 0.1, 0.1])
            .is_err()
    );
}

#[test]
fn raw_values_have_the_mean_and_variance_of_the_model() {
    // 21,600 green pixels: sees a mean off by 0.03 read-noise units and a variance off by 4 %.
    let sensor = SensorModel {
        vignetting: 0.0,
        black: [128.0; 4],
        ..SensorModel::default()
    };
    let camera = VirtualCamera::new(sensor, Box::new(Slope), seed(7)).unwrap();
    let image = NoiseFreeImage {
        width: 240,
        pixels: vec![[0.5; 3]; 240 * 180],
    };
    let check = |read_noise: f64| {
        let raw = camera.raw(
            &shot(FrameKind::Sample, 30.0, 0),
            Some(&image),
            &Exposure {
                lamp: [1.0; 3],
                time_ms: 30.0,
                filter: None,
            },
        );
        let mut green = Running::default();
        for (i, &v) in raw.iter().enumerate() {
            if CfaPattern::Rggb.channel(i / 240, i % 240) == 1 {
                green.push(f64::from(v) - 128.0);
            }
        }
        let signal = 30.0 * (60.0 * 0.5 + 0.004);
        let variance = signal / 2.5 + read_noise * read_noise + 1.0 / 12.0;
        let n = green.count() as f64;
        let z_mean = (green.mean() - signal) / (variance / n).sqrt();
        let z_variance = (green.variance() / variance - 1.0) / (2.0 / n).sqrt();
        (z_mean, z_variance, n)
    };
    // Two tests at a family-wise level of 1e-3.
    let limit = Normal::standard().inverse_cdf(1.0 - 0.5 * sidak_level(1e-3, 2));
    let (z_mean, z_variance, n) = check(2.0);
    assert!(z_mean.abs() < limit, "z = {z_mean}, n = {n}");
    assert!(z_variance.abs() < limit, "z = {z_variance}, n = {n}");
    // Negative control: a read noise of 6 instead of 2 is caught.
    assert!(check(6.0).1.abs() > limit);
}

#[test]
fn frames_are_a_function_of_the_shot_on_any_number_of_threads() {
    let take = |seed: u64, threads: usize, shot: &Shot| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.unwrap().install(|| {
            VirtualCamera::new(SensorModel::default(), Box::new(Slope), seed)
                .unwrap()
                .expose(shot)
                .unwrap()
                .bytes
        })
    };
    let first = shot(FrameKind::Sample, 30.0, 0);
    let bytes = take(5, 1, &first);
    assert_eq!(bytes, take(5, 3, &first));
    assert_ne!(bytes, take(6, 1, &first));
    assert_ne!(bytes, take(5, 1, &shot(FrameKind::Sample, 30.0, 1)));
    assert_ne!(bytes, take(5, 1, &shot(FrameKind::Dark, 30.0, 0)));
}

#[test]
fn an_interrupted_capture_gives_the_same_frames_when_it_goes_on() {
    let camera = || VirtualCamera::new(SensorModel::default(), Box::new(Slope), 5).unwrap();
    let visit = |kind, visit| Shot {
        visit,
        config: None,
        ..shot(kind, 30.0, 0)
    };
    let shots = [
        visit(FrameKind::White, 0),
        visit(FrameKind::Reference, 0),
        shot(FrameKind::Sample, 30.0, 0),
        visit(FrameKind::Reference, 1),
        visit(FrameKind::Dark, 0),
    ];
    let mut whole = camera();
    let whole: Vec<Vec<u8>> = shots
        .iter()
        .map(|s| whole.expose(s).unwrap().bytes)
        .collect();
    // A camera that is asked for the later shots only, and backwards.
    let mut again = camera();
    for (shot, bytes) in shots.iter().zip(&whole).skip(2).rev() {
        assert!(again.expose(shot).unwrap().bytes == *bytes, "{shot:?}");
    }
    // No two of them are the same frame, the visits of the reference included.
    for (i, a) in whole.iter().enumerate() {
        assert!(whole[..i].iter().all(|b| a != b), "frame {i} is a copy");
    }
}

#[test]
fn a_drifting_lamp_scales_what_is_lit_and_nothing_else() {
    let sensor = SensorModel {
        read_noise: 0.0,
        dark_current: 0.0,
        gain: 1e6,
        ..SensorModel::default()
    };
    let mut lit = 0;
    let law = move |_: &Shot| {
        lit += 1;
        [1.0, 0.5, 0.25].map(|b| if lit == 1 { 1.0 } else { b })
    };
    let mut camera = VirtualCamera::new(sensor, Box::new(Slope), 5)
        .unwrap()
        .with_lamp(Box::new(law));
    let mut mean = |kind| {
        let bytes = camera.expose(&shot(kind, 30.0, 0)).unwrap().bytes;
        // The pixels lie at the end of the file, two in three bytes, and begin with a red and a green one.
        let row = &bytes[bytes.len() - 180 * 360..][..360];
        let pair = |c: &[u8]| {
            let red = u16::from(c[0]) << 4 | u16::from(c[1]) >> 4;
            let green = (u16::from(c[1]) & 15) << 8 | u16::from(c[2]);
            [f64::from(red) - 128.0, f64::from(green) - 127.5]
        };
        row.chunks(3)
            .map(pair)
            .fold([0.0; 2], |s, p| [s[0] + p[0], s[1] + p[1]])
    };
    let first = mean(FrameKind::Sample);
    let dark = mean(FrameKind::Dark);
    let later = mean(FrameKind::Reference);
    assert!(first[0] > 1e4 && dark[0].abs() < 61.0, "{first:?} {dark:?}");
    assert!(
        (later[0] / first[0] - 1.0).abs() < 2e-3,
        "{first:?} {later:?}"
    );
    assert!(
        (later[1] / first[1] - 0.5).abs() < 2e-3,
        "{first:?} {later:?}"
    );
}

#[test]
fn senseless_sensors_shots_and_pictures_are_refused() {
    let sensor = SensorModel {
        gain: f64::NAN,
        ..SensorModel::default()
    };
    assert!(VirtualCamera::new(sensor, Box::new(Slope), 1).is_err());
    struct Broken;
    impl Appearance for Broken {
        fn radiance(&self, _: FrameKind, _: &Configuration, _: [f64; 2]) -> [f64; 3] {
            [0.1, f64::NAN, 0.1]
        }
    }
    let mut camera = VirtualCamera::new(SensorModel::default(), Box::new(Broken), 1).unwrap();
    let error = camera.expose(&shot(FrameKind::Sample, 1.0, 0)).unwrap_err();
    assert!(error.report().contains("configuration 3"), "{error}");
    assert!(camera.expose(&shot(FrameKind::Dark, 1.0, 0)).is_ok());
    assert!(camera.expose(&shot(FrameKind::Dark, f64::NAN, 0)).is_err());
    let camera = VirtualCamera::new(SensorModel::default(), Box::new(Slope), 1).unwrap();
    let mut camera = camera.with_lamp(Box::new(|_| [1.0, f64::NAN, 1.0]));
    let error = camera.expose(&shot(FrameKind::Sample, 1.0, 0)).unwrap_err();
    assert!(error.report().contains("lamp brightness"), "{error}");
}
