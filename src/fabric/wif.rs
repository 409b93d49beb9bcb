//! Drafts in the Weaving Information File format (WIF 1.1, 1997), which weaving programs write.
//!
//! Read: `[WEAVING]` (`Rising Shed`), `[WARP]` and `[WEFT]` (`Threads`), `[THREADING]`, and `[LIFTPLAN]` or `[TIEUP]` with `[TREADLING]`. Colors,
//! spacings, thicknesses and private sections are skipped. Warp thread 1 becomes column 0, pick 1 row 0, and a draft that repeats itself is cut
//! to its smallest repeat.

use super::Draft;
use crate::base::{Error, Result};
use std::collections::HashMap;

/// Longest list of threads or picks.
const MOST: usize = 20_000;

type Section = HashMap<String, String>;

impl Draft {
    /// The draft of a WIF file.
    ///
    /// # Errors
    /// A section is missing, a number cannot be read, a shaft or treadle is used that nothing moves, or as [`Draft::from_rows`].
    pub fn from_wif(text: &str) -> Result<Self> {
        let sections = sections(text);
        let threading = lists(&sections, "THREADING")?;
        let ends = count(&sections, "WARP", &threading)?;
        let lifts = if sections.contains_key("LIFTPLAN") {
            lists(&sections, "LIFTPLAN")?
        } else {
            lifts_of_treadles(&sections)?
        };
        let picks = count(&sections, "WEFT", &lifts)?;
        let rising = sections
            .get("WEAVING")
            .and_then(|s| s.get("RISING SHED"))
            .is_none_or(|v| is_true(v));
        let none = Vec::new();
        let rows: Vec<Vec<bool>> = (1..=picks)
            .map(|pick| {
                let lifted = lifts.get(&pick).unwrap_or(&none);
                let on_top = |end: usize| {
                    let shafts = threading.get(&end).unwrap_or(&none);
                    shafts.iter().any(|s| lifted.contains(s)) == rising
                };
                (1..=ends).map(on_top).collect()
            })
            .collect();
        let columns: Vec<Vec<bool>> = (0..ends)
            .map(|c| rows.iter().map(|r| r[c]).collect())
            .collect();
        let (n_rows, n_columns) = (period(&rows), period(&columns));
        let text: Vec<String> = rows[..n_rows]
            .iter()
            .map(|r| {
                r[..n_columns]
                    .iter()
                    .map(|&w| if w { '1' } else { '0' })
                    .collect()
            })
            .collect();
        Self::from_rows(&text)
    }
}

/// The smallest number of leading items of which the list is whole copies.
fn period(list: &[Vec<bool>]) -> usize {
    let n = list.len();
    let repeats = |p: usize| n.is_multiple_of(p) && (p..n).all(|k| list[k] == list[k - p]);
    (1..n).find(|&p| repeats(p)).unwrap_or(n)
}

/// Sections and their entries, names in capitals; comments start with a semicolon.
fn sections(text: &str) -> HashMap<String, Section> {
    let mut all: HashMap<String, Section> = HashMap::new();
    let mut name = String::new();
    for line in text.lines() {
        let line = line.split(';').next().unwrap_or("").trim();
        if let Some(title) = line.strip_prefix('[').and_then(|l| l.strip_suffix(']')) {
            name = title.trim().to_uppercase();
            all.entry(name.clone()).or_default();
        } else if let Some((key, value)) = line.split_once('=') {
            let section = all.entry(name.clone()).or_default();
            section.insert(key.trim().to_uppercase(), value.trim().to_owned());
        }
    }
    all
}

fn is_true(value: &str) -> bool {
    ["true", "yes", "on", "1"].contains(&value.to_lowercase().as_str())
}

fn whole(section: &str, text: &str) -> Result<usize> {
    let number: Option<usize> = text.trim().parse().ok();
    number.filter(|n| *n <= MOST).ok_or_else(|| {
        Error::new(format!(
            "wif [{section}]: expected a whole number up to {MOST}, found '{}'",
            text.trim()
        ))
    })
}

/// A section of lists of numbers: `3=1,4`. A zero means none.
fn lists(sections: &HashMap<String, Section>, name: &str) -> Result<HashMap<usize, Vec<usize>>> {
    let section = sections.get(name).ok_or_else(|| {
        Error::new(format!("wif: section [{name}] is missing"))
            .with_hint("a draft needs [THREADING], and [LIFTPLAN] or [TIEUP] and [TREADLING]")
    })?;
    let mut all = HashMap::new();
    for (key, value) in section {
        let mut list = Vec::new();
        for item in value.split(',').filter(|item| !item.trim().is_empty()) {
            let number = whole(name, item)?;
            if number > 0 {
                list.push(number);
            }
        }
        all.insert(whole(name, key)?, list);
    }
    Ok(all)
}

/// The shafts that each pick's treadles move.
fn lifts_of_treadles(sections: &HashMap<String, Section>) -> Result<HashMap<usize, Vec<usize>>> {
    let treadling = lists(sections, "TREADLING")?;
    let tie_up = lists(sections, "TIEUP")?;
    let mut lifts = HashMap::new();
    for (pick, treadles) in treadling {
        let mut shafts = Vec::new();
        for treadle in treadles {
            let tied = tie_up.get(&treadle).ok_or_else(|| {
                Error::new(format!(
                    "wif [TREADLING]: pick {pick} uses treadle {treadle}, which [TIEUP] does not have"
                ))
            })?;
            shafts.extend(tied);
        }
        lifts.insert(pick, shafts);
    }
    Ok(lifts)
}

/// The number of threads a section says, or the largest that a list has.
fn count(
    sections: &HashMap<String, Section>,
    name: &str,
    list: &HashMap<usize, Vec<usize>>,
) -> Result<usize> {
    let stated = sections.get(name).and_then(|s| s.get("THREADS"));
    let count = match stated {
        Some(text) => whole(name, text)?,
        None => list.keys().copied().max().unwrap_or(0),
    };
    if count > 0 {
        return Ok(count);
    }
    Err(Error::new(format!(
        "wif [{name}]: expected at least one thread"
    )))
}

#[cfg(test)]
mod tests {
    use super::*;

    const TWILL: &str = "[WIF]\nVersion=1.1\n[CONTENTS]\nTHREADING=true\n[WEAVING]\nShafts=4\nTreadles=4\nRising Shed=yes\n\
        [WARP]\nThreads=8 ; two repeats\n[WEFT]\nThreads=4\n\
        [THREADING]\n1=1\n2=2\n3=3\n4=4\n5=1\n6=2\n7=3\n8=4\n\
        [TIEUP]\n1=1,2\n2=2,3\n3=3,4\n4=4,1\n[TREADLING]\n1=1\n2=2\n3=3\n4=4\n\
        [Private Mill]\ncolor=blue\n";

    #[test]
    fn a_tie_up_a_lift_plan_and_a_sinking_shed_give_the_named_draft() {
        let named = Draft::named("2/2 twill").unwrap();
        assert_eq!(Draft::from_wif(TWILL).unwrap(), named);
        let plan = TWILL.replace("[TIEUP]", "[Nothing]").replace(
            "[TREADLING]\n1=1\n2=2\n3=3\n4=4",
            "[LIFTPLAN]\n1=1,2\n2=2,3\n3=3,4\n4=4,1",
        );
        assert_eq!(Draft::from_wif(&plan).unwrap(), named);
        // A sinking shed with the other shafts tied.
        let sinking = TWILL
            .replace("Rising Shed=yes", "Rising Shed=no")
            .replace("1=1,2\n2=2,3\n3=3,4\n4=4,1", "1=3,4\n2=4,1\n3=1,2\n4=2,3");
        assert_eq!(Draft::from_wif(&sinking).unwrap(), named);
        // Control: without its shafts exchanged it is another draft.
        let wrong = TWILL.replace("Rising Shed=yes", "Rising Shed=no");
        assert_ne!(Draft::from_wif(&wrong).unwrap(), named);
    }

    #[test]
    fn bad_files_are_refused_with_the_section() {
        let message = |text: &str| Draft::from_wif(text).unwrap_err().report();
        assert!(message("").starts_with("wif: section [THREADING] is missing"));
        let error = message(&TWILL.replace("1=1,2", "1=1,x"));
        assert!(error.starts_with("wif [TIEUP]: expected a whole number up to 20000, found 'x'"));
        let error = message(&TWILL.replace("[TREADLING]\n1=1", "[TREADLING]\n1=9"));
        assert!(error.contains("pick 1 uses treadle 9"), "{error}");
        let error = message(&TWILL.replace("Threads=8", "Threads=0"));
        assert!(error.starts_with("wif [WARP]: expected at least one thread"));
        let error = message(
            &TWILL
                .replace("4=4,1", "4=2,3")
                .replace("3=3,4", "3=2,3")
                .replace("1=1,2", "1=2,3"),
        );
        assert!(error.contains("is not woven in"), "{error}");
    }
}
