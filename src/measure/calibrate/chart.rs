//! A color chart's file, and color differences.

use crate::base::{Context, Error, Result};
use serde::Deserialize;
use std::path::Path;

/// A color chart.
pub(super) struct Chart {
    pub(super) patches: Vec<ChartPatch>,
}

/// A patch: where it is on the sample plane, and its color.
#[derive(Debug, Clone)]
pub(super) struct ChartPatch {
    pub(super) name: String,
    middle_mm: [f64; 2],
    size_mm: [f64; 2],
    /// Linear, 1: a perfect diffuser.
    pub(super) reference: [f64; 3],
}

/// A row of the file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Row {
    patch: String,
    x_mm: f64,
    y_mm: f64,
    width_mm: f64,
    height_mm: f64,
    r: Option<f64>,
    g: Option<f64>,
    b: Option<f64>,
    #[serde(rename = "X")]
    x: Option<f64>,
    #[serde(rename = "Y")]
    y: Option<f64>,
    #[serde(rename = "Z")]
    z: Option<f64>,
}

impl Chart {
    /// Reads the file; `space` is that of its r, g, b.
    pub(super) fn read(path: &Path, space: &str) -> Result<Self> {
        let what = || format!("chart {}", path.display());
        let mut reader = csv::ReaderBuilder::new()
            .comment(Some(b'#'))
            .trim(csv::Trim::All)
            .from_path(path)
            .context(what)?;
        let mut patches = Vec::new();
        for row in reader.deserialize() {
            let row: Row = row.context(what).map_err(|e| {
                e.with_hint(
                    "columns: patch, x_mm, y_mm, width_mm, height_mm, and r, g, b or X, Y, Z",
                )
            })?;
            patches.push(row.checked(space).context(what)?);
        }
        Ok(Self { patches })
    }
}

impl Row {
    fn checked(self, space: &str) -> Result<ChartPatch> {
        let bad = |what: String| Err(Error::new(format!("patch {}: {what}", self.patch)));
        let reference = match [self.r, self.g, self.b, self.x, self.y, self.z] {
            [Some(r), Some(g), Some(b), None, None, None] => [r, g, b],
            [None, None, None, Some(x), Some(y), Some(z)] if space == SRGB => {
                apply(&XYZ_TO_SRGB, [x, y, z])
            }
            [None, None, None, Some(_), Some(_), Some(_)] => {
                return bad(format!("X, Y, Z are turned to {SRGB}, not to {space}"));
            }
            _ => return bad("expected either r, g, b or X, Y, Z".to_owned()),
        };
        if !reference.iter().all(|v| (-1.0..=2.0).contains(v)) {
            let text = format!("reference {reference:?}, expected linear values with 1 for white");
            return bad(text).map_err(|e| e.with_hint("divide values in percent by 100"));
        }
        let place = [self.x_mm, self.y_mm, self.width_mm, self.height_mm];
        let sized = self.width_mm > 0.0 && self.height_mm > 0.0;
        if !sized || !place.iter().all(|v| (-1e4..1e4).contains(v)) {
            return bad(format!("x, y, width, height {place:?} mm are no rectangle"));
        }
        Ok(ChartPatch {
            middle_mm: [self.x_mm, self.y_mm],
            size_mm: [self.width_mm, self.height_mm],
            reference,
            name: self.patch,
        })
    }
}

impl ChartPatch {
    /// Its corners on the sample plane, millimeters.
    pub(super) fn corners(&self) -> [[f64; 2]; 4] {
        let [x, y] = self.middle_mm;
        let [w, h] = self.size_mm.map(|s| 0.5 * s);
        [
            [x - w, y - h],
            [x + w, y - h],
            [x + w, y + h],
            [x - w, y + h],
        ]
    }
}

/// Name of the space with Rec. 709 primaries and white D65, linear.
const SRGB: &str = "srgb";

/// CIE XYZ (Y = 1: white) to linear sRGB, IEC 61966-2-1.
const XYZ_TO_SRGB: [[f64; 3]; 3] = [
    [3.2406, -1.5372, -0.4986],
    [-0.9689, 1.8758, 0.0415],
    [0.0557, -0.2040, 1.0570],
];

/// And back, IEC 61966-2-1.
const SRGB_TO_XYZ: [[f64; 3]; 3] = [
    [0.4124, 0.3576, 0.1805],
    [0.2126, 0.7152, 0.0722],
    [0.0193, 0.1192, 0.9505],
];

fn apply(matrix: &[[f64; 3]; 3], v: [f64; 3]) -> [f64; 3] {
    matrix.map(|row| row[0] * v[0] + row[1] * v[1] + row[2] * v[2])
}

/// CIE 1976 color difference of two linear sRGB colors (1, 1, 1: white); none for another space.
pub(super) fn delta_e(space: &str, a: [f64; 3], b: [f64; 3]) -> Option<f64> {
    let [a, b] = [a, b].map(lab);
    let square: f64 = (0..3).map(|k| (a[k] - b[k]).powi(2)).sum();
    (space == SRGB).then(|| square.sqrt())
}

/// CIE L*a*b* relative to the white (1, 1, 1), CIE 15:2004.
fn lab(color: [f64; 3]) -> [f64; 3] {
    const DELTA: f64 = 6.0 / 29.0;
    let white = apply(&SRGB_TO_XYZ, [1.0; 3]);
    let xyz = apply(&SRGB_TO_XYZ, color);
    let f = [0, 1, 2].map(|k| {
        let t = xyz[k] / white[k];
        match t > DELTA.powi(3) {
            true => t.cbrt(),
            false => t / (3.0 * DELTA * DELTA) + 4.0 / 29.0,
        }
    });
    [
        116.0 * f[1] - 16.0,
        500.0 * (f[0] - f[1]),
        200.0 * (f[1] - f[2]),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colors_differ_as_in_the_tables() {
        let white = lab([1.0; 3]);
        assert!((white[0] - 100.0).abs() < 1e-9 && white[1].abs() < 1e-9);
        // sRGB red has L* 53.23, a* 80.11, b* 67.22 (IEC 61966-2-1 primaries).
        let red = lab([1.0, 0.0, 0.0]);
        for (found, wanted) in red.into_iter().zip([53.23, 80.11, 67.22]) {
            assert!((found - wanted).abs() < 0.05, "{red:?}");
        }
        assert!(delta_e("srgb", [0.2; 3], [0.2; 3]).unwrap().abs() < 1e-12);
        assert!(delta_e("p3", [0.2; 3], [0.2; 3]).is_none());
        // The two matrices are each other's inverse to their four digits.
        let back = apply(&XYZ_TO_SRGB, apply(&SRGB_TO_XYZ, [0.2, 0.5, 0.8]));
        for (found, wanted) in back.into_iter().zip([0.2, 0.5, 0.8]) {
            assert!((found - wanted).abs() < 1e-3, "{back:?}");
        }
    }
}
