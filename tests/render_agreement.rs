//! The fast integrator against the reference integrator, which shares no line of how a path is followed: means and all
//! derivatives, by z-test, over cloths, plates, views and poses.
//!
//! The light is wide, so that paths that carry light are not rare and batch means give honest errors. Family-wise level 1e-3 in each
//! test (Sidak); what a test can see is its bound (4.5 to 5) times the standard errors of both sides.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

#[path = "common/render_scenes.rs"]
mod render_scenes;

use goniofit::render::{Effort, FiberSceneOptions, Integrator, Plate, View};
use goniofit::session::Configuration;
use render_scenes::{
    GABARDINE, SOFT, Scores, Subject, WIDE, felt, parameters, pile, pose, seed, twill,
};

/// Mirror, back, crosswise, grazing in plane, grazing crosswise; the second and the last share their camera with others.
fn poses() -> Vec<Configuration> {
    vec![
        pose(1, [32.0, 180.0], [32.0, 0.0]),
        pose(2, [64.0, 0.0], [48.0, 20.0]),
        pose(3, [40.0, 270.0], [48.0, 20.0]),
        pose(4, [75.0, 180.0], [80.0, 0.0]),
        pose(5, [70.0, 90.0], [80.0, 0.0]),
    ]
}

fn options(plate: Plate) -> FiberSceneOptions {
    FiberSceneOptions {
        light: WIDE,
        plate,
        ..FiberSceneOptions::default()
    }
}

const WHITE: Plate = Plate::Diffuse([0.9, 0.6, 0.3]);

/// Both integrators over the poses, with the same number of paths.
fn compare(what: &str, subject: &Subject<'_>, poses: &[Configuration], paths: u64) -> Scores {
    let [fast, basic] = [Integrator::Fast, Integrator::Basic]
        .map(|i| subject.render(i, poses, Effort::Paths(paths), seed(11)));
    let mut scores = Scores::default();
    scores.compare(what, &fast, &basic);
    println!("{}", scores.sentence);
    scores
}

#[test]
fn on_every_cloth_above_every_plate() {
    let cloths = [
        ("twill", twill()),
        ("felt", felt(60, 0.2)),
        ("pile", pile(60)),
    ];
    for (name, tile) in &cloths {
        for (plate, material) in [
            (Plate::Black, GABARDINE),
            (Plate::Open, SOFT),
            (WHITE, SOFT),
        ] {
            let subject = Subject {
                tile,
                options: options(plate),
                parameters: parameters(material),
            };
            let scores = compare(&format!("{name} {plate:?}"), &subject, &poses(), 50_000);
            scores.assert_agree();
        }
    }
}

#[test]
fn through_a_pinhole_and_lit_from_below() {
    let tile = felt(60, 0.2);
    let subject = |plate: Plate| Subject {
        tile: &tile,
        options: FiberSceneOptions {
            // So near that the sample fills 53 degrees.
            view: View::Pinhole { distance: 10.0 },
            ..options(plate)
        },
        parameters: parameters(SOFT),
    };
    let near = [
        pose(1, [32.0, 180.0], [10.0, 0.0]),
        pose(2, [50.0, 90.0], [45.0, 30.0]),
    ];
    compare("pinhole", &subject(WHITE), &near, 100_000).assert_agree();

    let below = [
        pose(1, [180.0, 0.0], [0.0, 0.0]),
        pose(2, [130.0, 40.0], [30.0, 0.0]),
        pose(3, [95.0, 180.0], [80.0, 0.0]),
    ];
    let open = Subject {
        options: options(Plate::Open),
        ..subject(Plate::Open)
    };
    compare("from below", &open, &below, 100_000).assert_agree();
    // Negative control: a black plate shuts that light out.
    let black = Subject {
        options: options(Plate::Black),
        ..subject(Plate::Black)
    };
    let mut scores = Scores::default();
    let ask = |s: &Subject<'_>, i| s.render(i, &below[1..2], Effort::Paths(30_000), seed(12));
    scores.compare(
        "shut",
        &ask(&open, Integrator::Fast),
        &ask(&black, Integrator::Basic),
    );
    scores.assert_differ();
}

/// Negative control of the whole file, and what 100,000 paths of each integrator can see.
#[test]
fn small_faults_are_seen() {
    let tile = felt(60, 0.2);
    let subject = |plate, material| Subject {
        tile: &tile,
        options: options(plate),
        parameters: parameters(material),
    };
    let scaled = |places: std::ops::Range<usize>, by: f64| {
        let mut changed = SOFT;
        places.for_each(|i| changed[i] *= by);
        subject(WHITE, changed)
    };
    let ask = |s: &Subject<'_>, i| s.render(i, &poses(), Effort::Paths(100_000), seed(13));
    let right = ask(&subject(WHITE, SOFT), Integrator::Fast);
    let wrong = [
        (
            "plate 5 % darker",
            subject(Plate::Diffuse([0.855, 0.57, 0.285]), SOFT),
        ),
        ("no plate", subject(Plate::Black, SOFT)),
        ("c_r up by 30 %", scaled(0..3, 1.3)),
        ("c_tt up by 3 %", scaled(3..6, 1.03)),
        ("beta_r up by 30 %", scaled(6..7, 1.3)),
        ("beta_tt up by 10 %", scaled(7..8, 1.1)),
        ("gamma_tt up by 3 %", scaled(8..9, 1.03)),
    ];
    for (what, wrong) in wrong {
        let mut scores = Scores::default();
        scores.compare(what, &right, &ask(&wrong, Integrator::Basic));
        println!("{}", scores.sentence);
        scores.assert_differ();
    }
}
