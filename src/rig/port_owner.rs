//! Who holds a device: the processes that have it open, by the system's own list (Linux `/proc`).

use std::fs;
use std::path::Path;

/// The other processes that have `device` open, as `pid 123 (command line)`; empty when none can be seen. Processes of
/// other users cannot be looked into without their rights.
pub(super) fn owners(device: &str) -> Vec<String> {
    let Ok(device) = fs::canonicalize(device) else {
        return Vec::new();
    };
    let Ok(processes) = fs::read_dir("/proc") else {
        return Vec::new();
    };
    let own = std::process::id();
    let mut found: Vec<(u32, String)> = processes
        .flatten()
        .filter_map(|p| Some((p.file_name().to_str()?.parse().ok()?, p.path())))
        .filter(|(pid, path)| *pid != own && holds(path, &device))
        .map(|(pid, path)| (pid, command_line(&path)))
        .collect();
    found.sort();
    found
        .into_iter()
        .map(|(pid, command)| format!("pid {pid} ({command})"))
        .collect()
}

fn holds(process: &Path, device: &Path) -> bool {
    fs::read_dir(process.join("fd")).is_ok_and(|fds| {
        fds.flatten()
            .any(|fd| fs::read_link(fd.path()).is_ok_and(|target| target == device))
    })
}

/// The command line with its arguments, shortened; the bare name when it has none.
fn command_line(process: &Path) -> String {
    let bytes = fs::read(process.join("cmdline")).unwrap_or_default();
    let line: Vec<_> = bytes
        .split(|b| *b == 0)
        .filter(|word| !word.is_empty())
        .map(String::from_utf8_lossy)
        .collect();
    let line = line.join(" ");
    if line.is_empty() {
        let name = fs::read_to_string(process.join("comm")).unwrap_or_default();
        return name.trim().to_owned();
    }
    line.chars()
        .map(|c| if c.is_control() { '?' } else { c })
        .take(120)
        .collect()
}
