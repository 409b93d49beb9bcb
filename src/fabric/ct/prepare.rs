//! From a scan to a volume in which fibers can be found: even, flat, along the axes, cubic voxels, whole repeats of the
//! weave.
//!
//! All that moves voxels is one map, so values are interpolated once (trilinear). Does not remove noise, rings or streaks.

use super::align::{Map, size};
use super::coarse::Coarse;
use super::equalize::Levels;
use super::quadratic::Quadratic;
use super::resample::{Grid, Resampling};
use super::{SampleType, Volume, nrrd, statistics};
use crate::base::{Context, Error, Result, Watch};
use crate::fabric::aside::write_aside;
use glam::DVec3;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// What to do with a scan.
#[derive(Debug, Clone)]
pub struct Preparing {
    /// Even out the levels of air and fiber, to 0 and 1.
    pub equalize: bool,
    /// Subtract the quadratic through the cloth's middle from z.
    pub flatten: bool,
    /// Before that, turn the plane through the cloth's middle level, without shear.
    pub level: bool,
    /// How far the weft lies counter-clockwise off x, radians.
    pub weft: f64,
    /// How far the warp lies counter-clockwise off y, radians.
    pub warp: f64,
    /// What to keep.
    pub crop: Crop,
    /// Bytes of voxels held at a time.
    pub memory: usize,
    /// Existing folder for nameless files that hold unpacked voxels.
    pub scratch: PathBuf,
}

/// What to keep of a prepared volume; ends are rounded to whole voxels.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Crop {
    /// From and to along x, millimeters from the lower end.
    pub x_mm: Option<[f64; 2]>,
    /// From and to along y, millimeters from the lower end.
    pub y_mm: Option<[f64; 2]>,
    /// From and to along z, millimeters from the cloth's middle; what lies beyond the volume is ignored.
    pub z_mm: Option<[f64; 2]>,
    /// Size of one repeat of the weave in x and y, millimeters: as many whole ones as fit are kept, from the middle.
    pub repeat_mm: Option<[f64; 2]>,
}

/// What was done.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PrepareReport {
    /// Voxels of the scan along x, y, z.
    pub scan_dims: [usize; 3],
    /// Their size, micrometers.
    pub scan_voxel_um: [f64; 3],
    /// What they were stored as.
    pub scan_type: SampleType,
    /// Scene axes of the file's axes, fastest first.
    pub scan_axes: String,
    /// Otsu's threshold of the scan.
    pub scan_otsu: f64,
    /// The levels that became 0 and 1, if values were evened out; places from the lower corner of the scan.
    pub levels: Option<Levels>,
    /// The surface subtracted from z, if it was flattened; places from the middle.
    pub surface: Option<Quadratic>,
    /// From its lowest to its highest point within the prepared volume, micrometers.
    pub surface_range_um: f64,
    /// By how much the cloth was turned level, degrees.
    pub tilt_deg: f64,
    /// How far the weft lay off x, degrees.
    pub weft_deg: f64,
    /// How far the warp lay off y, degrees.
    pub warp_deg: f64,
    /// A point q of the prepared volume, counted from its middle, is `center + axes (q + (0, 0, surface))` from the
    /// scan's lower corner.
    pub center_mm: [f64; 3],
    /// Columns of the matrix `axes` of that map.
    pub axes_columns: [[f64; 3]; 3],
    /// The prepared volume's lower corner as such a q.
    pub lower_corner_mm: [f64; 3],
    /// What was asked to be kept.
    pub crop: Crop,
    /// Repeats of the weave kept, if asked for.
    pub repeats: Option<[usize; 2]>,
    /// Voxels of the prepared volume along x, y, z.
    pub dims: [usize; 3],
    /// Side of its cubic voxels, micrometers.
    pub voxel_um: f64,
    /// Its size, millimeters.
    pub size_mm: [f64; 3],
    /// Share of its voxels that lie outside the scan, filled with `outside_value`.
    pub outside_share: f64,
    /// The value given to them: that of air.
    pub outside_value: f32,
    /// Voxels from this value on count as fiber in the two numbers below.
    pub threshold: f64,
    /// Share of voxels of fiber.
    pub fiber_share: f64,
    /// Between the heights below which 1 % and 99 % of the voxels of fiber lie, millimeters.
    pub thickness_mm: f64,
}

/// Prepares a volume and writes it to `out` as NRRD: single precision, z = 0 the middle of the cloth if it was flattened.
///
/// # Errors
/// The volume is empty or damaged; the levels, the surface or the crop cannot be had; the file cannot be written; the
/// watch cancelled. Nothing is left behind then.
pub fn prepare(
    volume: Volume,
    options: &Preparing,
    out: &Path,
    watch: &dyn Watch,
) -> Result<PrepareReport> {
    check_angles(options)?;
    let volume = volume.unpacked(&options.scratch, watch)?;
    let found = statistics(&volume, options.memory, watch)?;
    let full = size(&volume);
    let coarse = Coarse::of(&volume, options.memory, watch)?;
    let levels = options
        .equalize
        .then(|| Levels::fit(&coarse, [full.x, full.y], found.otsu))
        .transpose()?;
    let air = air_level(&coarse, found.otsu);
    // Density above half way from air to fiber: faint voxels come in gradually, noise in air does not.
    let weight = |place: DVec3, value: f64| {
        let above = match &levels {
            Some(levels) => levels.even(place.x, place.y, value) - 0.5,
            None => value - found.otsu,
        };
        above.max(0.0)
    };
    let half = [0.5 * full.x, 0.5 * full.y];
    let mut map = Map::of_yarns(&volume, options.weft, options.warp);
    let hint = || "the cloth cannot be laid flat (--no-flatten leaves it as it is)";
    if options.level {
        map = map.leveled(&weight, &coarse, half).context(hint)?;
    }
    if options.flatten {
        map = map.flattened(&weight, &coarse, half).context(hint)?;
    }
    let (grid, repeats) = cropped(
        uncropped(&volume, &map, &coarse, &weight, options),
        &options.crop,
    )?;
    let grid = grid.checked()?;
    drop(coarse);
    let outside = if levels.is_some() { 0.0 } else { air as f32 };
    let threshold = if levels.is_some() { 0.5 } else { found.otsu };
    let resampling = Resampling::new(
        &volume,
        &map,
        grid,
        levels.as_ref(),
        outside,
        options.memory,
    );
    let written = write(&resampling, threshold, out, watch)?;
    let voxels = grid.dims.iter().map(|n| *n as f64).product::<f64>();
    Ok(PrepareReport {
        scan_dims: volume.dims(),
        scan_voxel_um: volume.voxel_mm().map(|v| v * 1e3),
        scan_type: volume.sample(),
        scan_axes: volume.axes().to_string(),
        scan_otsu: found.otsu,
        levels,
        surface: map.surface,
        surface_range_um: 1e3 * resampling.lift_range(),
        tilt_deg: map.axes.z_axis.angle_between(DVec3::Z).to_degrees(),
        weft_deg: options.weft.to_degrees(),
        warp_deg: options.warp.to_degrees(),
        center_mm: map.center.to_array(),
        axes_columns: map.axes.to_cols_array_2d(),
        lower_corner_mm: grid.low.to_array(),
        crop: options.crop,
        repeats,
        dims: grid.dims,
        voxel_um: 1e3 * grid.voxel,
        size_mm: grid.dims.map(|n| n as f64 * grid.voxel),
        outside_share: written.outside as f64 / voxels,
        outside_value: outside,
        threshold,
        fiber_share: written.solid.iter().sum::<u64>() as f64 / voxels,
        thickness_mm: grid.voxel * thickness(&written.solid),
    })
}

fn check_angles(options: &Preparing) -> Result<()> {
    let [weft, warp] = [options.weft, options.warp].map(f64::to_degrees);
    if [weft, warp].iter().all(|a| a.abs() <= 180.0) && (weft - warp).abs() <= 45.0 {
        return Ok(());
    }
    Err(Error::new(format!(
        "weft {weft} and warp {warp} degrees off the axes: expected at most 180, and at most 45 apart"
    ))
    .with_hint("volume axes are exchanged and reversed with --axes"))
}

/// Mean value below the threshold.
fn air_level(coarse: &Coarse, threshold: f64) -> f64 {
    let empty = coarse.points().filter(|p| p.1 < threshold);
    let (n, sum) = empty.fold((0.0, 0.0), |(n, sum), p| (n + 1.0, sum + p.1));
    sum / f64::max(n, 1.0)
}

/// The grid of everything: in the plane as much as lies in the scan, centered; in z all that is in the scan anywhere, or,
/// where the cloth was turned level, all that holds fiber.
fn uncropped(
    volume: &Volume,
    map: &Map,
    coarse: &Coarse,
    weight: &dyn Fn(DVec3, f64) -> f64,
    options: &Preparing,
) -> Grid {
    let half = 0.5 * size(volume);
    let voxel = volume.voxel_mm().into_iter().fold(f64::INFINITY, f64::min);
    let mut share: f64 = 1.0;
    for q in [
        DVec3::new(half.x, half.y, 0.0),
        DVec3::new(half.x, -half.y, 0.0),
    ] {
        let reached = (map.axes * q).abs();
        share = share.min(half.x / reached.x).min(half.y / reached.y);
    }
    // Rounding of angles of 0 must not cost a voxel.
    let [x, y] = [half.x, half.y].map(|h| if share > 1.0 - 1e-12 { h } else { h * share });
    let count = |length: f64| (length / voxel + 1e-6).floor().max(1.0);
    let (nx, ny) = (count(2.0 * x), count(2.0 * y));
    let steps = |k: i32, h: f64| h * f64::from(k) / 32.0;
    let (mut least, mut most) = (f64::INFINITY, f64::NEG_INFINITY);
    for lift in (-32..=32).flat_map(|i| (-32..=32).map(move |j| map.lift(steps(i, x), steps(j, y))))
    {
        (least, most) = (least.min(lift), most.max(lift));
    }
    let [low, high] = if options.level {
        let (mut low, mut high) = (f64::INFINITY, f64::NEG_INFINITY);
        for (place, _) in coarse.points().filter(|p| weight(p.0, p.1) > 0.0) {
            let q = map.before_flattening(place);
            let z = q.z - map.lift(q.x, q.y);
            (low, high) = (low.min(z), high.max(z));
        }
        let margin = 2.0 * coarse.reach();
        [low - margin, high + margin]
    } else {
        [-half.z - most, half.z - least]
    };
    let nz = ((high - low) / voxel - 1e-6).ceil().max(1.0);
    Grid {
        dims: [nx as usize, ny as usize, nz as usize],
        voxel,
        low: DVec3::new(-x, -y, low),
    }
}

/// Applies a crop: the boxes first, then whole repeats of what is left.
fn cropped(mut grid: Grid, crop: &Crop) -> Result<(Grid, Option<[usize; 2]>)> {
    for (axis, wanted) in [crop.x_mm, crop.y_mm].into_iter().enumerate() {
        let Some([from, to]) = wanted else { continue };
        let length = grid.dims[axis] as f64 * grid.voxel;
        let slack = 0.5 * grid.voxel;
        if !(from >= -slack && to <= length + slack && to - from >= grid.voxel) {
            return Err(Error::new(format!(
                "crop from {from} to {to} mm along {}: expected a range within 0 to {length:.4} mm",
                ["x", "y"][axis]
            ))
            .with_hint(
                "crops are counted from the lower corner of what is left after aligning the yarns",
            ));
        }
        let voxel = grid.voxel;
        keep(&mut grid, axis, from / voxel, to / voxel);
    }
    if let Some([from, to]) = crop.z_mm {
        let (low, high) = (grid.low.z, grid.low.z + grid.dims[2] as f64 * grid.voxel);
        if !(from < to && from < high && to > low) {
            return Err(Error::new(format!(
                "crop from {from} to {to} mm along z: the volume reaches from {low:.4} to {high:.4} mm"
            )));
        }
        let voxel = grid.voxel;
        keep(&mut grid, 2, (from - low) / voxel, (to - low) / voxel);
    }
    let Some(repeat) = crop.repeat_mm else {
        return Ok((grid, None));
    };
    let mut repeats = [0; 2];
    for axis in 0..2 {
        let (n, voxel) = (grid.dims[axis] as f64, grid.voxel);
        // A repeat that is short by half a voxel is whole.
        let fit = ((n + 0.5) * voxel / repeat[axis]).floor();
        if !(fit >= 1.0 && repeat[axis] >= 2.0 * voxel) {
            return Err(Error::new(format!(
                "a repeat of {} mm along {}: expected at least two voxels and at most the {:.4} mm there are",
                repeat[axis],
                ["x", "y"][axis],
                n * voxel
            )));
        }
        let kept = (fit * repeat[axis] / voxel).round().min(n);
        let from = ((n - kept) / 2.0).floor();
        keep(&mut grid, axis, from, from + kept);
        repeats[axis] = fit as usize;
    }
    Ok((grid, Some(repeats)))
}

/// Keeps the voxels between two borders along an axis.
fn keep(grid: &mut Grid, axis: usize, from: f64, to: f64) {
    let n = grid.dims[axis] as f64;
    let (from, to) = (from.round().clamp(0.0, n - 1.0), to.round().clamp(1.0, n));
    grid.dims[axis] = ((to - from) as usize).max(1);
    grid.low[axis] += from * grid.voxel;
}

struct Written {
    outside: u64,
    /// Voxels of fiber in each layer.
    solid: Vec<u64>,
}

/// Writes the volume aside and renames it when it is whole.
fn write(
    resampling: &Resampling,
    threshold: f64,
    out: &Path,
    watch: &dyn Watch,
) -> Result<Written> {
    let what = || format!("{} cannot be written", out.display());
    let Grid { dims, voxel, low } = resampling.grid;
    let first = 0.5 * voxel;
    let header = nrrd::written(dims, voxel, [first, first, low.z + first]);
    write_aside(out, |file| {
        file.write_all(header.as_bytes()).context(what)?;
        let mut written = Written {
            outside: 0,
            solid: Vec::with_capacity(dims[2]),
        };
        resampling.sweep(watch, |values, outside| {
            written.outside += outside;
            for layer in values.chunks_exact(dims[0] * dims[1]) {
                let solid = layer.iter().filter(|v| f64::from(**v) >= threshold);
                written.solid.push(solid.count() as u64);
                for value in layer {
                    file.write_all(&value.to_le_bytes()).context(what)?;
                }
            }
            Ok(())
        })?;
        if written.solid.iter().all(|n| *n == 0) {
            return Err(Error::new("no fiber in what is left of the volume")
                .with_hint("is the crop where the cloth is?"));
        }
        Ok(written)
    })
}

/// Layers between those below which 1 % and 99 % of the voxels lie.
fn thickness(solid: &[u64]) -> f64 {
    let total = solid.iter().sum::<u64>() as f64;
    let height = |share: f64| {
        let mut below = 0.0;
        for (k, n) in solid.iter().enumerate() {
            let n = *n as f64;
            if n > 0.0 && below + n >= share * total {
                return k as f64 + (share * total - below) / n;
            }
            below += n;
        }
        solid.len() as f64
    };
    height(0.99) - height(0.01)
}
