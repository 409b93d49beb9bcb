//! `goniofit report`.

use super::{Outcome, inputs, terminal::Terminal};
use crate::base::Result;
use crate::fit::FitResult;
use crate::report::{Provenance, page};
use crate::session::files;
use std::path::PathBuf;

/// Make the HTML page of a fit
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  goniofit report fit --force                    # remakes fit/report.html
  goniofit report fit/fit.json --out page.html

The page is one file: no scripts, nothing loaded from elsewhere.")]
pub(crate) struct Arguments {
    /// A fit.json, or the folder that holds one
    fit: PathBuf,
    /// The page to write [default: report.html beside fit.json]
    #[arg(long, value_name = "PAGE.html")]
    out: Option<PathBuf>,
    /// Replace an existing page
    #[arg(long)]
    force: bool,
}

pub(crate) fn run(a: Arguments) -> Result<Outcome> {
    let fit = if a.fit.is_dir() {
        a.fit.join("fit.json")
    } else {
        a.fit.clone()
    };
    let result = FitResult::read(&fit)?;
    let out = a.out.unwrap_or_else(|| fit.with_file_name("report.html"));
    inputs::refuse_overwriting(&out, a.force)?;
    files::write_atomic(&out, page(&result, &Provenance::default()).as_bytes())?;
    Terminal::new()?.say(format!("wrote {}", out.display()));
    Ok(Outcome::Done)
}
