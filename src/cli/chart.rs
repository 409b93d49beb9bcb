//! `goniofit chart`.

use super::output::data;
use super::{Outcome, inputs};
use crate::base::{Error, Result};
use crate::fit::{FitResult, Iteration, PairedValue, rms_of};
use crate::report::{Course, CoursePoint, convergence_chart};
use crate::session::files;
use std::path::PathBuf;

/// Iterations that a drawing shows one by one.
const MANY: usize = 60;
/// Otherwise their means over stretches of time that grow so.
const STRETCH: f64 = 1.12;

/// How fits converged: residual against CPU seconds, several fits on one chart
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  goniofit chart fit --svg convergence.svg
  goniofit chart newton published adam --svg methods.svg
  goniofit chart fits/* --json

Prints a line per iteration (CSV), the final check last. Residuals are those of every iteration's own renders, with one
standard error. CPU seconds of an iteration are its share of the fit's, by seconds of rendering. Of more than 60 iterations the
drawing shows means over neighbors that the search went on from.")]
pub(crate) struct Arguments {
    /// Fits: fit.json, or the folders that hold them
    #[arg(required = true, value_name = "FIT")]
    fits: Vec<PathBuf>,
    /// Draw the chart
    #[arg(long, value_name = "C.svg")]
    svg: Option<PathBuf>,
    /// Print JSON instead of CSV
    #[arg(long)]
    json: bool,
    /// Replace an existing drawing
    #[arg(long)]
    force: bool,
}

pub(crate) fn run(a: Arguments) -> Result<Outcome> {
    if let Some(svg) = &a.svg {
        inputs::refuse_overwriting(svg, a.force)?;
    }
    let read = |path: &PathBuf| {
        let fit = inputs::fit_result(path)?;
        let course = course(path.display().to_string(), &fit)?;
        let drawn = smoothed(&course, &fit);
        Ok((course, drawn))
    };
    let fits = a.fits.iter().map(read).collect::<Result<Vec<_>>>()?;
    let courses: Vec<&Course> = fits.iter().map(|(course, _)| course).collect();
    if a.json {
        print_json(&courses);
    } else {
        print_csv(&courses);
    }
    if let Some(svg) = &a.svg {
        let drawn: Vec<Course> = fits.iter().map(|(_, drawn)| drawn.clone()).collect();
        files::write_atomic(svg, convergence_chart(&drawn).as_bytes())?;
    }
    Ok(Outcome::Done)
}

fn course(path: String, fit: &FitResult) -> Result<Course> {
    let cost = &fit.time;
    if !(cost.wall_s > 0.0 && cost.cpu_s > 0.0) {
        return Err(Error::new(format!(
            "{path}: it took {} s and {} CPU s, expected positive numbers",
            cost.wall_s, cost.cpu_s
        )));
    }
    let cpu_per_s = cost.cpu_s / cost.wall_s;
    let points = fit.history.iter().map(|h| CoursePoint {
        cpu_s: h.wall_s * cpu_per_s,
        residual_percent: h.weighted_rms_percent,
        se_percent: h.weighted_rms_se_percent,
        accepted: h.accepted,
    });
    Ok(Course {
        name: format!("{path} ({}, seed {})", fit.method, fit.seed),
        points: points.collect(),
        end: CoursePoint {
            cpu_s: cost.cpu_s,
            residual_percent: fit.objective.weighted_rms_percent,
            se_percent: fit.objective.weighted_rms_se_percent,
            accepted: true,
        },
    })
}

/// The course as it is drawn: where there are many iterations, those the search went on from, and their means over stretches of
/// time, before the root is taken.
fn smoothed(course: &Course, fit: &FitResult) -> Course {
    if course.points.len() <= MANY {
        return course.clone();
    }
    let all = course.points.iter().zip(&fit.history);
    let kept: Vec<(&CoursePoint, &Iteration)> = all.filter(|(p, _)| p.accepted).collect();
    let together = |(a, _): &(&CoursePoint, &Iteration), (b, _): &(&CoursePoint, &Iteration)| {
        let stretch = |p: &CoursePoint| (p.cpu_s.ln() / STRETCH.ln()).floor() as i64;
        stretch(a) == stretch(b)
    };
    let mean = |group: &[(&CoursePoint, &Iteration)]| {
        let n = group.len() as f64;
        let sum = |of: fn(&Iteration) -> f64| group.iter().map(|(_, h)| of(h)).sum::<f64>();
        let value = PairedValue {
            value: sum(|h| h.paired_objective) / n,
            standard_error: sum(|h| h.paired_objective_se.powi(2)).sqrt() / n,
        };
        let (rms, se) = rms_of(value, fit.objective.n);
        CoursePoint {
            cpu_s: group.iter().map(|(p, _)| p.cpu_s).sum::<f64>() / n,
            residual_percent: 100.0 * rms,
            se_percent: 100.0 * se,
            accepted: true,
        }
    };
    Course {
        points: kept.chunk_by(together).map(mean).collect(),
        ..course.clone()
    }
}

fn print_csv(courses: &[&Course]) {
    data!("fit,iteration,cpu_s,weighted_rms_percent,weighted_rms_se_percent,accepted");
    for course in courses {
        let name = course.name.replace('"', "\"\"");
        for (i, p) in course.points.iter().chain([&course.end]).enumerate() {
            let number = match i == course.points.len() {
                true => "check".to_owned(),
                false => (i + 1).to_string(),
            };
            data!(
                "\"{name}\",{number},{},{},{},{}",
                p.cpu_s,
                p.residual_percent,
                p.se_percent,
                p.accepted
            );
        }
    }
}

fn print_json(courses: &[&Course]) {
    let point = |p: &CoursePoint| {
        serde_json::json!({
            "cpu_s": p.cpu_s,
            "weighted_rms_percent": p.residual_percent,
            "weighted_rms_se_percent": p.se_percent,
            "accepted": p.accepted,
        })
    };
    let one = |c: &&Course| {
        let points: Vec<_> = c.points.iter().map(point).collect();
        serde_json::json!({ "fit": c.name, "iterations": points, "check": point(&c.end) })
    };
    let all: Vec<_> = courses.iter().map(one).collect();
    data!("{}", serde_json::Value::Array(all));
}
