//! Drafts: which yarn is on top at each crossing.
//!
//! Does not check that a cloth holds together (a draft can pass here and still fall apart into layers), and knows one
//! layer only: no double cloth, no pile, no knit.

use crate::base::{Error, Result};

/// Longest side of a draft, in yarns.
pub const MAX_DRAFT: usize = 256;

const KNOWN: &str = "known weaves: 'plain', 'A/B twill' (2/1, 2/2, 3/1, ...), '5-end satin', '8-end satin' (warp on top), \
                     '5-end sateen', '8-end sateen' (weft on top); anything else as draft = [\"10\", \"01\"]";

/// One repeat of a weave: `rows` weft yarns by `columns` warp yarns.
///
/// Row 0 is the weft yarn with the smallest y, column 0 the warp yarn with the smallest x.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Draft {
    rows: usize,
    columns: usize,
    warp_on_top: Vec<bool>,
}

impl Draft {
    /// A draft from text rows of `0` and `1` (1 = warp on top; blanks are ignored).
    ///
    /// # Errors
    /// No rows, rows of different length, another character, more than [`MAX_DRAFT`] yarns, or a yarn that never changes
    /// side (it would not be woven in).
    pub fn from_rows<S: AsRef<str>>(rows: &[S]) -> Result<Self> {
        let mut warp_on_top = Vec::new();
        let mut columns = None;
        for (index, row) in rows.iter().enumerate() {
            let row = read_row(index, row.as_ref())?;
            let expected = *columns.get_or_insert(row.len());
            if row.len() != expected {
                return Err(Error::new(format!(
                    "draft row {}: expected {expected} columns as in row 1, found {}",
                    index + 1,
                    row.len()
                )));
            }
            warp_on_top.extend(row);
        }
        let draft = Self {
            rows: rows.len(),
            columns: columns.unwrap_or(0),
            warp_on_top,
        };
        draft.check()?;
        Ok(draft)
    }

    /// A weave by name; see the hint of its error for the list.
    ///
    /// An `A/B twill` has each warp yarn over A and under B weft yarns, one step per pick; satins step 2 (5-end) or 3
    /// (8-end) yarns per pick.
    ///
    /// # Errors
    /// The name is not known.
    pub fn named(name: &str) -> Result<Self> {
        let unknown = || Error::new(format!("unknown weave '{name}'")).with_hint(KNOWN);
        let lower = name.trim().to_lowercase();
        let words: Vec<&str> = lower.split_whitespace().collect();
        match words.as_slice() {
            ["plain"] => Self::stepped(2, 1, 1),
            ["5-end", "satin"] => Self::stepped(5, 4, 2),
            ["8-end", "satin"] => Self::stepped(8, 7, 3),
            ["5-end", "sateen"] => Self::stepped(5, 1, 2),
            ["8-end", "sateen"] => Self::stepped(8, 1, 3),
            [ratio, "twill"] | ["twill", ratio] => {
                let (over, under) = ratio.split_once('/').ok_or_else(unknown)?;
                let over: usize = over.parse().map_err(|_| unknown())?;
                let under: usize = under.parse().map_err(|_| unknown())?;
                if !((1..=16).contains(&over) && (1..=16).contains(&under)) {
                    return Err(unknown());
                }
                Self::stepped(over + under, over, 1)
            }
            _ => Err(unknown()),
        }
    }

    /// Warp on top in `over` of `size` columns, moved by `step` columns from one row to the next.
    fn stepped(size: usize, over: usize, step: usize) -> Result<Self> {
        let warp_on_top = (0..size * size)
            .map(|k| {
                let (row, column) = (k / size, k % size);
                (column + size * step - (row * step) % size) % size < over
            })
            .collect();
        let draft = Self {
            rows: size,
            columns: size,
            warp_on_top,
        };
        draft.check()?;
        Ok(draft)
    }

    fn check(&self) -> Result<()> {
        if self.rows == 0 || self.columns == 0 {
            return Err(Error::new("the draft is empty: expected rows of 0 and 1").with_hint(KNOWN));
        }
        if self.rows > MAX_DRAFT || self.columns > MAX_DRAFT {
            return Err(Error::new(format!(
                "the draft has {} x {} crossings: expected at most {MAX_DRAFT} x {MAX_DRAFT}",
                self.rows, self.columns
            )));
        }
        let constant = |cells: &[bool]| cells.iter().all(|&c| c == cells[0]);
        let loose = (0..self.rows)
            .find(|&r| constant(&self.weft_cells(r)))
            .map(|r| format!("draft row {}: the weft yarn", r + 1))
            .or_else(|| {
                (0..self.columns)
                    .find(|&c| constant(&self.warp_cells(c)))
                    .map(|c| format!("draft column {}: the warp yarn", c + 1))
            });
        match loose {
            Some(yarn) => Err(
                Error::new(format!("{yarn} stays on one side and is not woven in")).with_hint(
                    "each row and each column of a draft needs at least one 0 and one 1",
                ),
            ),
            None => Ok(()),
        }
    }

    /// Weft yarns per repeat.
    pub fn rows(&self) -> usize {
        self.rows
    }

    /// Warp yarns per repeat.
    pub fn columns(&self) -> usize {
        self.columns
    }

    /// True where the warp yarn `column` lies over the weft yarn `row` (both taken modulo the repeat).
    pub fn warp_on_top(&self, row: usize, column: usize) -> bool {
        self.warp_on_top[(row % self.rows) * self.columns + column % self.columns]
    }

    /// The sides of warp yarn `column` in order of y: true where it is on top.
    pub fn warp_cells(&self, column: usize) -> Vec<bool> {
        (0..self.rows)
            .map(|r| self.warp_on_top(r, column))
            .collect()
    }

    /// The sides of weft yarn `row` in order of x: true where it is on top.
    pub fn weft_cells(&self, row: usize) -> Vec<bool> {
        (0..self.columns)
            .map(|c| !self.warp_on_top(row, c))
            .collect()
    }
}

fn read_row(index: usize, row: &str) -> Result<Vec<bool>> {
    row.chars()
        .filter(|c| !c.is_whitespace())
        .map(|c| match c {
            '0' => Ok(false),
            '1' => Ok(true),
            other => Err(Error::new(format!(
                "draft row {}: expected 0 or 1, found '{other}'",
                index + 1
            ))),
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The rows of a named draft as text, 1 = warp on top.
    fn rows_of(name: &str) -> Vec<String> {
        let draft = Draft::named(name).unwrap();
        let side = |r: usize, c: usize| if draft.warp_on_top(r, c) { '1' } else { '0' };
        let row = |r: usize| (0..draft.columns).map(|c| side(r, c)).collect();
        (0..draft.rows).map(row).collect()
    }

    #[test]
    fn named_weaves_are_the_textbook_drafts() {
        assert_eq!(rows_of("plain"), ["10", "01"]);
        assert_eq!(rows_of("2/1 twill"), ["110", "011", "101"]);
        assert_eq!(rows_of("Twill 2/2"), ["1100", "0110", "0011", "1001"]);
        assert_eq!(rows_of("3/1 twill"), ["1110", "0111", "1011", "1101"]);
        assert_eq!(
            rows_of("5-end satin"),
            ["11110", "10111", "11101", "01111", "11011"]
        );
    }

    #[test]
    fn satins_bind_each_yarn_once_and_never_beside_the_neighbor() {
        for (name, n) in [("5-end satin", 5), ("8-end satin", 8)] {
            let draft = Draft::named(name).unwrap();
            let binding: Vec<usize> = (0..n)
                .map(|r| {
                    let zeros: Vec<usize> = (0..n).filter(|&c| !draft.warp_on_top(r, c)).collect();
                    assert_eq!(zeros.len(), 1, "{name} row {r}");
                    zeros[0]
                })
                .collect();
            for r in 0..n {
                let step = (binding[(r + 1) % n] + n - binding[r]) % n;
                assert!(step > 1 && step < n - 1, "{name}: step {step}");
                assert_eq!(draft.warp_cells(r).iter().filter(|&&c| !c).count(), 1);
            }
        }
    }

    #[test]
    fn bad_drafts_are_refused_with_the_place() {
        let message = |rows: &[&str]| Draft::from_rows(rows).unwrap_err().report();
        assert!(message(&["10", "011"]).starts_with("draft row 2: expected 2 columns"));
        assert!(message(&["10", "0x"]).starts_with("draft row 2: expected 0 or 1, found 'x'"));
        assert!(message(&["11", "01"]).starts_with("draft row 1: the weft yarn stays"));
        assert!(message(&["10", "10"]).starts_with("draft column 1: the warp yarn stays"));
        assert!(message(&[]).starts_with("the draft is empty"));
        let error = Draft::named("herringbone").unwrap_err().report();
        assert!(error.contains("hint: known weaves"), "{error}");
        assert!(Draft::named("0/2 twill").is_err());
        assert!(Draft::named("999999999999999/1 twill").is_err());
    }
}
