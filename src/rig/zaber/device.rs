//! The controller as the rig sees it: [`Motion`] over the dialogue.

use super::{TRIES, Zaber, flags};
use crate::base::Result;
use crate::rig::description::Homing;
use crate::rig::devices::{AxisLimits, Light, Motion, Target};

impl Motion for Zaber<'_> {
    fn name(&self) -> &str {
        &self.name
    }

    fn firmware(&self) -> String {
        self.firmware.clone()
    }

    fn dump(&self) -> Vec<String> {
        let retries = self.link.retries.iter().cloned();
        self.dump.iter().cloned().chain(retries).collect()
    }

    fn take_notes(&mut self) -> Vec<String> {
        self.link.take_notes()
    }

    fn check(&self, homing: Homing) -> Result<()> {
        if homing == Homing::Cycle {
            return Ok(());
        }
        Err(self.error(
            "a Zaber controller homes itself, its zero marks cannot be taken on trust",
            "set homing = \"cycle\" in the rig file",
        ))
    }

    fn axis_limits(&self, letter: char) -> Result<AxisLimits> {
        let (_, facts) = self.axis(letter).map_err(|f| f.told(&self.name))?;
        Ok(facts.limits)
    }

    fn moves_in_line(&self) -> bool {
        false
    }

    fn is_homed(&self) -> bool {
        self.homed
    }

    fn home(&mut self) -> Result<()> {
        self.homed = false;
        self.moving = true;
        self.homing = true;
        let result = self.home_all();
        self.checked(result)?;
        self.moving = false;
        self.homing = false;
        self.homed = true;
        Ok(())
    }

    fn trust_position(&mut self) -> Result<()> {
        Err(self.error(
            "its position cannot be taken on trust",
            "home it: set homing = \"cycle\" in the rig file",
        ))
    }

    fn state(&mut self) -> Result<String> {
        let result = self.link.ask(0, "get pos", TRIES);
        let reply = self.checked(result)?;
        let state = if reply.busy { "BUSY" } else { "IDLE" };
        Ok(match reply.flag {
            Some(flag) => format!("{state} {flag} ({})", flags::meaning(&flag).1),
            None => state.to_owned(),
        })
    }

    fn positions(&mut self, letters: &[char]) -> Result<Vec<f64>> {
        let result = (|| {
            let reply = self.link.accepted(0, "get pos", TRIES)?;
            let all = self.listed("pos", &reply.data)?;
            let of = |letter: &char| Ok(all[self.axis(*letter)?.0].map_or(0.0, |p| p as f64));
            letters.iter().map(of).collect()
        })();
        self.checked(result)
    }

    fn start_move(&mut self, targets: &[Target]) -> Result<()> {
        if !self.homed {
            return Err(self.error("its position is not known", "home the rig before moving it"));
        }
        let result = self.start(targets);
        self.checked(result)
    }

    fn finish_move(&mut self, targets: &[Target], timeout: f64) -> Result<Vec<f64>> {
        let result = self.finish(targets, timeout);
        let positions = self.checked(result)?;
        self.moving = false;
        Ok(positions)
    }

    fn look_on_the_way(&mut self) -> Result<bool> {
        let result = self.glance();
        self.checked(result)
    }

    fn verify_at(&mut self, targets: &[Target]) -> Result<Vec<f64>> {
        let result = self.verified(targets);
        self.checked(result)
    }

    fn may_be_moving(&self) -> bool {
        self.moving
    }

    fn may_be_homing(&self) -> bool {
        self.homing
    }

    fn brake(&mut self) {
        if !self.lost {
            self.faulted = true;
            // A board that cannot be reached tells it in the stop that follows.
            let _ = self.link.send(0, "stop");
        }
    }

    fn make_safe(&mut self, at_once: bool) -> Result<String> {
        if self.lost {
            return Err(self.error("it is disconnected", "check by eye that nothing moves"));
        }
        if !(self.moving || self.faulted) {
            return Ok(format!("board '{}': at rest", self.name));
        }
        let result = self.stop_and_wait(if at_once { "estop" } else { "stop" });
        self.checked(result)?;
        let position = if self.homed {
            "position kept"
        } else {
            "position unknown, home before moving"
        };
        Ok(format!("board '{}': stopped, {position}", self.name))
    }

    fn lamp(&mut self) -> Option<&mut dyn Light> {
        None
    }
}
