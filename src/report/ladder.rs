//! The page and the table of a ladder of models.

use super::html::escape;
use super::page::{STYLE, Section, Table, document, extra};
use crate::fit::ladder::{Evidence, Ladder, Step};

/// The rungs of a ladder, a row each: errors in percent, relative to brightness.
pub fn ladder_table(ladder: &Ladder) -> Table {
    let head = [
        "model",
        "numbers",
        "median",
        "80th",
        "rms",
        "unseen",
        "worst pose",
        "at bounds",
        "starts",
        "seconds",
        "verdict",
    ];
    Table {
        head: head.map(str::to_owned).to_vec(),
        rows: ladder.steps.iter().map(|s| row(ladder, s)).collect(),
    }
}

fn row(ladder: &Ladder, step: &Step) -> Vec<String> {
    let mut cells = vec![step.model.clone(), step.free.to_string()];
    match &step.evidence {
        Some(e) => cells.extend(shown(e)),
        None => cells.extend((0..8).map(|_| "-".to_owned())),
    }
    let choice = &ladder.choice;
    cells.push(match (&step.evidence, step.model == choice.model) {
        (Some(_), true) if choice.adequate => "chosen, good enough".to_owned(),
        (Some(_), true) => "chosen, not good enough".to_owned(),
        (Some(_), false) => step.note.clone(),
        (None, _) => format!("not tried: {}", step.note),
    });
    cells
}

fn shown(e: &Evidence) -> [String; 8] {
    let percent = |x: f64| format!("{:.1} %", 100.0 * x);
    let rms = match e.residual_se > 0.0 {
        true => format!(
            "{:.1} +- {:.1} %",
            100.0 * e.residual,
            100.0 * e.residual_se
        ),
        false => percent(e.residual),
    };
    let bounds = match e.at_bounds.len() {
        0 => "none".to_owned(),
        _ => e.at_bounds.join(" "),
    };
    [
        percent(e.errors.median),
        percent(e.errors.percentile_80),
        rms,
        e.unseen.map_or("-".to_owned(), |u| percent(u.rms)),
        format!("{} ({})", e.worst_pose.0, percent(e.worst_pose.1)),
        bounds,
        e.starts
            .map_or("-".to_owned(), |[agree, all]| format!("{agree} of {all}")),
        format!("{:.2}", e.seconds),
    ]
}

/// A page of a ladder; `title` is its heading, `command` what repeats it.
pub fn ladder_page(ladder: &Ladder, title: &str, command: &str) -> String {
    let [n, distinct] = ladder.numbers;
    let basis = format!(
        "{n} numbers, {distinct} at distinct geometries; errors of the measurements alone leave {:.2} %, and {:.2} % are asked for.",
        100.0 * ladder.noise,
        100.0 * ladder.tolerance
    );
    let section = |title: &str, paragraphs: Vec<String>, table| Section {
        title: title.to_owned(),
        paragraphs,
        table,
        pictures: Vec::new(),
    };
    let open = match ladder.chosen().map(|e| e.undetermined.join(", ")) {
        Some(names) if !names.is_empty() => names,
        _ => "none".to_owned(),
    };
    let sections = [
        section("Advice", vec![ladder.advice.clone(), basis], None),
        section("Models", Vec::new(), Some(ladder_table(ladder))),
        section("Not determined by these poses", vec![open], None),
        section("Warnings", ladder.warnings.clone(), None),
        section("How this was made", vec![command.to_owned()], None),
    ];
    let body: String = sections.iter().map(extra).collect();
    document(title, STYLE, &format!("<h1>{}</h1>\n{body}", escape(title)))
}
