//! What a ladder says to people.

use super::{Choice, Evidence, Facts, Ladder, Step};

/// Errors at unseen geometries so many times those at fitted ones are worth a warning.
const MUCH: f64 = 2.0;

/// The ladder with its advice and warnings.
pub(super) fn told(facts: &Facts<'_>, steps: Vec<Step>, choice: Choice) -> Ladder {
    let tried = steps.iter().filter_map(|s| s.evidence.as_ref());
    let chosen = tried.clone().find(|e| e.model == choice.model);
    let (advice, warnings) = match chosen {
        Some(chosen) => (
            advice(facts, &steps, &choice, chosen),
            warnings(facts, &choice, chosen),
        ),
        None => (String::new(), Vec::new()),
    };
    Ladder {
        format: "goniofit-ladder-1".to_owned(),
        numbers: [facts.n, facts.n_distinct],
        noise: facts.noise,
        tolerance: facts.tolerance,
        steps,
        choice,
        advice,
        warnings,
    }
}

fn percent(x: f64) -> String {
    format!("{:.1} %", 100.0 * x)
}

fn advice(facts: &Facts<'_>, steps: &[Step], choice: &Choice, chosen: &Evidence) -> String {
    let model = &choice.model;
    let untried = steps.iter().find(|s| s.traced && s.evidence.is_none());
    if !choice.adequate {
        if chosen.residual <= facts.tolerance {
            return format!(
                "{model} may be good enough, but its renders leave {} unknown by {}: give more --paths or --time.",
                percent(chosen.residual),
                percent(chosen.residual_se)
            );
        }
        let next = match untried {
            Some(s) => format!("try --model {}", s.model),
            None => "doubt the measurements or the cloth's description before any number here"
                .to_owned(),
        };
        return format!(
            "No model tried is good enough: {model} is the best of them and leaves {} where {} are asked for; {next}.",
            percent(chosen.residual),
            percent(facts.tolerance)
        );
    }
    let how = match choice.reaches_noise {
        true => format!(
            "it reaches the noise of the measurements, {}",
            percent(facts.noise)
        ),
        false => format!(
            "it leaves {}, within the {} asked for but above the noise of {}",
            percent(chosen.residual),
            percent(facts.tolerance),
            percent(facts.noise)
        ),
    };
    if choice.firm {
        format!("Use {model}: {how}.")
    } else {
        format!(
            "{model} will do for these poses ({how}), but whether the cloth needs it, less or more cannot be told: {}.",
            choice.doubts.join("; ")
        )
    }
}

fn warnings(facts: &Facts<'_>, choice: &Choice, chosen: &Evidence) -> Vec<String> {
    let mut list = vec![format!(
        "away from the measured poses, and beyond {:.0} degrees, nothing was measured that holds {} in check",
        facts.steepest.to_degrees(),
        choice.model
    )];
    if let Some(unseen) = chosen
        .unseen
        .filter(|u| u.rms > MUCH * chosen.residual.max(facts.noise))
    {
        list.push(format!(
            "geometries left out of the fit are missed by {} (half of the numbers by less than {}), those in it by {}",
            percent(unseen.rms),
            percent(unseen.median),
            percent(chosen.residual)
        ));
    }
    if !chosen.undetermined.is_empty() {
        list.push(format!(
            "these poses do not determine {}",
            chosen.undetermined.join(", ")
        ));
    }
    if chosen.albedo.is_some_and(|a| a.iter().any(|a| *a > 1.0)) {
        list.push("the fitted cloth reflects more light than falls on it".to_owned());
    }
    list
}
