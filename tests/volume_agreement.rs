//! Volumes: the fast tracker (voxel by voxel, exact transmittance, shared paths) against the reference (null collisions), which
//! shares no line of how a path is followed: means and all derivatives, by z-test, over media, plates and poses.
//!
//! The light is wide, so that paths that carry light are not rare and batch means give honest errors. Family-wise level 1e-3 in each
//! test (Sidak); what a test can see is its bound (4.5 to 5) times the standard errors of both sides.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

#[path = "common/render_scenes.rs"]
mod render_scenes;
#[path = "common/volumes.rs"]
mod volumes;

use goniofit::render::{Effort, FiberSceneOptions, Integrator, Plate, View};
use goniofit::session::Configuration;
use render_scenes::{Scores, WIDE, felt, pose, seed};
use volumes::{
    Volume, numbers, random_voxels, silk_volume, soft_volume, thin_flakes, voxelized, wide_flakes,
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

fn compare(what: &str, a: &Volume<'_>, b: &Volume<'_>, at: &[Configuration], paths: u64) -> Scores {
    let fast = a.render(Integrator::Fast, at, Effort::Paths(paths), seed(21));
    let basic = b.render(Integrator::Basic, at, Effort::Paths(paths), seed(22));
    let mut scores = Scores::default();
    for (x, y) in fast.iter().zip(&basic) {
        let pairs = numbers(x, a.medium.0)
            .into_iter()
            .zip(numbers(y, b.medium.0));
        for ((name, x_mean, x_se), (_, y_mean, y_se)) in pairs {
            let what = format!("{what}, pose {}, {name}", x.config);
            scores.add(&what, (x_mean, x_se), (y_mean, y_se));
        }
    }
    println!(
        "{} of bound {:.2}: {}",
        scores.worst,
        scores.bound(),
        scores.sentence
    );
    scores
}

#[test]
fn in_every_medium_above_every_plate() {
    let random = random_voxels();
    let strands = voxelized(&felt(60, 0.2), 0.05);
    for (name, tile, density, plate, medium) in [
        ("random", &random, 40.0, Plate::Black, wide_flakes()),
        ("random", &random, 40.0, WHITE, silk_volume()),
        ("random", &random, 40.0, WHITE, thin_flakes()),
        ("strands", &strands, 60.0, Plate::Open, soft_volume()),
        ("strands", &strands, 60.0, WHITE, wide_flakes()),
    ] {
        let volume = Volume {
            tile,
            density,
            options: options(plate),
            medium,
        };
        let what = format!("{name} {plate:?} {}", volume.medium.0.name());
        compare(&what, &volume, &volume, &poses(), 12_000).assert_agree();
    }
}

#[test]
fn through_a_pinhole_and_lit_from_below() {
    let tile = random_voxels();
    let volume = |plate, view| Volume {
        tile: &tile,
        density: 40.0,
        options: FiberSceneOptions {
            view,
            ..options(plate)
        },
        medium: wide_flakes(),
    };
    let near = [
        pose(1, [32.0, 180.0], [10.0, 0.0]),
        pose(2, [50.0, 90.0], [45.0, 30.0]),
    ];
    // So near that the sample fills 53 degrees.
    let pinhole = volume(WHITE, View::Pinhole { distance: 10.0 });
    compare("pinhole", &pinhole, &pinhole, &near, 40_000).assert_agree();

    let below = [
        pose(1, [180.0, 0.0], [0.0, 0.0]),
        pose(2, [130.0, 40.0], [30.0, 0.0]),
        pose(3, [95.0, 180.0], [80.0, 0.0]),
    ];
    let open = volume(Plate::Open, View::Orthographic);
    compare("from below", &open, &open, &below, 40_000).assert_agree();
    // Negative control: a black plate shuts that light out.
    let shut = volume(Plate::Black, View::Orthographic);
    compare("shut", &open, &shut, &below[1..2], 20_000).assert_differ();
}

/// Negative control of the whole file, and what 40,000 paths of each tracker can see.
#[test]
fn small_faults_are_seen() {
    let tile = random_voxels();
    let volume = |density: f64, by: [f64; 3]| {
        let (model, right) = wide_flakes();
        let mut values = right.values().to_vec();
        values[..3].iter_mut().for_each(|albedo| *albedo *= by[0]);
        values[3] *= by[1];
        values[4] *= by[2];
        Volume {
            tile: &tile,
            density,
            options: options(WHITE),
            medium: (model, right.with_values(values)),
        }
    };
    let right = volume(40.0, [1.0; 3]);
    for (what, wrong) in [
        ("albedo down by 3 %", volume(40.0, [0.97, 1.0, 1.0])),
        ("gamma up by 50 %", volume(40.0, [1.0, 1.5, 1.0])),
        ("density up by 4 %", volume(40.0, [1.0, 1.0, 1.04])),
        ("density of the volume up by 4 %", volume(41.6, [1.0; 3])),
    ] {
        compare(what, &right, &wrong, &poses(), 40_000).assert_differ();
    }
}
