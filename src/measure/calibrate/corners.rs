//! The inner corners of a checkerboard in a RAW frame, to hundredths of a pixel.
//!
//! Nothing is demosaiced: every value is compared with the picture of a corner, and each place of the color filter mosaic
//! has its own black and white, so filters, black levels and white balance move no corner. The picture of a corner is
//! point-symmetric about it and so are the values used, which is why an error of the assumed blur or of the edges'
//! directions moves it only in second order. Light that changes linearly across the corner is fitted along.

use super::least_squares::{Normal, Solution};
use super::view::{Value, View};

/// A board as it should be seen: inner corners each way, and the image point of a point given in squares from the middle
/// of the inner corners.
pub(super) struct Expected<'a> {
    pub(super) corners: [usize; 2],
    pub(super) to_pixel: &'a dyn Fn([f64; 2]) -> [f64; 2],
}

impl Expected<'_> {
    /// The inner corners in squares from their middle, and whether the squares between +x and +y and opposite are of the
    /// board's first (+1) or second color (-1).
    pub(super) fn places(&self) -> impl Iterator<Item = ([f64; 2], f64)> {
        let [columns, rows] = self.corners;
        let middle = [0, 1].map(|a| 0.5 * (self.corners[a].saturating_sub(1)) as f64);
        (0..columns * rows).map(move |k| {
            let (i, j) = (k % columns, k / columns);
            let sign = if (i + j) % 2 == 0 { 1.0 } else { -1.0 };
            ([i as f64 - middle[0], j as f64 - middle[1]], sign)
        })
    }

    /// The edges that cross at a place.
    fn edges(&self, [a, b]: [f64; 2]) -> Edges {
        let middle = (self.to_pixel)([a, b]);
        // Along the board's y and x: one square, and how far its middle lies off the chord.
        let along = [[0.0, 0.5], [0.5, 0.0]].map(|[da, db]: [f64; 2]| {
            let (p, q) = (
                (self.to_pixel)([a + da, b + db]),
                (self.to_pixel)([a - da, b - db]),
            );
            let square = [p[0] - q[0], p[1] - q[1]];
            let off = [0, 1].map(|k| 0.5 * (p[k] + q[k]) - middle[k]);
            (square, off)
        });
        Edges::new(along)
    }

    /// The smallest distance between opposite edges of a square, over all corners, pixels.
    pub(super) fn smallest_square(&self) -> f64 {
        let widths = self
            .places()
            .map(|(p, _)| self.edges(p))
            .flat_map(|e| e.spacing);
        widths.fold(f64::MAX, f64::min)
    }
}

/// How a board was first found.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sighting {
    /// Where it is from where it was expected, squares.
    pub(super) shift: [f64; 2],
    /// How well it agrees with a checkerboard, 0..=1.
    pub(super) agreement: f64,
    /// Which color comes first.
    pub(super) sign: f64,
}

/// Steps of the search, per square, and how far it goes.
const SEARCH_STEP: f64 = 0.1;
const SEARCH_STEPS: i32 = 12;

/// Searches the board within 1.2 squares of where it is expected; `sign` is its first color where that is known.
pub(super) fn search(view: &View, expected: &Expected<'_>, sign: Option<f64>) -> Sighting {
    let levels = view.levels();
    let gray = |point: [f64; 2]| -> f64 {
        let [x, y] = point.map(|v| v.max(0.0) as usize);
        let (mut sum, mut n) = (0.0, 0.0);
        for value in view.pixel(x, y) {
            let [low, high] = levels[value.place];
            if high > low {
                sum += ((value.reading - low) / (high - low)).clamp(0.0, 1.0) - 0.5;
                n += 1.0;
            }
        }
        if n > 0.0 { sum / n } else { 0.0 }
    };
    let agreement = |shift: [f64; 2]| {
        let (mut sum, mut n) = (0.0, 0.0);
        for (place, sign) in expected.places() {
            for quarter in [[0.3, 0.3], [-0.3, -0.3], [0.3, -0.3], [-0.3, 0.3_f64]] {
                let at = [0, 1].map(|k| place[k] + shift[k] + quarter[k]);
                let color = sign * quarter[0].signum() * quarter[1].signum();
                sum += color * gray((expected.to_pixel)(at));
                n += 0.5;
            }
        }
        sum / n
    };
    let steps = (-SEARCH_STEPS..=SEARCH_STEPS).map(|k| f64::from(k) * SEARCH_STEP);
    let shifts = steps
        .clone()
        .flat_map(|a| steps.clone().map(move |b| [a, b]));
    let all: Vec<([f64; 2], f64)> = shifts.map(|s| (s, agreement(s))).collect();
    let size = |found: f64| sign.map_or(found.abs(), |s| s * found);
    let (peak, highest) = all
        .iter()
        .fold(([0.0; 2], 0.0), |best: ([f64; 2], f64), &(s, found)| {
            if size(found) > size(best.1) {
                (s, found)
            } else {
                best
            }
        });
    // The top is flat, as wide as the points' distance to the edges: its middle counts.
    let (mut shift, mut weight) = ([0.0; 2], 0.0);
    for &(s, found) in &all {
        let near = (0..2).all(|k| (s[k] - peak[k]).abs() < 0.6);
        let w = (found * highest.signum() - 0.8 * highest.abs()).max(0.0);
        if near && w > 0.0 {
            weight += w;
            shift = [0, 1].map(|k| shift[k] + w * s[k]);
        }
    }
    Sighting {
        shift: shift.map(|s| if weight > 0.0 { s / weight } else { 0.0 }),
        agreement: size(highest),
        sign: highest.signum(),
    }
}

/// A corner as found.
#[derive(Debug, Clone, Copy)]
pub(super) struct Corner {
    /// In squares from the middle of the inner corners.
    pub(super) place: [f64; 2],
    /// Image point, pixels.
    pub(super) at: [f64; 2],
    /// Its covariance from the scatter of the values about the fitted picture, pixels^2.
    pub(super) covariance: [[f64; 2]; 2],
    /// Scatter about the fitted picture over the contrast.
    misfit: f64,
}

/// Finds the corners near where they are expected; those whose surroundings look unlike a corner, or much less so than
/// the others', are left out.
pub(super) fn find(view: &View, expected: &Expected<'_>, sign: f64) -> Vec<Corner> {
    let mut corners: Vec<Corner> = expected
        .places()
        .filter_map(|(place, color)| {
            let edges = expected.edges(place);
            let start = (expected.to_pixel)(place);
            Fit::run(view, edges, start, color * sign).map(|corner| Corner { place, ..corner })
        })
        .collect();
    let mut misfits: Vec<f64> = corners.iter().map(|c| c.misfit).collect();
    misfits.sort_by(f64::total_cmp);
    let usual = misfits.get(misfits.len() / 2).copied().unwrap_or(0.0);
    corners.retain(|c| c.misfit <= 3.0 * usual);
    corners
}

/// The two edges that cross in a corner.
#[derive(Debug, Clone, Copy)]
struct Edges {
    /// Unit normals of the edges along the board's y and x.
    normals: [[f64; 2]; 2],
    /// Distance to the next parallel edge, pixels.
    spacing: [f64; 2],
    /// How a distorting lens bends them: distance off the tangent along the normal, over the square of the distance along
    /// the edge, 1/pixel.
    bend: [f64; 2],
}

impl Edges {
    /// From the image of one square along the board's y and x, and how far its middle lies off the chord.
    fn new([(y, y_off), (x, x_off)]: [([f64; 2], [f64; 2]); 2]) -> Self {
        let area = x[0] * y[1] - x[1] * y[0];
        let lengths = [y, x].map(|e| e[0].hypot(e[1]));
        let turn = area.signum();
        let normals = [
            [turn * y[1] / lengths[0], -turn * y[0] / lengths[0]],
            [-turn * x[1] / lengths[1], turn * x[0] / lengths[1]],
        ];
        let bend = [(0, y_off), (1, x_off)].map(|(k, off): (usize, [f64; 2])| {
            (normals[k][0] * off[0] + normals[k][1] * off[1]) / (0.5 * lengths[k]).powi(2)
        });
        Self {
            normals,
            spacing: lengths.map(|l| area.abs() / l),
            bend,
        }
    }

    /// Distances of a point at this offset from the corner from both edges.
    fn distances(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        [0, 1].map(|k| {
            let [n, m] = self.normals[k];
            let along = n * y - m * x;
            n * x + m * y - self.bend[k] * along * along
        })
    }
}

/// Values used on either side of an edge, pixels at most and in squares at most.
const REACH_PX: f64 = 8.0;
const REACH_SQUARES: f64 = 0.75;
/// The narrowest blur fitted (standard deviation, pixels), and the widest.
const BLUR_PX: [f64; 2] = [0.2, 6.0];

/// A corner being fitted: its place, its blur, and per place of the layout a middle level and a contrast.
struct Fit {
    edges: Edges,
    at: [f64; 2],
    log_blur: f64,
    /// Middle and half contrast by place, then the relative change of the light per pixel in x and y.
    linear: [f64; 10],
}

/// How many numbers describe a corner: those of [`Fit`].
const NONLINEAR: usize = 3;
const UNKNOWNS: usize = NONLINEAR + 10;

impl Fit {
    fn run(view: &View, edges: Edges, start: [f64; 2], color: f64) -> Option<Corner> {
        let mut fit = Self {
            edges,
            at: start,
            log_blur: 0.0,
            linear: [0.0; 10],
        };
        let smallest = edges.spacing[0].min(edges.spacing[1]);
        let mut solution = None;
        for _ in 0..6 {
            let from = fit.at;
            let mut values = fit.values_near(view);
            fit.solve(view, &values, true)?;
            for _ in 0..8 {
                let before = fit.at;
                solution = Some(fit.solve(view, &values, false)?);
                if distance(fit.at, before) < 1e-4 {
                    break;
                }
            }
            fit.drop_strays(view, &mut values);
            if distance(fit.at, start) > 0.5 * smallest.max(4.0) {
                return None;
            }
            // Values are taken symmetrically about the corner; a small move of the window changes nothing.
            if distance(fit.at, from) < 0.02 {
                solution = Some(fit.solve(view, &values, false)?);
                break;
            }
        }
        fit.judged(solution?, color)
    }

    /// The corner, if it looks like one.
    fn judged(&self, solution: Solution, color: f64) -> Option<Corner> {
        let scale = solution.chi_square / solution.freedom as f64;
        let contrast = self.linear.chunks(2).take(4).map(|l| color * l[1]);
        let contrasts: Vec<f64> = contrast.filter(|c| c.abs() > 0.0).collect();
        let weakest = contrasts.iter().copied().fold(f64::MAX, f64::min);
        let mean = contrasts.iter().sum::<f64>() / contrasts.len() as f64;
        if solution.freedom < 8 || !(weakest > 3.0 * scale.sqrt() && mean.is_finite()) {
            return None;
        }
        let covariance = [0, 1].map(|i| [0, 1].map(|j| solution.covariance[i][j] * scale));
        Some(Corner {
            place: [0.0; 2],
            at: self.at,
            covariance,
            misfit: scale.sqrt() / mean,
        })
    }

    fn values_near(&self, view: &View) -> Vec<Value> {
        let [a, b] = self.edges.spacing.map(|s| REACH_PX.min(REACH_SQUARES * s));
        let [n, m] = self.edges.normals;
        // The corners of the window lie where both distances are at their limit.
        let across = (n[0] * m[1] - n[1] * m[0]).abs();
        let reach = (a + b) / across;
        let near = |v: &Value| {
            let [d, e] = self.distances(v.at);
            d.abs() <= a && e.abs() <= b
        };
        view.around(self.at, reach).filter(near).collect()
    }

    fn distances(&self, at: [f64; 2]) -> [f64; 2] {
        self.edges
            .distances([at[0] - self.at[0], at[1] - self.at[1]])
    }

    /// Of the picture (-1 to 1) at a point: its value, and its derivatives by x, y of the corner and log blur.
    fn picture(&self, at: [f64; 2]) -> [f64; 4] {
        let blur = self.log_blur.exp();
        let distances = self.distances(at);
        let waves = [0, 1].map(|k| wave(distances[k], self.edges.spacing[k], blur));
        let [[u, du, su], [v, dv, sv]] = waves;
        let [n, m] = self.edges.normals;
        [
            u * v,
            -(du * n[0] * v + u * dv * m[0]),
            -(du * n[1] * v + u * dv * m[1]),
            su * v + u * sv,
        ]
    }

    /// One Gauss-Newton step; with `only_linear` the place and the blur stay.
    fn solve(&mut self, view: &View, values: &[Value], only_linear: bool) -> Option<Solution> {
        let seen = places_seen(values);
        let columns: Vec<usize> = (0..UNKNOWNS)
            .filter(|&k| match k.checked_sub(NONLINEAR) {
                None => !only_linear,
                Some(l) => l >= 8 || seen[l / 2] > 0,
            })
            .collect();
        let brightness = self.brightness(view, values);
        let mut normal = Normal::new(columns.len());
        for value in values {
            let (model, slopes) = self.model(value, &brightness);
            let row: Vec<f64> = columns.iter().map(|&k| slopes[k]).collect();
            normal.add(&row, value.reading - model, 1.0);
        }
        let mut solution = normal.solve()?;
        for (&column, &step) in columns.iter().zip(&solution.values) {
            match column {
                // A step is cut to a pixel: far from the corner the picture is not linear in its place.
                0 | 1 => self.at[column] += step.clamp(-1.0, 1.0),
                2 => {
                    let [low, high] = BLUR_PX.map(f64::ln);
                    self.log_blur = (self.log_blur + step.clamp(-0.5, 0.5)).clamp(low, high);
                }
                _ => self.linear[column - NONLINEAR] += step,
            }
        }
        solution.chi_square = values
            .iter()
            .map(|v| (v.reading - self.model(v, &brightness).0).powi(2))
            .sum();
        Some(solution)
    }

    /// What a value should read, and its derivatives.
    fn model(&self, value: &Value, brightness: &[f64; 4]) -> (f64, [f64; UNKNOWNS]) {
        let picture = self.picture(value.at);
        let p = value.place;
        let [middle, contrast] = [self.linear[2 * p], self.linear[2 * p + 1]];
        let offset = [0, 1].map(|k| (value.at[k] - self.at[k]) * brightness[p]);
        let mut slopes = [0.0; UNKNOWNS];
        for k in 0..NONLINEAR {
            slopes[k] = contrast * picture[k + 1];
        }
        slopes[NONLINEAR + 2 * p] = 1.0;
        slopes[NONLINEAR + 2 * p + 1] = picture[0];
        slopes[NONLINEAR + 8] = offset[0];
        slopes[NONLINEAR + 9] = offset[1];
        let light = offset[0] * self.linear[8] + offset[1] * self.linear[9];
        (middle + contrast * picture[0] + light, slopes)
    }

    /// Mean reading by place less black: what a relative change of the light is relative to.
    fn brightness(&self, view: &View, values: &[Value]) -> [f64; 4] {
        let seen = places_seen(values);
        let mut mean = [0.0; 4];
        for value in values {
            let p = value.place;
            mean[p] += (value.reading - view.black[p]) / seen[p] as f64;
        }
        mean
    }

    /// Takes out values further off than six times the scatter: hot pixels and dust.
    fn drop_strays(&self, view: &View, values: &mut Vec<Value>) {
        let brightness = self.brightness(view, values);
        let off = |v: &Value| (v.reading - self.model(v, &brightness).0).abs();
        let mut sizes: Vec<f64> = values.iter().map(off).collect();
        sizes.sort_by(f64::total_cmp);
        let usual = sizes.get(sizes.len() / 2).copied().unwrap_or(0.0);
        // 1.4826 median deviations are one standard deviation of a normal law.
        values.retain(|v| off(v) <= 6.0 * 1.4826 * usual.max(0.3));
    }
}

fn places_seen(values: &[Value]) -> [usize; 4] {
    let mut seen = [0; 4];
    for value in values {
        seen[value.place] += 1;
    }
    seen
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Across an edge at 0 with its neighbors at +- `spacing`, blurred by a Gaussian: -1 on one side, 1 on the other; and its
/// derivatives by the distance and by the logarithm of the blur.
fn wave(d: f64, spacing: f64, blur: f64) -> [f64; 3] {
    let mut sums = [0.0; 3];
    for (sign, at) in [(1.0, d), (-1.0, d - spacing), (-1.0, d + spacing)] {
        let z = at / blur;
        let slope = 2.0 * crate::math::special::normal_density(z) / blur;
        sums[0] += sign * libm::erf(z * std::f64::consts::FRAC_1_SQRT_2);
        sums[1] += sign * slope;
        sums[2] -= sign * slope * at;
    }
    sums
}
