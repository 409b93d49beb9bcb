//! The three ways to state how bright a sample is: normalized radiance, radiance factor, BRDF.

use super::{Configuration, Intensity};
use crate::base::{Error, Result};
use std::f64::consts::PI;

/// What a number of a table is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Quantity {
    /// `M = pi L / E_normal = pi f_r cos(theta_light)`: what is measured.
    #[default]
    NormalizedRadiance,
    /// Radiance over that of a perfect white diffuser in the same light: `M / cos(theta_light)`.
    RadianceFactor,
    /// `f_r = L / E = M / (pi cos(theta_light))`, 1/sr.
    Brdf,
}

impl Quantity {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::NormalizedRadiance, Self::RadianceFactor, Self::Brdf];

    /// The name in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::NormalizedRadiance => "normalized_radiance",
            Self::RadianceFactor => "radiance_factor",
            Self::Brdf => "brdf",
        }
    }

    /// Its unit: `1` or `1/sr`.
    pub fn unit(self) -> &'static str {
        match self {
            Self::NormalizedRadiance | Self::RadianceFactor => "1",
            Self::Brdf => "1/sr",
        }
    }

    /// What it means, in one line.
    pub fn definition(self) -> &'static str {
        match self {
            Self::NormalizedRadiance => {
                "M = pi L / E_normal, E_normal: irradiance by the light at normal incidence at the sample center"
            }
            Self::RadianceFactor => {
                "M / cos(theta_light): radiance over that of a perfect white diffuser in the same light"
            }
            Self::Brdf => "f_r = M / (pi cos(theta_light)), M = pi L / E_normal",
        }
    }

    /// The quantity of this name.
    ///
    /// # Errors
    /// With the names there are.
    pub fn named(name: &str) -> Result<Self> {
        let found = Self::ALL.into_iter().find(|q| q.name() == name);
        found.ok_or_else(|| {
            let names = Self::ALL.map(Self::name).join(", ");
            Error::new(format!("'{name}' is no quantity")).with_hint(format!("known: {names}"))
        })
    }

    /// What normalized radiance is multiplied by, in this configuration.
    pub fn factor(self, configuration: &Configuration) -> f64 {
        match self {
            Self::NormalizedRadiance => 1.0,
            Self::RadianceFactor => 1.0 / configuration.light.theta.cos(),
            Self::Brdf => 1.0 / (PI * configuration.light.theta.cos()),
        }
    }

    /// Mean and standard error in this quantity.
    pub fn of(self, intensity: &Intensity) -> ([f64; 3], [f64; 3]) {
        let factor = self.factor(&intensity.configuration);
        (
            intensity.mean.map(|m| m * factor),
            intensity.standard_error.map(|s| s * factor),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::PolarDirection;

    #[test]
    fn a_white_diffuser_reads_one_as_a_radiance_factor_at_every_angle() {
        for theta in [0.0, 30.0, 80.0] {
            let intensity = Intensity {
                configuration: Configuration {
                    id: 1,
                    light: PolarDirection::from_degrees(theta, 20.0),
                    camera: PolarDirection::from_degrees(10.0, 0.0),
                    rotation: 0.4,
                },
                mean: [theta.to_radians().cos(); 3],
                standard_error: [0.5 * theta.to_radians().cos(); 3],
                present: [true; 3],
            };
            let (factor, se) = Quantity::RadianceFactor.of(&intensity);
            let (brdf, _) = Quantity::Brdf.of(&intensity);
            assert!((factor[0] - 1.0).abs() < 1e-12 && (se[1] - 0.5).abs() < 1e-12);
            assert!((brdf[2] - 1.0 / PI).abs() < 1e-12);
        }
        assert!(Quantity::ALL.map(|q| Quantity::named(q.name()).unwrap()) == Quantity::ALL);
        let error = Quantity::named("btdf").unwrap_err().report();
        assert!(
            error.contains("'btdf'") && error.contains("radiance_factor"),
            "{error}"
        );
    }
}
