//! Promise: `ct prepare` makes volumes even, flat, aligned, cropped and cubic, as it says, whatever memory it is given.
#![allow(clippy::unwrap_used, clippy::float_cmp, missing_docs)]

#[path = "common/ct_files.rs"]
mod ct_files;

use ct_files::{all, nrrd_f32, open, write};
use goniofit::base::{Result, Unwatched, Watch};
use goniofit::fabric::ct::{Crop, PrepareReport, Preparing, Volume, prepare};
use std::path::Path;

fn nothing(folder: &Path) -> Preparing {
    Preparing {
        equalize: false,
        flatten: false,
        level: false,
        weft: 0.0,
        warp: 0.0,
        crop: Crop::default(),
        memory: 1 << 24,
        scratch: folder.to_owned(),
    }
}

/// Prepares a volume of f32 voxels.
fn run(
    folder: &Path,
    dims: [usize; 3],
    voxel_um: [f64; 3],
    values: impl Fn(usize, usize, usize) -> f32,
    change: impl FnOnce(&mut Preparing),
) -> Result<(Volume, PrepareReport)> {
    let file = write(folder, "scan.nrrd", &[&nrrd_f32(dims, voxel_um, values)]);
    let mut options = nothing(folder);
    change(&mut options);
    let out = folder.join("volume.nrrd");
    let report = prepare(open(&file, |_| ())?, &options, &out, &Unwatched)?;
    Ok((open(&out, |_| ())?, report))
}

fn at(volume: &Volume, x: usize, y: usize, z: usize) -> f64 {
    f64::from(
        volume
            .read([x, y, z], [x + 1, y + 1, z + 1])
            .unwrap()
            .values[0],
    )
}

/// A cloth of thickness 8 voxels with soft faces around height `middle`, voxels.
fn slab(z: usize, middle: f64) -> f64 {
    (4.5 - (z as f64 - middle).abs()).clamp(0.0, 1.0)
}

#[test]
fn with_nothing_to_do_voxels_stay_bit_for_bit() {
    let folder = tempfile::tempdir().unwrap();
    let value = |x, y, z| ((x * 7 + y * 13 + z * 29) % 101) as f32 / 7.0;
    let (volume, report) = run(folder.path(), [17, 12, 9], [5.3; 3], value, |_| ()).unwrap();
    assert_eq!(volume.dims(), [17, 12, 9]);
    let expected = open(&folder.path().join("scan.nrrd"), |_| ()).unwrap();
    assert_eq!(all(&volume), all(&expected));
    assert_eq!(report.outside_share, 0.0);
    assert!((volume.cubic_voxel_mm().unwrap() - 0.0053).abs() < 1e-12);
    // The middle of the cloth is z = 0, the lower corner x = y = 0.
    let origin = volume.origin_mm();
    let expected = [0.5, 0.5, -4.0].map(|v| v * 0.0053);
    assert!(
        origin
            .iter()
            .zip(expected)
            .all(|(a, b)| (a - b).abs() < 1e-12),
        "{origin:?}"
    );
}

/// The smallest fault it can see: the surface wrong by a tenth of a voxel at a corner, or subtracted with the wrong sign.
#[test]
fn a_curved_cloth_becomes_flat() {
    let folder = tempfile::tempdir().unwrap();
    let (nx, ny, nz) = (60, 40, 48);
    // Voxels from the middle of the volume to the middle of the cloth.
    let truth = |x: f64, y: f64| {
        let (u, v) = ((x + 0.5 - 30.0) / 30.0, (y + 0.5 - 20.0) / 20.0);
        -2.0 + 3.0 * u - 1.5 * v + 5.0 * u * u + 2.0 * u * v - 4.0 * v * v
    };
    // Thickness differs from column to column, or faces between voxels would fall into step with the grid.
    let value = |x: usize, y: usize, z: usize| {
        let thickness = ((x * 37 + y * 61) % 101) as f64 / 101.0 + 7.5;
        let depth = 0.5 + 0.5 * thickness - (z as f64 - 23.5 - truth(x as f64, y as f64)).abs();
        depth.clamp(0.0, 1.0) as f32
    };
    // The center of mass of a column, relative to z = 0, in voxels.
    let middles = |volume: &Volume, reach: f64| {
        let [nx, ny, nz] = volume.dims();
        let values = all(volume);
        let column = |i: usize| {
            let height = |z: usize| volume.origin_mm()[2] / 0.005 + z as f64;
            // Voxels from outside the scan are far away, and as faint as its air.
            let near = (0..nz).filter(|z| height(*z).abs() < reach);
            let weights = near.clone().map(|z| f64::from(values[z * nx * ny + i]));
            let heights = near.map(height);
            let mass: f64 = weights.clone().sum();
            weights.zip(heights).map(|(w, h)| w * h).sum::<f64>() / mass
        };
        (0..nx * ny).map(column).collect::<Vec<_>>()
    };
    let range = |m: &[f64]| {
        let fold = |f: fn(f64, f64) -> f64, start| m.iter().copied().fold(start, f);
        [
            fold(f64::min, f64::INFINITY),
            fold(f64::max, f64::NEG_INFINITY),
        ]
    };
    let (volume, report) = run(folder.path(), [nx, ny, nz], [5.0; 3], value, |o| {
        o.flatten = true
    })
    .unwrap();
    let [low, high] = range(&middles(&volume, 8.0));
    assert!(low > -0.1 && high < 0.1, "{low} to {high}");
    let found = report.surface.unwrap().coefficients.map(|c| c / 0.005);
    for (a, b) in found.iter().zip([-2.0, 3.0, -1.5, 5.0, 2.0, -4.0]) {
        assert!((a - b).abs() < 0.05, "{found:?}");
    }
    // Negative control.
    let (volume, _) = run(folder.path(), [nx, ny, nz], [5.0; 3], value, |_| ()).unwrap();
    let [low, high] = range(&middles(&volume, 100.0));
    assert!(high - low > 10.0, "{low} to {high}");
}

/// A tilted plate turned level keeps its thickness across; sheared level it grows by 1 / cos.
#[test]
fn a_tilted_cloth_is_turned_not_sheared() {
    let folder = tempfile::tempdir().unwrap();
    let slope = 20f64.to_radians().tan();
    let value = |x: usize, _, z: usize| slab(z, 39.5 + slope * (x as f64 - 49.5)) as f32;
    let thickness = |level| {
        let change = |o: &mut Preparing| (o.level, o.flatten) = (level, true);
        let (volume, report) = run(folder.path(), [100, 30, 80], [5.0; 3], value, change).unwrap();
        let [nx, ny, nz] = volume.dims();
        let near = |z: &usize| (volume.origin_mm()[2] + *z as f64 * 0.005).abs() < 0.06;
        let column = (0..nz).filter(near);
        let sum: f64 = column.map(|z| at(&volume, nx / 2, ny / 2, z)).sum();
        (sum, report.tilt_deg)
    };
    let ((turned, tilt), (sheared, none)) = (thickness(true), thickness(false));
    assert!((tilt - 20.0).abs() < 0.1 && none == 0.0, "{tilt}");
    let expected = 8.0 * 20f64.to_radians().cos();
    assert!(
        (turned - expected).abs() < 0.1,
        "{turned}, expected {expected}"
    );
    assert!((sheared - 8.0).abs() < 0.1, "{sheared}");
}

/// The smallest fault it can see: levels wrong by 2 % of the contrast anywhere.
#[test]
fn uneven_levels_become_0_and_1() {
    let folder = tempfile::tempdir().unwrap();
    let fiber = |x: usize, y: usize, z: usize| (x / 3 + y / 2 + z / 2).is_multiple_of(4);
    let r2 = |x: usize, y: usize| {
        ((x as f64 - 35.0) / 80.0).powi(2) + ((y as f64 - 20.0) / 80.0).powi(2)
    };
    // Contrast falls to 68 % in a corner, where air is as bright as the threshold of all.
    let value = |x, y, z| {
        let (air, contrast) = (50.0 + 140.0 * r2(x, y), 100.0 - 60.0 * r2(x, y));
        (air + if fiber(x, y, z) { contrast } else { 0.0 }) as f32
    };
    let worst = |volume: &Volume, outside: f64, inside: f64| {
        let [nx, ny, nz] = volume.dims();
        let mut worst: f64 = 0.0;
        for (i, v) in all(volume).into_iter().enumerate() {
            let truth = if fiber(i % nx, i / nx % ny, i / nx / ny) {
                inside
            } else {
                outside
            };
            worst = worst.max((f64::from(v) - truth).abs());
        }
        assert_eq!((nx, ny, nz), (80, 60, 20));
        worst
    };
    let (volume, report) = run(folder.path(), [80, 60, 20], [5.0; 3], value, |o| {
        o.equalize = true
    })
    .unwrap();
    let found = worst(&volume, 0.0, 1.0);
    assert!(found < 0.02, "{found}");
    assert_eq!(report.threshold, 0.5);
    assert!(
        (report.fiber_share - 0.25).abs() < 0.01,
        "{}",
        report.fiber_share
    );
    // Negative control: untouched levels are off by far more than 2 %.
    let (volume, _) = run(folder.path(), [80, 60, 20], [5.0; 3], value, |_| ()).unwrap();
    assert!(worst(&volume, 50.0, 150.0) > 30.0);
}

/// Stripes along two directions 7 degrees apart become stripes along x and y; lengths along both stay.
#[test]
fn yarns_are_brought_onto_the_axes() {
    let folder = tempfile::tempdir().unwrap();
    let (weft, warp) = (5f64.to_radians(), -2f64.to_radians());
    let n = 120;
    // Below, lines of constant distance from the weft direction; above, from the warp's. Period 16 voxels along the other
    // system.
    let value = |x: usize, y: usize, z: usize| {
        let (x, y) = (x as f64 + 0.5 - 60.0, y as f64 + 0.5 - 60.0);
        let cross = (weft - warp).cos();
        let phase = if z < 4 {
            (y * weft.cos() - x * weft.sin()) / cross
        } else {
            (x * warp.cos() + y * warp.sin()) / cross
        };
        (std::f64::consts::TAU * phase / 16.0).cos() as f32
    };
    let change = |o: &mut Preparing| (o.weft, o.warp) = (weft, warp);
    let (volume, report) = run(folder.path(), [n, n, 8], [5.0; 3], value, change).unwrap();
    let [nx, ny, _] = volume.dims();
    assert_eq!(report.outside_share, 0.0);
    assert!(nx > 105 && ny > 105, "{nx} {ny}");
    let wave = |q: f64| (std::f64::consts::TAU * q / 16.0).cos();
    let mut worst: f64 = 0.0;
    for y in 0..ny {
        for x in 0..nx {
            let q = |i: usize, k: usize| report.lower_corner_mm[k] / 0.005 + i as f64 + 0.5;
            worst = worst.max((at(&volume, x, y, 2) - wave(q(y, 1))).abs());
            worst = worst.max((at(&volume, x, y, 6) - wave(q(x, 0))).abs());
        }
    }
    // Linear interpolation loses up to (2 pi / 16)^2 / 8 of a wave of 16 voxels.
    assert!(worst < 0.025, "{worst}");
}

#[test]
fn flat_voxels_become_cubes() {
    let folder = tempfile::tempdir().unwrap();
    // Linear, so interpolation is exact inside.
    let value = |x: usize, y: usize, z: usize| (x as f64 + 2.0 * y as f64 + 10.0 * z as f64) as f32;
    let (volume, report) = run(folder.path(), [10, 8, 6], [5.0, 5.0, 12.5], value, |_| ()).unwrap();
    assert_eq!(volume.dims(), [10, 8, 15]);
    assert!((report.voxel_um - 5.0).abs() < 1e-9);
    for z in 2..13 {
        let height = (z as f64 + 0.5) / 2.5 - 0.5;
        assert!(
            (at(&volume, 3, 4, z) - (3.0 + 8.0 + 10.0 * height)).abs() < 1e-4,
            "{z}"
        );
    }
    // Half a voxel beyond the outermost centers the outermost goes on.
    assert_eq!(at(&volume, 3, 4, 0), 11.0);
}

#[test]
fn crops_are_whole_voxels_and_whole_repeats() {
    let folder = tempfile::tempdir().unwrap();
    let value = |x: usize, y: usize, z: usize| (x + 100 * y + 10_000 * z) as f32;
    let crop = Crop {
        x_mm: Some([0.02, 0.31]),
        y_mm: Some([0.1, 0.2]),
        z_mm: Some([-0.011, 5.0]),
        repeat_mm: None,
    };
    let (volume, _) = run(folder.path(), [70, 50, 10], [5.0; 3], value, |o| {
        o.crop = crop
    })
    .unwrap();
    assert_eq!(volume.dims(), [58, 20, 7]);
    assert_eq!(at(&volume, 0, 0, 0), (4 + 100 * 20 + 10_000 * 3) as f64);
    let crop = Crop {
        repeat_mm: Some([0.0801, 0.125]),
        ..Crop::default()
    };
    let (volume, report) = run(folder.path(), [70, 50, 10], [5.0; 3], value, |o| {
        o.crop = crop
    })
    .unwrap();
    assert_eq!(report.repeats, Some([4, 2]));
    assert_eq!(volume.dims(), [64, 50, 10]);
    assert_eq!(at(&volume, 0, 0, 0), 3.0);
}

#[test]
fn what_cannot_be_prepared_is_said() {
    let folder = tempfile::tempdir().unwrap();
    let cloth = |x: usize, y: usize, z: usize| {
        slab(z, 10.0) as f32 * if (x + y).is_multiple_of(3) { 0.9 } else { 1.0 }
    };
    let fails = |value: &dyn Fn(usize, usize, usize) -> f32, change: &dyn Fn(&mut Preparing)| {
        run(folder.path(), [20, 20, 20], [5.0; 3], value, change)
            .err()
            .unwrap()
            .report()
    };
    let crop = |o: &mut Preparing, crop: Crop| o.crop = crop;
    let too_far = Crop {
        x_mm: Some([0.0, 0.2]),
        ..Crop::default()
    };
    let report = fails(&cloth, &|o| crop(o, too_far));
    assert!(
        report.contains("crop from 0 to 0.2 mm along x: expected a range within 0 to 0.1000 mm"),
        "{report}"
    );
    let backward = Crop {
        y_mm: Some([0.08, 0.02]),
        ..Crop::default()
    };
    assert!(fails(&cloth, &|o| crop(o, backward)).contains("along y"));
    let air = Crop {
        z_mm: Some([0.03, 0.05]),
        ..Crop::default()
    };
    assert!(fails(&cloth, &|o| crop(o, air)).contains("no fiber in what is left"));
    let nowhere = Crop {
        z_mm: Some([1.0, 2.0]),
        ..Crop::default()
    };
    assert!(fails(&cloth, &|o| crop(o, nowhere)).contains("the volume reaches from"));
    let large = Crop {
        repeat_mm: Some([0.2, 0.05]),
        ..Crop::default()
    };
    assert!(fails(&cloth, &|o| crop(o, large)).contains(
        "a repeat of 0.2 mm along x: expected at least two voxels and at most the 0.1000 mm"
    ));
    assert!(fails(&cloth, &|o| o.weft = 1.0).contains("at most 45 apart"));
    assert!(fails(&|_, _, _| 2.0, &|_| ()).contains("every voxel is 2: the volume is empty"));
    // A single column of cloth has no surface, and no level that could be fitted.
    let column = |x: usize, y: usize, _: usize| if (x, y) == (4, 7) { 1.0 } else { 0.0 };
    let report = fails(&column, &|o| o.flatten = true);
    assert!(
        report.contains("do not spread over the cloth") && report.contains("--no-flatten"),
        "{report}"
    );
    let report = fails(&column, &|o| o.equalize = true);
    assert!(
        report.contains("the level of fiber cannot be fitted") && report.contains("--no-equalize"),
        "{report}"
    );
}

/// Everything at once: a curved, tilted, uneven weave of flat voxels, its yarns off the axes.
fn hard(x: usize, y: usize, z: usize) -> f32 {
    let (u, v) = (x as f64 / 24.0 - 1.0, y as f64 / 20.0 - 1.0);
    let middle = 9.5 + 2.0 * u - v + 1.5 * u * u;
    let yarn = 0.6
        + 0.4
            * ((x as f64 + 0.1 * y as f64) / 3.0).cos()
            * ((y as f64 - 0.05 * x as f64) / 2.5).cos();
    let fiber = (3.0 * yarn - (z as f64 - middle).abs()).clamp(0.0, 1.0);
    (20.0 + 5.0 * u * u + (100.0 - 10.0 * v * v) * fiber) as f32
}

fn everything(options: &mut Preparing, level: bool) {
    options.equalize = true;
    options.flatten = true;
    options.level = level;
    options.weft = 0.06;
    options.warp = 0.02;
}

#[test]
fn memory_does_not_matter() {
    for level in [false, true] {
        for axes in ["x,y,z", "y,-z,x"] {
            let mut results = Vec::new();
            for memory in [1 << 24, 60_000, 3000, 1] {
                let folder = tempfile::tempdir().unwrap();
                let file = write(
                    folder.path(),
                    "scan.nrrd",
                    &[&nrrd_f32([48, 40, 20], [5.0, 5.0, 8.0], hard)],
                );
                let mut options = nothing(folder.path());
                everything(&mut options, level);
                options.memory = memory;
                let out = folder.path().join("volume.nrrd");
                let volume = open(&file, |r| r.axes = Some(axes.parse().unwrap())).unwrap();
                // In other axes the cloth is no height over the plane: only that pieces agree is tested.
                if axes != "x,y,z" {
                    (options.equalize, options.flatten, options.level) = (false, false, false);
                }
                let report = prepare(volume, &options, &out, &Unwatched).unwrap();
                results.push((std::fs::read(&out).unwrap(), report));
            }
            for (bytes, report) in &results[1..] {
                assert!(*bytes == results[0].0, "level {level}, axes {axes}");
                assert_eq!(*report, results[0].1);
            }
        }
    }
}

struct Impatient;

impl Watch for Impatient {
    fn progress(&self, _: &str, _: u64, _: u64) {}
    fn cancelled(&self) -> bool {
        true
    }
}

#[test]
fn an_interrupt_leaves_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    let file = write(
        folder.path(),
        "scan.nrrd",
        &[&nrrd_f32([48, 40, 20], [5.0; 3], hard)],
    );
    let out = folder.path().join("volume.nrrd");
    let error = prepare(
        open(&file, |_| ()).unwrap(),
        &nothing(folder.path()),
        &out,
        &Impatient,
    )
    .unwrap_err();
    assert!(error.report().contains("interrupted"));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}
