//! What several commands read the same way.

use crate::base::{Context, Error, Result};
use crate::fit::FitResult;
use crate::scatter::{AnyModel, Parameters, Parametric, YARN_SYSTEMS};
use crate::session::{SessionFolder, files};
use serde_json::Value;
use std::path::Path;

/// Reads a parameter file (JSON) for `model`, or the parameters of a fit.json.
pub(crate) fn parameters(path: &Path, model: &dyn Parametric) -> Result<Parameters> {
    Parameters::from_json(model, &parameters_object(path)?)
        .context(|| format!("parameters {}", path.display()))
}

/// The object of a parameter file, or that in a fit.json.
fn parameters_object(path: &Path) -> Result<Value> {
    let mut object: Value = serde_json::from_str(&files::read_text(path)?)
        .context(|| format!("parameters {}", path.display()))?;
    if object.get("format").is_some() && object.get("parameters").is_some() {
        object = object["parameters"].take();
    }
    Ok(object)
}

/// As [`parameters`], for the model with parameters per yarn system where the file has them.
pub(crate) fn parameters_and_model(path: &Path, model: AnyModel) -> Result<(Parameters, AnyModel)> {
    let what = || format!("parameters {}", path.display());
    let object = parameters_object(path)?;
    let by_system = YARN_SYSTEMS.iter().any(|s| object.get(s).is_some());
    let model = if by_system {
        model.per_system()?
    } else {
        model
    };
    let parameters = Parameters::from_json(model.parametric(), &object).context(what)?;
    Ok((parameters, model))
}

/// Reads a fit.json, given it or the folder that holds it.
pub(crate) fn fit_result(path: &Path) -> Result<FitResult> {
    if path.is_dir() {
        FitResult::read(&path.join("fit.json"))
    } else {
        FitResult::read(path)
    }
}

/// Parses `1%` or `0.01`.
pub(crate) fn fraction(text: &str) -> Result<f64, String> {
    let (number, scale) = text
        .strip_suffix('%')
        .map_or((text, 1.0), |n| (n.trim_end(), 0.01));
    match number.parse::<f64>() {
        Ok(x) if (x * scale) > 0.0 && (x * scale) < 1.0 => Ok(x * scale),
        _ => Err(format!(
            "'{text}' is not a fraction between 0 and 1; write 1% or 0.01"
        )),
    }
}

/// Opens a session, given its folder or the folder of a demo that holds it as `session/`.
pub(crate) fn session(folder: &Path) -> Result<SessionFolder> {
    let inner = folder.join("session");
    let holds = |f: &Path| f.join("session.json").is_file();
    SessionFolder::open(if !holds(folder) && holds(&inner) {
        &inner
    } else {
        folder
    })
}

/// Makes a folder for results and proves that it can be written, before any long work.
pub(crate) fn prepare_folder(folder: &Path) -> Result<()> {
    let what = || format!("{} cannot be written", folder.display());
    std::fs::create_dir_all(folder).context(what)?;
    let probe = folder.join(format!(".goniofit.{}.part", std::process::id()));
    std::fs::write(&probe, b"")
        .and_then(|()| std::fs::remove_file(&probe))
        .context(what)
}

/// Fails when `path` exists and `force` was not given.
pub(crate) fn refuse_overwriting(path: &Path, force: bool) -> Result<()> {
    if path.exists() && !force {
        return Err(Error::new(format!("{} exists already", path.display()))
            .with_hint("--force replaces it; or choose another name"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fractions_are_percent_or_plain() {
        assert!((fraction("1%").unwrap() - 0.01).abs() < 1e-15);
        assert!((fraction("0.02").unwrap() - 0.02).abs() < 1e-15);
        for bad in ["0", "100%", "nan", "-1%", "1 percent", ""] {
            assert!(fraction(bad).is_err(), "{bad}");
        }
    }
}
