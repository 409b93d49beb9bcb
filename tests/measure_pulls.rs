//! Promise: the stated standard errors are right. Over many sessions of the virtual camera, (measured - truth) / stated
//! standard error has mean 0 and standard deviation 1.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

mod virtual_session;

use virtual_session::Setup;
use virtual_session::pulls::{pulls, seed, verdict};

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
