//! One run of another program, with a time limit and a private folder for what it writes.

use crate::base::{Context, Result, Watch};
use crate::rig::transport::Clock;
use rustix::process::{Pid, Signal, kill_process_group};
use std::fs::{DirBuilder, File};
use std::io::Read;
use std::os::unix::fs::DirBuilderExt;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};

/// How often a wait looks at what it waits for and at the [`Watch`], seconds.
pub(super) const LOOK: f64 = 0.05;
/// How long a program may take to end after it was asked to, seconds.
const GRACE: f64 = 2.0;
/// The most that is read of what a program says, bytes.
const MOST_TEXT: u64 = 1 << 20;

/// A folder of this process alone, gone when it is dropped.
#[derive(Debug)]
pub(super) struct Scratch {
    path: PathBuf,
}

impl Scratch {
    /// Makes it in the system's folder for temporary files, readable by its owner only.
    ///
    /// # Errors
    /// The system refuses.
    pub(super) fn new() -> Result<Self> {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let base = std::env::temp_dir();
        loop {
            let n = COUNT.fetch_add(1, Ordering::Relaxed);
            let path = base.join(format!("goniofit-{}-{n}", std::process::id()));
            match DirBuilder::new().mode(0o700).create(&path) {
                Ok(()) => return Ok(Self { path }),
                Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists && n < 10_000 => {}
                Err(e) => {
                    return Err(e).context(|| format!("{} cannot be created", path.display()));
                }
            }
        }
    }

    /// Where it is.
    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// An empty folder in it.
    ///
    /// # Errors
    /// The system refuses.
    pub(super) fn emptied(&self, name: &str) -> Result<PathBuf> {
        let path = self.path.join(name);
        if path.exists() {
            std::fs::remove_dir_all(&path)
                .context(|| format!("{} cannot be emptied", path.display()))?;
        }
        std::fs::create_dir(&path).context(|| format!("{} cannot be created", path.display()))?;
        Ok(path)
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.path);
    }
}

/// What a program said, and how it ended.
#[derive(Debug)]
pub(super) struct Answer {
    /// Its standard output.
    pub(super) stdout: String,
    /// Its standard error.
    pub(super) stderr: String,
    /// How it ended.
    pub(super) ending: Ending,
}

/// How a program ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Ending {
    /// By itself, successfully.
    Success,
    /// By itself, with another status.
    Failure,
    /// It took longer than allowed and was ended.
    TimedOut,
    /// [`Watch::urgent`]: it was ended.
    Stopped,
}

/// Runs `command` to its end, `limit` seconds at most. It gets no input and a process group of its own, so that Ctrl-C
/// reaches this program alone; whoever it left behind in that group ends with it.
///
/// # Errors
/// It cannot be started, or `scratch` cannot be written.
pub(super) fn run(
    command: &mut Command,
    limit: f64,
    scratch: &Scratch,
    clock: &dyn Clock,
    watch: &dyn Watch,
) -> std::io::Result<Answer> {
    let texts = ["stdout", "stderr"].map(|name| scratch.path().join(name));
    let mut child = command
        .stdin(Stdio::null())
        .stdout(File::create(&texts[0])?)
        .stderr(File::create(&texts[1])?)
        .process_group(0)
        .spawn()?;
    let ending = wait(&mut child, limit, clock, watch);
    signal(&child, Signal::KILL);
    let ending = ending?;
    let [stdout, stderr] = texts.map(|path| read_text(&path));
    Ok(Answer {
        stdout: stdout?,
        stderr: stderr?,
        ending,
    })
}

/// Waits for the end; asks for it when the time is over or the watch is urgent, and enforces it when nothing comes of that.
fn wait(
    child: &mut Child,
    limit: f64,
    clock: &dyn Clock,
    watch: &dyn Watch,
) -> std::io::Result<Ending> {
    if let Some(status) = wait_until(child, clock.now() + limit, clock, || watch.urgent())? {
        return Ok(if status.success() {
            Ending::Success
        } else {
            Ending::Failure
        });
    }
    signal(child, Signal::INT);
    if wait_until(child, clock.now() + GRACE, clock, || false)?.is_none() {
        signal(child, Signal::KILL);
        child.wait()?;
    }
    Ok(if watch.urgent() {
        Ending::Stopped
    } else {
        Ending::TimedOut
    })
}

fn wait_until(
    child: &mut Child,
    until: f64,
    clock: &dyn Clock,
    enough: impl Fn() -> bool,
) -> std::io::Result<Option<ExitStatus>> {
    loop {
        if let Some(status) = child.try_wait()? {
            return Ok(Some(status));
        }
        if clock.now() >= until || enough() {
            return Ok(None);
        }
        clock.sleep(LOOK);
    }
}

/// Signals the child's process group; that it may be gone already does not matter.
fn signal(child: &Child, signal: Signal) {
    if let Some(group) = i32::try_from(child.id()).ok().and_then(Pid::from_raw) {
        let _ = kill_process_group(group, signal);
    }
}

fn read_text(path: &Path) -> std::io::Result<String> {
    let mut bytes = Vec::new();
    File::open(path)?.take(MOST_TEXT).read_to_end(&mut bytes)?;
    Ok(String::from_utf8_lossy(&bytes).into_owned())
}
