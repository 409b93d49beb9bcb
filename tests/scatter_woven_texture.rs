//! Promise: the texture of woven cloth has the BRDF as its mean, with noise too, and published fabrics are whole.
#![allow(
    clippy::unwrap_used,
    clippy::float_cmp,
    clippy::print_stdout,
    missing_docs
)]

#[path = "common/woven.rs"]
mod woven_cases;

use glam::DVec3;
use goniofit::scatter::CHANNELS;
use goniofit::scatter::surface::woven::{
    Noise, PRESETS, Preset, Repeat, Segment, Shape, Texture, YarnLook, preset, segment_frame,
};
use woven_cases::{above, stream};

#[test]
fn the_mean_of_a_texture_over_its_segment_is_the_integral() {
    let mut random = stream(80);
    let (mut worst, mut control, n) = (0.0_f64, 0.0_f64, 60);
    for _ in 0..n {
        let segment = Segment::new(woven_cases::shape(&mut random)).unwrap();
        let (wi, wr) = (above(&mut random), above(&mut random));
        let expected = segment.estimate(wi, wr, 1e-8).value;
        let share = 0.3;
        let (w, l) = (segment.shape().width, segment.shape().length);
        // Fine along the curve; across it the band is a step, whose mean 200 points know to half a percent.
        let (along, across) = (1500, 200);
        let (n_x, n_y) = match segment.is_filament() {
            true => (along, across),
            false => (across, along),
        };
        let mut sum = 0.0;
        for i in 0..n_x {
            for j in 0..n_y {
                let x = ((i as f64 + 0.5) / n_x as f64 - 0.5) * w;
                let y = ((j as f64 + 0.5) / n_y as f64 - 0.5) * l;
                sum += segment.texture(wi, wr, (x, y), share);
            }
        }
        let mean = sum / (n_x * n_y) as f64;
        let scale = expected.max(2e-3);
        worst = worst.max((mean - expected).abs() / scale);
        control += (mean * w * l - expected).abs() / scale / f64::from(n);
    }
    println!("{worst:.1e}; without the area normalization {control:.1e}");
    assert!(worst < 0.05 && control > 0.2);
}

/// Published fabrics with coefficients.
fn published() -> impl Iterator<Item = (&'static Preset, [YarnLook; 2])> {
    PRESETS.iter().map(|p| {
        let look = |system: usize| YarnLook {
            shape: p.shape(system),
            k_s: [0.5, 0.3 + 0.2 * system as f64, 1.0],
        };
        (p, [look(0), look(1)])
    })
}

/// The BRDF of a published fabric without its diffuse part.
fn specular(preset: &Preset, looks: &[YarnLook; 2], wi: DVec3, wr: DVec3) -> [f64; CHANNELS] {
    let repeat = preset.repeat();
    let layout = repeat.layout().unwrap();
    let mut value = [0.0; CHANNELS];
    for t in layout.types() {
        let look = &looks[t.system];
        let shape = Shape {
            width: t.width,
            length: t.length,
            ..look.shape
        };
        let [i, r] = [wi, wr].map(|w| segment_frame(t.system, w));
        let f = Segment::new(shape).unwrap().estimate(i, r, 1e-7).value;
        (0..CHANNELS).for_each(|c| value[c] += look.k_s[c] * layout.weight(t) * f);
    }
    value
}

#[test]
fn published_fabrics_cover_their_repeat_once() {
    for (preset, _) in published() {
        let Repeat { size, segments } = preset.repeat();
        let area: f64 = segments.iter().map(|s| s.width * s.length).sum();
        assert!((area - size[0] * size[1]).abs() < 1e-12, "{}", preset.name);
        let mut random = stream(90);
        for _ in 0..2000 {
            let at = [size[0] * random.uniform(), size[1] * random.uniform()];
            let over = segments
                .iter()
                .filter(|s| {
                    let extent = match s.system {
                        0 => [s.width, s.length],
                        _ => [s.length, s.width],
                    };
                    (0..2).all(|k| {
                        let d = (at[k] - s.center[k]) / size[k];
                        (d - d.round()).abs() * size[k] <= 0.5 * extent[k]
                    })
                })
                .count();
            assert_eq!(over, 1, "{} at {at:?}", preset.name);
        }
        assert_eq!(preset.repeat().layout().unwrap().types().len(), 2);
    }
    let error = preset("jersey").err().unwrap().report();
    assert!(error.contains("known fabrics: denim"), "{error}");
}

#[test]
fn the_mean_of_a_cloths_texture_is_its_brdf() {
    for (preset, looks) in published() {
        let texture = Texture::new(preset.repeat(), [0.0; 3], looks, 0.5, None).unwrap();
        let size = preset.repeat().size;
        let mut random = stream(91);
        let mut worst = 0.0_f64;
        for _ in 0..6 {
            let (wi, wr) = (above(&mut random), above(&mut random));
            let expected = specular(preset, &looks, wi, wr);
            let n = 600;
            let mut mean = [0.0; CHANNELS];
            for k in 0..n * n {
                let x = size[0] * ((k % n) as f64 + 0.5) / n as f64;
                let y = size[1] * ((k / n) as f64 + 0.5) / n as f64;
                let value = texture.value(wi, wr, (x, y));
                (0..CHANNELS).for_each(|c| mean[c] += value[c] / (n * n) as f64);
            }
            for c in 0..CHANNELS {
                worst = worst.max((mean[c] - expected[c]).abs() / expected[c].max(2e-3));
            }
        }
        println!("{}: {worst:.1e}", preset.name);
        // A grid of 600 x 600 points knows the bands' edges to about one percent: sees a weight that is off by 5 %.
        assert!(worst < 0.05, "{}: {worst}", preset.name);
    }
}

/// Level 1e-3 over 6 fabrics (Sidak): 3.76 standard errors. Sees a mean of the noise off by about 3 %.
#[test]
fn noise_leaves_the_mean_as_it_is_and_is_a_function_of_its_seed() {
    let (wi, wr) = (
        DVec3::new(0.1, 0.2, 0.97).normalize(),
        DVec3::new(-0.15, 0.05, 0.98).normalize(),
    );
    let mut control = 0.0_f64;
    for (preset, looks) in published() {
        let noise = |seed: u64| Some(Noise { cells: 3, seed });
        let with = |noise: Option<Noise>| {
            Texture::new(preset.repeat(), [0.0; 3], looks, 0.5, noise).unwrap()
        };
        let (plain, rough, other) = (with(None), with(noise(5)), with(noise(6)));
        let size = preset.repeat().size;
        let mut random = stream(92);
        let mut ratio = goniofit::math::statistics::Running::default();
        let (mut differ, n) = (0, 20_000);
        for _ in 0..n {
            let at = (
                400.0 * size[0] * random.uniform(),
                400.0 * size[1] * random.uniform(),
            );
            let [a, b, c] = [&plain, &rough, &other].map(|t| t.value(wi, wr, at)[1]);
            if a > 0.0 {
                ratio.push(b / a);
                differ += usize::from(b != c);
                assert_eq!(b, rough.value(wi, wr, at)[1]);
            }
        }
        let z = (ratio.mean() - 1.0) / ratio.standard_error();
        assert!(
            z.abs() < 3.76,
            "{}: mean {}, z {z}",
            preset.name,
            ratio.mean()
        );
        assert!(differ as u64 == ratio.count() && ratio.count() > 500);
        control = control.max((0.95 * ratio.mean() - 1.0).abs() / ratio.standard_error());
    }
    assert!(control > 3.76, "{control}");
}
