//! Curve text of Mitsuba 3's `linearcurve` and `bsplinecurve` shapes.
//!
//! One control point a line, `x y z radius`; a blank line begins the next curve. There are no comments, so neither unit,
//! tile size nor yarn system is stored: lengths are millimeters here, reading needs the tile size and gives every fiber
//! yarn system 0. `linearcurve` draws the written polylines as they are (spherical joints, no faces seen from inside);
//! `bsplinecurve` reads the same text but takes the points as cubic control points, rounds off the path and stops short of
//! its ends. A curve read from here is taken as a polyline.
//!
//! A segment's radius is the one of its first point; the last point repeats the last segment's radius.

use super::{Curve, FiberTile, MAX_SEGMENTS, check_segment, curves, from_curves, needed_tile};
use crate::base::{Error, Result};
use glam::DVec3;
use std::fmt::Write;

pub(crate) fn write(tile: &FiberTile) -> Vec<u8> {
    let mut text = String::new();
    for (index, curve) in curves(tile).iter().enumerate() {
        if index > 0 {
            text.push('\n');
        }
        for (k, p) in curve.points.iter().enumerate() {
            let radius = curve.radii[k.min(curve.radii.len() - 1)];
            // Writing to a String cannot fail.
            let _ = writeln!(text, "{} {} {} {radius}", p.x, p.y, p.z);
        }
    }
    text.into_bytes()
}

pub(crate) fn read(bytes: &[u8], tile: Option<[f64; 2]>) -> Result<FiberTile> {
    let size = needed_tile(tile)?;
    let text = std::str::from_utf8(bytes)
        .map_err(|e| Error::new(format!("byte {}: this is not text", e.valid_up_to())))?;
    let mut list: Vec<Curve> = Vec::new();
    let mut points: Vec<(DVec3, f64)> = Vec::new();
    let mut count = 0_usize;
    let mut last = 0;
    for (number, line) in (1..).zip(text.lines()) {
        last = number;
        if line.trim().is_empty() {
            finish(&mut points, &mut list, number)?;
            continue;
        }
        count += 1;
        if count > MAX_SEGMENTS {
            return Err(Error::new(format!(
                "line {number}: more than {MAX_SEGMENTS} points"
            )));
        }
        let (point, radius) = control_point(line, number)?;
        if let Some(&(before, before_radius)) = points.last() {
            check_segment(before, point, before_radius, || format!("line {number}"))?;
        }
        points.push((point, radius));
    }
    finish(&mut points, &mut list, last)?;
    if !text.is_empty() && !text.ends_with('\n') {
        return Err(
            Error::new(format!("line {last}: the last line has no line end"))
                .with_hint("was the file cut off?"),
        );
    }
    if list.is_empty() {
        return Err(Error::new("no curves: the fabric is empty")
            .with_hint("expected lines 'x y z radius', a blank line between curves"));
    }
    Ok(from_curves(size, &list))
}

/// Ends the current curve before line `number`.
fn finish(points: &mut Vec<(DVec3, f64)>, list: &mut Vec<Curve>, number: usize) -> Result<()> {
    match points.len() {
        0 => return Ok(()),
        1 => {
            return Err(Error::new(format!(
                "line {number}: the curve that ends here has one point: expected at least two"
            )));
        }
        n => list.push(Curve {
            points: points.iter().map(|p| p.0).collect(),
            radii: points[..n - 1].iter().map(|p| p.1).collect(),
            yarn_system: 0,
        }),
    }
    points.clear();
    Ok(())
}

fn control_point(line: &str, number: usize) -> Result<(DVec3, f64)> {
    let words: Vec<&str> = line.split_whitespace().collect();
    let [x, y, z, radius] = words.as_slice() else {
        return Err(Error::new(format!(
            "line {number}: expected 'x y z radius', found {} columns",
            words.len()
        )));
    };
    let value = |text: &str| {
        text.parse::<f64>()
            .ok()
            .filter(|v| v.is_finite())
            .ok_or_else(|| {
                Error::new(format!(
                    "line {number}: expected a finite number, found '{text}'"
                ))
            })
    };
    let radius = value(radius)?;
    if radius <= 0.0 {
        return Err(Error::new(format!(
            "line {number}: expected a positive radius, found {radius}"
        )));
    }
    Ok((DVec3::new(value(x)?, value(y)?, value(z)?), radius))
}
