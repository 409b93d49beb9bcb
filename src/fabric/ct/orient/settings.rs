//! Options with every default filled in, the work in boxes, and the thresholds.

use super::directions::Filter;
use super::search::{self, Search};
use super::tensor::Tensor;
use super::{DensityChoice, Found, Method, OrientReport, Orienting};
use crate::base::{Error, Result, Watch};
use crate::fabric::ct::check_going_on;
use crate::fabric::ct::gaussian::{BLOCK, GROUP};
use crate::fabric::ct::gray::{Area, Gray};
use crate::fabric::ct::statistics::otsu;
use crate::fabric::{PackedDirection, VoxelTile};
use rayon::prelude::*;

/// Gradient and window of the structure tensor as shares of the fiber radius, and in voxels where that is not known.
const GRADIENT: [f64; 2] = [0.6, 1.0];
const WINDOW: [f64; 2] = [1.55, 2.5];
/// Voxel side of the published filter settings, millimeters.
const PUBLISHED_SIDE: f64 = 0.005;
/// Shares of voxels at which scores are reported.
const SHARES: [f64; 7] = [0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5];

/// Options with every default filled in.
pub(super) struct Settings {
    method: Method,
    exact: bool,
    gradient: f64,
    window: f64,
    filter: Filter,
    eps_d: f64,
    eps_j: Option<f64>,
    density_choices: Vec<DensityChoice>,
}

/// What was found, for every voxel of the volume.
#[derive(Debug, PartialEq)]
pub(super) struct Scores {
    pub(super) direction: Vec<PackedDirection>,
    /// Minus 1 in air.
    pub(super) confidence: Vec<f32>,
    /// Empty when not asked for.
    pub(super) fit: Vec<f32>,
}

impl Settings {
    pub(super) fn new(gray: &Gray, options: &Orienting) -> Result<Self> {
        let radius = options.fiber_radius.map(|r| r / gray.side);
        let width = |given: Option<f64>, [share, fixed]: [f64; 2]| {
            given.unwrap_or_else(|| radius.map_or(fixed, |r| share * r))
        };
        let scale = gray.side / PUBLISHED_SIDE;
        let filter = options.filter.unwrap_or(Filter {
            s: scale * scale,
            t: 2.0 * scale * scale,
            h: ((16.0 / scale).round() as usize).clamp(3, 48),
        });
        let threshold = otsu(&gray.values);
        let settings = Self {
            method: options.method,
            exact: options.exact,
            gradient: width(options.gradient, GRADIENT),
            window: width(options.window, WINDOW),
            filter,
            eps_d: options.eps_d.unwrap_or(threshold),
            eps_j: options.eps_j,
            density_choices: density_choices(gray, threshold),
        };
        settings.check(options)?;
        let largest = gray.values.iter().copied().fold(f32::MIN, f32::max);
        if f64::from(largest) < settings.eps_d {
            return Err(Error::new(format!(
                "no voxel reaches eps_d = {}: the largest is {largest}",
                settings.eps_d
            ))
            .with_hint(format!(
                "Otsu's threshold of this volume is {threshold:.4}; without --eps-d it is used"
            )));
        }
        Ok(settings)
    }

    fn check(&self, options: &Orienting) -> Result<()> {
        let Filter { s, t, h } = self.filter;
        let widths = [self.gradient, self.window];
        if !widths.iter().all(|w| (0.3..=40.0).contains(w)) {
            return Err(Error::new(format!(
                "tensor widths of {} and {} voxels: expected 0.3 to 40",
                self.gradient, self.window
            ))
            .with_hint("is the fiber radius in micrometers, and the voxel size right?"));
        }
        if !(s > 0.0 && s < t && t <= 100.0 && s >= 0.01 && (3..=48).contains(&h)) {
            return Err(Error::new(format!(
                "filter s {s}, t {t}, h {h}: expected 0.01 <= s < t <= 100 and h from 3 to 48 voxels"
            )));
        }
        if !(self.eps_d > 0.0 && self.eps_d.is_finite()) {
            return Err(Error::new(format!(
                "least density {}: expected a number above 0",
                self.eps_d
            ))
            .with_hint("goniofit ct prepare makes air 0 and fiber 1"));
        }
        if let Some(j) = self.eps_j.filter(|j| !(*j <= 0.0 && j.is_finite())) {
            return Err(Error::new(format!(
                "least filter value {j}: expected at most 0, as the filter is never positive"
            )));
        }
        let [least, drop] = [options.least_confidence, options.drop_share];
        if !((0.0..1.0).contains(&least) && (0.0..1.0).contains(&drop)) {
            return Err(Error::new(format!(
                "least confidence {least} and share to drop {drop}: expected 0 to less than 1"
            )));
        }
        Ok(())
    }

    /// Directions and scores of all voxels; `block` replaces the size of boxes.
    pub(super) fn scores(
        &self,
        gray: &Gray,
        block: Option<[usize; 3]>,
        watch: &dyn Watch,
    ) -> Result<Scores> {
        let wanted = self.eps_j.is_some() || self.method != Method::Tensor;
        let line = self.method == Method::Line;
        let search = wanted.then(|| Search::new(self.filter, line, self.exact));
        let tensor = Tensor::new(self.gradient, self.window);
        let usual = match self.method {
            Method::Tensor => BLOCK.map(|n| n.max(2 * Tensor::reach(self.gradient, self.window))),
            _ => search::BLOCK,
        };
        let solid = self.eps_d as f32;
        let areas = Area::filling(gray.shape, block.unwrap_or(usual));
        let n = gray.values.len();
        let mut scores = Scores {
            direction: vec![PackedDirection::default(); n],
            confidence: vec![-1.0; n],
            fit: vec![f32::NEG_INFINITY; if wanted { n } else { 0 }],
        };
        let group = if self.method == Method::Tensor {
            GROUP
        } else {
            8 * GROUP
        };
        for (done, group_areas) in areas.chunks(group).enumerate() {
            check_going_on(watch)?;
            let found: Vec<Vec<Found>> = group_areas
                .par_iter()
                .map(|area| match (&search, self.method) {
                    (Some(search), Method::Filter | Method::Line) => {
                        search.directions(gray, area, solid)
                    }
                    (Some(search), Method::Tensor) => {
                        let mut found = tensor.directions(gray, area, solid);
                        search.fill_fit(gray, area, solid, &mut found);
                        found
                    }
                    (None, _) => tensor.directions(gray, area, solid),
                })
                .collect();
            for voxel in found.iter().flatten() {
                scores.direction[voxel.place] = voxel.direction;
                scores.confidence[voxel.place] = voxel.confidence;
                if wanted {
                    scores.fit[voxel.place] = voxel.fit;
                }
            }
            let at = ((done + 1) * group).min(areas.len());
            watch.progress("finding directions", at as u64, areas.len() as u64);
        }
        Ok(scores)
    }

    pub(super) fn thresholded(
        self,
        gray: Gray,
        scores: Scores,
        options: &Orienting,
    ) -> Result<(VoxelTile, OrientReport)> {
        let confidence_quantiles = quantiles(&scores.confidence, |c| c >= 0.0, &SHARES);
        let fit_quantiles = quantiles(&scores.fit, f32::is_finite, &SHARES);
        let dropping = quantiles(&scores.confidence, |c| c >= 0.0, &[options.drop_share]);
        let by_share = if options.drop_share > 0.0 {
            dropping.first().map_or(0.0, |q| q.1)
        } else {
            0.0
        };
        let least = options.least_confidence.max(by_share);
        let mut report = OrientReport {
            method: self.method,
            exact: self.exact,
            gradient: self.gradient,
            window: self.window,
            filter: self.filter,
            eps_d: self.eps_d,
            eps_j: self.eps_j,
            least_confidence: least,
            voxels: gray.values.len(),
            solid: 0,
            kept: 0,
            dropped_by_confidence: 0,
            dropped_by_fit: 0,
            density_choices: self.density_choices,
            confidence_quantiles,
            fit_quantiles,
            axis_shares: [0.0; 3],
        };
        let mut density = gray.values;
        for (place, value) in density.iter_mut().enumerate() {
            let confidence = f64::from(scores.confidence[place]);
            let fits = self
                .eps_j
                .is_none_or(|eps| f64::from(scores.fit[place]) >= eps);
            if confidence < 0.0 {
                *value = 0.0;
                continue;
            }
            report.solid += 1;
            if confidence <= 0.0 || confidence < least {
                report.dropped_by_confidence += 1;
                *value = 0.0;
            } else if !fits {
                report.dropped_by_fit += 1;
                *value = 0.0;
            } else {
                report.kept += 1;
                let d = scores.direction[place].unpack().abs();
                let axis = usize::from(d.y > d.x.max(d.z)) + 2 * usize::from(d.z > d.x.max(d.y));
                report.axis_shares[axis] += 1.0;
            }
        }
        if report.kept == 0 {
            return Err(nothing_left(&report));
        }
        report.axis_shares = report.axis_shares.map(|n| n / report.kept as f64);
        let tile = VoxelTile::from_parts(
            gray.shape,
            gray.side,
            gray.bottom,
            density,
            scores.direction,
        )?;
        Ok((tile, report))
    }
}

/// Says which threshold left nothing, and one that leaves most.
fn nothing_left(report: &OrientReport) -> Error {
    let at = |list: &[(f64, f64)]| list.iter().find(|q| q.0 >= 0.05).map_or(0.0, |q| q.1);
    let all = format!("all {} voxels that reach eps_d", report.solid);
    match report.eps_j {
        Some(eps) if report.dropped_by_fit > 0 => {
            Error::new(format!("eps_j = {eps} drops {all}")).with_hint(format!(
                "{:.2} keeps 95 % of them here; it goes with the filter, the voxel size and how densely fibers are packed",
                at(&report.fit_quantiles)
            ))
        }
        _ => Error::new(format!(
            "a confidence of at least {} drops {all}",
            report.least_confidence
        ))
        .with_hint(format!(
            "{:.3} keeps 95 % of them here",
            at(&report.confidence_quantiles)
        )),
    }
}

/// Shares and the values they do not exceed.
fn quantiles(values: &[f32], counts: impl Fn(f32) -> bool, shares: &[f64]) -> Vec<(f64, f64)> {
    // Some millions are plenty for a quantile.
    let stride = values.len() / 20_000_000 + 1;
    let mut list: Vec<f32> = values
        .iter()
        .step_by(stride)
        .copied()
        .filter(|v| counts(*v))
        .collect();
    list.sort_unstable_by(f32::total_cmp);
    let value = |share: &f64| {
        let at = (share * list.len() as f64) as usize;
        list.get(at.min(list.len().wrapping_sub(1)))
            .map(|v| (*share, f64::from(*v)))
    };
    shares.iter().filter_map(value).collect()
}

/// Thresholds between the mean of air and that of fiber, by Otsu's classes.
fn density_choices(gray: &Gray, threshold: f64) -> Vec<DensityChoice> {
    let (mut air, mut fiber) = ([0.0, 0.0], [0.0, 0.0]);
    for v in &gray.values {
        let v = f64::from(*v);
        let class = if v < threshold { &mut air } else { &mut fiber };
        class[0] += 1.0;
        class[1] += v;
    }
    let mean = |c: [f64; 2]| c[1] / f64::max(c[0], 1.0);
    let n = gray.values.len() as f64;
    let choice = |level: f64| {
        let eps_d = mean(air) + level * (mean(fiber) - mean(air));
        let reached = gray.values.iter().filter(|v| f64::from(**v) >= eps_d);
        DensityChoice {
            level,
            eps_d,
            share: reached.count() as f64 / n,
        }
    };
    [0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8].map(choice).to_vec()
}
