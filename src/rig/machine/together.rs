//! Several boards on their way at the same time.

use super::{Error, LOOK, Result, Rig};

/// Looks in a row at which no board moves.
const STILL: u32 = 2;

impl Rig<'_> {
    /// Looks at all of these boards in turns until none moves, so that a fault of any is noticed while the others are on
    /// their way. A single board is watched by its own driver.
    ///
    /// # Errors
    /// The first fault of any board, or something still moves after `timeout` seconds.
    pub(super) fn watch_together(&mut self, moving: &[usize], timeout: f64) -> Result<()> {
        if moving.len() < 2 {
            return Ok(());
        }
        let deadline = self.clock.now() + timeout;
        let mut still = 0;
        while still < STILL {
            let mut at_rest = true;
            for i in moving {
                at_rest &= self.boards[*i].look_on_the_way()?;
            }
            still = if at_rest { still + 1 } else { 0 };
            if self.clock.now() > deadline {
                return Err(Error::new(format!(
                    "the boards have not all ended a move after {timeout:.0} s"
                ))
                .with_hint(
                    "compare the boards' speeds and accelerations ($110.. and $120..) with the rig file",
                ));
            }
            self.clock.sleep(LOOK);
        }
        Ok(())
    }
}
