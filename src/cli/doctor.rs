//! `goniofit doctor`: is everything there for a capture?

mod cameras;
mod machine;
mod ports;
mod rig;

use super::Outcome;
use super::output::data;
use super::ports::override_ports;
use crate::base::Result;
use crate::rig::RigDescription;
use crate::session::Plan;
use serde_json::json;
use std::path::PathBuf;

/// Check ports, rig file, cameras, disk and clock before a capture
///
/// Looks and does not touch: no port is opened and nothing moves, unless --probe asks for it. Each line says ok, warn or
/// fail, and what to do. Exit code 0 when nothing fails, 1 otherwise.
#[derive(clap::Args)]
#[command(after_help = "Examples:
  goniofit doctor
      what this machine has
  goniofit doctor --rig R.toml --plan P.toml --out session
      and whether this capture could begin: ports, permissions, limits, disk space
  goniofit doctor --rig R.toml --probe
      and whether a controller answers on each port; opening a port resets many boards
  goniofit doctor --json | jq '.findings[] | select(.level != \"ok\")'")]
pub(crate) struct Arguments {
    /// Rig description
    #[arg(long, value_name = "R.toml")]
    rig: Option<PathBuf>,
    /// Plan to check against the rig's limits
    #[arg(long, value_name = "P.toml", requires = "rig")]
    plan: Option<PathBuf>,
    /// Port of a device instead of the rig file's: PATH, or BOARD=PATH (or lamp=PATH) for each
    #[arg(long, value_name = "[BOARD=]PATH", requires = "rig")]
    port: Vec<String>,
    /// Where the session shall go
    #[arg(long, value_name = "DIR", default_value = ".")]
    out: PathBuf,
    /// Open the ports and ask who is there; resets many boards and stops a motion under way
    #[arg(long)]
    probe: bool,
    /// Print the findings as JSON
    #[arg(long)]
    json: bool,
}

/// How bad a finding is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Level {
    Ok,
    Warn,
    Fail,
}

impl Level {
    fn name(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Warn => "warn",
            Self::Fail => "fail",
        }
    }
}

/// One line of the doctor.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Finding {
    area: &'static str,
    level: Level,
    what: String,
    /// What to do about it.
    todo: String,
}

/// Findings of one area.
struct Findings {
    area: &'static str,
    all: Vec<Finding>,
}

impl Findings {
    fn new(area: &'static str) -> Self {
        Self {
            area,
            all: Vec::new(),
        }
    }

    fn add(&mut self, level: Level, what: impl Into<String>, todo: impl Into<String>) {
        self.all.push(Finding {
            area: self.area,
            level,
            what: what.into(),
            todo: todo.into(),
        });
    }

    fn ok(&mut self, what: impl Into<String>) {
        self.add(Level::Ok, what, "");
    }

    /// A failure with its own hints as what to do.
    fn fail(&mut self, error: &crate::base::Error) {
        let report = error.report();
        let (what, hints) = report.split_once("\nhint: ").unwrap_or((&report, ""));
        let todo = if hints.is_empty() {
            "docs/rig.md explains every key of the rig file".to_owned()
        } else {
            hints.replace("\nhint: ", "; ")
        };
        self.add(Level::Fail, what, todo);
    }
}

pub(crate) fn run(arguments: Arguments) -> Result<Outcome> {
    let mut of_rig = Findings::new("rig");
    let rig = arguments.rig.as_deref().and_then(|path| {
        let read = RigDescription::read(path).and_then(|mut rig| {
            override_ports(&mut rig, &arguments.port)?;
            Ok(rig)
        });
        read.map_err(|e| of_rig.fail(&e)).ok()
    });
    let plan = arguments
        .plan
        .as_deref()
        .and_then(|path| Plan::read(path).map_err(|e| of_rig.fail(&e)).ok());
    if let Some(rig) = &rig {
        rig::look(rig, plan.as_ref(), &mut of_rig);
    }
    let mut findings = ports::look(rig.as_ref(), arguments.probe);
    findings.extend(of_rig.all);
    findings.extend(cameras::look());
    findings.extend(machine::look(&arguments.out, rig.as_ref(), plan.as_ref()));
    print(&findings, arguments.json);
    let failed = findings.iter().any(|f| f.level == Level::Fail);
    Ok(if failed {
        Outcome::OutsideTolerance
    } else {
        Outcome::Done
    })
}

fn print(findings: &[Finding], json: bool) {
    if json {
        let rows: Vec<_> = findings
            .iter()
            .map(|f| {
                json!({"area": f.area, "level": f.level.name(), "what": f.what, "todo": f.todo})
            })
            .collect();
        let ok = findings.iter().all(|f| f.level != Level::Fail);
        data!("{}", json!({"ok": ok, "findings": rows}));
        return;
    }
    for f in findings {
        data!("{:<5} {:<7} {}", f.level.name(), f.area, f.what);
        if !f.todo.is_empty() {
            data!("              -> {}", f.todo);
        }
    }
}
