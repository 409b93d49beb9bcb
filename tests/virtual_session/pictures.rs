//! What lies in front of the virtual camera: cloth, white panel, even source, checkerboard, color chart.

use super::colors::Patch;
use goniofit::math::Random;
use goniofit::rig::Appearance;
use goniofit::session::{Configuration, FrameKind};
use std::collections::BTreeMap;

/// Spacing of the grain, millimeters.
const GRAIN_MM: f64 = 0.12;
/// Half the side of the cloth, millimeters; around it lies black card.
const CLOTH_HALF_MM: f64 = 9.0;
const GRAIN_CELLS: usize = 160;

/// Everything there is to photograph.
pub struct Scene {
    pub cloth: Cloth,
    pub panel: Panel,
    pub board: Board,
    pub chart: Chart,
    /// Relative change of the even source per millimeter.
    pub flat_gradient: [f64; 2],
}

impl Appearance for Scene {
    fn radiance(&self, kind: FrameKind, pose: &Configuration, point: [f64; 2]) -> [f64; 3] {
        match kind {
            FrameKind::White => self.panel.radiance(pose),
            FrameKind::Sample | FrameKind::Reference => self.cloth.radiance(pose, point),
            FrameKind::Flat => {
                let [gx, gy] = self.flat_gradient;
                [1.0 + gx * point[0] + gy * point[1]; 3]
            }
            FrameKind::Board => self.board.radiance(pose, point),
            FrameKind::Chart => self.chart.radiance(pose, point),
            FrameKind::Dark => [0.0; 3],
        }
    }
}

/// A cloth-like picture: slow waves, a weave of 0.4 mm, grain, and glints; darker the more it is turned away, by the law of
/// Lommel and Seeliger.
pub struct Cloth {
    phases: [f64; 4],
    /// Peak to peak of the grain's values on its lattice.
    grain: Vec<f64>,
    /// Places of small spots 20 times as bright as the cloth.
    glints: Vec<[f64; 2]>,
    /// Its brightness in each configuration over that of the law.
    pub levels: BTreeMap<u32, [f64; 3]>,
}

/// Standard deviation of a glint's Gaussian spot, millimeters.
const GLINT_MM: f64 = 0.15;

impl Cloth {
    pub fn new(phases: [f64; 4], grain: f64, glints: usize, seed: u64) -> Self {
        let value = |i: usize| grain * (Random::keyed(&[seed, 12, i as u64]).uniform() - 0.5);
        let mut random = Random::keyed(&[seed, 13]);
        let mut place = || 9.0 * (random.uniform() - 0.5);
        let grain = match grain > 0.0 {
            true => (0..GRAIN_CELLS * GRAIN_CELLS).map(value).collect(),
            false => Vec::new(),
        };
        Self {
            phases,
            grain,
            glints: (0..glints).map(|_| [place(), place()]).collect(),
            levels: BTreeMap::new(),
        }
    }

    /// Smooth between the values on the lattice, so that its mean can be known.
    fn grain_at(&self, point: [f64; 2]) -> f64 {
        if self.grain.is_empty() {
            return 0.0;
        }
        let [(x, u), (y, v)] = point.map(|p| {
            let at = p / GRAIN_MM + 0.5 * GRAIN_CELLS as f64;
            let u = at.fract();
            (at as usize, u * u * (3.0 - 2.0 * u))
        });
        let row = |y: usize| {
            let at = &self.grain[y * GRAIN_CELLS + x..];
            at[0] + u * (at[1] - at[0])
        };
        row(y) + v * (row(y + 1) - row(y))
    }

    fn glint_at(&self, [x, y]: [f64; 2]) -> f64 {
        let square = |g: &[f64; 2]| (x - g[0]).powi(2) + (y - g[1]).powi(2);
        let spots = self.glints.iter().map(square);
        let near = spots.filter(|d| *d < 25.0 * GLINT_MM * GLINT_MM);
        near.map(|d| 20.0 * (-0.5 * d / (GLINT_MM * GLINT_MM)).exp())
            .sum()
    }

    fn radiance(&self, pose: &Configuration, point: [f64; 2]) -> [f64; 3] {
        let inside = point.iter().all(|p| p.abs() < CLOTH_HALF_MM);
        let level = self.levels.get(&pose.id).unwrap_or(&[1.0; 3]);
        let law = lommel_seeliger(pose);
        if !inside {
            return level.map(|l| 0.1 * law * l);
        }
        let texture = self.texture(point);
        [0, 1, 2].map(|c| law * level[c] * texture[c])
    }

    fn texture(&self, point: [f64; 2]) -> [f64; 3] {
        let [x, y] = point;
        let waves = 0.1 * (0.9 * x + self.phases[0]).sin() + 0.1 * (1.3 * y + self.phases[1]).sin();
        let weave = 0.2 * ((15.7 * x + self.phases[2]).sin() * (15.7 * y + self.phases[3]).sin());
        let detail = weave + self.grain_at(point) + self.glint_at(point);
        [1.0, 0.8, 1.2].map(|color| 1.0 + waves + color * detail)
    }
}

/// `2 cos(theta_L) / (cos(theta_L) + cos(theta_C))`.
pub fn lommel_seeliger(pose: &Configuration) -> f64 {
    let (light, camera) = (pose.light.theta.cos(), pose.camera.theta.cos());
    2.0 * light / (light + camera)
}

/// A white panel that is not Lambertian: its reflectance factor is `factor` at `reference` and goes with the angles as
/// those of sintered panels do, from 0.88 to 1.06 of a perfect diffuser.
pub struct Panel {
    pub factor: [f64; 3],
    pub reference: Configuration,
}

impl Panel {
    fn shape(pose: &Configuration) -> f64 {
        let (sin_l, cos_l) = pose.light.theta.sin_cos();
        let (sin_c, cos_c) = pose.camera.theta.sin_cos();
        let azimuth = (pose.light.phi - pose.camera.phi).cos();
        1.05 - 0.14 * (1.0 - cos_l * cos_c) - 0.1 * sin_l * sin_c * azimuth
    }

    /// Its true reflectance factor.
    pub fn reflectance_factor(&self, pose: &Configuration) -> [f64; 3] {
        let ratio = Self::shape(pose) / Self::shape(&self.reference);
        self.factor.map(|f| f * ratio)
    }

    fn radiance(&self, pose: &Configuration) -> [f64; 3] {
        let cosine = pose.light.theta.cos();
        self.reflectance_factor(pose).map(|f| f * cosine)
    }
}

/// A checkerboard with its middle at the sample center and a white margin around it.
#[derive(Clone, Copy)]
pub struct Board {
    pub columns: usize,
    pub rows: usize,
    pub square_mm: f64,
}

impl Board {
    fn radiance(&self, pose: &Configuration, [x, y]: [f64; 2]) -> [f64; 3] {
        let column = (x / self.square_mm + 0.5 * self.columns as f64).floor();
        let row = (y / self.square_mm + 0.5 * self.rows as f64).floor();
        let inside =
            (0.0..self.columns as f64).contains(&column) && (0.0..self.rows as f64).contains(&row);
        let black = inside && (column + row) as i64 % 2 == 0;
        [pose.light.theta.cos() * if black { 0.06 } else { 0.8 }; 3]
    }
}

/// Square patches in a grid of 6 x 4 on a dark ground, row by row from the corner (-x, -y).
pub struct Chart {
    pub patches: Vec<Patch>,
    pub patch_mm: f64,
    pub pitch_mm: f64,
}

impl Chart {
    pub const COLUMNS: usize = 6;
    pub const ROWS: usize = 4;

    /// Where the middle of a patch lies, millimeters.
    pub fn center_mm(&self, patch: usize) -> [f64; 2] {
        let at = |i: usize, n: usize| (i as f64 - 0.5 * (n as f64 - 1.0)) * self.pitch_mm;
        [
            at(patch % Self::COLUMNS, Self::COLUMNS),
            at(patch / Self::COLUMNS, Self::ROWS),
        ]
    }

    fn radiance(&self, pose: &Configuration, [x, y]: [f64; 2]) -> [f64; 3] {
        let cosine = pose.light.theta.cos();
        let on = |patch: &usize| {
            let [u, v] = self.center_mm(*patch);
            (x - u).abs().max((y - v).abs()) < 0.5 * self.patch_mm
        };
        let found = (0..self.patches.len()).find(on);
        found.map_or([0.03 * cosine; 3], |i| {
            self.patches[i].camera.map(|m| m * cosine)
        })
    }
}
