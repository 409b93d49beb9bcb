//! What every room says to its caller: an [`Error`] with a hint, and progress through a [`Watch`].
//!
//! Knows nothing of cloth, files or devices.

use std::fmt;

/// The result every fallible public function returns.
pub type Result<T, E = Error> = std::result::Result<T, E>;

/// A failure told to a person: what went wrong and where (lowercase, no full stop), the cause below it, and what to do.
///
/// `Display` prints the message alone; [`Error::report`] prints the whole chain with the hints.
#[derive(Debug)]
pub struct Error {
    message: String,
    hint: Option<String>,
    source: Option<Box<dyn std::error::Error + Send + Sync + 'static>>,
}

impl Error {
    /// A failure with its message: what, where, and what was expected instead.
    pub fn new(message: impl Into<String>) -> Self {
        Self {
            message: message.into(),
            hint: None,
            source: None,
        }
    }

    /// Adds what the user can do about it; replaces an earlier hint of this link of the chain.
    #[must_use]
    pub fn with_hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = Some(hint.into());
        self
    }

    /// Adds the cause below this failure.
    #[must_use]
    pub fn with_source(
        mut self,
        source: impl Into<Box<dyn std::error::Error + Send + Sync + 'static>>,
    ) -> Self {
        self.source = Some(source.into());
        self
    }

    /// The hint of this link of the chain.
    pub fn hint(&self) -> Option<&str> {
        self.hint.as_deref()
    }

    /// The chain as printed to a person: `message: cause: cause`, then one `hint:` line for each hint on the way down.
    pub fn report(&self) -> String {
        let mut line = self.message.clone();
        let mut hints: Vec<&str> = self.hint.iter().map(String::as_str).collect();
        let mut next = std::error::Error::source(self);
        while let Some(cause) = next {
            line.push_str(": ");
            line.push_str(&cause.to_string());
            if let Some(error) = cause.downcast_ref::<Error>() {
                hints.extend(error.hint());
            }
            next = cause.source();
        }
        hints.dedup();
        for hint in hints {
            line.push_str("\nhint: ");
            line.push_str(hint);
        }
        line
    }
}

impl fmt::Display for Error {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.message)
    }
}

impl std::error::Error for Error {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        self.source
            .as_ref()
            .map(|s| s.as_ref() as &(dyn std::error::Error + 'static))
    }
}

/// Adds what was being done to a lower failure.
pub trait Context<T> {
    /// Wraps the failure in an [`Error`] whose message is `message()`, the old one becoming its cause.
    fn context<M: Into<String>>(self, message: impl FnOnce() -> M) -> Result<T>;
}

impl<T, E: Into<Box<dyn std::error::Error + Send + Sync + 'static>>> Context<T>
    for std::result::Result<T, E>
{
    fn context<M: Into<String>>(self, message: impl FnOnce() -> M) -> Result<T> {
        self.map_err(|cause| Error::new(message()).with_source(cause))
    }
}

/// Who watches a long piece of work: hears its progress and may ask it to stop.
///
/// Shared between threads; must be cheap, as it is called up to a few hundred times a second.
pub trait Watch: Sync {
    /// `done` of `total` units (same unit, `total > 0`) of the stage named `stage` are finished.
    fn progress(&self, stage: &str, done: u64, total: u64);
    /// True when the work should end early, keeping what is finished.
    fn cancelled(&self) -> bool;
    /// True when moving hardware must stop at once, in the middle of whatever it does.
    fn urgent(&self) -> bool {
        false
    }
}

/// A [`Watch`] that neither listens nor interrupts.
#[derive(Debug, Clone, Copy, Default)]
pub struct Unwatched;

impl Watch for Unwatched {
    fn progress(&self, _stage: &str, _done: u64, _total: u64) {}
    fn cancelled(&self) -> bool {
        false
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn report_prints_the_chain_then_the_hints() {
        let low =
            Error::new("line 3: expected 12 columns, found 11").with_hint("was the file cut off?");
        let high: Result<()> = Err(low).context(|| "measurements m.csv cannot be read");
        let text = high.unwrap_err().report();
        assert_eq!(
            text,
            "measurements m.csv cannot be read: line 3: expected 12 columns, found 11\nhint: was the file cut off?"
        );
    }
}
