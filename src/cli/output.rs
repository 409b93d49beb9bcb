//! Data on stdout.

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
