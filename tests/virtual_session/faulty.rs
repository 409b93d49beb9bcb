//! A rig with every fault of a real one, each drawn per seed.

use super::Setup;
use goniofit::math::Random;
use goniofit::measure::calibration::PoseErrors;
use goniofit::rig::SensorModel;
use goniofit::rig::virtual_camera::{Dust, Optics, PixelFaults};
use goniofit::session::{CameraFacts, Lens};

/// How well the operator says that things stand where they were asked to be; faults are drawn with these standard
/// deviations.
pub const STATED_POSE: PoseErrors = PoseErrors {
    camera_theta_deg: 0.05,
    light_theta_deg: 0.05,
    rotation_deg: 0.05,
    height_mm: 0.03,
};

struct Draw(Random);

impl Draw {
    fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.0.uniform()
    }

    fn about(&mut self, sd: f64) -> f64 {
        sd * self.0.normal()
    }
}

/// A sensor and a lens that are like no other.
pub fn sensor(seed: u64) -> SensorModel {
    let plain = Setup::new(seed).sensor;
    let mut draw = Draw(Random::keyed(&[seed, 4001]));
    let dust = (0..3).map(|_| Dust {
        center_px: [
            draw.between(0.0, plain.width as f64),
            draw.between(0.0, plain.height as f64),
        ],
        radius_px: draw.between(1.0, 4.0),
        depth: draw.between(0.02, 0.12),
    });
    let dust = dust.collect();
    let lens = Lens {
        roll: draw.about(0.005),
        perspective: 1.0 / draw.between(500.0, 900.0),
        distortion: draw.about(0.003),
        sag_px: [[draw.about(0.3), draw.about(0.3)], [0.0, draw.about(0.3)]],
    };
    let dark_current = draw.between(0.003, 0.012);
    SensorModel {
        pixel_mm: plain.pixel_mm * (1.0 + draw.about(0.003)),
        center_px: plain.center_px.map(|c| c + draw.about(0.5)),
        responsivity: plain.responsivity.map(|r| r * draw.between(0.9, 1.1)),
        gain: draw.between(2.0, 4.0),
        read_noise: draw.between(1.5, 3.0),
        dark_current,
        vignetting: draw.between(0.02, 0.15),
        shutter_jitter: 0.0,
        flicker: draw.between(0.0, 0.0005),
        optics: Optics {
            lens,
            falloff_center_px: [draw.about(4.0), draw.about(4.0)],
            falloff_quartic: draw.between(0.0, 0.04),
            gradient: [draw.about(0.01), draw.about(0.01)],
            dust,
            blur_px: 0.0,
        },
        faults: PixelFaults {
            nonlinearity: [draw.about(0.02), draw.about(0.01)],
            response_sd: draw.between(0.003, 0.012),
            dark_current_sd: 0.3 * dark_current,
            hot_fraction: draw.between(0.0005, 0.003),
            hot_per_ms: draw.between(0.5, 4.0),
            gains: [draw.between(0.95, 1.05), 1.0, draw.between(0.95, 1.05)],
            pattern_seed: seed,
            ..PixelFaults::default()
        },
        ..plain
    }
}

/// A drifting lamp: it warms up and fades.
pub fn lamp(x: f64, _: usize) -> [f64; 3] {
    [0.03, 0.025, 0.035].map(|d| 1.0 - d * x + 0.01 * (1.0 - (-6.0 * x).exp()))
}

/// What the rig's description states of the camera: right for an ideal lens, and off by what a ruler is off.
pub fn stated(sensor: &SensorModel) -> CameraFacts {
    let plain = Setup::new(0).sensor;
    CameraFacts {
        pixel_mm: plain.pixel_mm,
        center_px: plain.center_px,
        lens: Lens::default(),
        ..sensor.facts()
    }
}

impl Setup {
    /// A session on a rig with every fault: non-linear, unequal, hot and dusty pixels, vignetting, a real lens that points
    /// beside the center, angles that are a little off, a lamp that drifts and flickers, and exposures that clip.
    pub fn faulty(seed: u64) -> Self {
        let sensor = sensor(seed);
        let mut draw = Draw(Random::keyed(&[seed, 4002]));
        Self {
            stated: Some(stated(&sensor)),
            dark_sensor: sensor.clone(),
            sensor,
            poses: [(0.0, 0.0), (48.0, 90.0), (64.0, 0.0), (75.0, 90.0)]
                .map(|(theta, rotation)| {
                    let level = 10_f64.powf(draw.between(-1.7, 0.0));
                    (
                        theta,
                        rotation,
                        [0; 3].map(|_| level * draw.between(0.8, 1.2)),
                    )
                })
                .to_vec(),
            reference_every: 3,
            lamp: Some(lamp),
            pose_sd: STATED_POSE,
            pointing_sd_px: [0.1, 0.1],
            white_se: 0.003,
            ..Self::new(seed)
        }
    }
}
