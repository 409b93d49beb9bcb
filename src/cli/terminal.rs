//! Talking to the person: progress with ETA on stderr, and Ctrl-C.

use crate::base::{Context, Error, Result, Watch};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use std::io::{BufRead, IsTerminal, Write};
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// The person at the other end of stderr.
///
/// On a terminal the current stage is a bar with ETA; elsewhere a plain line every five seconds. The first Ctrl-C asks
/// the work to end and keep what it has. The second ends the program at once, or, where hardware moves, stops it in
/// whatever it does ([`Watch::urgent`]); there only the third ends the program.
pub(crate) struct Terminal {
    interrupts: Arc<AtomicU32>,
    /// The Ctrl-C from which on hardware must stop at once.
    urgent_from: u32,
    stage: Mutex<Option<Stage>>,
    interactive: bool,
    started: Instant,
    last_line_ms: AtomicU64,
}

struct Stage {
    name: String,
    bar: ProgressBar,
    begun: Instant,
    /// What was done already when it began: work of an earlier run says nothing of the speed.
    from: f64,
}

impl Terminal {
    /// Takes over Ctrl-C (and SIGTERM) for the rest of the process. Call once.
    pub(crate) fn new() -> Result<Self> {
        Self::with_interrupts(&[
            "stopping after the current step; press Ctrl-C again to end at once",
        ])
    }

    /// As [`Terminal::new`], for commands in which nothing is worth finishing: the first Ctrl-C stops the rig.
    pub(crate) fn stopping_at_once() -> Result<Self> {
        let answers = &[
            "stopping the rig now",
            "the rig is being stopped; a third Ctrl-C ends the program and leaves it as it is",
        ];
        Ok(Self {
            urgent_from: 1,
            ..Self::with_interrupts(answers)?
        })
    }

    /// One answer for each Ctrl-C that does not end the program.
    fn with_interrupts(answers: &'static [&'static str]) -> Result<Self> {
        let interrupts = Arc::new(AtomicU32::new(0));
        let count = interrupts.clone();
        ctrlc::set_handler(move || {
            let earlier = count.fetch_add(1, Ordering::SeqCst);
            match answers.get(earlier as usize) {
                // The terminal may be what went away.
                Some(answer) => drop(writeln!(std::io::stderr(), "\n{answer}")),
                None => std::process::exit(130),
            }
        })
        .context(|| "Ctrl-C cannot be handled")?;
        Ok(Self {
            interrupts,
            urgent_from: 2,
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

    /// Asks the person; Enter or y goes on.
    pub(crate) fn confirm(&self, question: &str, yes: bool) -> Result<()> {
        if yes {
            self.say(format!("{question}: yes (--yes)"));
            return Ok(());
        }
        if !std::io::stdin().is_terminal() {
            return Err(nobody_there(question));
        }
        self.say(format!("{question} [Enter = done, n = stop]"));
        if !self.line_within(f64::INFINITY)? {
            return Err(Error::new("stopped by the operator"));
        }
        let mut answer = String::new();
        let read = std::io::stdin().lock().read_line(&mut answer);
        match answer.trim().to_lowercase().as_str() {
            "" | "y" | "yes" if matches!(read, Ok(n) if n > 0) => Ok(()),
            _ => Err(declined(question)),
        }
    }

    /// Waits until there is a line to read on stdin: true; or `seconds` have passed, or Ctrl-C was pressed: false.
    pub(crate) fn line_within(&self, seconds: f64) -> Result<bool> {
        let stdin = std::io::stdin();
        let begun = Instant::now();
        let look = Timespec {
            tv_sec: 0,
            tv_nsec: 50_000_000,
        };
        while !self.cancelled() && begun.elapsed().as_secs_f64() < seconds {
            match poll(&mut [PollFd::new(&stdin, PollFlags::IN)], Some(&look)) {
                Ok(0) | Err(rustix::io::Errno::INTR) => {}
                Ok(_) => return Ok(true),
                Err(e) => return Err(Error::new("the terminal cannot be read").with_source(e)),
            }
        }
        Ok(false)
    }

    /// Runs `work` with a bar of its expected time, if that is long enough to wonder about.
    pub(crate) fn with_progress<T>(
        &self,
        stage: &str,
        expected_s: f64,
        work: impl FnOnce() -> T,
    ) -> T {
        const WORTH_SHOWING_S: f64 = 2.0;
        if expected_s < WORTH_SHOWING_S {
            return work();
        }
        let done = AtomicBool::new(false);
        let result = std::thread::scope(|scope| {
            scope.spawn(|| {
                let begun = Instant::now();
                let total = (1000.0 * expected_s) as u64;
                while !done.load(Ordering::SeqCst) {
                    // It is an estimate: the bar never says that it is over.
                    let past = (begun.elapsed().as_millis() as u64).min(total * 99 / 100);
                    self.progress(stage, past, total);
                    std::thread::sleep(Duration::from_millis(50));
                }
            });
            let _end = Flag(&done);
            work()
        });
        self.finish_stage();
        result
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
            let own = fraction - stage.from;
            let eta = if own > 0.0 {
                format!(", ETA {:.0} s", elapsed * (1.0 - fraction) / own)
            } else {
                String::new()
            };
            eprintln!("  {}: {:.0} %{eta}", stage.name, 100.0 * fraction);
        }
    }
}

/// Set when it goes out of scope, also by a panic.
struct Flag<'a>(&'a AtomicBool);

impl Drop for Flag<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::SeqCst);
    }
}

/// The answer when there is no person to ask.
pub(crate) fn nobody_there(question: &str) -> Error {
    Error::new(format!("nobody is there to answer: {question}"))
        .with_hint("run in a terminal, or pass --yes when everything is in place")
}

/// The answer of a person who said no.
pub(crate) fn declined(question: &str) -> Error {
    Error::new(format!("the operator declined: {question}"))
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
            bar.set_position(done);
            bar.reset_eta();
            *current = Some(Stage {
                name: stage.to_owned(),
                bar,
                begun: Instant::now(),
                from: done as f64 / total as f64,
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
        self.interrupts.load(Ordering::SeqCst) >= self.urgent_from
    }
}
