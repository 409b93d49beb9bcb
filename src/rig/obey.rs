//! Which requests of the operator end a wait of a driver.

use crate::base::Watch;

/// Which requests of the operator end a wait.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Obey {
    /// To end early or at once: nothing has moved yet.
    Any,
    /// Only to stop at once.
    Urgent,
    /// None: a stop is under way.
    Nothing,
}

impl Obey {
    /// True when the operator asked for what this wait obeys.
    pub(super) fn ends(self, watch: &dyn Watch) -> bool {
        match self {
            Self::Any => watch.cancelled() || watch.urgent(),
            Self::Urgent => watch.urgent(),
            Self::Nothing => false,
        }
    }
}
