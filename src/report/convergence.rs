//! Residual against CPU time, one line per fit.

use super::html::number;
use super::page::STYLE;
use super::svg::{Axis, Drawing, Scale, log_range};

/// The course of one fit.
#[derive(Debug, Clone, PartialEq)]
pub struct Course {
    /// What the legend calls it.
    pub name: String,
    /// Its iterations, in order.
    pub points: Vec<CoursePoint>,
    /// The final check.
    pub end: CoursePoint,
}

/// Where a fit stood.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CoursePoint {
    /// CPU seconds of rendering so far, all threads.
    pub cpu_s: f64,
    /// Weighted rms residual, percent.
    pub residual_percent: f64,
    /// Its standard error, percent.
    pub se_percent: f64,
    /// Whether the search went on from here.
    pub accepted: bool,
}

const WIDTH: f64 = 680.0;
const HEIGHT: f64 = 420.0;
/// White paper, whatever the reader's screen prefers.
const LIGHT: &str = ":root{color-scheme:light;--ink:#1f2328;--soft:#646b73;--line:#dcd9d3}\n";
/// Height of one line of the legend.
const LINE: f64 = 17.0;

/// Colors that remain apart for the colorblind (Okabe and Ito 2008); yellow is left out, being too light for a line.
const COLORS: [&str; 7] = [
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#56B4E9", "#E69F00",
];
const DASHES: [&str; 3] = ["none", "7 3", "2 3"];

/// How series `k` looks: color, dashes and mark repeat with different periods, so that no two of the first many are alike even
/// without color.
pub(super) struct Look {
    color: &'static str,
    dashes: &'static str,
    mark: usize,
}

impl Look {
    pub(super) fn of(k: usize) -> Self {
        Self {
            color: COLORS[k % COLORS.len()],
            dashes: DASHES[(k / MARKS) % DASHES.len()],
            mark: k % MARKS,
        }
    }

    fn line(&self, d: &mut Drawing, points: &[(f64, f64)]) {
        let list: Vec<String> = points
            .iter()
            .map(|(x, y)| format!("{x:.1},{y:.1}"))
            .collect();
        d.raw(&format!(
            "<polyline points=\"{}\" fill=\"none\" stroke=\"{}\" stroke-width=\"1.4\" stroke-dasharray=\"{}\"/>",
            list.join(" "),
            self.color,
            self.dashes
        ));
    }

    /// The mark around `(x, y)`, of radius `r`; hollow where the search did not go on.
    fn mark(&self, d: &mut Drawing, (x, y): (f64, f64), r: f64, filled: bool, title: &str) {
        let shape = outline(self.mark, x, y, r);
        let fill = if filled { self.color } else { "#ffffff" };
        let title = super::html::escape(title);
        d.raw(&format!(
            "<path d=\"{shape}\" fill=\"{fill}\" stroke=\"{}\" stroke-width=\"1.2\"><title>{title}</title></path>",
            self.color
        ));
    }

    fn whisker(&self, d: &mut Drawing, x: f64, from: f64, to: f64) {
        d.raw(&format!(
            "<line x1=\"{x:.1}\" x2=\"{x:.1}\" y1=\"{from:.1}\" y2=\"{to:.1}\" stroke=\"{}\" stroke-opacity=\".7\"/>",
            self.color
        ));
    }
}

const MARKS: usize = 5;

/// Disk, square, triangle, diamond, cross.
fn outline(mark: usize, x: f64, y: f64, r: f64) -> String {
    match mark {
        0 => format!(
            "M{:.1} {y:.1}a{r} {r} 0 1 0 {:.1} 0a{r} {r} 0 1 0 {:.1} 0z",
            x - r,
            2.0 * r,
            -2.0 * r
        ),
        1 => format!(
            "M{:.1} {:.1}h{d:.1}v{d:.1}h-{d:.1}z",
            x - 0.88 * r,
            y - 0.88 * r,
            d = 1.76 * r
        ),
        2 => format!(
            "M{x:.1} {:.1}l{w:.1} {h:.1}h-{ww:.1}z",
            y - 1.15 * r,
            w = 1.1 * r,
            ww = 2.2 * r,
            h = 1.95 * r
        ),
        3 => format!(
            "M{x:.1} {:.1}l{e:.1} {e:.1}l-{e:.1} {e:.1}l-{e:.1} -{e:.1}z",
            y - 1.25 * r,
            e = 1.25 * r
        ),
        _ => format!(
            "M{:.1} {:.1}l{d:.1} {d:.1}m0 -{d:.1}l-{d:.1} {d:.1}",
            x - 0.9 * r,
            y - 0.9 * r,
            d = 1.8 * r
        ),
    }
}

/// An SVG file: weighted rms residual with bars of one standard error against CPU seconds, both logarithmic. Where it is
/// below the axis there is only the bar. A hollow mark is an iteration that the search did not go on from, the large one the
/// final check on fresh renders.
pub fn convergence_chart(courses: &[Course]) -> String {
    let height = HEIGHT + LINE * courses.len() as f64;
    let mut d = Drawing::new(WIDTH, height, "Residual against CPU seconds");
    d.raw("<rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>");
    let all = || courses.iter().flat_map(|c| c.points.iter().chain([&c.end]));
    let (x_low, x_high) = log_range(all().map(|p| p.cpu_s));
    let (y_low, y_high) =
        log_range(all().flat_map(|p| [p.residual_percent, p.residual_percent + p.se_percent]));
    let x = Axis {
        scale: Scale::Logarithmic,
        low: x_low,
        high: x_high,
        from: 58.0,
        to: WIDTH - 14.0,
    };
    let y = Axis {
        scale: Scale::Logarithmic,
        low: y_low.max(y_high / 1e4),
        high: y_high,
        from: HEIGHT - 48.0,
        to: 28.0,
    };
    d.axes(
        &x,
        &y,
        "CPU seconds of rendering",
        "weighted rms residual, %",
    );
    for (k, course) in courses.iter().enumerate() {
        draw(&mut d, course, &Look::of(k), &x, &y);
        let top = HEIGHT + LINE * k as f64;
        legend(&mut d, course, &Look::of(k), top);
    }
    d.finish_file(&(STYLE.to_owned() + LIGHT))
}

fn draw(d: &mut Drawing, course: &Course, look: &Look, x: &Axis, y: &Axis) {
    let place = |p: &CoursePoint| (x.at(p.cpu_s), y.at(p.residual_percent));
    // What is not above the axis is within its error of zero: its bar says how far up.
    let shown = |p: &&CoursePoint| p.residual_percent > y.low;
    let gone_on = course.points.iter().filter(|p| p.accepted && shown(p));
    let line: Vec<(f64, f64)> = gone_on
        .chain([&course.end].into_iter().filter(shown))
        .map(place)
        .collect();
    look.line(d, &line);
    let last = course.points.len();
    for (i, p) in course.points.iter().chain([&course.end]).enumerate() {
        let (at, _) = place(p);
        look.whisker(
            d,
            at,
            y.at(p.residual_percent - p.se_percent),
            y.at(p.residual_percent + p.se_percent),
        );
        if !shown(&p) {
            continue;
        }
        let what = if i == last {
            "final check"
        } else {
            "iteration"
        };
        let title = format!(
            "{}, {what}: {} ± {} % after {} CPU s",
            course.name,
            number(p.residual_percent, 3),
            number(p.se_percent, 2),
            number(p.cpu_s, 3)
        );
        look.mark(
            d,
            place(p),
            if i == last { 6.0 } else { 3.4 },
            p.accepted,
            &title,
        );
    }
}

fn legend(d: &mut Drawing, course: &Course, look: &Look, y: f64) {
    look.line(d, &[(58.0, y), (94.0, y)]);
    look.mark(d, (76.0, y), 3.4, true, &course.name);
    let end = format!(
        "{}: {} ± {} % in {} CPU s",
        course.name,
        number(course.end.residual_percent, 3),
        number(course.end.se_percent, 2),
        number(course.end.cpu_s, 3)
    );
    d.text("label", 102.0, y + 4.0, "start", &end);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_many_series_look_different_without_color() {
        let looks: Vec<_> = (0..MARKS * DASHES.len())
            .map(|k| (Look::of(k).mark, Look::of(k).dashes))
            .collect();
        let distinct: std::collections::HashSet<_> = looks.iter().collect();
        assert_eq!(distinct.len(), looks.len());
    }
}
