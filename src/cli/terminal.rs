//! Talking to the person: progress with ETA on stderr, and Ctrl-C.

use crate::base::{Context, Result, Watch};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::IsTerminal;
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// The person at the other end of stderr.
///
/// On a terminal the current stage is a bar with ETA; elsewhere a plain line every five seconds. The first Ctrl-C asks
/// the work to end and keep what it has. The second ends the program at once, or, where hardware moves, stops it in
/// whatever it does ([`Watch::urgent`]); there only the third ends the program.
pub(crate) struct Terminal {
    interrupts: Arc<AtomicU32>,
    stage: Mutex<Option<Stage>>,
    interactive: bool,
    started: Instant,
    last_line_ms: AtomicU64,
}

struct Stage {
    name: String,
    bar: ProgressBar,
    begun: Instant,
}

impl Terminal {
    /// Takes over Ctrl-C (and SIGTERM) for the rest of the process. Call once.
    pub(crate) fn new() -> Result<Self> {
        Self::with_interrupts(&[
            "stopping after the current step; press Ctrl-C again to end at once",
        ])
    }

    /// As [`Terminal::new`], for commands that move hardware.
    pub(crate) fn for_hardware() -> Result<Self> {
        Self::with_interrupts(&[
            "stopping after the current shot; press Ctrl-C again to stop the rig now",
            "stopping the rig now; a third Ctrl-C ends the program and leaves the rig as it is",
        ])
    }

    /// One answer for each Ctrl-C that does not end the program.
    fn with_interrupts(answers: &'static [&'static str]) -> Result<Self> {
        let interrupts = Arc::new(AtomicU32::new(0));
        let count = interrupts.clone();
        ctrlc::set_handler(move || {
            let earlier = count.fetch_add(1, Ordering::SeqCst);
            match answers.get(earlier as usize) {
                Some(answer) => eprintln!("\n{answer}"),
                None => std::process::exit(130),
            }
        })
        .context(|| "Ctrl-C cannot be handled")?;
        Ok(Self {
            interrupts,
            stage: Mutex::new(None),
            interactive: std::io::stderr().is_terminal(),
            started: Instant::now(),
            last_line_ms: AtomicU64::new(0),
        })
    }

    /// Prints one line of talk above the progress bar.
    pub(crate) fn say(&self, line: impl AsRef<str>) {
        self.finish_stage();
        eprintln!("{}", line.as_ref());
    }

    /// Removes the progress bar; the next progress report starts a new one.
    pub(crate) fn finish_stage(&self) {
        if let Ok(mut stage) = self.stage.lock()
            && let Some(stage) = stage.take()
        {
            stage.bar.finish_and_clear();
        }
    }

    fn plain_line(&self, stage: &Stage, done: u64, total: u64) {
        let now = self.started.elapsed().as_millis() as u64;
        let last = self.last_line_ms.load(Ordering::Relaxed);
        let due = now.saturating_sub(last) >= 5000;
        if due
            && self
                .last_line_ms
                .compare_exchange(last, now, Ordering::Relaxed, Ordering::Relaxed)
                .is_ok()
        {
            let elapsed = stage.begun.elapsed().as_secs_f64();
            let fraction = done as f64 / total as f64;
            let eta = if fraction > 0.0 {
                format!(", ETA {:.0} s", elapsed * (1.0 / fraction - 1.0))
            } else {
                String::new()
            };
            eprintln!("  {}: {:.0} %{eta}", stage.name, 100.0 * fraction);
        }
    }
}

impl Watch for Terminal {
    fn progress(&self, stage: &str, done: u64, total: u64) {
        let Ok(mut current) = self.stage.lock() else {
            return;
        };
        if current.as_ref().is_none_or(|s| s.name != stage) {
            if let Some(old) = current.take() {
                old.bar.finish_and_clear();
            }
            let target = if self.interactive {
                ProgressDrawTarget::stderr_with_hz(8)
            } else {
                ProgressDrawTarget::hidden()
            };
            let bar = ProgressBar::with_draw_target(Some(total), target);
            if let Ok(style) = ProgressStyle::with_template(
                "  {msg} [{bar:30}] {percent} %  {elapsed} elapsed, ETA {eta}",
            ) {
                bar.set_style(style.progress_chars("=> "));
            }
            bar.set_message(stage.to_owned());
            bar.enable_steady_tick(Duration::from_millis(250));
            *current = Some(Stage {
                name: stage.to_owned(),
                bar,
                begun: Instant::now(),
            });
        }
        if let Some(current) = current.as_ref() {
            current.bar.set_length(total);
            current.bar.set_position(done);
            if !self.interactive {
                self.plain_line(current, done, total);
            }
        }
    }

    fn cancelled(&self) -> bool {
        self.interrupts.load(Ordering::SeqCst) >= 1
    }

    fn urgent(&self) -> bool {
        self.interrupts.load(Ordering::SeqCst) >= 2
    }
}
