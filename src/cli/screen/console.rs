//! The terminal itself: keys without Enter, and lines that are redrawn in place.

use super::table::{Line, Style};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::termios::{
    InputModes, LocalModes, OptionalActions, QueueSelector, SpecialCodeIndex, Termios, tcflush,
    tcgetattr, tcgetpgrp, tcgetwinsize, tcsetattr,
};
use std::fmt::Write as _;
use std::fs::File;
use std::io::{Read, Write};

/// Keys as they are pressed, unseen; the terminal is as before when this goes out of scope.
///
/// Ctrl-C stays a signal. Ctrl-Z and Ctrl-\ do nothing: they would leave the rig alone with its lamp on.
pub(super) struct Keyboard {
    terminal: File,
    before: Termios,
}

impl Keyboard {
    /// None when `terminal` is none, or belongs to another program at the moment.
    pub(super) fn new(terminal: File) -> Option<Self> {
        let before = tcgetattr(&terminal).ok()?;
        if tcgetpgrp(&terminal).is_ok_and(|front| front != rustix::process::getpgrp()) {
            return None;
        }
        let mut raw = before.clone();
        raw.local_modes -= LocalModes::ICANON | LocalModes::ECHO;
        // Ctrl-S would hold back the picture, and with it the keys, until Ctrl-Q.
        raw.input_modes -= InputModes::IXON;
        raw.special_codes[SpecialCodeIndex::VMIN] = 0;
        raw.special_codes[SpecialCodeIndex::VTIME] = 0;
        for off in [SpecialCodeIndex::VSUSP, SpecialCodeIndex::VQUIT] {
            raw.special_codes[off] = 0;
        }
        tcsetattr(&terminal, OptionalActions::Now, &raw).ok()?;
        // What was typed before anybody could read the keys line means nothing.
        let _ = tcflush(&terminal, QueueSelector::IFlush);
        Some(Self { terminal, before })
    }

    /// Keys pressed within `milliseconds`; none when the terminal is gone.
    pub(super) fn keys(&self, milliseconds: u32) -> Option<Vec<u8>> {
        let look = Timespec {
            tv_sec: 0,
            tv_nsec: i64::from(milliseconds) * 1_000_000,
        };
        let mut wanted = [PollFd::new(&self.terminal, PollFlags::IN)];
        match poll(&mut wanted, Some(&look)) {
            Ok(0) | Err(rustix::io::Errno::INTR) => return Some(Vec::new()),
            Ok(_) => {}
            Err(_) => return None,
        }
        let mut buffer = [0; 64];
        match (&self.terminal).read(&mut buffer) {
            Ok(n) if n > 0 => Some(buffer[..n].to_vec()),
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => Some(Vec::new()),
            _ => None,
        }
    }

    /// Puts the terminal back as it was. Keys nobody read are not for the shell.
    pub(super) fn restore(&self) {
        let _ = tcflush(&self.terminal, QueueSelector::IFlush);
        let _ = tcsetattr(&self.terminal, OptionalActions::Now, &self.before);
    }
}

impl Drop for Keyboard {
    fn drop(&mut self) {
        self.restore();
    }
}

/// Lines at the bottom of a terminal, redrawn in place; what is said scrolls away above them.
pub(super) struct Canvas {
    terminal: File,
    color: bool,
    /// Characters of each line drawn last.
    drawn: Vec<usize>,
}

impl Canvas {
    pub(super) fn new(terminal: File, color: bool) -> Self {
        let mut canvas = Self {
            terminal,
            color,
            drawn: Vec::new(),
        };
        canvas.write("\x1b[?25l");
        canvas
    }

    /// Columns and rows; those of the smallest terminal when it does not tell.
    pub(super) fn size(&self) -> (usize, usize) {
        match tcgetwinsize(&self.terminal) {
            Ok(size) if size.ws_col > 0 && size.ws_row > 0 => {
                (usize::from(size.ws_col), usize::from(size.ws_row))
            }
            _ => (80, 24),
        }
    }

    /// Writes `said` above `lines`, in one piece so that nothing flickers.
    pub(super) fn draw(&mut self, said: &[String], lines: &[Line]) {
        let (width, _) = self.size();
        // A terminal that became narrower has wrapped what is on it.
        let up: usize = self.drawn.iter().map(|n| n.div_ceil(width).max(1)).sum();
        let mut out = String::from("\x1b[?2026h\r");
        if up > 0 {
            let _ = write!(out, "\x1b[{up}A");
        }
        for text in said {
            let _ = write!(out, "{text}\x1b[K\r\n");
        }
        for line in lines {
            let code = if self.color { sgr(line.style) } else { "" };
            let end = if code.is_empty() { "" } else { "\x1b[0m" };
            let _ = write!(out, "{code}{}{end}\x1b[K\r\n", line.text);
        }
        out.push_str("\x1b[J\x1b[?2026l");
        self.drawn = lines.iter().map(|l| l.text.chars().count()).collect();
        self.write(&out);
    }

    /// Shows the cursor again.
    pub(super) fn restore(&mut self) {
        self.write("\x1b[?25h");
    }

    /// The terminal may be gone; there is nobody to tell then.
    fn write(&mut self, text: &str) {
        let _ = self.terminal.write_all(text.as_bytes());
    }
}

fn sgr(style: Style) -> &'static str {
    match style {
        Style::Plain => "",
        Style::Bold => "\x1b[1m",
        Style::Faint => "\x1b[2m",
        Style::Good => "\x1b[32m",
        Style::Warning => "\x1b[33m",
        Style::Bad => "\x1b[31m",
    }
}
