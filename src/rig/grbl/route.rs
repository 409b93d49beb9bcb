//! The straight line of a move, and what no report may say while it runs.
//!
//! The protocol has no checksum: a digit lost on the way to the board is executed. Where the axes are is the only witness.

use super::fault::Fault;

/// Seconds an axis may stand still while the controller says that it runs.
const STALLED: f64 = 5.0;

/// The way of one move, all axes of the board in the order of a status report.
#[derive(Debug, Clone)]
pub(super) struct Route {
    from: Vec<f64>,
    to: Vec<f64>,
    /// How far each axis may be off the line.
    room: Vec<f64>,
    letters: Vec<char>,
    /// The largest part of the line that was reported so far.
    furthest: f64,
    last: Vec<f64>,
    last_change: f64,
    last_heard: f64,
}

impl Route {
    /// The line between two positions; all of the same length as `room` and `letters`.
    pub(super) fn new(
        from: Vec<f64>,
        to: Vec<f64>,
        room: Vec<f64>,
        letters: Vec<char>,
        now: f64,
    ) -> Self {
        Self {
            last: from.clone(),
            from,
            to,
            room,
            letters,
            furthest: 0.0,
            last_change: now,
            last_heard: now,
        }
    }

    /// A report came now.
    pub(super) fn heard(&mut self, now: f64) {
        self.last_heard = now;
    }

    /// When the last report came, or the move began.
    pub(super) fn last_heard(&self) -> f64 {
        self.last_heard
    }

    /// Part of the line at which `position` is nearest, 0 to 1.
    fn part(&self, position: &[f64]) -> f64 {
        let (mut along, mut squared) = (0.0, 0.0);
        for ((f, t), p) in self.from.iter().zip(&self.to).zip(position) {
            along += (t - f) * (p - f);
            squared += (t - f) * (t - f);
        }
        if squared > 0.0 {
            (along / squared).clamp(0.0, 1.0)
        } else {
            0.0
        }
    }

    /// Checks a position reported while the move runs: on the line, not beyond its end, and not going back.
    pub(super) fn check(&mut self, position: &[f64]) -> Result<(), Fault> {
        if position.len() != self.from.len() {
            return Err(Fault::unexpected(
                format!(
                    "it reports {} axes, expected {}",
                    position.len(),
                    self.from.len()
                ),
                "check for noise on the cable, then home again",
            ));
        }
        let part = self.part(position);
        // Going back counts from where it was last seen.
        let nearest = part.max(self.furthest);
        self.furthest = nearest;
        for (i, p) in position.iter().enumerate() {
            let line = self.from[i] + nearest * (self.to[i] - self.from[i]);
            if !(0.0..=self.room[i]).contains(&(p - line).abs()) {
                return Err(Fault::unexpected(
                    format!(
                        "axis {} stands at {p:.4}, off its way from {:.4} to {:.4}",
                        self.letters[i], self.from[i], self.to[i]
                    ),
                    "the move is not executed as sent; check for noise on the cable, then home again",
                ));
            }
        }
        Ok(())
    }

    /// As [`Route::check`], for a controller that says it runs: it must also get on.
    pub(super) fn check_running(&mut self, position: &[f64], now: f64) -> Result<(), Fault> {
        self.check(position)?;
        if position != self.last {
            self.last = position.to_vec();
            self.last_change = now;
        }
        if now - self.last_change > STALLED {
            return Err(Fault::unexpected(
                format!("it says that it runs, but stood still for {STALLED:.0} s"),
                "reset the board; when it happens again, check its firmware",
            ));
        }
        Ok(())
    }

    /// True when `position` is where the move began.
    pub(super) fn is_at_start(&self, position: &[f64]) -> bool {
        self.is_near(position, &self.from)
    }

    /// True when `position` is where the move ends.
    pub(super) fn is_at_end(&self, position: &[f64]) -> bool {
        self.is_near(position, &self.to)
    }

    fn is_near(&self, position: &[f64], place: &[f64]) -> bool {
        position.len() == place.len()
            && position
                .iter()
                .zip(place)
                .zip(&self.room)
                .all(|((a, b), room)| (a - b).abs() <= *room)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn route() -> Route {
        Route::new(
            vec![0.0, 0.0, -7.0],
            vec![-30.0, 40.0, -7.0],
            vec![0.03; 3],
            vec!['X', 'Y', 'Z'],
            0.0,
        )
    }

    #[test]
    fn every_place_on_the_line_is_free_and_none_beside_behind_or_beyond_it() {
        let mut r = route();
        for i in 0..=100 {
            let s = f64::from(i) / 100.0;
            r.check(&[-30.0 * s, 40.0 * s + 0.01, -7.01]).unwrap();
        }
        for wrong in [
            [-15.0, 20.1, -7.0],
            [0.1, 0.0, -7.0],
            [-30.06, 40.08, -7.0],
            [-15.0, 20.0, -6.9],
            [f64::NAN, 20.0, -7.0],
        ] {
            assert!(route().check(&wrong).is_err(), "{wrong:?}");
        }
        assert!(r.check(&[-15.0, 20.0, -7.0]).is_err(), "it goes back");
        assert!(r.check(&[-30.0, 40.0]).is_err());
    }

    #[test]
    fn a_controller_that_runs_without_moving_is_stuck() {
        let mut r = route();
        r.check_running(&[-3.0, 4.0, -7.0], 1.0).unwrap();
        r.check_running(&[-3.0, 4.0, -7.0], 5.9).unwrap();
        assert!(r.check_running(&[-3.0, 4.0, -7.0], 6.1).is_err());
    }
}
