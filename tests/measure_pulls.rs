//! Promise: the stated standard errors are right. Over many sessions of the virtual camera, (measured - truth) / stated
//! standard error has mean 0 and standard deviation 1.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

mod virtual_session;

use goniofit::base::Unwatched;
use goniofit::math::statistics::{Running, sidak_level};
use goniofit::measure::{MeasureOptions, measure_session};
use statrs::distribution::{ContinuousCDF, Normal, StudentsT};
use virtual_session::{Setup, folder, record};

fn seed(default: u64) -> u64 {
    std::env::var("SEED").map_or(default, |s| s.parse().unwrap())
}

/// The pulls of every session: one list of 3 x configurations each.
fn pulls(n_sessions: u64, setup: impl Fn(u64) -> Setup) -> Vec<Vec<f64>> {
    (0..n_sessions)
        .map(|i| {
            let setup = setup(i);
            let folder = folder();
            let session = record(folder.path(), &setup);
            let (measured, report) =
                measure_session(&session, &MeasureOptions::default(), &Unwatched).unwrap();
            assert_eq!(measured.intensities.len(), setup.poses.len(), "{report:?}");
            let pairs = measured.intensities.iter().zip(&setup.poses);
            pairs
                .flat_map(|(m, &(_, _, truth))| {
                    (0..3).map(move |c| (m.mean[c] - truth[c]) / m.standard_error[c])
                })
                .collect()
        })
        .collect()
}

/// What is wrong with the pulls, if anything, at a family-wise level of 1e-3.
///
/// Pulls of one session share the white standard, so sessions are the independent unit: the session means of pull and of
/// pull^2 are tested against 0 and 1 by Student's t, and so is the mean pull of each cell over the sessions.
fn verdict(pulls: &[Vec<f64>]) -> Result<String, String> {
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

#[test]
fn stated_errors_are_right_and_a_wrong_black_level_is_caught() {
    // 60 sessions of 12 pulls see standard errors that are off by 15 %, and a bias of 0.3 standard errors.
    let seed = seed(20_260_401);
    let good = verdict(&pulls(60, |i| Setup::new(seed + i)));
    println!("{good:?}");
    assert!(good.is_ok(), "{good:?}");
    // Negative control: darks whose black level is wrong by two raw values of 4095.
    let bad = verdict(&pulls(20, |i| {
        let mut setup = Setup::new(seed + 1000 + i);
        for black in &mut setup.dark_sensor.black {
            *black += 2.0;
        }
        setup
    }));
    println!("{bad:?}");
    assert!(bad.is_err(), "a wrong black level passed: {bad:?}");
}

#[test]
fn stated_errors_are_right_without_texture_and_with_repeats() {
    let seed = seed(20_260_402);
    let good = verdict(&pulls(40, |i| Setup {
        grain: 0.0,
        exposures_ms: vec![16.0],
        sample_repeats: 2,
        white_se: 0.0,
        dark_repeats: 2,
        ..Setup::new(seed + i)
    }));
    println!("{good:?}");
    assert!(good.is_ok(), "{good:?}");
}
