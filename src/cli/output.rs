//! Data on stdout.

use crate::session::Configuration;
use std::fmt::Arguments;
use std::io::{ErrorKind, Write};

/// Writes to stdout. When the reader has gone (`| head`) the program ends quietly; when stdout cannot be written for
/// another reason (disk full) it ends with an error.
pub(crate) fn write(text: Arguments<'_>) {
    let mut stdout = std::io::stdout().lock();
    if let Err(error) = stdout.write_fmt(text).and_then(|()| stdout.flush()) {
        if error.kind() == ErrorKind::BrokenPipe {
            std::process::exit(0);
        }
        eprintln!("error: stdout cannot be written: {error}");
        std::process::exit(2);
    }
}

/// A line of data on stdout; see [`write`].
macro_rules! data {
    ($($arguments:tt)*) => {
        $crate::cli::output::write(format_args!("{}\n", format_args!($($arguments)*)))
    };
}
pub(crate) use data;

/// A pose in degrees: light and camera as polar angle and azimuth, rotation; without the last bits' noise of the conversion,
/// and without -0.
pub(crate) fn pose_degrees(c: &Configuration) -> [f64; 5] {
    let angles = [
        c.light.theta,
        c.light.phi,
        c.camera.theta,
        c.camera.phi,
        c.rotation,
    ];
    angles.map(|a| (a.to_degrees() * 1e6).round() / 1e6 + 0.0)
}
