//! What derivatives cost: the same paths with and without them.
//!
//! Without: a model with no parameters whose function is evaluated through `Scattering::importance`, which for all but very
//! small colors is the same number without derivatives (but with a sampling density, so this side is a little too slow).

use goniofit::base::{Result, Unwatched};
use goniofit::fabric::Fabric;
use goniofit::math::Random;
use goniofit::render::{Effort, Estimates, FiberScene, FiberSceneOptions, Request, Scene};
use goniofit::scatter::{
    CHANNELS, Evaluation, Khungurn, MAX_ROWS, Model, Outgoing, ParameterInfo, Parameters,
    Parametric, Passage, Sampled, Scattering,
};
use goniofit::session::Configuration;
use serde::{Deserialize, Serialize};

/// Camera paths of each view.
const PATHS: u64 = 8192;

#[derive(Serialize, Deserialize)]
pub(super) struct Cost {
    fabric: String,
    /// CPU seconds with derivatives and without: the least of several rounds.
    cpu_s_with: f64,
    cpu_s_without: f64,
    pub(super) gradient_cost: f64,
    /// Largest relative difference of a mean: zero when the paths were the same. Not zero for Silk, whose green of 0.008
    /// is followed as if it were brighter, so that the paths' rules differ a little.
    means_apart: f64,
}

impl Cost {
    pub(super) fn line(&self) -> String {
        format!(
            "{:<10} CPU time with derivatives over without: {:.3} ({:.2} s / {:.2} s, means apart {:.1e})\n",
            self.fabric, self.gradient_cost, self.cpu_s_with, self.cpu_s_without, self.means_apart
        )
    }
}

/// Khungurn's model without parameters.
struct ValueOnly;

struct ValueOnlyScattering(Box<dyn Scattering>);

impl Parametric for ValueOnly {
    fn name(&self) -> &'static str {
        "khungurn without derivatives"
    }

    fn parameters(&self) -> &'static [ParameterInfo] {
        &[]
    }
}

impl Model for ValueOnly {
    fn prepare(&self, parameters: &Parameters) -> Result<Box<dyn Scattering>> {
        Ok(Box::new(ValueOnlyScattering(Khungurn.prepare(parameters)?)))
    }
}

impl Scattering for ValueOnlyScattering {
    fn evaluate(&self, wi: glam::DVec3, wo: glam::DVec3, h: f64) -> Evaluation {
        Evaluation {
            value: self
                .0
                .importance(wi, &self.0.outgoing(wo, h, [1.0; CHANNELS]))
                .0,
            derivative: [[0.0; CHANNELS]; MAX_ROWS],
        }
    }

    fn outgoing(&self, wo: glam::DVec3, h: f64, carried: [f64; CHANNELS]) -> Outgoing {
        self.0.outgoing(wo, h, carried)
    }

    fn importance(&self, wi: glam::DVec3, o: &Outgoing) -> ([f64; CHANNELS], f64) {
        self.0.importance(wi, o)
    }

    fn sample(&self, o: &Outgoing, random: &mut Random) -> Option<Sampled> {
        self.0.sample(o, random)
    }

    fn light_points(&self, wi: glam::DVec3, o: &Outgoing, half_angle: f64) -> usize {
        self.0.light_points(wi, o, half_angle)
    }

    fn passage(&self) -> Passage {
        self.0.passage()
    }
}

pub(super) fn cost(
    fabric: &Fabric,
    configurations: &[Configuration],
    name: &str,
    parameters: &Parameters,
    rounds: usize,
) -> Cost {
    let scene = |model: &'static dyn Model| {
        FiberScene::new(&fabric.tile, model, FiberSceneOptions::default()).unwrap()
    };
    let (with, without) = (scene(&Khungurn), scene(&ValueOnly));
    let run = |scene: &FiberScene| -> Estimates {
        let request = Request {
            configurations,
            parameters,
            effort: Effort::Paths(PATHS),
            seed: 1,
            stream: 0,
        };
        scene.estimate(&request, &Unwatched).unwrap()
    };
    let (mut least, mut apart) = ([f64::INFINITY; 2], 0.0_f64);
    for _ in 0..rounds {
        let (a, b) = (run(&with), run(&without));
        least = [least[0].min(a.cpu_s), least[1].min(b.cpu_s)];
        let pairs = a.configurations.iter().zip(&b.configurations);
        let pairs = pairs.flat_map(|(a, b)| a.mean.into_iter().zip(b.mean));
        apart = pairs.fold(apart, |m, (a, b)| m.max((a / b - 1.0).abs()));
    }
    Cost {
        fabric: name.to_owned(),
        cpu_s_with: least[0],
        cpu_s_without: least[1],
        gradient_cost: least[0] / least[1],
        means_apart: apart,
    }
}
