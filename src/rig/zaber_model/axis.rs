//! One axis: motion in pieces of constant acceleration, its reference, its warning flags.

use super::options::ZaberAxis;
use std::collections::BTreeSet;

/// Constant acceleration from `t` on.
#[derive(Debug, Clone, Copy)]
struct Piece {
    t: f64,
    position: f64,
    speed: f64,
    acceleration: f64,
}

/// A motion that ends at rest.
#[derive(Debug, Clone)]
pub(super) struct Profile {
    pieces: Vec<Piece>,
    end: f64,
}

impl Profile {
    /// From rest to rest.
    pub(super) fn between(from: f64, to: f64, speed: f64, acceleration: f64, start: f64) -> Self {
        let way = (to - from).abs();
        let direction = (to - from).signum();
        let speed = speed.min((way * acceleration).sqrt());
        let ramp = if speed > 0.0 {
            speed / acceleration
        } else {
            0.0
        };
        let cruise = if speed > 0.0 { way / speed - ramp } else { 0.0 };
        let ramp_way = direction * 0.5 * speed * ramp;
        let piece = |t, position, speed, acceleration| Piece {
            t,
            position,
            speed: direction * speed,
            acceleration: direction * acceleration,
        };
        Self {
            pieces: vec![
                piece(start, from, 0.0, acceleration),
                piece(start + ramp, from + ramp_way, speed, 0.0),
                piece(start + ramp + cruise, to - ramp_way, speed, -acceleration),
            ],
            end: start + 2.0 * ramp + cruise,
        }
    }

    /// Position and speed at the time `t`.
    fn at(&self, t: f64) -> (f64, f64) {
        let t = t.clamp(self.pieces[0].t, self.end);
        let before = self.pieces.iter().rev().find(|p| p.t <= t);
        let p = before.unwrap_or(&self.pieces[0]);
        let dt = t - p.t;
        (
            p.position + p.speed * dt + 0.5 * p.acceleration * dt * dt,
            p.speed + p.acceleration * dt,
        )
    }

    /// Braking from where it is at the time `t`.
    fn braked(&self, t: f64, acceleration: f64) -> Self {
        let (position, speed) = self.at(t);
        Self {
            pieces: vec![Piece {
                t,
                position,
                speed,
                acceleration: -speed.signum() * acceleration,
            }],
            end: t + speed.abs() / acceleration,
        }
    }
}

#[derive(Debug)]
pub(super) struct Axis {
    pub(super) options: ZaberAxis,
    /// `maxspeed` as it is set now, microsteps per second.
    pub(super) max_speed: f64,
    /// Microsteps from the home sensor, when at rest.
    rest: f64,
    /// What the controller takes for the home sensor's place.
    zero: f64,
    motion: Option<Profile>,
    homing: bool,
    pub(super) stuck: bool,
    pub(super) flags: BTreeSet<&'static str>,
}

impl Axis {
    pub(super) fn new(options: ZaberAxis) -> Self {
        let mut axis = Self {
            max_speed: options.max_speed,
            rest: options.stands_at as f64,
            zero: 0.0,
            motion: None,
            homing: false,
            stuck: false,
            flags: BTreeSet::new(),
            options,
        };
        axis.power_up(0.0);
        axis
    }

    /// Stops where it is; without an absolute encoder that is 0 from now on.
    pub(super) fn power_up(&mut self, now: f64) {
        self.halt(now);
        self.flags.clear();
        if !self.options.keeps_reference {
            self.zero = self.rest;
            self.flags.insert("WR");
        }
    }

    /// Stops on the spot.
    pub(super) fn halt(&mut self, now: f64) {
        self.rest = self.truth(now).round();
        self.motion = None;
        self.homing = false;
        self.stuck = false;
    }

    /// Microsteps from the home sensor.
    pub(super) fn truth(&self, now: f64) -> f64 {
        self.motion.as_ref().map_or(self.rest, |m| m.at(now).0)
    }

    /// What the controller says.
    pub(super) fn position(&self, now: f64) -> i64 {
        (self.truth(now) - self.zero).round() as i64
    }

    pub(super) fn is_moving(&self, now: f64) -> bool {
        self.motion.as_ref().is_some_and(|m| m.pieces[0].t <= now)
    }

    pub(super) fn is_busy(&self, now: f64) -> bool {
        self.stuck || self.is_moving(now)
    }

    pub(super) fn next_event(&self) -> Option<f64> {
        self.motion.as_ref().map(|m| m.end)
    }

    /// Starts a motion to a position of the controller; returns the time halfway.
    pub(super) fn start(&mut self, position: f64, speed: f64, now: f64, start: f64) -> f64 {
        let from = self.truth(now);
        let to = position + self.zero;
        self.flags.remove("NI");
        self.flags.remove("FS");
        self.homing = false;
        let profile = Profile::between(from, to, speed, self.options.acceleration, start);
        let half = 0.5 * (start + profile.end);
        self.motion = Some(profile);
        half
    }

    /// Starts to look for the home sensor, at half speed.
    pub(super) fn home(&mut self, now: f64) {
        let way = -self.zero;
        self.start(way, 0.5 * self.max_speed, now, now);
        self.homing = true;
    }

    /// Brakes; what was not reached is left.
    pub(super) fn stop(&mut self, now: f64, acceleration: f64) {
        self.stuck = false;
        if self.is_busy(now) {
            self.flags.insert("NI");
            self.homing = false;
        }
        if let Some(motion) = &self.motion {
            self.motion = Some(motion.braked(now, acceleration));
        }
    }

    /// Ends a motion that is over; true when it was one.
    pub(super) fn settle(&mut self, now: f64) -> bool {
        let Some(end) = self.next_event().filter(|t| *t <= now) else {
            return false;
        };
        self.rest = self.truth(end).round();
        self.motion = None;
        if std::mem::take(&mut self.homing) {
            self.zero = 0.0;
            self.flags.remove("WR");
            self.flags.remove("WH");
        }
        self.flags.remove("NC");
        true
    }
}
