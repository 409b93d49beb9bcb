//! The reflectance factor of a white panel: stated, or looked up in a table by geometry.
//!
//! A panel is no constant white: over usual geometries its factor runs from 0.88 to 1.06.

use crate::base::{Context, Error, Result};
use crate::session::{Configuration, WhiteReference, files};
use std::path::{Path, PathBuf};

/// Where a panel's reflectance factor at the reference geometry comes from.
#[derive(Debug, Clone, PartialEq)]
pub enum Factor {
    /// The session's manifest.
    Session,
    /// Stated: factor and standard uncertainty, r, g, b.
    Stated([f64; 3], [f64; 3]),
    /// A table by geometry, and its standard uncertainty (none: the manifest's). CSV with columns `light`, `camera`,
    /// `rel_azimuth` (degrees; 0: light and camera on the same side) and three that begin with `BRF`, each followed by its
    /// wavelength: the longest is red, the shortest blue.
    Table(PathBuf, Option<[f64; 3]>),
}

/// Angles agree within this, degrees.
const SAME_DEG: f64 = 0.5;

impl Factor {
    /// The factor and its standard uncertainty at the reference geometry, r, g, b.
    ///
    /// # Errors
    /// A number has no meaning, or the table cannot be read or does not have the geometry, nor its neighbors.
    pub(super) fn at(&self, white: &WhiteReference) -> Result<([f64; 3], [f64; 3])> {
        let stated_se = white.reflectance_factor_se;
        let (factor, se) = match self {
            Self::Session => (white.reflectance_factor, stated_se),
            Self::Stated(factor, se) => (*factor, *se),
            Self::Table(path, se) => {
                let (factor, between) = Table::read(path)?
                    .at(Geometry::of(&white.configuration))
                    .context(|| format!("panel table {}", path.display()))?;
                let se = se.unwrap_or(stated_se);
                (factor, [0, 1, 2].map(|c| between[c].hypot(se[c])))
            }
        };
        for c in 0..3 {
            if !(0.01..=2.0).contains(&factor[c]) || !(0.0..=0.5).contains(&se[c]) {
                return Err(Error::new(format!(
                    "the panel's reflectance factor is {:?} +- {se:?}, expected 0.01 to 2 and an uncertainty of 0 to 0.5",
                    factor
                ))
                .with_hint("state it as R,G,B with 1 for a perfect diffuser"));
            }
        }
        Ok((factor, se))
    }
}

/// Polar angles of light and camera, azimuth between them (0..=180), degrees.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Geometry([f64; 3]);

impl Geometry {
    fn of(configuration: &Configuration) -> Self {
        let between = configuration.light.phi - configuration.camera.phi;
        // At the normal there is no azimuth; acos folds to 0..=180.
        Self([
            configuration.light.theta.to_degrees(),
            configuration.camera.theta.to_degrees(),
            between.cos().clamp(-1.0, 1.0).acos().to_degrees(),
        ])
    }

    /// True when azimuth says nothing: one of the directions is the normal.
    fn upright(&self) -> bool {
        self.0[0].min(self.0[1]) < SAME_DEG
    }

    /// Angle off from another geometry, coordinate by coordinate.
    fn off(&self, other: &Self) -> [f64; 3] {
        let azimuth = if self.upright() && other.upright() {
            0.0
        } else {
            self.0[2] - other.0[2]
        };
        [self.0[0] - other.0[0], self.0[1] - other.0[1], azimuth]
    }
}

impl std::fmt::Display for Geometry {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [light, camera, azimuth] = self.0.map(|a| (10.0 * a).round() / 10.0);
        write!(
            f,
            "light {light}, camera {camera}, azimuth between {azimuth} degrees"
        )
    }
}

/// Factors by geometry.
struct Table {
    rows: Vec<(Geometry, [f64; 3])>,
}

impl Table {
    fn read(path: &Path) -> Result<Self> {
        let what = || format!("panel table {}", path.display());
        let text = files::read_text(path)?;
        let mut reader = csv::ReaderBuilder::new()
            .trim(csv::Trim::All)
            .comment(Some(b'#'))
            .from_reader(text.as_bytes());
        let names = reader.headers().context(what)?.clone();
        let columns = columns(&names).context(what)?;
        let mut rows = Vec::new();
        for (record, line) in reader.records().zip(2..) {
            let record = record.context(what)?;
            let mut values = [0.0; 6];
            for (value, &column) in values.iter_mut().zip(&columns) {
                let text = record.get(column).unwrap_or("");
                *value = text
                    .parse()
                    .ok()
                    .filter(|v: &f64| v.is_finite())
                    .ok_or_else(|| {
                        Error::new(format!(
                            "{}: line {line}: '{text}' under '{}' is not a number",
                            what(),
                            &names[column]
                        ))
                    })?;
            }
            let [light, camera, azimuth, r, g, b] = values;
            let folded = azimuth
                .to_radians()
                .cos()
                .clamp(-1.0, 1.0)
                .acos()
                .to_degrees();
            rows.push((Geometry([light, camera, folded]), [r, g, b]));
        }
        if rows.is_empty() {
            return Err(Error::new(format!("{} has no rows", what())));
        }
        Ok(Self { rows })
    }

    /// The factor at a geometry: a row's, or straight between two rows that differ from it in one angle, one on either
    /// side; and the standard uncertainty of having gone between them, taken as the difference of the two over the square
    /// root of 12.
    fn at(&self, wanted: Geometry) -> Result<([f64; 3], [f64; 3])> {
        let size = |g: &Geometry| g.off(&wanted).iter().map(|d| d * d).sum::<f64>().sqrt();
        let mut by_distance: Vec<&(Geometry, [f64; 3])> = self.rows.iter().collect();
        by_distance.sort_by(|a, b| size(&a.0).total_cmp(&size(&b.0)));
        if let Some((found, factor)) = by_distance.first()
            && found.off(&wanted).iter().all(|d| d.abs() <= SAME_DEG)
        {
            return Ok((*factor, [0.0; 3]));
        }
        for axis in 0..3 {
            let on_line = |g: &Geometry| {
                let off = g.off(&wanted);
                (0..3).all(|a| a == axis || off[a].abs() <= SAME_DEG)
            };
            let side = |sign: f64| {
                by_distance
                    .iter()
                    .find(|(g, _)| on_line(g) && sign * g.off(&wanted)[axis] > 0.0)
            };
            if let (Some((low, a)), Some((high, b))) = (side(-1.0), side(1.0)) {
                let (down, up) = (-low.off(&wanted)[axis], high.off(&wanted)[axis]);
                let w = down / (down + up);
                let factor = [0, 1, 2].map(|c| (1.0 - w) * a[c] + w * b[c]);
                return Ok((
                    factor,
                    [0, 1, 2].map(|c| (b[c] - a[c]).abs() / 12.0_f64.sqrt()),
                ));
            }
        }
        let nearest: Vec<String> = by_distance
            .iter()
            .take(1)
            .map(|(g, _)| g.to_string())
            .collect();
        Err(Error::new(format!(
            "no row within {SAME_DEG} degrees of the white's geometry ({wanted}), nor rows on both sides of it; the nearest is {}",
            nearest.join("")
        ))
        .with_hint("shoot the white at a geometry of the table, or state its factor there"))
    }
}

/// Where light, camera, azimuth, red, green and blue stand.
fn columns(names: &csv::StringRecord) -> Result<[usize; 6]> {
    let find = |name: &str| {
        names.iter().position(|n| n == name).ok_or_else(|| {
            Error::new(format!("no column '{name}'"))
                .with_hint("columns are light, camera, rel_azimuth and BRF with three wavelengths, as in BRF450,BRF550,BRF620")
        })
    };
    let band = |(i, n): (usize, &str)| Some((n.strip_prefix("BRF")?.parse::<f64>().ok()?, i));
    let mut bands: Vec<(f64, usize)> = names.iter().enumerate().filter_map(band).collect();
    bands.sort_by(|a, b| b.0.total_cmp(&a.0));
    let [red, green, blue] = bands[..] else {
        return Err(Error::new(format!(
            "{} columns of factors (BRF and a wavelength), expected three",
            bands.len()
        )));
    };
    Ok([
        find("light")?,
        find("camera")?,
        find("rel_azimuth")?,
        red.1,
        green.1,
        blue.1,
    ])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table(text: &str) -> Table {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("table.csv");
        std::fs::write(&path, text).unwrap();
        Table::read(&path).unwrap()
    }

    const TEXT: &str = "light,camera,rel_azimuth,BRF450,BRF550,BRF620\n32,32,180,1.05,1.06,1.07\n32,32,90,1.03,1.03,1.03\n64,48,0,0.88,0.87,0.86\n0,45,0,1.0,1.01,1.02\n";

    #[test]
    fn a_geometry_is_looked_up_interpolated_between_two_rows_or_refused() {
        let table = table(TEXT);
        let at = |g: [f64; 3]| table.at(Geometry(g));
        assert_eq!(
            at([32.3, 31.8, 179.9]).unwrap(),
            ([1.07, 1.06, 1.05], [0.0; 3])
        );
        // The azimuth of a light at the normal says nothing.
        let upright = at([0.0, 45.0, 120.0]).unwrap();
        assert_eq!(upright, ([1.02, 1.01, 1.0], [0.0; 3]));
        let (factor, se) = at([32.0, 32.0, 135.0]).unwrap();
        assert!((factor[0] - 1.05).abs() < 1e-12 && (se[0] - 0.04 / 12.0_f64.sqrt()).abs() < 1e-12);
        for beyond in [[32.0, 32.0, 60.0], [48.0, 40.0, 90.0], [64.0, 48.0, 10.0]] {
            let text = at(beyond).unwrap_err().report();
            assert!(
                text.contains("the nearest is light") && text.contains("hint:"),
                "{text}"
            );
        }
    }

    #[test]
    fn a_bad_table_says_where() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("table.csv");
        for (text, expected) in [
            (
                "light,camera,BRF450,BRF550,BRF620\n1,2,3,4,5\n",
                "no column 'rel_azimuth'",
            ),
            (
                "light,camera,rel_azimuth,BRF450\n1,2,3,4\n",
                "1 columns of factors",
            ),
            (
                "light,camera,rel_azimuth,BRF450,BRF550,BRF620\n1,2,3,x,4,5\n",
                "line 2: 'x' under 'BRF450'",
            ),
            (
                "light,camera,rel_azimuth,BRF450,BRF550,BRF620\n",
                "has no rows",
            ),
        ] {
            std::fs::write(&path, text).unwrap();
            let found = Table::read(&path).map(|_| ()).unwrap_err().report();
            assert!(found.contains(expected), "{found}");
        }
    }
}
