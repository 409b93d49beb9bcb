//! The two things a driver may touch: bytes to and from a device, and time.

use std::io;
use std::sync::Mutex;
use std::time::{Duration, Instant};

/// A byte stream to one device.
pub trait Transport: Send {
    /// Hands all bytes to the device.
    ///
    /// # Errors
    /// `BrokenPipe` when the device is gone; `TimedOut` when it takes no bytes; the system's error otherwise.
    fn write(&mut self, bytes: &[u8]) -> io::Result<()>;

    /// Reads what has arrived, waiting at most `timeout` seconds for the first byte (0 = do not wait).
    ///
    /// # Errors
    /// `TimedOut` when nothing came; `Ok(0)` and every other error mean that the device is gone.
    fn read(&mut self, buffer: &mut [u8], timeout: f64) -> io::Result<usize>;
}

/// Monotonic time in seconds. The only source of time for drivers and for the capture loop.
pub trait Clock: Send + Sync {
    /// Seconds since the clock was made.
    fn now(&self) -> f64;
    /// Lets `seconds` pass.
    fn sleep(&self, seconds: f64);
}

/// The machine's monotonic clock.
#[derive(Debug)]
pub struct SystemClock {
    start: Instant,
}

impl SystemClock {
    /// A clock that starts at zero now.
    pub fn new() -> Self {
        Self {
            start: Instant::now(),
        }
    }
}

impl Default for SystemClock {
    fn default() -> Self {
        Self::new()
    }
}

impl Clock for SystemClock {
    fn now(&self) -> f64 {
        self.start.elapsed().as_secs_f64()
    }

    fn sleep(&self, seconds: f64) {
        std::thread::sleep(duration(seconds));
    }
}

/// A clock that stands still until somebody sleeps on it or waits on a simulated device.
#[derive(Debug, Default)]
pub struct VirtualClock {
    now: Mutex<f64>,
}

impl VirtualClock {
    /// A clock at zero.
    pub fn new() -> Self {
        Self::default()
    }

    /// Moves to the time `t`; never backwards.
    pub fn advance_to(&self, t: f64) {
        let mut now = self.now.lock().expect("the clock's lock is never poisoned");
        if t > *now {
            *now = t;
        }
    }
}

impl Clock for VirtualClock {
    fn now(&self) -> f64 {
        *self.now.lock().expect("the clock's lock is never poisoned")
    }

    fn sleep(&self, seconds: f64) {
        self.advance_to(self.now() + seconds);
    }
}

/// A non-negative number of seconds as a `Duration`; negative and NaN become zero.
pub(super) fn duration(seconds: f64) -> Duration {
    Duration::try_from_secs_f64(seconds.max(0.0)).unwrap_or(Duration::ZERO)
}

/// The error of a read in which nothing came.
pub(super) fn timed_out() -> io::Error {
    io::Error::new(io::ErrorKind::TimedOut, "nothing came in time")
}
