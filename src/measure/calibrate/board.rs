//! The camera that sees a checkerboard's corners where they were found, in all poses at once.
//!
//! Gauss-Newton over scale, pointing, lens and the board's own place on the turntable. Beside these every pose has an
//! offset of its pointing, drawn from a normal law of unknown variance: what a camera arm does not repeat. That variance
//! is estimated along (restricted maximum likelihood, by expectation and maximization), so corners of one pose do not count
//! as independent of each other where they are not.

use super::corners::Corner;
use super::least_squares::{Normal, Solution};
use crate::session::{CameraFacts, Configuration, Perturbation, Projection};

/// What is fitted, in the order of [`Camera::values`].
pub(super) const NAMES: [&str; PARAMETERS] = [
    "pixel_mm",
    "center x",
    "center y",
    "roll",
    "board x",
    "board y",
    "sag sin x",
    "sag sin y",
    "sag cos x",
    "sag cos y",
    "perspective",
    "distortion",
    "board angle",
];

/// How many numbers are fitted.
pub(super) const PARAMETERS: usize = 13;

/// One number per parameter.
pub(super) type Parameters = [f64; PARAMETERS];

/// The corners found in one pose.
#[derive(Debug, Clone)]
pub(super) struct Pose {
    pub(super) configuration: Configuration,
    pub(super) corners: Vec<Corner>,
}

/// A camera and a board on the turntable.
#[derive(Debug, Clone)]
pub(super) struct Camera {
    facts: CameraFacts,
    square_mm: f64,
    pub(super) values: Parameters,
}

impl Camera {
    /// The camera as stated, the board in the middle.
    pub(super) fn new(facts: &CameraFacts, square_mm: f64) -> Self {
        let lens = facts.lens;
        let [[a, b], [c, d]] = lens.sag_px;
        let [x, y] = facts.center_px;
        Self {
            facts: facts.clone(),
            square_mm,
            values: [
                facts.pixel_mm,
                x,
                y,
                lens.roll,
                0.0,
                0.0,
                a,
                b,
                c,
                d,
                lens.perspective,
                lens.distortion,
                0.0,
            ],
        }
    }

    /// Scale, pointing and lens as fitted.
    pub(super) fn facts(&self) -> CameraFacts {
        let v = &self.values;
        let mut facts = self.facts.clone();
        facts.pixel_mm = v[0];
        facts.center_px = [v[1], v[2]];
        facts.lens.roll = v[3];
        facts.lens.sag_px = [[v[6], v[7]], [v[8], v[9]]];
        facts.lens.perspective = v[10];
        facts.lens.distortion = v[11];
        facts
    }

    /// Where a point of the board (squares from the middle of the inner corners) lies on the sample plane, millimeters.
    fn on_sample(&self, [a, b]: [f64; 2]) -> [f64; 2] {
        let (s, c) = self.values[12].sin_cos();
        [
            self.values[4] + self.square_mm * (c * a - s * b),
            self.values[5] + self.square_mm * (s * a + c * b),
        ]
    }

    /// From the board (squares from the middle of the inner corners) to the image, in a pose in which the camera points
    /// so far (pixels) beside where it should.
    pub(super) fn view(
        &self,
        pose: &Configuration,
        shift_px: [f64; 2],
    ) -> impl Fn([f64; 2]) -> [f64; 2] + use<> {
        let errors = Perturbation {
            shift_px,
            ..Perturbation::default()
        };
        let projection = Projection::perturbed(&self.facts(), pose, &errors);
        let camera = self.clone();
        move |place| projection.to_pixel(camera.on_sample(place))
    }

    /// Changes of the parameters that move some corner of a board of this half size (squares) by about a pixel.
    fn units(&self, reach: f64) -> Parameters {
        let reach_mm = reach * self.square_mm;
        let pixel = self.values[0];
        let reach_px = reach_mm / pixel;
        let half_diagonal = 0.5 * (self.facts.width as f64).hypot(self.facts.height as f64);
        let mut units = [1.0; PARAMETERS];
        units[0] = pixel / reach_px;
        units[3] = 1.0 / reach_px;
        units[4] = pixel;
        units[5] = pixel;
        units[10] = 1.0 / (reach_px * reach_mm);
        units[11] = (half_diagonal / reach_px).powi(2) / reach_px;
        units[12] = 1.0 / reach_px;
        units
    }
}

/// What is believed of the parameters before many poses are seen, as standard deviations in pixels at the board's edge;
/// the scale in parts of itself.
const PRIOR_PX: f64 = 4.0;
const PRIOR_SCALE: f64 = 0.03;
/// The board lies within half a square of the middle.
const PRIOR_BOARD_SQUARES: f64 = 0.3;
/// Scatter of the pointing assumed before it is known, pixels.
const FIRST_POINTING_PX: f64 = 0.1;
/// A parameter that the poses would leave less certain than this (pixels at the board's edge) is held.
const UNDETERMINED_PX: f64 = 1.0;
/// A corner further off than this (standard deviations) does not count.
const STRAY: f64 = 5.0;

/// What the corners say.
#[derive(Debug, Clone)]
pub(super) struct Fitted {
    pub(super) camera: Camera,
    pub(super) standard_error: Parameters,
    /// True for parameters held at 0.
    pub(super) held: [bool; PARAMETERS],
    /// Standard deviation of a pose's offset, pixels.
    pub(super) pointing_sd: [f64; 2],
    /// Per pose: the offset that the camera does not explain.
    pub(super) offsets: Vec<[f64; 2]>,
    /// Root mean square distance of the corners that count from the fitted ones, pixels.
    pub(super) residual: f64,
    /// Per pose, how many corners count.
    pub(super) counted: Vec<usize>,
}

/// A fit under way.
struct Work<'a> {
    poses: &'a [Pose],
    camera: Camera,
    units: Parameters,
    free: Vec<usize>,
    /// Per pose: the image's offset.
    offsets: Vec<[f64; 2]>,
    /// Variance of the offsets.
    pointing: [f64; 2],
    /// What the corners' own covariances must be multiplied with.
    noise: f64,
    counts: Vec<Vec<bool>>,
}

/// Brings the camera to the corners seen so far, on the strength of what is believed beforehand; for predicting the next
/// pose.
pub(super) fn follow(camera: &mut Camera, stated: &Camera, poses: &[Pose]) {
    let mut work = Work::new(camera.clone(), poses, (0..PARAMETERS).collect());
    for _ in 0..8 {
        let Some(solution) = work.normal(Some(stated)).solve() else {
            return;
        };
        if work.step(&solution) < 1e-3 {
            break;
        }
    }
    if work.camera.values.iter().all(|v| v.is_finite()) {
        *camera = work.camera;
    }
}

/// Fits all poses; `hold` are parameters that stay 0 whatever the poses say. None when the corners do not even give scale
/// and center.
pub(super) fn fit(camera: &Camera, poses: &[Pose], hold: &[usize]) -> Option<Fitted> {
    let mut start = camera.clone();
    for &k in hold {
        start.values[k] = 0.0;
    }
    let mut work = Work::new(start, poses, Vec::new());
    for k in (0..PARAMETERS).filter(|k| !hold.contains(k)) {
        work.free.push(k);
        let index = work.free.len() - 1;
        let solution = work.normal(None).solve();
        let determined = solution.is_some_and(|s| s.se(index) < UNDETERMINED_PX);
        if !determined && k < 3 {
            return None;
        }
        if !determined {
            work.free.pop();
            work.camera.values[k] = 0.0;
        }
    }
    for round in 0..60 {
        let found = work.normal(None).solve()?;
        let moved = work.step(&found);
        let before = work.pointing;
        work.weigh(&found);
        let settled = (0..2).all(|k| (work.pointing[k] / before[k] - 1.0).abs() < 1e-3);
        if round > 5 && moved < 1e-6 && settled {
            break;
        }
    }
    let pointing = work.pointing;
    let doubts = work.doubts();
    work.pointing = [0, 1].map(|a| pointing[a] * doubts[a]);
    let solution = work.normal(None).solve()?;
    work.pointing = pointing;
    Some(work.finished(&solution))
}

impl<'a> Work<'a> {
    fn new(camera: Camera, poses: &'a [Pose], free: Vec<usize>) -> Self {
        let places = poses.iter().flat_map(|p| &p.corners);
        let reach = places.map(|c| c.place[0].hypot(c.place[1]));
        Self {
            units: camera.units(reach.fold(1.0, f64::max)),
            camera,
            free,
            offsets: vec![[0.0; 2]; poses.len()],
            pointing: [FIRST_POINTING_PX.powi(2); 2],
            noise: 1.0,
            counts: poses.iter().map(|p| vec![true; p.corners.len()]).collect(),
            poses,
        }
    }

    /// Normal equations of the next step: free parameters in their units, then the poses' offsets in pixels.
    fn normal(&self, stated: Option<&Camera>) -> Normal {
        let n = self.free.len();
        let mut normal = Normal::new(n + 2 * self.poses.len());
        let mut row = vec![0.0; n + 2 * self.poses.len()];
        for (p, pose) in self.poses.iter().enumerate() {
            let offset = self.offsets[p];
            let here = self.camera.view(&pose.configuration, offset);
            let nudged = self
                .free
                .iter()
                .copied()
                .chain([PARAMETERS, PARAMETERS + 1]);
            let moved: Vec<_> = nudged.map(|k| self.nudged(k, pose, offset)).collect();
            for (corner, _) in pose
                .corners
                .iter()
                .zip(&self.counts[p])
                .filter(|(_, c)| **c)
            {
                let seen = here(corner.place);
                let off = difference(corner.at, seen, 1.0);
                let columns = (0..n).chain(n + 2 * p..n + 2 * p + 2);
                let slopes: Vec<_> = moved
                    .iter()
                    .map(|m| difference(m(corner.place), seen, NUDGE))
                    .zip(columns)
                    .collect();
                for whitened in whitening(corner, self.noise) {
                    row.fill(0.0);
                    for (slope, column) in &slopes {
                        row[*column] = whitened[0] * slope[0] + whitened[1] * slope[1];
                    }
                    normal.add(&row, whitened[0] * off[0] + whitened[1] * off[1], 1.0);
                }
            }
            for a in 0..2 {
                row.fill(0.0);
                row[n + 2 * p + a] = 1.0;
                normal.add(&row, -self.offsets[p][a], self.pointing[a]);
            }
        }
        for (i, (wanted, sd)) in stated.into_iter().flat_map(|s| self.beliefs(s)).enumerate() {
            row.fill(0.0);
            row[i] = 1.0;
            normal.add(&row, wanted, sd * sd);
        }
        normal
    }

    /// The view with one parameter a little larger, or, after those, the pose's own offset in x or y.
    fn nudged(
        &self,
        k: usize,
        pose: &Pose,
        mut offset: [f64; 2],
    ) -> impl Fn([f64; 2]) -> [f64; 2] + use<> {
        let mut camera = self.camera.clone();
        match k.checked_sub(PARAMETERS) {
            Some(axis) => offset[axis] += NUDGE,
            None => camera.values[k] += NUDGE * self.units[k],
        }
        camera.view(&pose.configuration, offset)
    }

    /// Per free parameter: the step that leads to what is stated, and how far from it the truth may be.
    fn beliefs(&self, stated: &Camera) -> Vec<(f64, f64)> {
        let free = self.free.iter();
        free.map(|&k| {
            let wanted = (stated.values[k] - self.camera.values[k]) / self.units[k];
            let sd = match k {
                0 => PRIOR_SCALE * stated.values[0] / self.units[0],
                1 | 2 => 5.0 * PRIOR_PX,
                4 | 5 => PRIOR_BOARD_SQUARES * stated.square_mm / self.units[k],
                _ => PRIOR_PX,
            };
            (wanted, sd)
        })
        .collect()
    }

    /// Takes a step; returns its largest part, pixels.
    fn step(&mut self, solution: &Solution) -> f64 {
        let n = self.free.len();
        let steps = &solution.values;
        for (&k, step) in self.free.iter().zip(steps) {
            self.camera.values[k] += step * self.units[k];
        }
        for (i, offset) in self.offsets.iter_mut().enumerate() {
            for a in 0..2 {
                offset[a] += steps[n + 2 * i + a];
            }
        }
        steps.iter().fold(0.0, |m, s| m.max(s.abs()))
    }

    /// Which corners count, how noisy they are, and how much the pointing scatters.
    fn weigh(&mut self, solution: &Solution) {
        let sizes: Vec<f64> = self.sizes().into_iter().flatten().collect();
        let mut sorted = sizes.clone();
        sorted.sort_by(f64::total_cmp);
        // The median of a squared length in two dimensions is 2 ln 2 variances; strays do not move it.
        let usual = sorted[sorted.len() / 2] / (2.0 * std::f64::consts::LN_2);
        let mut counted = Vec::new();
        for (&size, count) in sizes.iter().zip(self.counts.iter_mut().flatten()) {
            *count = size <= STRAY * STRAY * usual;
            counted.extend(count.then_some(size));
        }
        let unknowns = self.free.len() + 2 * self.poses.len();
        let freedom = (2 * counted.len()).saturating_sub(unknowns).max(1);
        self.noise *= counted.iter().sum::<f64>() / freedom as f64;
        let n = self.free.len();
        for a in 0..2 {
            let second = self.offsets.iter().enumerate();
            let second = second.map(|(p, o)| o[a] * o[a] + solution.se(n + 2 * p + a).powi(2));
            self.pointing[a] = second.sum::<f64>() / self.poses.len() as f64;
        }
    }

    /// By how much the few poses that tell the pointing's variance widen what is derived from it: the variance of Student's
    /// t, whose degrees of freedom are the poses less what is fitted to each axis.
    fn doubts(&self) -> [f64; 2] {
        let free = |k: usize| f64::from(u8::from(self.free.contains(&k)));
        [[1, 6, 8], [2, 7, 9]].map(|own| {
            let fitted = own.map(free).iter().sum::<f64>() + 0.5 * (free(4) + free(5));
            let freedom = (self.poses.len() as f64 - fitted).max(3.0);
            freedom / (freedom - 2.0)
        })
    }

    /// Squared distances of all corners from where they should be, in standard deviations.
    fn sizes(&self) -> Vec<Vec<f64>> {
        let mut sizes: Vec<Vec<f64>> = Vec::new();
        for (pose, offset) in self.poses.iter().zip(&self.offsets) {
            let here = self.camera.view(&pose.configuration, *offset);
            let corners = pose.corners.iter().map(|corner| {
                let off = difference(corner.at, here(corner.place), 1.0);
                let parts = whitening(corner, self.noise).map(|w| w[0] * off[0] + w[1] * off[1]);
                parts[0] * parts[0] + parts[1] * parts[1]
            });
            sizes.push(corners.collect());
        }
        sizes
    }

    fn finished(self, solution: &Solution) -> Fitted {
        let mut standard_error = [0.0; PARAMETERS];
        for (i, &k) in self.free.iter().enumerate() {
            standard_error[k] = solution.se(i) * self.units[k];
        }
        let (mut square, mut n) = (0.0, 0.0);
        for (pose, counts) in self.poses.iter().zip(&self.counts) {
            let here = self.camera.view(&pose.configuration, [0.0; 2]);
            for (corner, _) in pose.corners.iter().zip(counts).filter(|(_, c)| **c) {
                let off = difference(corner.at, here(corner.place), 1.0);
                square += off[0] * off[0] + off[1] * off[1];
                n += 1.0;
            }
        }
        let counted = self.counts.iter().map(|c| c.iter().filter(|c| **c).count());
        Fitted {
            standard_error,
            held: std::array::from_fn(|k| !self.free.contains(&k)),
            pointing_sd: self.pointing.map(f64::sqrt),
            offsets: self.offsets,
            residual: f64::sqrt(square / n),
            counted: counted.collect(),
            camera: self.camera,
        }
    }
}

/// Step of the difference quotients, in units of [`Camera::units`].
const NUDGE: f64 = 1e-4;

fn difference(a: [f64; 2], b: [f64; 2], step: f64) -> [f64; 2] {
    [(a[0] - b[0]) / step, (a[1] - b[1]) / step]
}

/// What no picture of a corner is better than, pixels: paper and ink, and the picture's own shape.
const FLOOR_PX: f64 = 0.005;

/// The rows of W with `W C W' = 1` for the corner's covariance C.
fn whitening(corner: &Corner, noise: f64) -> [[f64; 2]; 2] {
    let [[a, b], [_, d]] = corner.covariance;
    let (a, b, d) = (a + FLOOR_PX * FLOOR_PX, b, d + FLOOR_PX * FLOOR_PX);
    let first = (noise * a).sqrt();
    let second = (noise * (d - b * b / a)).sqrt();
    [[1.0 / first, 0.0], [-b / (a * second), 1.0 / second]]
}
