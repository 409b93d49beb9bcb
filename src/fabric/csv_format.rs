//! Segments as comma-separated text, the format that keeps everything.
//!
//! `x0,y0,z0,x1,y1,z1,radius_mm,yarn_system`, millimeters, one segment a row, the segments of a fiber one after the other;
//! a comment `# tile_mm = [x, y]` before the header holds the tile size. Numbers are written with as many digits as read
//! back the same. Neighbors are not stored: reading finds them by position.

use super::link::link;
use super::{FiberTile, MAX_SEGMENTS, NO_SEGMENT, Segment, check_segment, check_tile};
use crate::base::{Context, Error, Result};
use glam::DVec3;
use std::fmt::Write;

const HEADER: &str = "x0,y0,z0,x1,y1,z1,radius_mm,yarn_system";

pub(crate) fn write(tile: &FiberTile) -> Vec<u8> {
    let mut text = format!(
        "# fibers as straight segments, millimeters; yarn_system 0 warp, 1 weft\n# tile_mm = [{}, {}]\n{HEADER}\n",
        tile.size[0], tile.size[1]
    );
    for s in &tile.segments {
        // Writing to a String cannot fail.
        let _ = writeln!(
            text,
            "{},{},{},{},{},{},{},{}",
            s.start.x, s.start.y, s.start.z, s.end.x, s.end.y, s.end.z, s.radius, s.yarn_system
        );
    }
    text.into_bytes()
}

pub(crate) fn read(bytes: &[u8], tile: Option<[f64; 2]>) -> Result<FiberTile> {
    let text = std::str::from_utf8(bytes)
        .map_err(|e| Error::new(format!("byte {}: this is not text", e.valid_up_to())))?;
    let mut stored = None;
    let mut header = false;
    let mut segments = Vec::new();
    for (number, line) in (1..).zip(text.lines()) {
        let line = line.trim();
        if let Some(comment) = line.strip_prefix('#') {
            if let Some(size) = tile_comment(comment).context(|| format!("line {number}"))? {
                stored = Some(size);
            }
        } else if line.is_empty() {
        } else if !header {
            if line.replace(' ', "") != HEADER {
                return Err(Error::new(format!(
                    "line {number}: expected the header '{HEADER}', found '{line}'"
                )));
            }
            header = true;
        } else {
            if segments.len() >= MAX_SEGMENTS {
                return Err(Error::new(format!(
                    "line {number}: more than {MAX_SEGMENTS} segments"
                )));
            }
            segments.push(row(line, number)?);
        }
    }
    if !text.is_empty() && !text.ends_with('\n') {
        return Err(Error::new(format!(
            "line {}: the last line has no line end",
            text.lines().count()
        ))
        .with_hint("was the file cut off?"));
    }
    let size = size(stored, tile)?;
    if segments.is_empty() {
        return Err(
            Error::new("no segments: the fabric is empty").with_hint(format!(
                "expected the header '{HEADER}' and one row a segment"
            )),
        );
    }
    link(&mut segments, size);
    Ok(FiberTile { size, segments })
}

/// The tile size from the file and from the argument, which must agree.
fn size(stored: Option<[f64; 2]>, tile: Option<[f64; 2]>) -> Result<[f64; 2]> {
    match (stored, tile) {
        (Some(a), Some(b)) if (a[0] - b[0]).abs() > 1e-9 || (a[1] - b[1]).abs() > 1e-9 => {
            Err(Error::new(format!(
                "the file says tile_mm = [{}, {}], the caller [{}, {}]",
                a[0], a[1], b[0], b[1]
            )))
        }
        (Some(a), _) => check_tile(a),
        (None, Some(b)) => check_tile(b),
        (None, None) => Err(Error::new("the tile size is missing")
            .with_hint("add a line '# tile_mm = [x, y]' before the header")),
    }
}

fn tile_comment(comment: &str) -> Result<Option<[f64; 2]>> {
    let Some((key, value)) = comment.split_once('=') else {
        return Ok(None);
    };
    if key.trim() != "tile_mm" {
        return Ok(None);
    }
    let wrong = || Error::new(format!("expected 'tile_mm = [x, y]', found '{comment}'"));
    let inner = value
        .trim()
        .strip_prefix('[')
        .and_then(|v| v.strip_suffix(']'))
        .ok_or_else(wrong)?;
    let (x, y) = inner.split_once(',').ok_or_else(wrong)?;
    let number = |text: &str| text.trim().parse::<f64>().map_err(|_| wrong());
    Ok(Some(check_tile([number(x)?, number(y)?])?))
}

fn row(line: &str, number: usize) -> Result<Segment> {
    let columns: Vec<&str> = line.split(',').map(str::trim).collect();
    if columns.len() != 8 {
        return Err(Error::new(format!(
            "line {number}: expected 8 columns ({HEADER}), found {}",
            columns.len()
        ))
        .with_hint("was the file cut off?"));
    }
    let mut v = [0.0; 7];
    for (value, text) in v.iter_mut().zip(&columns) {
        *value = text
            .parse()
            .map_err(|_| Error::new(format!("line {number}: expected a number, found '{text}'")))?;
    }
    let yarn_system = columns[7].parse().map_err(|_| {
        Error::new(format!(
            "line {number}: expected a yarn_system from 0 to 255, found '{}'",
            columns[7]
        ))
    })?;
    let (start, end) = (DVec3::new(v[0], v[1], v[2]), DVec3::new(v[3], v[4], v[5]));
    check_segment(start, end, v[6], || format!("line {number}"))?;
    Ok(Segment {
        start,
        end,
        radius: v[6],
        yarn_system,
        previous: NO_SEGMENT,
        next: NO_SEGMENT,
    })
}
