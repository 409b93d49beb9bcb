//! What only the methods with a fixed schedule are asked.

use super::SEED;
use crate::base::{Error, Result};
use crate::fit::{Budget, Method, Options};

const SCHEDULE: &str = "Schedule (sgd, adam and binary-search)";

/// What only the methods with a fixed schedule are asked.
#[derive(Debug, Clone, Default, clap::Args)]
pub(crate) struct Schedule {
    /// Camera paths of one iteration, both renders together [default: so that all iterations fit in the limit]
    #[arg(long, value_name = "N", help_heading = SCHEDULE)]
    pub(crate) iteration_paths: Option<u64>,
    /// Iterations of each run [default: 60 for sgd, 200 for adam]
    #[arg(long, value_name = "N", help_heading = SCHEDULE)]
    pub(crate) iterations: Option<u32>,
    /// Learning rates: the multipliers a that sgd tries, or adam's first step [default: 0.25,1,4,16,64,256 or 0.3]
    #[arg(long, value_name = "A,...", value_delimiter = ',', help_heading = SCHEDULE)]
    pub(crate) rates: Vec<f64>,
}

impl Schedule {
    /// Whether `method` can work it off.
    pub(crate) fn check(&self, method: Method) -> Result<()> {
        let mut options = Options {
            method,
            ..Options::new(SEED, Budget::default())
        };
        self.apply(&mut options)?;
        options.check_method()
    }

    /// Puts it into the options.
    pub(super) fn apply(&self, options: &mut Options) -> Result<()> {
        options.iteration_paths = self.iteration_paths;
        let asked = self.iterations.is_some() || !self.rates.is_empty();
        match (options.method, self.rates.as_slice()) {
            (Method::GaussNewton, _) if asked || self.iteration_paths.is_some() => {
                return Err(
                    Error::new("gauss-newton has no schedule of iterations and rates").with_hint(
                        "--iteration-paths, --iterations and --rates go with --method sgd or adam",
                    ),
                );
            }
            (Method::BinarySearch, _) if asked => {
                return Err(
                    Error::new("binary-search has no iterations and rates to choose").with_hint(
                        "--iterations and --rates go with --method sgd or adam; its renders are 27",
                    ),
                );
            }
            (Method::Sgd, rates) if !rates.is_empty() => options.sgd.rates = rates.to_vec(),
            (Method::Adam, [rate]) => options.adam.rate = *rate,
            (Method::Adam, [_, _, ..]) => {
                return Err(Error::new("adam takes one learning rate, not a list")
                    .with_hint("write e.g. --rates 0.3"));
            }
            _ => {}
        }
        if let Some(iterations) = self.iterations {
            options.sgd.iterations = iterations;
            options.adam.iterations = iterations;
        }
        Ok(())
    }
}
