//! What a caller may ask of a fit.

use super::adam::AdamOptions;
use super::bounds::Bounds;
use super::published::SgdOptions;
use super::robust::Loss;
use crate::base::{Error, Result};
use crate::render::TAU;
use crate::scatter::Parameters;

/// How the parameters are searched.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Method {
    /// Stochastic Gauss-Newton on fresh render pairs (docs/fit.md).
    #[default]
    GaussNewton,
    /// The published stochastic gradient descent in rescaled parameters (Khungurn 2015 sec. 5.4, 5.5).
    Sgd,
    /// Adam (Kingma and Ba 2015) on the same gradients.
    Adam,
    /// The published binary searches for microflakes (Zhao 2011 sec. 7.1, Khungurn 2015 sec. 7.1): docs/fit.md.
    BinarySearch,
}

impl Method {
    /// All methods, the default first.
    pub const ALL: [Self; 4] = [Self::GaussNewton, Self::Sgd, Self::Adam, Self::BinarySearch];

    /// Those that fit any model; [`Method::BinarySearch`] wants microflakes.
    pub const GENERAL: [Self; 3] = [Self::GaussNewton, Self::Sgd, Self::Adam];

    /// The name on the command line and in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::GaussNewton => "gauss-newton",
            Self::Sgd => "sgd",
            Self::Adam => "adam",
            Self::BinarySearch => "binary-search",
        }
    }

    /// The method with this name.
    ///
    /// # Errors
    /// When there is none; the hint lists those that exist.
    pub fn named(name: &str) -> Result<Self> {
        Self::ALL
            .into_iter()
            .find(|m| m.name() == name)
            .ok_or_else(|| {
                let known: Vec<_> = Self::ALL.iter().map(|m| m.name()).collect();
                Error::new(format!("unknown method '{name}'"))
                    .with_hint(format!("known methods: {}", known.join(", ")))
            })
    }
}

/// When a fit ends: at the first limit it meets. At least one must be given.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Budget {
    /// Seconds of rendering, as the scene reports them (search and final check together). A fit limited by time depends
    /// on the machine's speed and is not reproducible.
    pub time_s: Option<f64>,
    /// Camera paths in all (search and final check together). Reproducible on any number of threads.
    pub paths: Option<u64>,
    /// Monte Carlo part of the weighted rms error of the fitted means, as a fraction. Without it the search ends when
    /// Monte Carlo noise adds little to the measurement errors.
    pub accuracy: Option<f64>,
}

/// Everything a fit needs besides the scene and the measurements.
#[derive(Debug, Clone)]
pub struct Options {
    /// How to search.
    pub method: Method,
    /// When to end.
    pub budget: Budget,
    /// Every random number is a function of it.
    pub seed: u64,
    /// How residuals count.
    pub loss: Loss,
    /// Configurations darker than this get no more weight: [`TAU`] (Khungurn 2015 eq. 20).
    pub tau: f64,
    /// Relative standard deviation of a gain common to all measurements, which is then one more unknown; exact scale when
    /// none. Not for [`Method::Sgd`] and [`Method::BinarySearch`].
    pub gain_prior: Option<f64>,
    /// Where to begin; the model's published defaults when none.
    pub start: Option<Parameters>,
    /// Bounds narrower than the model's own.
    pub bounds: Bounds,
    /// A weighted rms residual significantly above this fraction is reported as a model that does not explain the data.
    pub tolerance: f64,
    /// Camera paths of one iteration of any method but [`Method::GaussNewton`], both renders together. When none, what the
    /// budget's paths or time allow so that all iterations fit; the published 8.4 million when neither is limited.
    pub iteration_paths: Option<u64>,
    /// How [`Method::Sgd`] works.
    pub sgd: SgdOptions,
    /// How [`Method::Adam`] works.
    pub adam: AdamOptions,
}

impl Options {
    /// A fit from the published defaults with a tolerance of 5 %.
    pub fn new(seed: u64, budget: Budget) -> Self {
        Self {
            method: Method::default(),
            budget,
            seed,
            loss: Loss::default(),
            tau: TAU,
            gain_prior: None,
            start: None,
            bounds: Bounds::default(),
            tolerance: 0.05,
            iteration_paths: None,
            sgd: SgdOptions::default(),
            adam: AdamOptions::default(),
        }
    }

    pub(super) fn check(&self) -> Result<()> {
        let Budget {
            time_s,
            paths,
            accuracy,
        } = self.budget;
        if time_s.is_none() && paths.is_none() && accuracy.is_none() {
            return Err(Error::new("a fit needs a limit: time, paths or accuracy"));
        }
        if time_s.is_some_and(|t| !(1e-3..1e9).contains(&t)) {
            return Err(Error::new(
                "the time budget must be a positive number of seconds",
            ));
        }
        if accuracy.is_some_and(|a| !(1e-5..1.0).contains(&a)) {
            return Err(Error::new(
                "the accuracy must be a fraction between 0.00001 and 1",
            ));
        }
        if !(0.0..1e3).contains(&self.tolerance) {
            return Err(Error::new("the tolerance must be a fraction >= 0"));
        }
        if self.gain_prior.is_some_and(|s| !(1e-4..=0.5).contains(&s)) {
            return Err(Error::new(
                "the prior of the gain must be a fraction between 0.0001 and 0.5",
            ));
        }
        self.check_method()
    }

    /// Refuses what the method cannot do, whatever its limits.
    ///
    /// # Errors
    /// With the fault.
    pub fn check_method(&self) -> Result<()> {
        if self.gain_prior.is_some() && self.method == Method::Sgd {
            return Err(Error::new("the published descent has no gain")
                .with_hint("fit a gain with --method gauss-newton or adam"));
        }
        if self.method == Method::BinarySearch
            && (self.gain_prior.is_some() || self.loss != Loss::Squared)
        {
            return Err(Error::new(
                "the binary search has neither a gain nor another loss than squared",
            )
            .with_hint("use them with --method gauss-newton or adam"));
        }
        if self.iteration_paths == Some(0) {
            return Err(Error::new("an iteration needs at least one path"));
        }
        match self.method {
            Method::GaussNewton | Method::BinarySearch => Ok(()),
            Method::Sgd => self.sgd.check(),
            Method::Adam => self.adam.check(),
        }
    }
}
