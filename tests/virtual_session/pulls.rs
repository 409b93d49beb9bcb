//! Whether stated errors are right: (measured - truth) / stated standard error over many sessions.

use super::{Setup, TRUE_WHITE, folder, record};
use goniofit::base::Unwatched;
use goniofit::math::statistics::{Running, sidak_level};
use goniofit::measure::{Budget, MeasureOptions, measure_session};
use rayon::prelude::*;
use statrs::distribution::{ContinuousCDF, Normal, StudentsT};

pub fn seed(default: u64) -> u64 {
    std::env::var("SEED").map_or(default, |s| s.parse().unwrap())
}

/// One channel of one configuration, measured.
pub struct Cell {
    pub truth: f64,
    /// (Measured - truth) / truth.
    pub error: f64,
    /// The same, less the part of it that comes from the certificate of the white standard, which is known here.
    pub own_error: f64,
    pub budget: Budget,
}

impl Cell {
    pub fn pull(&self) -> f64 {
        self.error * self.truth / self.budget.total()
    }

    /// The part of the budget that is largest.
    pub fn dominated_by(&self) -> &'static str {
        let parts = self.budget.parts().into_iter();
        parts.max_by(|a, b| a.1.total_cmp(&b.1)).unwrap().0
    }

    /// Shot, read and dark noise are below 0.2 % of the mean.
    pub fn is_well_lit(&self) -> bool {
        let b = &self.budget;
        let noise = b.shot.hypot(b.read).hypot(b.dark);
        noise < 0.002 * self.truth
    }
}

/// Records one session and measures it: 3 x configurations.
pub fn cells(setup: &Setup, options: &MeasureOptions) -> Vec<Cell> {
    let folder = folder();
    let session = record(folder.path(), setup);
    let (measured, report) = measure_session(&session, options, &Unwatched).unwrap();
    assert_eq!(measured.intensities.len(), setup.poses.len(), "{report:?}");
    let stated = setup.stated_white().reflectance_factor;
    let found = measured.intensities.iter().zip(&report.configurations);
    let found = found.zip(&setup.poses);
    found
        .flat_map(|((m, report), &(_, _, truth))| {
            (0..3).map(move |c| Cell {
                truth: truth[c],
                error: m.mean[c] / truth[c] - 1.0,
                own_error: m.mean[c] / truth[c] - stated[c] / TRUE_WHITE[c],
                budget: report.budget[c],
            })
        })
        .collect()
}

/// The pulls of every session: one list of 3 x configurations each.
pub fn pulls(n_sessions: u64, setup: impl Fn(u64) -> Setup + Sync) -> Vec<Vec<f64>> {
    (0..n_sessions)
        .into_par_iter()
        .map(|i| {
            let found = cells(&setup(i), &MeasureOptions::default());
            found.iter().map(Cell::pull).collect()
        })
        .collect()
}

/// What is wrong with the pulls, if anything, at a family-wise level of 1e-3.
///
/// Pulls of one session share the white standard, so sessions are the independent unit: the session means of pull and of
/// pull^2 are tested against 0 and 1 by Student's t, and so is the mean pull of each cell over the sessions.
pub fn verdict(pulls: &[Vec<f64>]) -> Result<String, String> {
    let cells = pulls[0].len();
    let level = sidak_level(1e-3, cells + 2);
    let n = pulls.len() as f64;
    let t_limit = StudentsT::new(0.0, 1.0, n - 1.0)
        .unwrap()
        .inverse_cdf(1.0 - 0.5 * level);
    let normal_limit = Normal::standard().inverse_cdf(1.0 - 0.5 * level);
    let (mut mean, mut square) = (Running::default(), Running::default());
    for session in pulls {
        mean.push(session.iter().sum::<f64>() / cells as f64);
        square.push(session.iter().map(|p| p * p).sum::<f64>() / cells as f64);
    }
    let text = format!(
        "mean pull {:.3} +- {:.3}, mean square pull {:.3} +- {:.3}, n = {n} sessions",
        mean.mean(),
        mean.standard_error(),
        square.mean(),
        square.standard_error()
    );
    let unbiased = mean.mean().abs() < t_limit * mean.standard_error();
    let honest = (square.mean() - 1.0).abs() < t_limit * square.standard_error();
    if !unbiased {
        return Err(format!("biased: {text}"));
    }
    if !honest {
        return Err(format!("wrong standard errors: {text}"));
    }
    for cell in 0..cells {
        let mean = pulls.iter().map(|p| p[cell]).sum::<f64>() / n;
        let centered = mean.abs() * n.sqrt() < normal_limit;
        if !centered {
            return Err(format!("cell {cell}: mean pull {mean:.3}; {text}"));
        }
    }
    Ok(text)
}
