//! A task is done by one process at a time: a file `lock` in its folder, with process and host for people to read.
//!
//! What counts is the kernel's lock on the open file: it ends with its process, however that ends. A file with a holder's
//! name that nobody has locked is what a killed process or a dead machine leaves. Where a network file system keeps such
//! locks to one machine, a lock held on another looks left behind; it is still never taken without being asked to.

use crate::base::{Context, Error, Result};
use crate::rig::utc_now;
use rustix::fs::{FlockOperation, flock};
use serde::{Deserialize, Serialize};
use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Read, Seek, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// How often to try: whoever only looks lets go at once.
const TRIES: usize = 40;
const PAUSE: Duration = Duration::from_millis(10);

/// Who does, or did, a task.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Holder {
    process: u32,
    host: String,
    since_utc: String,
}

impl Holder {
    /// This process.
    pub(super) fn me() -> Self {
        Self {
            process: std::process::id(),
            host: rustix::system::uname().nodename().to_string_lossy().into(),
            since_utc: utc_now(),
        }
    }

    /// In words.
    pub(super) fn words(&self) -> String {
        let Self {
            process,
            host,
            since_utc,
        } = self;
        format!("process {process} on {host} since {since_utc}")
    }
}

/// The right to do a task, given back when it goes out of scope.
pub(super) struct Lock {
    path: PathBuf,
    /// Locked while it is open.
    _file: File,
}

impl Drop for Lock {
    fn drop(&mut self) {
        // Before the file is closed: nobody else can have it yet.
        let _ = std::fs::remove_file(&self.path);
    }
}

/// What asking for a lock, or looking at one, gave.
pub(super) enum Found {
    /// It was free; now it is taken, when it was asked for.
    Free(Option<Lock>),
    /// Somebody works.
    Held(Option<Holder>),
    /// Somebody ended without giving it back.
    Left(Holder),
}

fn path_in(folder: &Path) -> PathBuf {
    folder.join("lock")
}

/// Looks who does the task, if anybody.
pub(super) fn look(folder: &Path) -> Result<Found> {
    let path = path_in(folder);
    match File::open(&path) {
        Ok(mut file) => {
            let free = try_lock(&file, FlockOperation::NonBlockingLockShared, &path)?;
            if free && !still_at(&file, &path) {
                return Ok(Found::Free(None));
            }
            Ok(judge(free, holder(&mut file), false))
        }
        Err(e) if e.kind() == ErrorKind::NotFound => Ok(Found::Free(None)),
        Err(e) => Err(e).context(|| format!("{} cannot be read", path.display())),
    }
}

/// Takes the task's lock; one that was left behind only with `take_over`.
pub(super) fn take(folder: &Path, take_over: bool) -> Result<Found> {
    let path = path_in(folder);
    let what = || format!("{} cannot be locked", path.display());
    let mut found = Found::Held(None);
    for _ in 0..TRIES {
        let mut options = OpenOptions::new();
        options.read(true).write(true).create(true).truncate(false);
        let mut file = options.open(&path).context(what)?;
        let free = try_lock(&file, FlockOperation::NonBlockingLockExclusive, &path)?;
        if free && still_at(&file, &path) {
            found = judge(true, holder(&mut file), take_over);
            if matches!(found, Found::Free(_)) {
                let text = serde_json::to_string(&Holder::me()).context(what)?;
                file.rewind()
                    .and_then(|()| file.set_len(0))
                    .and_then(|()| file.write_all(text.as_bytes()))
                    .context(what)?;
                return Ok(Found::Free(Some(Lock { path, _file: file })));
            }
            return Ok(found);
        }
        found = Found::Held(holder(&mut file));
        std::thread::sleep(PAUSE);
    }
    Ok(found)
}

/// Whether an open file is still the one with this name: it may have been given back, and another begun, between opening
/// and locking.
fn still_at(file: &File, path: &Path) -> bool {
    let id = |m: std::fs::Metadata| (m.dev(), m.ino());
    let (own, there) = (file.metadata().map(id), std::fs::metadata(path).map(id));
    matches!((own, there), (Ok(own), Ok(there)) if own == there)
}

fn judge(free: bool, holder: Option<Holder>, take_over: bool) -> Found {
    match (free, holder) {
        (false, holder) => Found::Held(holder),
        (true, Some(holder)) if !take_over => Found::Left(holder),
        (true, _) => Found::Free(None),
    }
}

fn try_lock(file: &File, operation: FlockOperation, path: &Path) -> Result<bool> {
    match flock(file, operation) {
        Ok(()) => Ok(true),
        Err(rustix::io::Errno::WOULDBLOCK) => Ok(false),
        Err(e) => Err(Error::new(format!("{} cannot be locked", path.display()))
            .with_hint("--out must lie on a file system with locks (flock)")
            .with_source(e)),
    }
}

fn holder(file: &mut File) -> Option<Holder> {
    let mut text = String::new();
    file.rewind().ok()?;
    file.read_to_string(&mut text).ok()?;
    serde_json::from_str(&text).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mine(found: Found) -> Lock {
        match found {
            Found::Free(Some(lock)) => lock,
            Found::Free(None) => panic!("free, but not taken"),
            Found::Held(holder) => panic!("held by {holder:?}"),
            Found::Left(holder) => panic!("left by {holder:?}"),
        }
    }

    #[test]
    fn one_holds_others_see_who_and_a_dead_one_must_be_taken_over() {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path();
        assert!(matches!(look(folder).unwrap(), Found::Free(None)));
        let lock = mine(take(folder, false).unwrap());
        let me = std::process::id();
        for found in [look(folder), take(folder, false), take(folder, true)] {
            assert!(matches!(found.unwrap(), Found::Held(Some(h)) if h.process == me));
        }
        drop(lock);
        assert!(!path_in(folder).exists());

        let gone = Holder {
            host: "elsewhere".into(),
            ..Holder::me()
        };
        std::fs::write(path_in(folder), serde_json::to_string(&gone).unwrap()).unwrap();
        for found in [look(folder), take(folder, false)] {
            assert!(matches!(found.unwrap(), Found::Left(h) if h == gone));
        }
        drop(mine(take(folder, true).unwrap()));
        drop(mine(take(folder, false).unwrap()));
    }

    #[test]
    fn of_many_at_once_exactly_one_works() {
        // Two hold it in some of 1200 rounds if a lock on a removed file counts.
        let folder = tempfile::tempdir().unwrap();
        let inside = std::sync::atomic::AtomicUsize::new(0);
        let taken = std::sync::atomic::AtomicUsize::new(0);
        std::thread::scope(|scope| {
            for _ in 0..8 {
                scope.spawn(|| {
                    for _ in 0..150 {
                        let Found::Free(Some(lock)) = take(folder.path(), true).unwrap() else {
                            continue;
                        };
                        use std::sync::atomic::Ordering::SeqCst;
                        assert_eq!(inside.fetch_add(1, SeqCst), 0);
                        taken.fetch_add(1, SeqCst);
                        std::thread::yield_now();
                        inside.fetch_sub(1, SeqCst);
                        drop(lock);
                    }
                });
            }
        });
        assert!(taken.into_inner() > 150);
    }
}
