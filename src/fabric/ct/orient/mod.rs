//! From gray voxels to density and direction (Zhao 2011 section 5; docs/ct.md compares the methods against truths).
//!
//! Voxels below a threshold on density are air. For the others a direction is found, and voxels whose direction is not to
//! be believed are dropped. Does not tell two fibers in one voxel apart.

mod directions;
mod eigen;
mod search;
mod tensor;

pub use directions::Filter;

use super::check_going_on;
use super::gaussian::{BLOCK, GROUP};
use super::gray::{Area, Gray};
use super::statistics::otsu;
use crate::base::{Error, Result, Watch};
use crate::fabric::{PackedDirection, VoxelTile};
use rayon::prelude::*;
use search::Search;
use serde::Serialize;
use tensor::Tensor;

/// Gradient and window of the structure tensor as shares of the fiber radius, and in voxels where that is not known.
const GRADIENT: [f64; 2] = [0.6, 1.0];
const WINDOW: [f64; 2] = [1.55, 2.5];
/// Voxel side of the published filter settings, millimeters.
const PUBLISHED_SIDE: f64 = 0.005;
/// Shares of voxels at which scores are reported.
const SHARES: [f64; 7] = [0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5];

/// How directions are found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// Structure tensor.
    Tensor,
    /// The oriented filter of Zhao 2011.
    Filter,
    /// The same filter integrated along lines: fast, nearly the same weights.
    Line,
}

/// How to orient a volume. Nothing given: the defaults in parentheses.
#[derive(Debug, Clone, PartialEq)]
pub struct Orienting {
    /// How directions are found.
    pub method: Method,
    /// Filter and line: try all 3072 directions, not from coarse to fine.
    pub exact: bool,
    /// Expected fiber radius, millimeters: sets the widths of the tensor (unknown: 1 and 2.5 voxels).
    pub fiber_radius: Option<f64>,
    /// Standard deviation of the tensor's derivatives, voxels (0.6 radii).
    pub gradient: Option<f64>,
    /// Standard deviation of the tensor's window, voxels (1.55 radii).
    pub window: Option<f64>,
    /// The filter, in voxels (s, t, h = 1, 2, 16 of 5 um, as published for gabardine, scaled to the voxel).
    pub filter: Option<Filter>,
    /// Least density (Otsu's threshold of the volume).
    pub eps_d: Option<f64>,
    /// Least value of the filter along the direction, on its own scale: at most 0 (none).
    pub eps_j: Option<f64>,
    /// Least confidence, 0 to 1 (0).
    pub least_confidence: f64,
    /// Share of voxels to drop, those of least confidence (0).
    pub drop_share: f64,
}

impl Orienting {
    /// This method with all defaults.
    pub fn new(method: Method) -> Self {
        Self {
            method,
            exact: false,
            fiber_radius: None,
            gradient: None,
            window: None,
            filter: None,
            eps_d: None,
            eps_j: None,
            least_confidence: 0.0,
            drop_share: 0.0,
        }
    }
}

/// A threshold on density and what it would keep.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DensityChoice {
    /// Place between the mean of air (0) and of fiber (1).
    pub level: f64,
    /// The threshold.
    pub eps_d: f64,
    /// Share of all voxels from it on.
    pub share: f64,
}

/// What was done and found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct OrientReport {
    /// How directions were found.
    pub method: Method,
    /// Whether all directions were tried.
    pub exact: bool,
    /// Standard deviations of the tensor's derivatives and window, voxels.
    pub gradient: f64,
    /// See `gradient`.
    pub window: f64,
    /// The filter, voxels.
    pub filter: Filter,
    /// Least density used.
    pub eps_d: f64,
    /// Least filter value used.
    pub eps_j: Option<f64>,
    /// Least confidence used; that of `drop_share` where it is more.
    pub least_confidence: f64,
    /// Voxels in all.
    pub voxels: usize,
    /// Those from `eps_d` on.
    pub solid: usize,
    /// Those kept in the end.
    pub kept: usize,
    /// Dropped for their confidence (those without any direction among them).
    pub dropped_by_confidence: usize,
    /// Dropped by `eps_j`.
    pub dropped_by_fit: usize,
    /// What other thresholds on density would keep.
    pub density_choices: Vec<DensityChoice>,
    /// Share of solid voxels and the confidence they do not exceed.
    pub confidence_quantiles: Vec<(f64, f64)>,
    /// Share of solid voxels and the filter value they do not exceed; empty when it was not needed.
    pub fit_quantiles: Vec<(f64, f64)>,
    /// Shares of kept voxels along x, y and z most of all.
    pub axis_shares: [f64; 3],
}

/// A voxel's direction.
#[derive(Debug, Clone, Copy)]
struct Found {
    place: usize,
    direction: PackedDirection,
    /// 0 to 1, hardly depending on how densely fibers are packed.
    confidence: f32,
    /// Value of the filter; minus infinity where it was not asked for.
    fit: f32,
}

/// Finds density and direction of every voxel. The density of a voxel that is kept is its gray value, of others 0.
///
/// Takes about 16 bytes a voxel. Results do not depend on the number of threads.
///
/// # Errors
/// A number has no meaning, the volume is empty, a threshold leaves nothing (the hint has one that leaves something), or
/// the watch cancelled.
pub fn orient(
    gray: Gray,
    options: &Orienting,
    watch: &dyn Watch,
) -> Result<(VoxelTile, OrientReport)> {
    gray.check()?;
    let settings = Settings::new(&gray, options)?;
    let scores = settings.scores(&gray, None, watch)?;
    settings.thresholded(gray, scores, options)
}

/// Options with every default filled in.
struct Settings {
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
struct Scores {
    direction: Vec<PackedDirection>,
    /// Minus 1 in air.
    confidence: Vec<f32>,
    /// Empty when not asked for.
    fit: Vec<f32>,
}

impl Settings {
    fn new(gray: &Gray, options: &Orienting) -> Result<Self> {
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
    fn scores(&self, gray: &Gray, block: Option<[usize; 3]>, watch: &dyn Watch) -> Result<Scores> {
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

    fn thresholded(
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::Unwatched;
    use glam::DVec3;

    /// Fibers of 3 voxels in diameter along a direction, 8 voxels apart.
    fn fibers(shape: [usize; 3], along: DVec3, periodic: bool) -> Gray {
        let (u, v) = along.any_orthonormal_pair();
        let wave = |x: f64| 2.0 * (x / 8.0 - (x / 8.0).round()) * 4.0;
        let mut values = Vec::new();
        for k in 0..shape[2] {
            for j in 0..shape[1] {
                for i in 0..shape[0] {
                    let p = DVec3::new(i as f64, j as f64, k as f64);
                    let r = wave(p.dot(u)).hypot(wave(p.dot(v)));
                    values.push((2.2 - r).clamp(0.0, 1.0) as f32);
                }
            }
        }
        Gray {
            shape,
            side: 0.005,
            bottom: 0.0,
            values,
            periodic,
        }
    }

    fn errors(gray: &Gray, along: DVec3, options: &Orienting) -> Vec<f64> {
        let (tile, _) = orient(gray.clone(), options, &Unwatched).unwrap();
        let kept = (0..gray.values.len()).filter(|p| tile.density()[*p] > 0.0);
        let angle = |p| {
            tile.direction(p)
                .dot(along)
                .abs()
                .min(1.0)
                .acos()
                .to_degrees()
        };
        let mut list: Vec<f64> = kept.map(angle).collect();
        list.sort_by(f64::total_cmp);
        list
    }

    #[test]
    fn straight_fibers_are_found_up_to_the_borders_by_every_method() {
        // 1 degree for the tensor sees borders taken as air; the others step by up to 3.6 degrees.
        for (method, exact, most) in [
            (Method::Tensor, false, 1.0),
            (Method::Filter, true, 4.0),
            (Method::Filter, false, 4.0),
            (Method::Line, false, 4.0),
        ] {
            for along in [DVec3::X, DVec3::new(1.0, 2.0, -0.7).normalize()] {
                let gray = fibers([24, 20, 20], along, false);
                let options = Orienting {
                    exact,
                    eps_d: Some(0.5),
                    ..Orienting::new(method)
                };
                let list = errors(&gray, along, &options);
                let at = |share: f64| list[(share * (list.len() - 1) as f64) as usize];
                let bound = if method == Method::Tensor {
                    at(1.0)
                } else {
                    at(0.5)
                };
                assert!(
                    bound < most,
                    "{method:?} {exact} {along}: {bound} {}",
                    at(0.9)
                );
                // The control: another direction is not within the bound.
                let wrong = errors(&gray, along.any_orthonormal_vector(), &options);
                assert!(wrong[0] > 45.0);
            }
        }
    }

    #[test]
    fn boxes_and_threads_do_not_matter() {
        let gray = fibers([30, 26, 22], DVec3::new(0.3, 1.0, 0.2).normalize(), true);
        for (method, block) in [
            (Method::Tensor, [7, 30, 9]),
            (Method::Filter, [32, 5, 3]),
            (Method::Line, [32, 26, 1]),
        ] {
            let options = Orienting {
                filter: Some(Filter {
                    s: 1.0,
                    t: 2.0,
                    h: 7,
                }),
                eps_j: Some(-30.0),
                ..Orienting::new(method)
            };
            let settings = Settings::new(&gray, &options).unwrap();
            let usual = settings.scores(&gray, None, &Unwatched).unwrap();
            let pool = rayon::ThreadPoolBuilder::new().num_threads(3).build();
            let other = pool
                .unwrap()
                .install(|| settings.scores(&gray, Some(block), &Unwatched).unwrap());
            assert_eq!(usual, other, "{method:?}");
        }
    }

    #[test]
    fn a_periodic_volume_has_no_seam() {
        // Moving the volume round the seam moves the result with it.
        let gray = fibers([32, 16, 24], DVec3::new(0.0, 1.0, 0.0), true);
        let mut moved = gray.clone();
        for row in moved.values.chunks_mut(32) {
            row.rotate_right(11);
        }
        let options = Orienting::new(Method::Tensor);
        let (a, _) = orient(gray, &options, &Unwatched).unwrap();
        let (b, _) = orient(moved, &options, &Unwatched).unwrap();
        for (k, d) in a.density().iter().enumerate() {
            let other = k - k % 32 + (k % 32 + 11) % 32;
            assert!((d - b.density()[other]).abs() < 1e-6);
            let cos = a.direction(k).dot(b.direction(other)).abs();
            assert!(*d == 0.0 || cos > 1.0 - 1e-6);
        }
    }

    #[test]
    fn coarse_to_fine_finds_what_trying_all_finds() {
        // Of fibers along many directions at least 93 % of voxels must agree; the control is one direction for all.
        let (mut same, mut all, mut shifted) = (0, 0, 0);
        for along in [
            DVec3::new(1.0, 0.1, 0.3),
            DVec3::new(0.4, 1.0, -0.2),
            DVec3::new(-0.5, 0.6, 1.0),
        ] {
            let gray = fibers([20, 18, 16], along.normalize(), false);
            let mut options = Orienting::new(Method::Filter);
            options.eps_d = Some(0.5);
            let scores = |exact: bool| {
                let options = Orienting {
                    exact,
                    ..options.clone()
                };
                let settings = Settings::new(&gray, &options).unwrap();
                settings.scores(&gray, None, &Unwatched).unwrap()
            };
            let (fast, exact) = (scores(false), scores(true));
            let first = exact
                .direction
                .iter()
                .find(|d| **d != PackedDirection::default());
            for place in (0..gray.values.len()).filter(|p| exact.confidence[*p] >= 0.0) {
                all += 1;
                same += usize::from(fast.direction[place] == exact.direction[place]);
                shifted += usize::from(Some(&exact.direction[place]) == first);
                assert!(fast.fit[place] <= exact.fit[place] + 1e-3);
            }
        }
        assert!(same as f64 >= 0.93 * all as f64, "{same} of {all}");
        assert!((shifted as f64) < 0.93 * all as f64);
    }

    #[test]
    fn thresholds_that_leave_nothing_are_answered_with_one_that_does() {
        let gray = fibers([16, 16, 16], DVec3::new(1.0, 0.4, 0.2).normalize(), false);
        let fails = |change: &dyn Fn(&mut Orienting)| {
            let mut options = Orienting::new(Method::Tensor);
            change(&mut options);
            let done = orient(gray.clone(), &options, &Unwatched);
            done.map(|d| d.1).unwrap_err().report()
        };
        let found = fails(&|o| o.eps_d = Some(2.0));
        assert!(
            found.contains("no voxel reaches eps_d = 2: the largest is 1\nhint: Otsu"),
            "{found}"
        );
        let found = fails(&|o| o.eps_j = Some(0.0));
        assert!(
            found.contains("eps_j = 0 drops all") && found.contains("keeps 95 %"),
            "{found}"
        );
        assert!(fails(&|o| o.least_confidence = 0.999_999_9).contains("keeps 95 %"));
        assert!(fails(&|o| o.eps_j = Some(1.0)).contains("at most 0"));
        assert!(fails(&|o| o.eps_d = Some(-1.0)).contains("above 0"));
        assert!(fails(&|o| o.drop_share = 1.0).contains("less than 1"));
        assert!(fails(&|o| o.fiber_radius = Some(8.0)).contains("micrometers"));
        let mut flat = gray.clone();
        flat.values.fill(0.25);
        let error = orient(flat, &Orienting::new(Method::Tensor), &Unwatched).map(|d| d.1);
        assert!(error.unwrap_err().report().contains("every voxel is 0.25"));
        // A share to drop is dropped, and what is suggested keeps what it says.
        let mut options = Orienting::new(Method::Filter);
        options.drop_share = 0.3;
        let (_, report) = orient(gray, &options, &Unwatched).unwrap();
        let dropped = report.dropped_by_confidence as f64 / report.solid as f64;
        assert!(dropped <= 0.3 + 1e-3, "{dropped}");
    }
}
