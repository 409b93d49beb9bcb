//! Slices in the order of their numbers.

use crate::base::{Error, Result};
use std::path::{Path, PathBuf};

/// Sorts the files of a series by the last number in their names (`slice9.tif` before `slice10.tif`).
///
/// # Errors
/// A name has no number, there are several series (names that differ in more than the number), a number occurs twice, or
/// one is missing.
pub(super) fn series(files: Vec<PathBuf>) -> Result<Vec<PathBuf>> {
    if files.len() == 1 {
        return Ok(files);
    }
    let mut numbered = files
        .into_iter()
        .map(|file| Ok((split(&file)?, file)))
        .collect::<Result<Vec<_>>>()?;
    numbered.sort();
    for pair in numbered.windows(2) {
        let [((name_a, a), file_a), ((name_b, b), file_b)] = pair else {
            continue;
        };
        let (shown_a, shown_b) = (name(file_a), name(file_b));
        if name_a != name_b {
            return Err(Error::new(format!(
                "several series of slices: {shown_a} and {shown_b} differ in more than a number"
            ))
            .with_hint("put each series into a folder of its own"));
        }
        if a == b {
            return Err(Error::new(format!(
                "{shown_a} and {shown_b} have the same number"
            )));
        }
        if b - a > 1 {
            let missing = if b - a == 2 {
                format!("slice {} is missing", a + 1)
            } else {
                format!("slices {} to {} are missing", a + 1, b - 1)
            };
            return Err(
                Error::new(format!("{missing} between {shown_a} and {shown_b}"))
                    .with_hint("find the slices, or number those there are without a gap"),
            );
        }
    }
    Ok(numbered.into_iter().map(|n| n.1).collect())
}

/// What is the same in all names of a series, and the number.
fn split(file: &Path) -> Result<((String, String), u64)> {
    let stem = file.file_stem().unwrap_or_default().to_string_lossy();
    let digit = |c: char| c.is_ascii_digit();
    let number = stem.rfind(digit).map(|last| {
        let first = stem[..=last].rfind(|c| !digit(c)).map_or(0, |i| {
            i + stem[i..].chars().next().map_or(1, char::len_utf8)
        });
        (first, last + 1)
    });
    let parsed = number.and_then(|(a, b)| Some((a, b, stem[a..b].parse::<u64>().ok()?)));
    parsed
        .map(|(a, b, n)| ((stem[..a].to_owned(), stem[b..].to_owned()), n))
        .ok_or_else(|| {
            Error::new(format!(
                "{} has no number: its place among the slices is unknown",
                name(file)
            ))
            .with_hint("name slices as slice_0001.tif, and keep other TIFF files elsewhere")
        })
}

/// A file's name for a message.
pub(super) fn name(file: &Path) -> String {
    file.file_name()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sorted(names: &[&str]) -> Result<Vec<String>> {
        let files = series(names.iter().map(PathBuf::from).collect())?;
        Ok(files.iter().map(|f| name(f)).collect())
    }

    #[test]
    fn slices_go_by_their_last_number() {
        let names = [
            "c5um_10_rec.tif",
            "c5um_9_rec.tif",
            "c5um_011_rec.tif",
            "c5um_8_rec.tif",
        ];
        let expected = [
            "c5um_8_rec.tif",
            "c5um_9_rec.tif",
            "c5um_10_rec.tif",
            "c5um_011_rec.tif",
        ];
        assert_eq!(sorted(&names).unwrap(), expected);
        assert_eq!(
            sorted(&["\u{b5}7.tif", "\u{b5}6.tif"]).unwrap()[0],
            "\u{b5}6.tif"
        );
    }

    #[test]
    fn a_series_with_a_fault_is_refused() {
        for (names, message) in [
            (
                &["a1.tif", "a2.tif", "a4.tif"][..],
                "slice 3 is missing between a2.tif and a4.tif",
            ),
            (&["a1.tif", "a5.tif"], "slices 2 to 4 are missing"),
            (&["a1.tif", "b2.tif"], "several series"),
            (&["a1.tif", "a01.tif"], "same number"),
            (&["a1.tif", "flat.tif"], "flat.tif has no number"),
        ] {
            let error = sorted(names).unwrap_err();
            assert!(error.to_string().contains(message), "{error}");
        }
    }
}
