//! Pictures of volumes: their mean is that of the means, their pixels show the voxels that lie there, and the command writes
//! them.
#![allow(clippy::unwrap_used, missing_docs)]

#[path = "common/render_scenes.rs"]
mod render_scenes;
#[path = "common/volumes.rs"]
mod volumes;

use assert_cmd::Command;
use goniofit::base::Unwatched;
use goniofit::render::{
    Effort, FiberSceneOptions, Integrator, Layer, Picture, PictureEffort, PictureRequest, Pictured,
    Plate, Region, VolumeScene,
};
use goniofit::session::Configuration;
use render_scenes::{Scores, WIDE, pose, seed};
use std::fs;
use volumes::{Volume, medium, random_voxels, wide_flakes};

const WHITE: Plate = Plate::Diffuse([0.9, 0.6, 0.3]);

/// The first two share their camera paths.
fn poses() -> Vec<Configuration> {
    vec![
        pose(3, [32.0, 180.0], [32.0, 0.0]),
        pose(1, [50.0, 90.0], [32.0, 0.0]),
        pose(2, [60.0, 0.0], [70.0, 30.0]),
    ]
}

fn volume(tile: &goniofit::fabric::VoxelTile) -> Volume<'_> {
    Volume {
        tile,
        density: 40.0,
        options: FiberSceneOptions {
            light: WIDE,
            plate: WHITE,
            sample_square: 2.0,
            ..FiberSceneOptions::default()
        },
        medium: wide_flakes(),
    }
}

fn pictures(
    scene: &VolumeScene,
    volume: &Volume<'_>,
    region: Region,
    resolution: [usize; 2],
) -> Vec<Picture> {
    let request = PictureRequest {
        configurations: &poses(),
        parameters: &volume.medium.1,
        region,
        resolution,
        effort: PictureEffort::PathsPerPixel(64),
        derivatives: &[0, 1, 2],
        seed: seed(61),
    };
    scene.pictures(&request, &Unwatched).unwrap()
}

fn add(scores: &mut Scores, what: &str, layer: &Layer, mean: [f64; 3], se: [f64; 3], factor: f64) {
    let (found, found_se) = layer.mean();
    for c in 0..3 {
        let found = (factor * found[c], found_se[c]);
        scores.add(&format!("{what} {c}"), found, (mean[c], se[c]));
    }
}

/// Against the reference tracker with null collisions, which shares no line of how a path is followed: 36 numbers. Standard errors are
/// about 1 %, so 6 % off is seen; the control is off by 20 %.
#[test]
fn the_mean_of_a_picture_is_the_mean_and_its_derivatives() {
    let tile = random_voxels();
    let volume = volume(&tile);
    let scene = volume.scene(Integrator::Fast);
    let pictures = pictures(&scene, &volume, scene.sample_square(), [24, 24]);
    let effort = Effort::Paths(20_000);
    let means = volume.render(Integrator::Basic, &poses(), effort, seed(62));
    let scored = |factor: f64| {
        let mut scores = Scores::default();
        for (p, e) in pictures.iter().zip(&means) {
            assert_eq!(p.config, e.config);
            let what = format!("pose {} mean", e.config);
            let (mean, se) = (e.mean, e.standard_error);
            add(&mut scores, &what, &p.radiance, mean, se, factor);
            for (k, layer) in p.derivatives.iter().enumerate() {
                let what = format!("pose {} row {k}", e.config);
                let (mean, se) = (e.derivative[k], e.derivative_se[k]);
                add(&mut scores, &what, layer, mean, se, factor);
            }
        }
        scores
    };
    let right = scored(1.0);
    assert!(right.worst < right.bound(), "{}", right.sentence);
    let wrong = scored(1.2);
    assert!(wrong.worst > wrong.bound(), "{}", wrong.sentence);
}

/// Where the tile is empty the white plate is seen, where it is dense the dark medium: a picture of the tile tells which half is
/// which, and a picture one period away is the same cloth.
#[test]
fn a_pixel_shows_the_voxels_that_lie_there() {
    let mut tile = goniofit::fabric::VoxelTile::empty([8, 4, 2], 0.05, 0.0).unwrap();
    for k in 0..2 {
        for j in 0..4 {
            for i in 4..8 {
                let place = tile.place([i, j, k]);
                tile.set(place, 1.0, glam::DVec3::X).unwrap();
            }
        }
    }
    let volume = Volume {
        density: 400.0,
        medium: medium(
            "microflake-density",
            r#"{"albedo": [0.05, 0.05, 0.05], "gamma": 0.3, "density_scale": 1.0}"#,
        ),
        ..volume(&tile)
    };
    let scene = volume.scene(Integrator::Fast);
    let region = scene.tile();
    assert!((region.size[0] - 0.4).abs() < 1e-12 && (region.center[1] - 0.1).abs() < 1e-12);
    let all = pictures(&scene, &volume, region, [4, 2]);
    let mut away = region;
    away.center[0] += 0.4;
    let moved = pictures(&scene, &volume, away, [4, 2]);
    let red = |p: &Picture, i: usize| p.radiance.value[i][0];
    for row in [0, 4] {
        // Nearest the camera's side of the step there is shadow: compare the middles of the halves.
        let (open, cloth) = (red(&all[0], row), red(&all[0], row + 2));
        assert!(open > 2.0 * cloth, "{open} {cloth}");
        let (open, cloth) = (red(&moved[0], row), red(&moved[0], row + 2));
        assert!(open > 2.0 * cloth, "one tile away: {open} {cloth}");
    }
}

/// The command, from a description of voxels to files; what cannot be is refused.
#[test]
fn the_command_pictures_voxels() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    random_voxels().write(&at("cloth.nrrd")).unwrap();
    let description = "kind = \"voxels\"\nname = \"noise\"\nfile = \"cloth.nrrd\"\n";
    fs::write(at("cloth.toml"), description).unwrap();
    let command = |model: &str| {
        let mut command = Command::cargo_bin("goniofit").unwrap();
        command
            .args(["render", "image", "--fabric"])
            .arg(at("cloth.toml"))
            .args(["--model", model, "--tile", "--size", "13x11"])
            .args(["--paths", "16", "--derivative", "gamma", "--json"])
            .args(["--pose", "light=32,180 camera=32,0"])
            .args(["--pose", "light=60,90 camera=32,0", "--all", "--out"])
            .arg(at("noise"));
        command
    };
    let done = command("microflake").assert().success();
    let summary: serde_json::Value = serde_json::from_slice(&done.get_output().stdout).unwrap();
    assert_eq!(summary["size"], serde_json::json!([13, 11]));
    let names = [
        "noise.png",
        "noise.d_gamma.png",
        "noise.config_01.exr",
        "noise.config_02.d_gamma.exr",
    ];
    for name in names {
        assert!(at(name).metadata().unwrap().len() > 100, "{name}");
    }
    command("khungurn").arg("--force").assert().code(2);
}
