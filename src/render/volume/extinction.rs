//! A medium's extinction as a table over the sine to the fiber, for the walk through voxels.

use crate::scatter::MAX_ROWS;
use crate::scatter::media::Medium;
use glam::DVec3;

/// Pieces of the table; linear in between. The flakes' extinction at gamma 0.005, the most curved of the published ones, is off by
/// 8e-7 along the fiber, where it is 0.004.
const PIECES: usize = 4096;

/// `e` and those of its derivatives that are not zero, as functions of the sine of the angle to the fiber.
///
/// The media are surfaces of revolution about the fiber and the same on both sides, so the sine is all that matters.
pub(super) struct Extinction {
    /// The rows that have a slope.
    rows: Vec<usize>,
    /// Per point of the table: `e`, then the derivative by each of `rows`.
    table: Vec<f32>,
}

/// One value per row of the model's parameters.
pub(super) type Scores = [f64; MAX_ROWS];

impl Extinction {
    pub(super) fn new(medium: &dyn Medium) -> Self {
        let at = |k: usize| {
            let sine = (k as f64 / PIECES as f64).min(1.0);
            DVec3::new((1.0 - sine * sine).max(0.0).sqrt(), sine, 0.0)
        };
        let slopes: Vec<Scores> = (0..=PIECES)
            .map(|k| medium.extinction_slopes(at(k)))
            .collect();
        let moves = |row: &usize| slopes.iter().any(|s| s[*row] != 0.0);
        let rows: Vec<usize> = (0..MAX_ROWS).filter(moves).collect();
        let table = slopes.iter().enumerate().flat_map(|(k, slopes)| {
            let own = rows.iter().map(|&row| slopes[row]);
            std::iter::once(medium.extinction(at(k)))
                .chain(own)
                .map(|x| x as f32)
                .collect::<Vec<_>>()
        });
        Self {
            table: table.collect(),
            rows,
        }
    }

    /// `e` at this sine, a number in [0, 1] or a little above by rounding.
    #[inline]
    pub(super) fn at(&self, sine: f32) -> f64 {
        let (place, part) = self.place(sine);
        self.between(place, part, 0)
    }

    /// Adds `amount` times the derivatives of `e` at this sine.
    #[inline]
    pub(super) fn add_slopes(&self, sine: f32, amount: f64, to: &mut Scores) {
        if self.rows.is_empty() {
            return;
        }
        let (place, part) = self.place(sine);
        for (k, &row) in self.rows.iter().enumerate() {
            to[row] += amount * self.between(place, part, 1 + k);
        }
    }

    #[inline]
    fn place(&self, sine: f32) -> (usize, f32) {
        let x = sine * PIECES as f32;
        let k = (x as usize).min(PIECES - 1);
        (k * (1 + self.rows.len()), x - k as f32)
    }

    #[inline]
    fn between(&self, place: usize, part: f32, column: usize) -> f64 {
        let low = self.table[place + column];
        let high = self.table[place + column + 1 + self.rows.len()];
        f64::from(low + part * (high - low))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scatter::Parameters;
    use crate::scatter::media::model;

    #[test]
    fn the_table_is_the_medium() {
        // Sees an error of 4e-6 of the largest value, and a row that is lost.
        for (name, rows) in [
            ("microflake", 1),
            ("microflake-density", 2),
            ("khungurn-volume", 0),
            ("khungurn-volume-density", 1),
        ] {
            let model = model(name).unwrap();
            let medium = model.prepare(&Parameters::defaults(model)).unwrap();
            let table = Extinction::new(&*medium);
            assert_eq!(table.rows.len(), rows, "{name}");
            for k in 0..=1000 {
                let sine = f64::from(k) * 1e-3;
                let w = DVec3::new((1.0 - sine * sine).sqrt(), 0.0, sine);
                let error = table.at(sine as f32) - medium.extinction(w);
                assert!(error.abs() < 4e-6, "{name} at {sine}: off by {error:e}");
                let mut slopes = [0.0; MAX_ROWS];
                table.add_slopes(sine as f32, 2.0, &mut slopes);
                for (found, expected) in slopes.iter().zip(medium.extinction_slopes(w)) {
                    let error = found - 2.0 * expected;
                    assert!(
                        error.abs() < 2e-3,
                        "{name} at {sine}: slope off by {error:e}"
                    );
                }
            }
        }
    }
}
