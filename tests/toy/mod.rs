//! A smooth nonlinear stand-in for cloth: 16 configurations, 48 intensities, 9 parameters named and bounded like fiber
//! scattering, with noise like a path tracer's: rare hits, channels correlated, derivatives noisier than means.
#![allow(dead_code, unreachable_pub, missing_docs)]

use goniofit::base::{Error, Result, Watch};
use goniofit::fit::{Budget, Options};
use goniofit::math::{PolarDirection, Random, statistics::Running};
use goniofit::render::{Effort, Estimate, Estimates, Request, Scene};
use goniofit::scatter::{Model, ParameterInfo, Parameters, Parametric, Scattering, Unit};
use goniofit::session::{Configuration, Intensity, Measurements};

const DEG: f64 = std::f64::consts::PI / 180.0;

pub struct ToyModel;

const fn color(name: &'static str, default: f64) -> ParameterInfo {
    ParameterInfo {
        name,
        per_channel: true,
        unit: Unit::One,
        lower: 0.001,
        upper: 0.999,
        default,
    }
}

const fn width(
    name: &'static str,
    lower_deg: f64,
    upper_deg: f64,
    default_deg: f64,
) -> ParameterInfo {
    ParameterInfo {
        name,
        per_channel: false,
        unit: Unit::Angle,
        lower: lower_deg * DEG,
        upper: upper_deg * DEG,
        default: default_deg * DEG,
    }
}

static INFOS: [ParameterInfo; 5] = [
    color("c_r", 0.1),
    color("c_tt", 0.85),
    width("beta_r", 1.0, 10.0, 5.0),
    width("beta_tt", 10.0, 45.0, 10.0),
    width("gamma_tt", 1.0, 45.0, 10.0),
];

impl Parametric for ToyModel {
    fn name(&self) -> &'static str {
        "toy"
    }

    fn parameters(&self) -> &'static [ParameterInfo] {
        &INFOS
    }
}

impl Model for ToyModel {
    fn prepare(&self, _: &Parameters) -> Result<Box<dyn Scattering>> {
        Err(Error::new("the toy scatters nothing"))
    }
}

pub static TOY: ToyModel = ToyModel;

/// The scene, and what can be wrong with it.
pub struct Toy {
    /// Relative standard deviation of one path's contribution, by configuration.
    pub path_sd: [f64; 16],
    /// Width of the scores per unit of ln(parameter): how noisy derivatives are.
    pub score_sd: f64,
    /// Whether beta_r changes anything.
    pub beta_r_acts: bool,
    /// Camera paths per second of the virtual clock.
    pub speed: f64,
    /// Factor on configuration 3: a model that cannot fit.
    pub distortion: f64,
}

impl Default for Toy {
    fn default() -> Self {
        let mut path_sd = [3.0; 16];
        // The grazing out-of-plane poses see the lamp rarely.
        path_sd[8] = 20.0;
        path_sd[12] = 15.0;
        Self {
            path_sd,
            score_sd: 2.0,
            beta_r_acts: true,
            speed: 50_000.0,
            distortion: 1.0,
        }
    }
}

/// A Gaussian of unit height at width `s`, normalized like a lobe of mean width.
fn lobe(x: f64, s: f64) -> f64 {
    (-0.5 * (x / s).powi(2)).exp() * (10.0 * DEG / s).sqrt()
}

impl Toy {
    pub fn configurations() -> Vec<Configuration> {
        (0..16)
            .map(|i| Configuration {
                id: i + 1,
                light: PolarDirection::from_degrees(10.0 + 4.0 * f64::from(i), 180.0),
                camera: PolarDirection::from_degrees(30.0, 0.0),
                rotation: if i < 8 {
                    0.0
                } else {
                    std::f64::consts::FRAC_PI_2
                },
            })
            .collect()
    }

    /// The exact mean of configuration `i` (0-based) in channel `c`.
    pub fn mean(&self, values: &[f64], i: usize, c: usize) -> f64 {
        let (c_r, c_tt) = (values[c], values[3 + c]);
        let beta_r = if self.beta_r_acts {
            values[6]
        } else {
            5.0 * DEG
        };
        let (beta_tt, gamma) = (values[7], values[8]);
        let x = i as f64;
        let off_r = DEG * [1.0, 4.0, 9.0, 14.0][i % 4];
        let off_tt = DEG * [3.0, 25.0, 12.0, 40.0][(i / 2) % 4];
        let off_phi = DEG * [2.0, 30.0, 15.0, 55.0][(i / 4 + i) % 4];
        let surface = 0.25 * c_r * lobe(off_r, beta_r) * (1.0 + 0.3 * (x * 0.7).sin());
        let through = c_tt * (1.0 - c_r);
        let forward = 0.5 * through * lobe(off_tt, beta_tt) * lobe(off_phi, gamma);
        // Many bounces: what comes back grows steeply with the albedo.
        let albedo = c_r + through;
        let diffuse = 0.08 * (1.0 + 0.5 * (x * 1.3).cos()) * albedo.powi(5) / (1.0 - 0.7 * albedo);
        let factor = if i == 2 { self.distortion } else { 1.0 };
        factor * (surface + forward + diffuse)
    }

    /// Exact means and derivatives `[place]` of one number.
    pub fn exact(&self, values: &[f64], i: usize, c: usize) -> (f64, Vec<f64>) {
        let derivative = (0..values.len())
            .map(|j| {
                let h = 1e-5 * values[j];
                let at = |d: f64| {
                    let mut v = values.to_vec();
                    v[j] += d;
                    self.mean(&v, i, c)
                };
                (at(h) - at(-h)) / (2.0 * h)
            })
            .collect();
        (self.mean(values, i, c), derivative)
    }

    pub fn truth(values: &[f64; 9]) -> Parameters {
        let mut values = values.to_vec();
        values[6..].iter_mut().for_each(|v| *v *= DEG);
        Parameters::defaults(&TOY).with_values(values)
    }

    /// Measurements of `truth` with relative noise `sd` per number (not below that of an intensity of 0.02).
    pub fn measure(&self, truth: &Parameters, sd: f64, seed: u64) -> Measurements {
        let mut random = Random::keyed(&[seed, 0x3ea5]);
        let intensities = Self::configurations()
            .into_iter()
            .enumerate()
            .map(|(i, configuration)| {
                let exact: [f64; 3] = std::array::from_fn(|c| self.mean(truth.values(), i, c));
                let brightness = exact.iter().sum::<f64>() / 3.0;
                let se = sd * brightness.max(0.02);
                Intensity {
                    configuration,
                    mean: exact.map(|m| (m + se * random.normal()).max(0.0)),
                    standard_error: [se; 3],
                    present: [true; 3],
                }
            })
            .collect();
        Measurements { intensities }
    }

    pub fn means(&self, parameters: &Parameters) -> Vec<[f64; 3]> {
        (0..16)
            .map(|i| std::array::from_fn(|c| self.mean(parameters.values(), i, c)))
            .collect()
    }

    /// Weighted rms distance of the exact means at two parameter sets, weights of the second.
    pub fn distance(&self, fitted: &Parameters, truth: &Parameters) -> f64 {
        let rows = self
            .means(fitted)
            .into_iter()
            .zip(self.means(truth))
            .map(|(f, t)| {
                let w = goniofit::render::relative_error_weight(t, 0.02);
                (w, std::array::from_fn(|c| f[c] - t[c]))
            });
        goniofit::render::weighted_rms(rows)
    }

    fn estimate_one(&self, request: &Request<'_>, i: usize, paths: u64) -> Estimate {
        let p = request.parameters;
        // Configurations are known by their ids: a request may leave some out; 17 repeats the pose of 1.
        let place = (request.configurations[i].id as usize - 1) % 16;
        let exact: Vec<_> = (0..3).map(|c| self.exact(p.values(), place, c)).collect();
        // A path hits with probability q and then carries an exponential weight: relative variance (2 - q) / q.
        let q = 2.0 / (1.0 + self.path_sd[place].powi(2));
        let n_batches = 32u32;
        let per_batch = (paths as f64 / f64::from(n_batches)).max(1.0);
        let rows = p.infos().len();
        let mut means = [Running::default(); 3];
        let mut derivatives = vec![[Running::default(); 3]; rows];
        for batch in 0..n_batches {
            let mut random = Random::keyed(&[
                request.seed,
                request.stream,
                i as u64,
                u64::from(batch),
                0x70f,
            ]);
            let hits = poisson(per_batch * q, &mut random);
            let common = gamma(hits, &mut random) / (per_batch * q);
            let scores: Vec<f64> = (0..rows)
                .map(|_| self.score_sd * (2.0 * hits).sqrt() / (per_batch * q) * random.normal())
                .collect();
            for c in 0..3 {
                let (mean, derivative) = &exact[c];
                let own =
                    common * (1.0 + 0.3 * self.path_sd[place] / per_batch.sqrt() * random.normal());
                means[c].push(mean * own);
                for row in 0..rows {
                    let j = p.slot(row, c);
                    let noise = mean * scores[row] / p.values()[j].max(0.05);
                    derivatives[row][c].push(derivative[j] * own + noise);
                }
            }
        }
        Estimate {
            config: request.configurations[i].id,
            mean: means.map(|m| m.mean()),
            standard_error: means.map(|m| m.standard_error()),
            derivative: derivatives.iter().map(|d| d.map(|r| r.mean())).collect(),
            derivative_se: derivatives
                .iter()
                .map(|d| d.map(|r| r.standard_error()))
                .collect(),
            paths,
        }
    }
}

/// Poisson number; normal for large means.
fn poisson(mean: f64, random: &mut Random) -> f64 {
    if mean > 200.0 {
        return (mean + mean.sqrt() * random.normal()).round().max(0.0);
    }
    let (mut n, mut sum) = (0.0, -random.uniform_open().ln());
    while sum < mean {
        sum -= random.uniform_open().ln();
        n += 1.0;
    }
    n
}

/// Sum of `n` exponential numbers; normal for many.
fn gamma(n: f64, random: &mut Random) -> f64 {
    if n > 200.0 {
        return n + n.sqrt() * random.normal();
    }
    (0..n as u64).map(|_| -random.uniform_open().ln()).sum()
}

impl Scene for Toy {
    fn model(&self) -> &'static dyn Parametric {
        &TOY
    }

    fn estimate(&self, request: &Request<'_>, watch: &dyn Watch) -> Result<Estimates> {
        let n = request.configurations.len();
        let paths: Vec<u64> = match &request.effort {
            Effort::Paths(paths) => vec![*paths; n],
            Effort::Total { paths, shares } => {
                let sum: f64 = shares.iter().sum();
                shares
                    .iter()
                    .map(|s| ((*paths as f64 * s / sum) as u64).max(32))
                    .collect()
            }
            Effort::Accuracy(_) => return Err(Error::new("the toy takes path counts only")),
        };
        let total: u64 = paths.iter().sum();
        let mut configurations = Vec::new();
        for (i, &paths) in paths.iter().enumerate() {
            if watch.cancelled() {
                return Err(Error::new("cancelled"));
            }
            watch.progress("toy", i as u64, n as u64);
            configurations.push(self.estimate_one(request, i, paths));
        }
        let wall_s = total as f64 / self.speed;
        Ok(Estimates {
            configurations,
            cpu_s: 2.0 * wall_s,
            wall_s,
        })
    }
}

/// Red gabardine-like: one color and one width on their bounds.
pub const GABARDINE: [f64; 9] = [0.185, 0.047, 0.069, 0.999, 0.33, 0.354, 2.141, 12.0, 23.5];
/// Inside the bounds everywhere.
pub const INSIDE: [f64; 9] = [0.30, 0.20, 0.10, 0.70, 0.80, 0.60, 3.0, 16.0, 20.0];

/// The seed of a test, `SEED` in the environment overriding it.
pub fn seed(default: u64) -> u64 {
    std::env::var("SEED")
        .ok()
        .and_then(|s| s.parse().ok())
        .unwrap_or(default)
}

/// A fit with this many camera paths.
pub fn options(seed: u64, paths: u64) -> Options {
    let budget = Budget {
        paths: Some(paths),
        ..Budget::default()
    };
    Options::new(seed, budget)
}
