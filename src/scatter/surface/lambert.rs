//! Lambert's law: the same radiance toward everywhere.

use super::{
    MAX_SURFACE_ROWS, Surface, SurfaceEvaluation, SurfaceModel, above, check, coefficient,
};
use crate::base::Result;
use crate::scatter::{CHANNELS, ParameterInfo, Parameters, Parametric};
use glam::DVec3;
use std::f64::consts::FRAC_1_PI;

/// The model `lambert`: `f = k_d/pi`, row `k_d`, the albedo. Three numbers.
#[derive(Debug, Clone, Copy)]
pub struct Lambert;

/// Diffuse albedo of every reflectance model.
pub(super) const DIFFUSE: ParameterInfo = coefficient("k_d", 1.0, 0.3);

impl Parametric for Lambert {
    fn name(&self) -> &'static str {
        "lambert"
    }

    fn parameters(&self) -> &'static [ParameterInfo] {
        const { &[DIFFUSE] }
    }
}

impl SurfaceModel for Lambert {
    fn prepare(&self, parameters: &Parameters) -> Result<Box<dyn Surface>> {
        let k_d = check(self.name(), &DIFFUSE, parameters.channels("k_d"), 0.0, 1e6)?;
        Ok(Box::new(Diffuse { k_d }))
    }
}

struct Diffuse {
    k_d: [f64; CHANNELS],
}

impl Surface for Diffuse {
    fn value(&self, wi: DVec3, wr: DVec3) -> [f64; CHANNELS] {
        self.evaluate(wi, wr).value
    }

    fn evaluate(&self, wi: DVec3, wr: DVec3) -> SurfaceEvaluation {
        let mut e = SurfaceEvaluation::zero();
        if wi.is_nan() || wr.is_nan() {
            e.value = [f64::NAN; CHANNELS];
        } else if above(wi, wr) {
            e.value = self.k_d.map(|k| k * FRAC_1_PI);
            e.derivative[0] = [FRAC_1_PI; CHANNELS];
        }
        e
    }

    fn colors(&self, wi: DVec3, wr: DVec3) -> [f64; MAX_SURFACE_ROWS] {
        let mut rows = [0.0; MAX_SURFACE_ROWS];
        if above(wi, wr) {
            rows[0] = FRAC_1_PI;
        }
        rows
    }
}
