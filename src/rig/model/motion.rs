//! Straight-line motion in time: constant acceleration, cruise, constant deceleration; every block starts and ends at rest.

/// One planned line.
#[derive(Debug, Clone)]
pub(super) struct Block {
    /// Where it ends, machine units.
    pub(super) to: Vec<f64>,
    /// Programmed speed, units per second; infinite for G0.
    pub(super) speed: f64,
    /// True for a jog.
    pub(super) jog: bool,
}

/// A line being run.
#[derive(Debug, Clone)]
pub(super) struct Motion {
    pub(super) block: Block,
    from: Vec<f64>,
    length: f64,
    acceleration: f64,
    top_speed: f64,
    start: f64,
    /// Distance at `start`.
    start_distance: f64,
    /// Duration, speed at its start, acceleration.
    phases: Vec<(f64, f64, f64)>,
    /// A hold or jog cancel was asked for: the profile only brakes.
    pub(super) braking: bool,
}

impl Motion {
    /// Starts a block at rest; `rates` in units per minute and `accelerations` in units per second squared, per axis.
    pub(super) fn start(
        from: &[f64],
        block: Block,
        rates: &[f64],
        accelerations: &[f64],
        now: f64,
    ) -> Self {
        let delta: Vec<f64> = block.to.iter().zip(from).map(|(b, a)| b - a).collect();
        let length = delta.iter().map(|d| d * d).sum::<f64>().sqrt();
        let bound = |limits: &[f64], unit: f64| {
            let along = delta
                .iter()
                .zip(limits)
                .filter(|(d, _)| d.abs() > 0.0)
                .map(|(d, l)| l / unit * length / d.abs());
            along.fold(f64::INFINITY, f64::min)
        };
        let mut motion = Self {
            top_speed: block.speed.min(bound(rates, 60.0)),
            acceleration: bound(accelerations, 1.0),
            block,
            from: from.to_vec(),
            length,
            start: now,
            start_distance: 0.0,
            phases: Vec::new(),
            braking: false,
        };
        motion.plan_run(now, 0.0);
        motion
    }

    fn plan_run(&mut self, now: f64, done: f64) {
        let rest = (self.length - done).max(0.0);
        self.start = now;
        self.start_distance = done;
        self.braking = false;
        if rest <= 0.0 {
            self.phases.clear();
            return;
        }
        let a = self.acceleration;
        let v = self.top_speed.min((a * rest).sqrt());
        let cruise = (rest - v * v / a).max(0.0) / v;
        self.phases = vec![(v / a, 0.0, a), (cruise, v, 0.0), (v / a, v, -a)];
    }

    /// Brakes to a standstill from here.
    pub(super) fn brake(&mut self, now: f64) {
        let (distance, speed) = self.state(now);
        self.start = now;
        self.start_distance = distance;
        self.phases = vec![(speed / self.acceleration, speed, -self.acceleration)];
        self.braking = true;
    }

    /// Goes on from a standstill.
    pub(super) fn resume(&mut self, now: f64) {
        let (distance, _) = self.state(now);
        self.plan_run(now, distance);
    }

    /// When the profile ends.
    pub(super) fn end(&self) -> f64 {
        self.start + self.phases.iter().map(|p| p.0).sum::<f64>()
    }

    /// Distance along the line and speed.
    fn state(&self, now: f64) -> (f64, f64) {
        let mut t = now - self.start;
        let mut distance = self.start_distance;
        for &(duration, v, a) in &self.phases {
            if t < duration {
                return (distance + v * t + a * t * t / 2.0, v + a * t);
            }
            distance += v * duration + a * duration * duration / 2.0;
            t -= duration;
        }
        (distance.min(self.length), 0.0)
    }

    /// Speed, units per minute.
    pub(super) fn feed(&self, now: f64) -> f64 {
        self.state(now).1 * 60.0
    }

    /// True when the end of the line is reached (and not only the end of braking).
    pub(super) fn at_target(&self, now: f64) -> bool {
        self.length - self.state(now).0 <= 1e-9 * self.length.max(1.0)
    }

    /// Axis positions.
    pub(super) fn position(&self, now: f64) -> Vec<f64> {
        if self.at_target(now) {
            return self.block.to.clone();
        }
        let part = self.state(now).0 / self.length;
        self.from
            .iter()
            .zip(&self.block.to)
            .map(|(a, b)| a + (b - a) * part)
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn motion(to: &[f64]) -> Motion {
        let block = Block {
            to: to.to_vec(),
            speed: 10.0,
            jog: false,
        };
        Motion::start(&vec![0.0; to.len()], block, &[6000.0; 5], &[20.0; 5], 1.0)
    }

    #[test]
    fn a_trapezoid_takes_the_time_of_its_formula() {
        let m = motion(&[30.0, 40.0]);
        // The path has acceleration 20 / 0.8 = 25: 50/10 s of travel plus one v/a = 0.4 s.
        assert!((m.end() - 1.0 - 5.4).abs() < 1e-12, "{}", m.end());
        let p = m.position(1.0 + 2.7);
        assert!(
            (p[0] - 15.0).abs() < 1e-9 && (p[1] - 20.0).abs() < 1e-9,
            "{p:?}"
        );
    }

    #[test]
    fn braking_then_resuming_ends_at_the_target() {
        let mut m = motion(&[-20.0]);
        m.brake(2.0);
        assert!((m.end() - 2.5).abs() < 1e-12 && !m.at_target(m.end()));
        m.resume(5.0);
        assert_eq!(m.position(m.end()), [-20.0]);
    }
}
