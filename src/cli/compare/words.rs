//! The comparison in words.

use crate::cli::output::data;
use crate::fit::{Residuals, SideBySide, Verdict};
use serde_json::Value;

/// What there is to say of the scan and of what was found in it: name and value.
pub(super) fn facts(report: &Value) -> Vec<(String, String)> {
    let facts = [
        ("scan", scan(&report["scan"])),
        ("volume", volume(&report["volume"])),
        ("fibers found", found(&report["fibers"]["found"])),
        (
            "against the true fibers",
            against_truth(&report["fibers"]["against_truth"]),
        ),
        (
            "directions of the volume",
            transferred(&report["fibers"]["transferred_share"]),
        ),
    ];
    let there = |(name, value): (&str, Option<String>)| Some((name.to_owned(), value?));
    facts.into_iter().filter_map(there).collect()
}

fn scan(v: &Value) -> Option<String> {
    let dims: Vec<String> = v["dims"].as_array()?.iter().map(Value::to_string).collect();
    Some(format!(
        "{} voxels of {:.3} um, blurred by {:.2} um, noise {} of the step from air to fiber; {:.1} % fiber; stretched along y by {:.4}",
        dims.join(" x "),
        1e3 * v["voxel_mm"].as_f64()?,
        1e3 * v["blur_mm"].as_f64()?,
        v["noise"],
        100.0 * v["fiber_share"].as_f64()?,
        v["stretch_y"].as_f64()?
    ))
}

fn volume(v: &Value) -> Option<String> {
    if let Some(file) = v["file"].as_str() {
        return Some(file.to_owned());
    }
    Some(format!(
        "{} of {} voxels kept, those of density {:.3} or more; directions by structure tensor",
        v["kept"],
        v["voxels"],
        v["eps_d"].as_f64()?
    ))
}

fn found(v: &Value) -> Option<String> {
    Some(format!(
        "{} lines, {:.1} mm, radius {:.2} um",
        v["fibers"],
        v["length_mm"].as_f64()?,
        1e3 * v["radius_mm"][0].as_f64()?
    ))
}

fn against_truth(v: &Value) -> Option<String> {
    Some(format!(
        "{:.1} % of their length found, {:.1} % of what was found is right; directions {:.1} degrees off at the median; {:.1} pieces a fiber",
        100.0 * v["recall"].as_f64()?,
        100.0 * v["precision"].as_f64()?,
        v["direction_median"].as_f64()?,
        v["pieces"].as_f64()?
    ))
}

fn transferred(share: &Value) -> Option<String> {
    Some(format!(
        "those of found fibers within two radii of them: {:.1} % of the voxels",
        100.0 * share.as_f64()?
    ))
}

/// The comparison as a table for people.
pub(super) fn print_table(result: &SideBySide) {
    if result.synthetic {
        data!("SYNTHETIC measurements: rendered, not photographed");
    }
    data!(
        "model        residual, %      validation, %    CPU s     paths       at bounds; not determined"
    );
    for m in &result.models {
        let list = |verdicts: &[Verdict]| match m.named(verdicts).as_slice() {
            [] => "-".to_owned(),
            names => names.join(" "),
        };
        data!(
            "{:<12} {:<16} {:<16} {:<9.1} {:<11} {}; {}",
            m.name,
            rms(&m.fitted),
            m.validation.as_ref().map_or("-".to_owned(), rms),
            m.cpu_s,
            m.paths,
            list(&[Verdict::AtLowerBound, Verdict::AtUpperBound]),
            list(&[Verdict::NotDetermined])
        );
    }
}

fn rms(r: &Residuals) -> String {
    format!(
        "{:.2} +- {:.2}",
        r.weighted_rms_percent, r.weighted_rms_se_percent
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn only_what_is_known_is_said() {
        let report = json!({
            "volume": {"file": "/cloth.nrrd"},
            "fibers": {"found": {"fibers": 3, "length_mm": 1.25, "radius_mm": [0.008, 0.008]}},
        });
        let said: Vec<String> = facts(&report).into_iter().map(|(_, v)| v).collect();
        assert_eq!(said, ["/cloth.nrrd", "3 lines, 1.2 mm, radius 8.00 um"]);
    }
}
