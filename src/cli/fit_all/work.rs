//! Doing what is left of the tasks, some at a time.

use super::inputs::{Hashes, Inputs};
use super::list::Task;
use super::lock::{self, Found, Holder};
use super::state::{self, Ending, Record, Standing, State};
use super::table;
use crate::base::{Context, Error, Result, Watch};
use crate::cli::fit::resume::{header, journal_in, working_folder};
use crate::cli::fit::{Ready, files_in, write};
use crate::cli::terminal::Terminal;
use crate::fit::{FitResult, Journal, JournalHeader};
use crate::session::files;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::Write;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

/// What is to be done, and how.
pub(super) struct Order<'a> {
    pub(super) out: &'a Path,
    /// Fits at once.
    pub(super) jobs: usize,
    /// Whether to try failures again.
    pub(super) retry: bool,
    /// Whether one task was asked for by name: then somebody else at it is an error.
    pub(super) alone: bool,
}

/// Does what is left. Threads are shared out evenly among the fits at once.
///
/// # Errors
/// When no threads can be had, a task that was asked for by name belongs to another process, or a folder cannot be written;
/// the other tasks are done all the same. That a fit fails is no error here: its folder says so.
pub(super) fn run(tasks: &[&Task], order: &Order<'_>, terminal: &Terminal) -> Result<()> {
    let threads = rayon::current_num_threads();
    let jobs = order.jobs.min(tasks.len());
    let progress = Progress::new(terminal, tasks.len());
    let next = AtomicUsize::new(0);
    let worker = |share: usize| -> Result<()> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(share).build();
        let pool = pool.context(|| "threads cannot be started")?;
        let mut outcome = Ok(());
        while let Some(&task) = tasks.get(next.fetch_add(1, Ordering::SeqCst)) {
            if terminal.cancelled() {
                break;
            }
            let work = Work {
                task,
                order,
                progress: &progress,
                folder: &order.out.join(&task.id),
            };
            outcome = outcome.and(work.visit(&pool));
        }
        outcome
    };
    std::thread::scope(|scope| {
        let share = |job: usize| (threads / jobs + usize::from(job < threads % jobs)).max(1);
        let start = |job: usize| scope.spawn(move || worker(share(job)));
        let workers: Vec<_> = (0..jobs).map(start).collect();
        let ends = workers.into_iter().map(|w| w.join());
        let ends = ends.map(|end| end.unwrap_or_else(|panic| Err(panicked(&*panic))));
        ends.fold(Ok(()), Result::and)
    })
}

/// One task, looked at by one worker.
struct Work<'a> {
    task: &'a Task,
    order: &'a Order<'a>,
    progress: &'a Progress<'a>,
    folder: &'a Path,
}

impl Work<'_> {
    /// Does the task if it is to be done, and says what became of it.
    fn visit(&self, pool: &rayon::ThreadPool) -> Result<()> {
        let standing = state::look(self.task, self.folder, &mut Hashes::default())?;
        let retry = self.order.retry && standing.state == State::Failed;
        if standing.state != State::Waiting && !retry {
            return self.leave(&standing);
        }
        std::fs::create_dir_all(self.folder)
            .context(|| format!("{} cannot be made", self.folder.display()))?;
        let lock = match lock::take(self.folder, self.order.retry)? {
            Found::Free(lock) => lock,
            // Somebody was faster.
            Found::Held(_) | Found::Left(_) => {
                let standing = state::look(self.task, self.folder, &mut Hashes::default())?;
                return self.leave(&standing);
            }
        };
        // It may have been finished between looking and locking.
        let inputs = Inputs::of(&self.task.asked, &mut Hashes::default());
        let again = state::recorded(self.folder, &inputs);
        if again.state != State::Waiting && !(self.order.retry && again.state == State::Failed) {
            drop(lock);
            return self.leave(&again);
        }
        if let Some(note) = standing.note {
            self.progress.say(&format!("{}: {note}", self.task.id));
        }
        let result = self.attempt(inputs, pool);
        drop(lock);
        let line = match result {
            Ok(standing) => table::line(self.task, &standing),
            Err(error) => format!("{}: failed: {}", self.task.id, error.report()),
        };
        self.progress.finished(self.task.number, Some(&line));
        Ok(())
    }

    /// Passes over a task that needs nothing, or belongs to somebody else.
    fn leave(&self, standing: &Standing) -> Result<()> {
        let id = &self.task.id;
        let holder = standing.note.as_deref().unwrap_or("another process");
        let line = match standing.state {
            State::Running => Some(format!("{id} is being done by {holder}")),
            State::Failed => Some(table::line(self.task, standing)),
            _ => None,
        };
        match line {
            Some(line) if standing.state == State::Running && self.order.alone => {
                Err(Error::new(line))
            }
            line => {
                self.progress.finished(self.task.number, line.as_deref());
                Ok(())
            }
        }
    }

    /// Does the task and records how it ended.
    fn attempt(&self, inputs: Inputs, pool: &rayon::ThreadPool) -> Result<Standing> {
        let started = Instant::now();
        let log = Log::open(self.folder, started)?;
        let command = self.task.asked.command(self.folder);
        log.line(&format!("{}, {}", command, Holder::me().words()));
        let mut record = Record::new(&self.task.id, inputs);
        let fitted = self.fit(&record.inputs, command, &log, pool);
        record.elapsed_s = started.elapsed().as_secs_f64();
        let outcome = match fitted {
            Ok(result) => {
                let stopped = self.progress.cancelled() && !result.converged;
                record.ending = if stopped {
                    Ending::Interrupted
                } else {
                    Ending::Finished
                };
                log.line(&result.reason);
                write(&result, self.folder, true).and_then(|()| {
                    record.fit = Some(files::sha256(result.to_json()?.as_bytes()));
                    record.write(self.folder)?;
                    Ok(state::finished(result))
                })
            }
            Err(error) => Err(error),
        };
        let Err(error) = outcome else { return outcome };
        log.line(&error.report());
        // Stopped before there was anything to keep: as if never begun.
        if !self.progress.cancelled() {
            record.ending = Ending::Failed;
            record.error = Some(error.report());
            record.fit = None;
            record.write(self.folder)?;
        }
        Err(error)
    }

    /// The fit itself, on the worker's threads.
    fn fit(
        &self,
        inputs: &Inputs,
        command: String,
        log: &Log,
        pool: &rayon::ThreadPool,
    ) -> Result<FitResult> {
        self.put_aside()?;
        let asked = &self.task.asked;
        let watch = Watched {
            work: self,
            log,
            shown: Mutex::new((String::new(), 0)),
        };
        let fit = || {
            let ready = asked.read()?;
            ready.notes.iter().for_each(|note| log.line(note));
            if Inputs::of(&self.task.asked, &mut Hashes::default()) != *inputs {
                return Err(Error::new("the inputs changed while they were read")
                    .with_hint("the next run does it again"));
            }
            let journal = self.journal(&ready, log)?;
            let before = cpu_seconds();
            let mut result = asked.fit(&ready, command, &journal, &watch)?;
            // The renderer counts the whole process, other fits included.
            result.time.cpu_s = cpu_seconds() - before + journal.recalled_cpu_s();
            Ok(result)
        };
        catch_unwind(AssertUnwindSafe(|| pool.install(fit)))
            .unwrap_or_else(|panic| Err(panicked(&*panic)))
    }

    /// The journal of the task: that of an earlier try if it is of the same fit, but perhaps for its limits.
    fn journal(&self, ready: &Ready, log: &Log) -> Result<Journal> {
        let path = journal_in(self.folder);
        let now = JournalHeader {
            arguments: self.task.asked.words(self.folder),
            folder: working_folder(),
            ..header(&self.task.asked, ready)
        };
        if path.exists() {
            let other = match JournalHeader::read(&path) {
                Ok(earlier) => earlier.difference(&now),
                Err(error) => Some(error.report()),
            };
            let Some(other) = other else {
                let journal = Journal::resume(&path, &now)?;
                let (pairs, _) = journal.found();
                log.line(&format!("going on with {pairs} render pairs"));
                return Ok(journal);
            };
            log.line(&format!("from the start, because of other {other}"));
            put_aside(&path)?;
        }
        Journal::create(&path, &now, false)
    }

    /// Keeps what an earlier try left, under another name: a fit and its record never contradict each other.
    fn put_aside(&self) -> Result<()> {
        files_in(self.folder).iter().try_for_each(|p| put_aside(p))
    }
}

/// Renames a file, if it is there, to `NAME.earlier.EXTENSION`.
fn put_aside(path: &Path) -> Result<()> {
    let extension = path.extension().unwrap_or_default().to_string_lossy();
    let aside = path.with_extension(format!("earlier.{extension}"));
    if path.exists() {
        std::fs::rename(path, &aside)
            .context(|| format!("{} cannot be renamed", path.display()))?;
    }
    Ok(())
}

/// CPU time of the threads of the present pool so far, seconds.
fn cpu_seconds() -> f64 {
    let of_thread = |_: rayon::BroadcastContext<'_>| {
        let t = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
        t.tv_sec as f64 + t.tv_nsec as f64 * 1e-9
    };
    rayon::broadcast(of_thread).iter().sum()
}

fn panicked(panic: &(dyn std::any::Any + Send)) -> Error {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    let text = text.or_else(|| panic.downcast_ref::<&str>().copied());
    Error::new(format!("the fit panicked: {}", text.unwrap_or("?")))
        .with_hint("this is a fault of the program; please report it with the inputs")
}

/// `log.txt`: what happened to a task, try after try; lines are added as they come.
struct Log {
    file: Mutex<File>,
    started: Instant,
}

impl Log {
    fn open(folder: &Path, started: Instant) -> Result<Self> {
        let path = folder.join("log.txt");
        let file = File::options().create(true).append(true).open(&path);
        let file = file.context(|| format!("{} cannot be written", path.display()))?;
        Ok(Self {
            file: Mutex::new(file),
            started,
        })
    }

    /// A log that cannot be written is no reason to lose a fit.
    fn line(&self, text: &str) {
        if let Ok(mut file) = self.file.lock() {
            let elapsed = self.started.elapsed().as_secs_f64();
            let _ = file.write_all(format!("{elapsed:9.1} s  {text}\n").as_bytes());
        }
    }
}

/// Shows a fit's progress to its log, and as part of the whole.
struct Watched<'a> {
    work: &'a Work<'a>,
    log: &'a Log,
    /// Stage and tenth that were logged last.
    shown: Mutex<(String, u64)>,
}

impl Watch for Watched<'_> {
    fn progress(&self, stage: &str, done: u64, total: u64) {
        let total = total.max(1);
        let tenth = 10 * done / total;
        if let Ok(mut shown) = self.shown.lock()
            && (shown.0 != stage || tenth > shown.1)
        {
            *shown = (stage.to_owned(), tenth);
            self.log.line(&format!("{stage} {} %", 10 * tenth));
        }
        let number = self.work.task.number;
        self.work.progress.part(number, 1000 * done / total);
    }

    fn cancelled(&self) -> bool {
        self.work.progress.cancelled()
    }
}

/// Progress of all tasks together, in thousandths of a task.
struct Progress<'a> {
    terminal: &'a Terminal,
    total: u64,
    state: Mutex<Parts>,
}

#[derive(Default)]
struct Parts {
    finished: u64,
    running: BTreeMap<usize, u64>,
    /// What was done when the bar last began: its ETA is about what was left then.
    begun: u64,
}

impl Parts {
    fn done(&self) -> u64 {
        1000 * self.finished + self.running.values().sum::<u64>()
    }
}

impl<'a> Progress<'a> {
    fn new(terminal: &'a Terminal, tasks: usize) -> Self {
        Self {
            terminal,
            total: 1000 * tasks as u64,
            state: Mutex::default(),
        }
    }

    fn cancelled(&self) -> bool {
        self.terminal.cancelled()
    }

    /// A running task has come this far.
    fn part(&self, number: usize, thousandths: u64) {
        let Ok(mut parts) = self.state.lock() else {
            return;
        };
        let part = parts.running.entry(number).or_default();
        *part = (*part).max(thousandths.min(1000));
        let stage = format!("{} fits left", self.total / 1000 - parts.finished);
        let (done, total) = (parts.done() - parts.begun, self.total - parts.begun);
        self.terminal.progress(&stage, done, total.max(1));
    }

    /// A line of talk; the bar begins anew below it.
    fn say(&self, line: &str) {
        let Ok(mut parts) = self.state.lock() else {
            return;
        };
        parts.begun = parts.done();
        self.terminal.say(line);
    }

    /// A task needs no more work.
    fn finished(&self, number: usize, line: Option<&str>) {
        let Ok(mut parts) = self.state.lock() else {
            return;
        };
        parts.running.remove(&number);
        parts.finished += 1;
        parts.begun = parts.done();
        if let Some(line) = line {
            self.terminal.say(line);
        }
    }
}
