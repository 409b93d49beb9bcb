//! Files that are whole or not there.

use crate::base::{Context, Error, Result};
use std::io::Write;
use std::path::Path;

/// Reads a text file.
///
/// # Errors
/// With the path, when it cannot be read or is not UTF-8.
pub fn read_text(path: &Path) -> Result<String> {
    std::fs::read_to_string(path).context(|| format!("{} cannot be read", path.display()))
}

/// Writes a file so that a reader (or a crash) sees either the old content or the whole new one: a temporary file in
/// the same folder, fsync, rename, fsync of the folder.
///
/// # Errors
/// With the path; the old file is then untouched.
pub fn write_atomic(path: &Path, content: &[u8]) -> Result<()> {
    let what = || format!("{} cannot be written", path.display());
    let folder = path
        .parent()
        .filter(|p| !p.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    let name = path
        .file_name()
        .ok_or_else(|| Error::new(what()))?
        .to_string_lossy()
        .into_owned();
    let temporary = folder.join(format!(".{name}.{}.part", std::process::id()));
    let written = (|| {
        let mut file = std::fs::File::create(&temporary)?;
        file.write_all(content)?;
        file.sync_all()?;
        std::fs::rename(&temporary, path)?;
        std::fs::File::open(folder)?.sync_all()
    })();
    if written.is_err() {
        // The error below is the one that matters; a leftover temporary file is harmless.
        let _ = std::fs::remove_file(&temporary);
    }
    written.context(what).map_err(|e| {
        e.with_hint("is the disk full, the folder not writable, or a folder in the file's place?")
    })
}

/// SHA-256, hexadecimal.
pub fn sha256(bytes: &[u8]) -> String {
    use sha2::Digest;
    sha2::Sha256::digest(bytes)
        .iter()
        .map(|b| format!("{b:02x}"))
        .collect()
}

/// True for the name of a file that [`write_atomic`] did not finish.
pub fn is_temporary(name: &str) -> bool {
    name.starts_with('.') && name.ends_with(".part")
}

/// Writes a file that must not exist yet (the camera's frames): whole, fsynced, never over an old one.
///
/// # Errors
/// When the file exists already, or cannot be written (disk full, no permission).
pub fn write_new(path: &Path, content: &[u8]) -> Result<()> {
    if path.exists() {
        return Err(Error::new(format!("{} exists already", path.display()))
            .with_hint("frames are never overwritten; choose a new session folder"));
    }
    write_atomic(path, content)
}
