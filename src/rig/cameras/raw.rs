//! Which files of a folder are RAW files.

use crate::base::{Context, Result};
use std::path::{Path, PathBuf};

/// Extensions of RAW files, lower case.
const RAW: [&str; 26] = [
    "3fr", "arw", "cr2", "cr3", "crw", "dcr", "dng", "erf", "fff", "iiq", "kdc", "mef", "mos",
    "mrw", "nef", "nrw", "orf", "ori", "pef", "raf", "raw", "rw2", "rwl", "sr2", "srf", "srw",
];

/// The files of a folder.
#[derive(Debug, Default)]
pub(super) struct RawFiles {
    /// RAW files, by name.
    pub(super) raw: Vec<PathBuf>,
    /// Others, by name.
    pub(super) others: Vec<PathBuf>,
}

/// Sorts the files of a folder; neither hidden ones nor folders.
///
/// # Errors
/// The folder cannot be read.
pub(super) fn raw_files(folder: &Path) -> Result<RawFiles> {
    let unreadable = || format!("{} cannot be read", folder.display());
    let mut paths = Vec::new();
    for entry in std::fs::read_dir(folder).context(unreadable)? {
        let path = entry.context(unreadable)?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        if !name.starts_with('.') && path.is_file() {
            paths.push(path);
        }
    }
    paths.sort();
    let (raw, others) = paths.into_iter().partition(|p| is_raw(p));
    Ok(RawFiles { raw, others })
}

fn is_raw(path: &Path) -> bool {
    let extension = path.extension().unwrap_or_default().to_string_lossy();
    RAW.contains(&extension.to_lowercase().as_str())
}
