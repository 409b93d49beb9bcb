//! The capture screen: a live table, keys, questions and signals; [`Screen`] is the loop's [`Operator`].
//!
//! One thread reads the keys and draws; signals arrive on a thread of their own. Both only set what is asked for and call
//! the stop hook, so neither ever waits for the rig. Without a terminal there are signals and plain lines.

mod console;
mod preview;
mod requests;
mod table;

use super::terminal::{declined, nobody_there};
use crate::base::{Context, Error, Result, Watch};
use crate::rig::{Operator, Request, RigDescription, Seen};
use crate::session::Plan;
use console::{Canvas, Keyboard};
use requests::Requests;
use std::fs::File;
use std::io::{IsTerminal, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use table::Table;

/// How often keys, questions and pauses are looked at.
const LOOK: Duration = Duration::from_millis(50);
/// How often the clock on the screen is redrawn.
const REDRAW: Duration = Duration::from_millis(250);
/// How often a plain line of progress is written.
const PLAIN_LINE: Duration = Duration::from_secs(5);

const KEYS: &str =
    "p pause after shot  space pause now  a abort  h halt  v preview  ? help  Ctrl-C";
const HELP: [&str; 7] = [
    "p      pause after the current shot        space  pause now, motion brakes with its position kept",
    "c      go on after a pause",
    "a      abort: motion brakes, lamp off; the session can be resumed",
    "h      halt: the fastest stop there is, the position is lost",
    "v      write a small picture of the last frame to preview.png in the session",
    "Ctrl-C asks for a pause; again: abort; a third time: halt; a fourth ends the program, rig as it is",
    "For people and fingers there must be a switch that cuts the motors' power.",
];

/// What a screen shows.
pub(crate) struct Setup<'a> {
    /// The rig.
    pub(crate) rig: &'a RigDescription,
    /// The plan.
    pub(crate) plan: &'a Plan,
    /// The session's folder.
    pub(crate) session: &'a Path,
    /// Every question is answered with yes.
    pub(crate) yes: bool,
}

/// What a question came to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Asked {
    Nothing,
    Waiting,
    Yes,
    No,
}

/// What the threads share.
struct Shared {
    requests: Requests,
    table: Mutex<Table>,
    /// Lines to write above the table.
    said: Mutex<Vec<String>>,
    asked: Mutex<Asked>,
    /// There is a person at a keyboard.
    keyboard: Mutex<Option<Keyboard>>,
    attended: AtomicBool,
    /// None when lines are plain.
    canvas: Mutex<Option<Canvas>>,
    plain: Option<Mutex<File>>,
    changed: AtomicBool,
    ended: AtomicBool,
    session: PathBuf,
    last_frame: Mutex<Option<PathBuf>>,
    previewing: AtomicBool,
    begun: Instant,
}

/// Poisoned by a panic elsewhere, it still is what it was.
fn locked<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The person in front of the rig, and what they see. The terminal is as before when it goes out of scope; nothing else
/// may print until then.
pub(crate) struct Screen {
    shared: Arc<Shared>,
    yes: bool,
    thread: Option<JoinHandle<()>>,
}

impl Screen {
    /// Takes over Ctrl-C, SIGTERM and SIGHUP for the rest of the process, and the terminal. Call once.
    pub(crate) fn new(setup: &Setup<'_>) -> Result<Self> {
        let (stdin, stderr) = (std::io::stdin(), std::io::stderr());
        let keys = stdin.is_terminal().then(|| duplicate(stdin.as_fd()));
        let dumb = std::env::var_os("TERM").is_some_and(|t| t == "dumb");
        let live = stderr.is_terminal() && !dumb;
        let screen = Self::on(setup, keys.transpose()?, duplicate(stderr.as_fd())?, live);
        let shared = screen.shared.clone();
        ctrlc::set_handler(move || shared.interrupt()).context(|| "Ctrl-C cannot be handled")?;
        Ok(screen)
    }

    /// On these files instead of the process's own.
    fn on(setup: &Setup<'_>, keys: Option<File>, out: File, live: bool) -> Self {
        let color = std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty());
        let keyboard = keys.and_then(Keyboard::new);
        let attended = keyboard.is_some();
        let mut table = Table::new(setup.rig, setup.plan, &setup.session.display().to_string());
        if attended {
            KEYS.clone_into(&mut table.keys);
        }
        let (canvas, plain) = if live {
            (Some(Canvas::new(out, color)), None)
        } else {
            (None, Some(Mutex::new(out)))
        };
        let shared = Arc::new(Shared {
            requests: Requests::default(),
            table: Mutex::new(table),
            said: Mutex::new(Vec::new()),
            asked: Mutex::new(Asked::Nothing),
            keyboard: Mutex::new(keyboard),
            attended: AtomicBool::new(attended),
            canvas: Mutex::new(canvas),
            plain,
            changed: AtomicBool::new(true),
            ended: AtomicBool::new(false),
            session: setup.session.to_owned(),
            last_frame: Mutex::new(None),
            previewing: AtomicBool::new(false),
            begun: Instant::now(),
        });
        let worker = shared.clone();
        Self {
            shared,
            yes: setup.yes,
            thread: Some(std::thread::spawn(move || worker.serve())),
        }
    }

    /// Writes one line of talk.
    pub(crate) fn say(&self, line: impl Into<String>) {
        self.shared.say(line.into());
    }

    /// Calls `hook` at once, on the thread that heard it, when motion shall end: a pause now, an abort or a halt.
    pub(crate) fn on_stop(&self, hook: Box<dyn Fn(Request) + Send>) {
        self.shared.requests.on_stop(hook);
    }
}

fn duplicate(fd: BorrowedFd<'_>) -> Result<File> {
    let copy = fd.try_clone_to_owned();
    Ok(File::from(copy.context(|| "the terminal cannot be used")?))
}

impl Drop for Screen {
    fn drop(&mut self) {
        self.shared.ended.store(true, Ordering::SeqCst);
        if let Some(thread) = self.thread.take() {
            // A panic in the thread has been printed already.
            let _ = thread.join();
        }
        locked(&self.shared.table).leave();
        locked(&self.shared.table).keys.clear();
        self.shared.draw();
        self.shared.restore();
    }
}

impl Watch for Screen {
    fn progress(&self, stage: &str, done: u64, total: u64) {
        let percent = 100 * done / total.max(1);
        locked(&self.shared.table).status = format!("{stage} {percent} %");
        self.shared.touch();
    }

    fn cancelled(&self) -> bool {
        self.shared.requests.now() >= Request::Pause
    }

    fn urgent(&self) -> bool {
        self.shared.requests.now() >= Request::PauseNow
    }
}

impl Operator for Screen {
    fn request(&self) -> Request {
        self.shared.requests.now()
    }

    fn confirm(&self, question: &str) -> Result<()> {
        if self.yes {
            self.say(format!("{question}: yes (--yes)"));
            return Ok(());
        }
        if !self.shared.is_attended() {
            return Err(nobody_there(question));
        }
        let keys = format!("{question} [Enter = done, n = stop]");
        self.say(&*keys);
        *locked(&self.shared.asked) = Asked::Waiting;
        let before = self.shared.show_keys(keys);
        let answer = loop {
            if self.cancelled() {
                break Err(Error::new("stopped by the operator"));
            }
            match *locked(&self.shared.asked) {
                Asked::Yes => break Ok(()),
                Asked::No => break Err(declined(question)),
                Asked::Waiting | Asked::Nothing => {}
            }
            if !self.shared.is_attended() {
                break Err(nobody_there(question));
            }
            std::thread::sleep(LOOK);
        };
        *locked(&self.shared.asked) = Asked::Nothing;
        self.shared.show_keys(before);
        answer
    }

    fn paused(&self) -> bool {
        if !self.shared.is_attended() {
            return false;
        }
        "paused".clone_into(&mut locked(&self.shared.table).status);
        let keys = "PAUSED: c go on  a abort, the session can be resumed  h halt  v preview";
        self.say(keys);
        let before = self.shared.show_keys(keys.to_owned());
        let go_on = loop {
            if self.shared.requests.take_go_on() || self.request() == Request::Go {
                break true;
            }
            if self.request() >= Request::Abort || !self.shared.is_attended() {
                break false;
            }
            std::thread::sleep(LOOK);
        };
        self.shared.show_keys(before);
        if go_on {
            self.say("going on");
        }
        go_on
    }

    fn seen(&self, what: &Seen<'_>) {
        if let Seen::Taken(taken) = what {
            let frame = self.shared.session.join("frames").join(&taken.record.file);
            *locked(&self.shared.last_frame) = Some(frame);
        }
        let worth_a_line = locked(&self.shared.table).see(what, self.shared.begun.elapsed());
        if let Some(text) = worth_a_line
            && (self.shared.plain.is_some() || matches!(what, Seen::Note(_)))
        {
            self.say(text);
        }
        self.shared.touch();
    }
}

impl Shared {
    fn touch(&self) {
        self.changed.store(true, Ordering::SeqCst);
    }

    fn is_attended(&self) -> bool {
        self.attended.load(Ordering::SeqCst)
    }

    /// Replaces the last line; returns what it was.
    fn show_keys(&self, keys: String) -> String {
        let before = std::mem::replace(&mut locked(&self.table).keys, keys);
        self.touch();
        before
    }

    fn say(&self, line: String) {
        if let Some(plain) = &self.plain {
            // Nobody reads when it cannot be written.
            let _ = writeln!(locked(plain), "{line}");
            return;
        }
        locked(&self.said).push(line);
        self.touch();
    }

    /// A signal came.
    fn interrupt(self: &Arc<Self>) {
        let asked = if self.ended.load(Ordering::SeqCst) {
            None
        } else {
            self.requests.interrupt()
        };
        let Some(asked) = asked else {
            self.restore();
            std::process::exit(130);
        };
        self.say(
            match asked {
                Request::Go | Request::Pause | Request::PauseNow if self.is_attended() => {
                    "pausing after the current shot; press Ctrl-C again to stop the rig now"
                }
                Request::Go | Request::Pause | Request::PauseNow => {
                    "stopping after the current shot; press Ctrl-C again to stop the rig now"
                }
                Request::Abort => {
                    "stopping the rig now; a third Ctrl-C halts it the fastest way, whatever becomes of the position"
                }
                Request::Halt => {
                    "halting; a fourth Ctrl-C ends the program and leaves the rig as it is"
                }
            }
            .to_owned(),
        );
    }

    /// Reads keys and draws until the screen ends.
    fn serve(self: &Arc<Self>) {
        let mut drawn = Instant::now();
        let mut told = Instant::now();
        while !self.ended.load(Ordering::SeqCst) {
            self.read_keys();
            if self.changed.swap(false, Ordering::SeqCst) || drawn.elapsed() >= REDRAW {
                drawn = Instant::now();
                self.draw();
            }
            if told.elapsed() >= PLAIN_LINE && self.plain.is_some() {
                told = Instant::now();
                let line = locked(&self.table).progress(self.begun.elapsed());
                self.say(format!("  {line}"));
            }
        }
    }

    fn read_keys(self: &Arc<Self>) {
        let keys = match locked(&self.keyboard).as_ref() {
            None => {
                std::thread::sleep(LOOK);
                return;
            }
            Some(keyboard) => keyboard.keys(LOOK.as_millis() as u32),
        };
        let Some(keys) = keys else {
            // The terminal went away: whoever asks from now on hears that nobody is there.
            self.attended.store(false, Ordering::SeqCst);
            *locked(&self.keyboard) = None;
            return;
        };
        for key in plain_keys(&keys) {
            self.press(key);
        }
    }

    fn press(self: &Arc<Self>, key: u8) {
        if self.answer(key) {
            return;
        }
        match key {
            0x03 => self.interrupt(),
            b'p' => self.ask_for(Request::Pause, "pausing after the current shot; c goes on"),
            b' ' => self.ask_for(Request::PauseNow, "pausing now; c goes on"),
            b'a' => self.ask_for(Request::Abort, "aborting: the rig stops, the lamp goes off"),
            b'h' => self.ask_for(Request::Halt, "halting the fastest way there is"),
            b'c' if !self.requests.go_on() => self.say("nothing is paused".to_owned()),
            b'v' => self.preview(),
            b'?' => HELP.iter().for_each(|line| self.say((*line).to_owned())),
            _ => {}
        }
    }

    fn ask_for(&self, request: Request, told: &str) {
        if self.requests.raise(request) {
            self.say(told.to_owned());
        }
    }

    /// Takes the key as the answer to a question, if one is asked and it is one.
    fn answer(&self, key: u8) -> bool {
        let mut asked = locked(&self.asked);
        if *asked != Asked::Waiting {
            return false;
        }
        *asked = match key {
            b'\r' | b'\n' | b'y' | b'Y' => Asked::Yes,
            b'n' | b'N' => Asked::No,
            _ => return false,
        };
        true
    }

    /// Writes the preview on a thread of its own: a large frame takes seconds, and keys must be heard.
    fn preview(self: &Arc<Self>) {
        let Some(frame) = locked(&self.last_frame).clone() else {
            self.say("there is no frame yet".to_owned());
            return;
        };
        if self.previewing.swap(true, Ordering::SeqCst) {
            return;
        }
        let shared = self.clone();
        std::thread::spawn(move || {
            let out = shared.session.join("preview.png");
            shared.say(match preview::write(&frame, &out) {
                Ok(()) => format!("the last frame is in {}", out.display()),
                Err(error) => format!("no preview: {}", error.report()),
            });
            shared.previewing.store(false, Ordering::SeqCst);
        });
    }

    fn draw(&self) {
        let mut canvas = locked(&self.canvas);
        if let Some(canvas) = canvas.as_mut() {
            let said = std::mem::take(&mut *locked(&self.said));
            let (width, height) = canvas.size();
            let lines = locked(&self.table).lines(width, height, self.begun.elapsed());
            canvas.draw(&said, &lines);
        }
    }

    /// Leaves the terminal as it was found.
    fn restore(&self) {
        // Taken away, so that the other thread draws nothing after it.
        if let Some(mut canvas) = locked(&self.canvas).take() {
            canvas.restore();
        }
        if let Some(keyboard) = locked(&self.keyboard).as_ref() {
            keyboard.restore();
        }
    }
}

/// Keys without the sequences of cursor and function keys, whose bytes would mean other keys.
fn plain_keys(bytes: &[u8]) -> Vec<u8> {
    let mut keys = Vec::new();
    let mut rest = bytes.iter();
    while let Some(&key) = rest.next() {
        if key != 0x1b {
            keys.push(key);
            continue;
        }
        match rest.next() {
            // ECMA-48: parameters, then one final byte.
            Some(b'[') => {
                rest.find(|b| (0x40..=0x7e).contains(*b));
            }
            Some(b'O') => {
                rest.next();
            }
            _ => {}
        }
    }
    keys
}

#[cfg(test)]
mod tests;
