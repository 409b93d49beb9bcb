//! A color chart whose colors follow from spectra: what a camera sees of them, and what sRGB they are.

use goniofit::math::Random;

/// 400 to 700 nm in steps of 10 nm.
const WAVELENGTHS: usize = 31;
type Spectrum = [f64; WAVELENGTHS];

/// One patch of a chart.
#[derive(Debug, Clone, Copy)]
pub struct Patch {
    /// What the camera sees under the rig's lamp, over what it sees of a perfect diffuser.
    pub camera: [f64; 3],
    /// Linear sRGB (D65), a perfect diffuser being 1, 1, 1.
    pub srgb: [f64; 3],
}

/// Relative power of CIE D65.
const D65: Spectrum = [
    82.75, 91.49, 93.43, 86.68, 104.86, 117.01, 117.81, 114.86, 115.92, 108.81, 109.35, 107.80,
    104.79, 107.69, 104.41, 104.05, 100.0, 96.33, 95.79, 88.69, 90.01, 89.60, 87.70, 83.29, 83.70,
    80.03, 80.21, 82.28, 78.28, 69.72, 71.61,
];

fn nanometers(i: usize) -> f64 {
    400.0 + 10.0 * i as f64
}

/// A bell whose two halves have widths of their own.
fn bell(x: f64, middle: f64, below: f64, above: f64) -> f64 {
    let width = if x < middle { below } else { above };
    (-0.5 * ((x - middle) / width).powi(2)).exp()
}

/// The CIE 1931 color matching functions as sums of bells (Wyman, Sloan and Shirley 2013).
fn observer(x: f64) -> [f64; 3] {
    [
        1.056 * bell(x, 599.8, 37.9, 31.0) + 0.362 * bell(x, 442.0, 16.0, 26.7)
            - 0.065 * bell(x, 501.1, 20.4, 26.2),
        0.821 * bell(x, 568.8, 46.9, 40.5) + 0.286 * bell(x, 530.9, 16.3, 31.1),
        1.217 * bell(x, 437.0, 11.8, 36.0) + 0.681 * bell(x, 459.0, 26.0, 13.8),
    ]
}

/// Sensitivities of the camera, its lamp's spectrum included: filters close to, but not combinations of, the observer's.
fn camera(x: f64) -> [f64; 3] {
    let lamp = 0.7 + 0.3 * (x - 400.0) / 300.0;
    [
        lamp * bell(x, 600.0, 34.0, 30.0),
        lamp * bell(x, 540.0, 38.0, 36.0),
        lamp * bell(x, 455.0, 26.0, 30.0),
    ]
}

/// A smooth reflectance: a base, a slope, and a bell up or down.
fn reflectance(random: &mut Random) -> Spectrum {
    let mut draw = |low: f64, high: f64| low + (high - low) * random.uniform();
    let (base, slope) = (draw(0.15, 0.5), draw(-0.12, 0.12));
    let (height, middle, width) = (draw(-0.5, 0.9), draw(420.0, 680.0), draw(25.0, 70.0));
    std::array::from_fn(|i| {
        let x = nanometers(i);
        let r = base + slope * (x - 550.0) / 150.0 + height * bell(x, middle, width, width) * 0.5;
        r.clamp(0.03, 0.95)
    })
}

/// The sum of a spectrum under weights, over that of a perfect diffuser.
fn response(spectrum: &Spectrum, weights: impl Fn(usize) -> [f64; 3]) -> [f64; 3] {
    let (mut sum, mut white) = ([0.0; 3], [0.0; 3]);
    for (i, r) in spectrum.iter().enumerate() {
        let w = weights(i);
        for c in 0..3 {
            sum[c] += w[c] * r;
            white[c] += w[c];
        }
    }
    [0, 1, 2].map(|c| sum[c] / white[c])
}

/// From XYZ, each over that of the white, to linear sRGB with a white of 1, 1, 1 (IEC 61966-2-1, D65 white folded in).
fn srgb(relative: [f64; 3]) -> [f64; 3] {
    let [x, y, z] = [0.950_47 * relative[0], relative[1], 1.088_83 * relative[2]];
    [
        3.240_625_5 * x - 1.537_208 * y - 0.498_628_6 * z,
        -0.968_930_7 * x + 1.875_756_1 * y + 0.041_517_5 * z,
        0.055_710_1 * x - 0.204_021_1 * y + 1.056_995_9 * z,
    ]
}

/// 24 patches: six grays, the others of random smooth spectra.
pub fn patches(seed: u64) -> Vec<Patch> {
    let mut random = Random::keyed(&[seed, 24]);
    let spectrum = |i: usize, random: &mut Random| match i {
        18..=23 => [[0.9, 0.59, 0.36, 0.19, 0.09, 0.033][i - 18]; WAVELENGTHS],
        _ => reflectance(random),
    };
    (0..24)
        .map(|i| {
            let r = spectrum(i, &mut random);
            Patch {
                camera: response(&r, |i| camera(nanometers(i))),
                srgb: srgb(response(&r, |i| {
                    observer(nanometers(i)).map(|o| o * D65[i])
                })),
            }
        })
        .collect()
}
