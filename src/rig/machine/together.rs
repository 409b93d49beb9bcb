//! Several boards on their way at the same time.

use super::{Error, LOOK, Result, Rig};

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
        loop {
            let mut busy = None;
            for i in moving {
                if !self.boards[*i].look_on_the_way()? {
                    busy = Some(*i);
                }
            }
            if busy.is_none() {
                // Each driver makes sure of its own arrival.
                return Ok(());
            }
            if let Some(i) = busy.filter(|_| self.clock.now() > deadline) {
                let name = self.boards[i].name();
                return Err(Error::new(format!(
                    "board '{name}': the move did not end within {timeout:.0} s"
                ))
                .with_hint(
                    "look what holds the axis; compare the board's speeds and accelerations with the rig file",
                ));
            }
            self.clock.sleep(LOOK);
        }
    }
}
