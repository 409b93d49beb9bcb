//! One file per command: reads arguments, composes the rooms, prints.
//!
//! stdout is data; everything else goes to stderr. Exit codes: 0 done; 1 finished but not within tolerance, or ended early
//! and resumable; 2 error; 3 stopped by the operator; 4 halted the fastest way, position unknown; 130 interrupted before
//! there was a result.

// Printing is this room's work.
#![allow(clippy::print_stderr)]

mod inputs;
mod judge;
mod output;
mod ports;
mod screen;
mod terminal;

mod calibrate;
mod calibrate_color;
mod calibrate_geometry;
mod capture;
mod chart;
mod compare;
mod crops;
mod ct;
mod demo;
mod doctor;
mod fabric;
mod fit;
mod fit_all;
mod measure;
mod measured;
mod plan;
mod predict;
mod render;
mod report;
mod rig;
mod scatter;
mod session;
mod sim;
mod simulate;
mod validate;
mod woven;

use crate::base::Result;
use clap::{Parser, Subcommand};
use std::process::ExitCode;

/// How a command that did not fail ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Outcome {
    /// Exit code 0.
    Done,
    /// Exit code 1: finished, but not within tolerance (not converged, saturated frames).
    OutsideTolerance,
    /// Exit code 3: ended by the operator, the rig stopped in order.
    Aborted,
    /// Exit code 4: ended by the operator, the rig stopped the fastest way.
    Halted,
    /// Exit code 130: interrupted before there was a result; what was done is kept.
    Interrupted,
}

/// From a gonioreflectometer's plan to fiber scattering parameters: move the rig, measure the frames, fit, report.
#[derive(Parser)]
#[command(name = "goniofit", version, propagate_version = true)]
struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Demo(demo::Arguments),
    Simulate(simulate::Arguments),
    Sim(sim::Arguments),
    Plan(plan::Arguments),
    Capture(capture::Arguments),
    Calibrate(calibrate::Arguments),
    Session(session::Arguments),
    Rig(rig::Arguments),
    Doctor(doctor::Arguments),
    Measure(measure::Arguments),
    Fit(fit::Arguments),
    FitAll(fit_all::Arguments),
    Render(render::Arguments),
    Scatter(scatter::Arguments),
    Fabric(fabric::Arguments),
    Ct(ct::Arguments),
    Woven(woven::Arguments),
    Predict(predict::Arguments),
    Validate(validate::Arguments),
    Compare(compare::Arguments),
    Chart(chart::Arguments),
    Report(report::Arguments),
}

/// Runs the program on the process's arguments.
pub fn main() -> ExitCode {
    let arguments = Arguments::parse();
    match run(arguments.command) {
        Ok(Outcome::Done) => ExitCode::SUCCESS,
        Ok(Outcome::OutsideTolerance) => ExitCode::from(1),
        Ok(Outcome::Aborted) => ExitCode::from(3),
        Ok(Outcome::Halted) => ExitCode::from(4),
        Ok(Outcome::Interrupted) => ExitCode::from(130),
        Err(error) => {
            eprintln!("error: {}", error.report());
            ExitCode::from(2)
        }
    }
}

fn run(command: Command) -> Result<Outcome> {
    match command {
        Command::Demo(a) => demo::run(a),
        Command::Simulate(a) => simulate::run(a),
        Command::Sim(a) => sim::run(a),
        Command::Plan(a) => plan::run(a),
        Command::Capture(a) => capture::run(a),
        Command::Calibrate(a) => calibrate::run(a),
        Command::Session(a) => session::run(a),
        Command::Rig(a) => rig::run(a),
        Command::Doctor(a) => doctor::run(a),
        Command::Measure(a) => measure::run(a),
        Command::Fit(a) => fit::run(a),
        Command::FitAll(a) => fit_all::run(a),
        Command::Render(a) => render::run(a),
        Command::Scatter(a) => scatter::run(a),
        Command::Fabric(a) => fabric::run(a),
        Command::Ct(a) => ct::run(a),
        Command::Woven(a) => woven::run(a),
        Command::Predict(a) => predict::run(a),
        Command::Validate(a) => validate::run(a),
        Command::Compare(a) => compare::run(a),
        Command::Chart(a) => chart::run(a),
        Command::Report(a) => report::run(a),
    }
}
