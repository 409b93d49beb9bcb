//! Directions of made volumes by every method.

use super::settings::Settings;
use super::*;
use crate::base::Unwatched;
use crate::fabric::PackedDirection;
use glam::DVec3;

/// Fibers of 3 voxels in diameter along a direction, 8 voxels apart.
fn fibers(shape: [usize; 3], along: DVec3, periodic: bool) -> Gray {
    let (u, v) = along.any_orthonormal_pair();
    let wave = |x: f64| 2.0 * (x / 8.0 - (x / 8.0).round()) * 4.0;
    let mut values = Vec::new();
    for k in 0..shape[2] {
        for j in 0..shape[1] {
            for i in 0..shape[0] {
                let p = DVec3::new(i as f64, j as f64, k as f64);
                let r = wave(p.dot(u)).hypot(wave(p.dot(v)));
                values.push((2.2 - r).clamp(0.0, 1.0) as f32);
            }
        }
    }
    Gray {
        shape,
        side: 0.005,
        bottom: 0.0,
        values,
        periodic,
    }
}

fn errors(gray: &Gray, along: DVec3, options: &Orienting) -> Vec<f64> {
    let (tile, _) = orient(gray.clone(), options, &Unwatched).unwrap();
    let kept = (0..gray.values.len()).filter(|p| tile.density()[*p] > 0.0);
    let angle = |p| {
        tile.direction(p)
            .dot(along)
            .abs()
            .min(1.0)
            .acos()
            .to_degrees()
    };
    let mut list: Vec<f64> = kept.map(angle).collect();
    list.sort_by(f64::total_cmp);
    list
}

#[test]
fn straight_fibers_are_found_up_to_the_borders_by_every_method() {
    // 1 degree for the tensor sees borders taken as air; the filter, whose lines also fit across fibers, is within 30 for half
    // of the voxels.
    for (method, exact, most) in [
        (Method::Tensor, false, 1.0),
        (Method::Filter, true, 30.0),
        (Method::Filter, false, 30.0),
        (Method::Line, false, 30.0),
    ] {
        for along in [DVec3::X, DVec3::new(1.0, 2.0, -0.7).normalize()] {
            let gray = fibers([24, 20, 20], along, false);
            let options = Orienting {
                exact,
                eps_d: Some(0.5),
                ..Orienting::new(method)
            };
            let list = errors(&gray, along, &options);
            let at = |share: f64| list[(share * (list.len() - 1) as f64) as usize];
            let bound = if method == Method::Tensor {
                at(1.0)
            } else {
                at(0.5)
            };
            assert!(
                bound < most,
                "{method:?} {exact} {along}: {bound} {}",
                at(0.9)
            );
            // The control: another direction is not within the bound.
            let wrong = errors(&gray, along.any_orthonormal_vector(), &options);
            assert!(wrong[wrong.len() / 2] > 45.0);
        }
    }
}

#[test]
fn boxes_and_threads_do_not_matter() {
    let gray = fibers([30, 26, 22], DVec3::new(0.3, 1.0, 0.2).normalize(), true);
    for (method, block) in [
        (Method::Tensor, [7, 30, 9]),
        (Method::Filter, [32, 5, 3]),
        (Method::Line, [32, 26, 1]),
    ] {
        let options = Orienting {
            filter: Some(Filter {
                s: 1.0,
                t: 2.0,
                h: 7,
            }),
            eps_j: Some(-30.0),
            ..Orienting::new(method)
        };
        let settings = Settings::new(&gray, &options).unwrap();
        let usual = settings.scores(&gray, None, &Unwatched).unwrap();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(3).build();
        let other = pool
            .unwrap()
            .install(|| settings.scores(&gray, Some(block), &Unwatched).unwrap());
        assert_eq!(usual, other, "{method:?}");
    }
}

#[test]
fn a_periodic_volume_has_no_seam() {
    // Moving the volume round the seam moves the result with it.
    let gray = fibers([32, 16, 24], DVec3::new(0.0, 1.0, 0.0), true);
    let mut moved = gray.clone();
    for row in moved.values.chunks_mut(32) {
        row.rotate_right(11);
    }
    let options = Orienting::new(Method::Tensor);
    let (a, _) = orient(gray, &options, &Unwatched).unwrap();
    let (b, _) = orient(moved, &options, &Unwatched).unwrap();
    for (k, d) in a.density().iter().enumerate() {
        let other = k - k % 32 + (k % 32 + 11) % 32;
        assert!((d - b.density()[other]).abs() < 1e-6);
        let cos = a.direction(k).dot(b.direction(other)).abs();
        assert!(*d == 0.0 || cos > 1.0 - 1e-6);
    }
}

#[test]
fn coarse_to_fine_finds_what_trying_all_finds() {
    // Of fibers along many directions at least 93 % of voxels must agree; the control is one direction for all.
    let (mut same, mut all, mut shifted) = (0, 0, 0);
    for along in [
        DVec3::new(1.0, 0.1, 0.3),
        DVec3::new(0.4, 1.0, -0.2),
        DVec3::new(-0.5, 0.6, 1.0),
    ] {
        let gray = fibers([20, 18, 16], along.normalize(), false);
        let mut options = Orienting::new(Method::Filter);
        options.eps_d = Some(0.5);
        let scores = |exact: bool| {
            let options = Orienting {
                exact,
                ..options.clone()
            };
            let settings = Settings::new(&gray, &options).unwrap();
            settings.scores(&gray, None, &Unwatched).unwrap()
        };
        let (fast, exact) = (scores(false), scores(true));
        let first = exact
            .direction
            .iter()
            .find(|d| **d != PackedDirection::default());
        for place in (0..gray.values.len()).filter(|p| exact.confidence[*p] >= 0.0) {
            all += 1;
            same += usize::from(fast.direction[place] == exact.direction[place]);
            shifted += usize::from(Some(&exact.direction[place]) == first);
            assert!(fast.fit[place] <= exact.fit[place] + 1e-3);
        }
    }
    assert!(same as f64 >= 0.93 * all as f64, "{same} of {all}");
    assert!((shifted as f64) < 0.93 * all as f64);
}

#[test]
fn thresholds_that_leave_nothing_are_answered_with_one_that_does() {
    let gray = fibers([16, 16, 16], DVec3::new(1.0, 0.4, 0.2).normalize(), false);
    let fails = |change: &dyn Fn(&mut Orienting)| {
        let mut options = Orienting::new(Method::Tensor);
        change(&mut options);
        let done = orient(gray.clone(), &options, &Unwatched);
        done.map(|d| d.1).unwrap_err().report()
    };
    let found = fails(&|o| o.eps_d = Some(2.0));
    assert!(
        found.contains("no voxel reaches eps_d = 2: the largest is 1\nhint: Otsu"),
        "{found}"
    );
    let found = fails(&|o| o.eps_j = Some(0.0));
    assert!(
        found.contains("eps_j = 0 drops all") && found.contains("keeps 95 %"),
        "{found}"
    );
    assert!(fails(&|o| o.least_confidence = 0.999_999_9).contains("keeps 95 %"));
    assert!(fails(&|o| o.eps_j = Some(1.0)).contains("at most 0"));
    assert!(fails(&|o| o.eps_d = Some(-1.0)).contains("above 0"));
    assert!(fails(&|o| o.drop_share = 1.0).contains("less than 1"));
    assert!(fails(&|o| o.fiber_radius = Some(8.0)).contains("micrometers"));
    let mut flat = gray.clone();
    flat.values.fill(0.25);
    let error = orient(flat, &Orienting::new(Method::Tensor), &Unwatched).map(|d| d.1);
    assert!(error.unwrap_err().report().contains("every voxel is 0.25"));
    // A share to drop is dropped, and what is suggested keeps what it says.
    let mut options = Orienting::new(Method::Filter);
    options.drop_share = 0.3;
    let (_, report) = orient(gray, &options, &Unwatched).unwrap();
    let dropped = report.dropped_by_confidence as f64 / report.solid as f64;
    assert!(dropped <= 0.3 + 1e-3, "{dropped}");
}
