//! What the tests of the renderer share: small cloths, parameters, poses, and the comparison of two lists of estimates.

#![allow(dead_code)]

use glam::DVec3;
use goniofit::base::Unwatched;
use goniofit::fabric::{self, FiberTile, NO_SEGMENT, Segment};
use goniofit::math::statistics::sidak_level;
use goniofit::math::{PolarDirection, Random};
use goniofit::render::{
    Effort, Estimate, FiberScene, FiberSceneOptions, Integrator, LightShape, Request, Scene,
};
use goniofit::scatter::{self, Model, Parameters};
use goniofit::session::Configuration;
use statrs::distribution::{ContinuousCDF, Normal};
use std::f64::consts::TAU;

/// The seed of a statistical test; the variable `SEED` overrides it.
pub(crate) fn seed(named: u64) -> u64 {
    std::env::var("SEED").map_or(named, |s| s.parse().expect("SEED is a number"))
}

pub(crate) fn khungurn() -> &'static dyn Model {
    scatter::model("khungurn").unwrap()
}

/// Khungurn parameters, flat: colors, then beta_r, beta_tt, gamma_tt in degrees.
pub(crate) fn parameters(flat_deg: [f64; 9]) -> Parameters {
    let radians = |(i, v): (usize, &f64)| if i < 6 { *v } else { v.to_radians() };
    let values = flat_deg.iter().enumerate().map(radians).collect();
    Parameters::defaults(khungurn()).with_values(values)
}

/// Gabardine's fibers (Khungurn 2015, Table IV).
pub(crate) const GABARDINE: [f64; 9] = [
    0.185, 0.047, 0.069, 0.999, 0.330, 0.354, 2.141, 10.0, 23.548,
];
/// Silk's (the same table): the narrowest reflection lobe it has.
pub(crate) const SILK: [f64; 9] = [0.745, 0.008, 0.070, 0.620, 0.553, 0.562, 1.0, 10.0, 19.823];
/// Wide lobes and bright colors: quiet estimates of many bounces.
pub(crate) const SOFT: [f64; 9] = [0.1, 0.3, 0.05, 0.85, 0.6, 0.9, 8.0, 25.0, 30.0];

/// Light and camera in degrees (polar angle, azimuth), turntable at zero.
pub(crate) fn pose(id: u32, light: [f64; 2], camera: [f64; 2]) -> Configuration {
    Configuration {
        id,
        light: PolarDirection::from_degrees(light[0], light[1]),
        camera: PolarDirection::from_degrees(camera[0], camera[1]),
        rotation: 0.0,
    }
}

/// A light that fills a good part of the sky, so that many paths carry light and errors are near normal.
pub(crate) const WIDE: LightShape = LightShape {
    side: 500.0,
    distance: 610.0,
};

pub(crate) fn segment(start: DVec3, end: DVec3, radius: f64) -> Segment {
    Segment {
        start,
        end,
        radius,
        yarn_system: 0,
        previous: NO_SEGMENT,
        next: NO_SEGMENT,
    }
}

/// One straight endless fiber along x through the middle of the tile.
pub(crate) fn one_fiber(size: f64, radius: f64) -> FiberTile {
    let start = DVec3::new(0.0, 0.5 * size, 0.0);
    let end = DVec3::new(size, 0.5 * size, 0.0);
    let (previous, next) = (0, 0);
    let endless = Segment {
        previous,
        next,
        ..segment(start, end, radius)
    };
    FiberTile {
        size: [size; 2],
        segments: vec![endless],
    }
}

/// Random short fibers, many of which cross and overlap.
pub(crate) fn felt(n: usize, thickness: f64) -> FiberTile {
    let mut random = Random::keyed(&[77]);
    let fiber = |_| {
        let mut u = || random.uniform();
        let start = DVec3::new(u(), u(), thickness * u());
        let turn = TAU * u();
        let slope = 1.5 * thickness * (u() - 0.5);
        let end = start + DVec3::new(turn.cos(), turn.sin(), slope) * 0.4;
        segment(start, end, 0.02)
    };
    FiberTile {
        size: [1.0, 1.0],
        segments: (0..n).map(fiber).collect(),
    }
}

/// Upright bent fibers of four segments each, joined, leaning toward +x.
pub(crate) fn pile(n: usize) -> FiberTile {
    let mut random = Random::keyed(&[78]);
    let mut segments = Vec::new();
    for _ in 0..n {
        let mut at = DVec3::new(random.uniform(), random.uniform(), 0.0);
        let lean = DVec3::new(0.3 + 0.2 * random.normal(), 0.2 * random.normal(), 1.0);
        let first = segments.len() as u32;
        for step in 0..4 {
            let bend = lean * DVec3::new(f64::from(step), f64::from(step), 1.0);
            let end = at + bend.normalize() * 0.15;
            let (previous, next) = match step {
                0 => (NO_SEGMENT, first + 1),
                3 => (first + 2, NO_SEGMENT),
                _ => (first + step - 1, first + step + 1),
            };
            segments.push(Segment {
                previous,
                next,
                ..segment(at, end, 0.012)
            });
            at = end;
        }
    }
    FiberTile {
        size: [1.0, 1.0],
        segments,
    }
}

/// A 2/2 twill of one repeat, 4 + 4 yarns of 12 fibers.
pub(crate) fn twill() -> FiberTile {
    let yarn = "pitch_mm = 0.25\nfibers = 12\nfiber_radius_um = 16.0\nyarn_width_mm = 0.24\nyarn_thickness_mm = 0.132\n\
                crown_mm = 0.08\ncrown_angle_deg = 70.0\ntwist_per_tile = 1\njitter = 0.05\n";
    let text = format!(
        "name = \"small twill\"\nseed = 3\n[weave]\npattern = \"2/2 twill\"\n[warp]\n{yarn}[weft]\n{yarn}\
         [segments]\nlength_mm = 0.04\n"
    );
    let file = tempfile::NamedTempFile::with_suffix(".toml").unwrap();
    std::fs::write(file.path(), text).unwrap();
    fabric::load(file.path()).unwrap().tile
}

/// A cloth in its surroundings, at its parameters.
pub(crate) struct Subject<'a> {
    pub(crate) tile: &'a FiberTile,
    pub(crate) options: FiberSceneOptions,
    pub(crate) parameters: Parameters,
}

impl Subject<'_> {
    pub(crate) fn render(
        &self,
        integrator: Integrator,
        configurations: &[Configuration],
        effort: Effort,
        seed: u64,
    ) -> Vec<Estimate> {
        let options = FiberSceneOptions {
            integrator,
            ..self.options
        };
        let request = Request {
            configurations,
            parameters: &self.parameters,
            effort,
            seed,
            stream: 0,
        };
        let scene = FiberScene::new(self.tile, khungurn(), options).unwrap();
        scene.estimate(&request, &Unwatched).unwrap().configurations
    }
}

/// All numbers of an estimate with their standard errors, and what they are called.
pub(crate) fn numbers(e: &Estimate) -> Vec<(String, f64, f64)> {
    let names = khungurn().parameters();
    let rows = names.iter().zip(e.derivative.iter().zip(&e.derivative_se));
    let derivatives = rows.flat_map(|(info, (d, se))| {
        (0..3).map(move |c| (format!("d/d{} {c}", info.name), d[c], se[c]))
    });
    (0..3)
        .map(|c| (format!("mean {c}"), e.mean[c], e.standard_error[c]))
        .chain(derivatives)
        .collect()
}

/// z-scores of many comparisons, the worst of them in words.
#[derive(Default)]
pub(crate) struct Scores {
    pub(crate) cells: usize,
    pub(crate) worst: f64,
    pub(crate) sentence: String,
}

impl Scores {
    pub(crate) fn add(&mut self, what: &str, (a, se_a): (f64, f64), (b, se_b): (f64, f64)) {
        let se = se_a.hypot(se_b);
        let difference = (a - b).abs();
        let z = if difference <= 0.0 {
            0.0
        } else {
            difference / se
        };
        assert!(z.is_finite(), "{what}: {a} +- {se_a} against {b} +- {se_b}");
        self.cells += 1;
        if z >= self.worst {
            self.worst = z;
            self.sentence = format!("{what}: {a} +- {se_a} against {b} +- {se_b}, z = {z:.2}");
        }
    }

    /// Two lists of estimates of the same poses from independent paths.
    pub(crate) fn compare(&mut self, what: &str, a: &[Estimate], b: &[Estimate]) {
        for (a, b) in a.iter().zip(b) {
            let paths = format!(
                "{what}, pose {} ({} and {} paths)",
                a.config, a.paths, b.paths
            );
            for ((name, x, se_x), (_, y, se_y)) in numbers(a).into_iter().zip(numbers(b)) {
                self.add(&format!("{paths}, {name}"), (x, se_x), (y, se_y));
            }
        }
    }

    /// Two-sided, family-wise level 1e-3 over all cells.
    pub(crate) fn bound(&self) -> f64 {
        z_bound(self.cells)
    }

    pub(crate) fn assert_agree(&self) {
        let bound = self.bound();
        assert!(self.worst < bound, "bound {bound:.2}, {}", self.sentence);
    }

    pub(crate) fn assert_differ(&self) {
        let bound = self.bound();
        assert!(
            self.worst > bound,
            "a fault was not seen, bound {bound:.2}, {}",
            self.sentence
        );
    }
}

/// The |z| that `cells` normal numbers together exceed with probability 1e-3.
pub(crate) fn z_bound(cells: usize) -> f64 {
    Normal::standard().inverse_cdf(1.0 - 0.5 * sidak_level(1e-3, cells))
}
