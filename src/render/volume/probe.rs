//! What flights through voxels cost, for benches: voxel by voxel, and with null collisions under a majorant for each brick.

use super::VolumeScene;
use super::extinction::Extinction;
use super::grid::End;
use crate::base::Result;
use crate::math::Random;
use crate::render::estimate::cpu_seconds;
use crate::scatter::Parameters;
use glam::DVec3;
use std::f64::consts::TAU;

/// The cost of flights to the next collision, from collisions of camera rays in uniform directions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FlightSpeed {
    /// Nanoseconds of one flight, voxel by voxel.
    pub exact_ns: f64,
    /// Voxels it goes through that hold anything.
    pub exact_voxels: f64,
    /// Nanoseconds with null collisions.
    pub null_ns: f64,
    /// Voxels that are looked up.
    pub null_voxels: f64,
    /// Shares of the flights that end in a collision, which must agree.
    pub met: [f64; 2],
}

impl FlightSpeed {
    /// In words, one line for each way.
    pub fn lines(&self) -> [String; 2] {
        let line = |way: &str, ns: f64, voxels: f64, met: f64| {
            let each = ns / voxels;
            format!("{way}: {ns:.0} ns, {voxels:.2} voxels, {each:.1} ns each, {met:.3} collide")
        };
        [
            line(
                "voxel by voxel",
                self.exact_ns,
                self.exact_voxels,
                self.met[0],
            ),
            line(
                "null collisions",
                self.null_ns,
                self.null_voxels,
                self.met[1],
            ),
        ]
    }
}

impl VolumeScene {
    /// Times `n` flights of each kind.
    ///
    /// # Errors
    /// When the parameters have no meaning for the model.
    pub fn flight_speed(
        &self,
        parameters: &Parameters,
        n: usize,
        seed: u64,
    ) -> Result<FlightSpeed> {
        let medium = self.model.prepare(parameters)?;
        let extinction = Extinction::new(&*medium);
        let with = (&extinction, self.density);
        let mut random = Random::keyed(&[seed, 0xf119]);
        let rays = self.rays(with, n, &mut random);
        let budgets: Vec<f64> = (0..rays.len())
            .map(|_| -random.uniform_open().ln())
            .collect();

        let begun = cpu_seconds();
        let mut met = [0.0; 2];
        for ((origin, direction), budget) in rays.iter().zip(&budgets) {
            let flight = self.grid.fly(with, *origin, *direction, *budget);
            met[0] += f64::from(u8::from(matches!(flight.end, End::Met { .. })));
        }
        let exact = cpu_seconds() - begun;

        let majorants = self.grid.brick_majorants(self.density * medium.majorant());
        let begun = cpu_seconds();
        let mut looked_up = 0;
        for (origin, direction) in &rays {
            let ended = self
                .grid
                .fly_null(with, &majorants, *origin, *direction, &mut random);
            met[1] += f64::from(u8::from(ended.0));
            looked_up += ended.1;
        }
        let null = cpu_seconds() - begun;

        let through: usize = rays
            .iter()
            .zip(&budgets)
            .map(|((o, d), budget)| self.grid.count(with, *o, *d, *budget))
            .sum();
        let each = 1.0 / rays.len() as f64;
        Ok(FlightSpeed {
            exact_ns: 1e9 * exact * each,
            exact_voxels: through as f64 * each,
            null_ns: 1e9 * null * each,
            null_voxels: looked_up as f64 * each,
            met: met.map(|m| m * each),
        })
    }

    /// From where camera rays collide, in uniform directions.
    fn rays(&self, with: (&Extinction, f64), n: usize, random: &mut Random) -> Vec<(DVec3, DVec3)> {
        let top = self.grid.z_range()[1];
        let mut rays = Vec::with_capacity(n);
        for _ in 0..n {
            let tilt = random.uniform();
            let down = DVec3::new(tilt, 0.3, -1.0).normalize();
            let from = self.options.start(random) + DVec3::new(0.0, 0.0, top);
            let budget = -random.uniform_open().ln();
            if let End::Met { distance, .. } = self.grid.fly(with, from, down, budget).end {
                let (z, turn) = (2.0 * random.uniform() - 1.0, TAU * random.uniform());
                let r = (1.0 - z * z).max(0.0).sqrt();
                let away = DVec3::new(r * turn.cos(), r * turn.sin(), z);
                rays.push((from + down * distance, away));
            }
        }
        rays
    }
}
