//! Camera programs and devices of this machine.

use super::{Finding, Findings, Level};
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

/// How long a program may take to say something.
const PATIENCE: Duration = Duration::from_secs(8);

pub(super) fn look() -> Vec<Finding> {
    let mut findings = Findings::new("camera");
    gphoto2(&mut findings);
    if let Some(process) = volume_monitor() {
        findings.add(
            Level::Warn,
            format!("the desktop's {process} is running and takes cameras for itself"),
            "systemctl --user stop gvfs-gphoto2-volume-monitor, and unmount the camera",
        );
    }
    let mut video: Vec<String> = entries("/dev")
        .filter(|name| {
            name.strip_prefix("video")
                .is_some_and(|n| n.parse::<u32>().is_ok())
        })
        .map(|name| format!("/dev/{name}"))
        .collect();
    video.sort();
    if !video.is_empty() {
        findings.ok(format!(
            "{}: for preview only, never radiometric",
            video.join(", ")
        ));
    }
    match ["arv-tool-0.8", "arv-tool-0.10", "arv-tool"]
        .iter()
        .find_map(|p| in_path(p))
    {
        Some(path) => findings.ok(format!("{} for GenICam cameras", path.display())),
        None => findings.add(
            Level::Warn,
            "no arv-tool: GenICam cameras cannot be used",
            "only if you have one: sudo apt install aravis-tools",
        ),
    }
    findings.all
}

fn gphoto2(findings: &mut Findings) {
    if in_path("gphoto2").is_none() {
        findings.add(
            Level::Warn,
            "no gphoto2: tethered cameras cannot be used",
            "only if you have one: sudo apt install gphoto2",
        );
        return;
    }
    match answer("gphoto2", &["--version"]) {
        Some(text) => findings.ok(text.lines().next().unwrap_or("gphoto2").to_owned()),
        None => {
            findings.add(
                Level::Warn,
                "gphoto2 does not say its version",
                "run `gphoto2 --version`",
            );
            return;
        }
    }
    let detected = answer("gphoto2", &["--auto-detect"]);
    let cameras: Option<Vec<String>> = detected.map(|text| {
        let rows = text.lines().skip_while(|l| !l.starts_with("---")).skip(1);
        rows.map(|l| l.split_whitespace().collect::<Vec<_>>().join(" "))
            .filter(|l| !l.is_empty())
            .collect()
    });
    match cameras {
        Some(cameras) if !cameras.is_empty() => {
            findings.ok(format!("gphoto2 detects {}", cameras.join(", ")));
        }
        Some(_) => findings.add(
            Level::Warn,
            "gphoto2 detects no camera",
            "switch it on, check the cable; set its USB mode to PTP",
        ),
        None => findings.add(
            Level::Warn,
            "gphoto2 --auto-detect does not answer",
            "unplug the camera, plug it in again",
        ),
    }
}

/// Names in a folder; none when it cannot be read.
fn entries(folder: &str) -> impl Iterator<Item = String> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.filter_map(|e| e.file_name().into_string().ok())
}

fn in_path(program: &str) -> Option<PathBuf> {
    let path = std::env::var_os("PATH")?;
    std::env::split_paths(&path)
        .map(|folder| folder.join(program))
        .find(|file| rustix::fs::access(file, rustix::fs::Access::EXEC_OK).is_ok())
}

/// The name of a running process that mounts cameras.
fn volume_monitor() -> Option<String> {
    entries("/proc")
        .filter(|name| name.bytes().all(|b| b.is_ascii_digit()))
        .filter_map(|id| std::fs::read_to_string(format!("/proc/{id}/comm")).ok())
        .map(|name| name.trim().to_owned())
        // The system cuts names off after 15 characters.
        .find(|name| name.starts_with("gvfs-gphoto2-vo") || name.starts_with("gvfsd-gphoto2"))
}

/// What a program prints, if it ends well and in time.
fn answer(program: &str, arguments: &[&str]) -> Option<String> {
    let mut child = Command::new(program)
        .args(arguments)
        .env("LC_ALL", "C")
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .ok()?;
    let mut stdout = child.stdout.take()?;
    let (sender, receiver) = channel();
    std::thread::spawn(move || {
        let mut text = String::new();
        if std::io::Read::read_to_string(&mut stdout, &mut text).is_ok() {
            // Nobody waits any more when it took too long.
            let _ = sender.send(text);
        }
    });
    let begun = Instant::now();
    loop {
        match child.try_wait() {
            Ok(Some(status)) if status.success() => {
                return receiver.recv_timeout(Duration::from_secs(1)).ok();
            }
            Ok(None) if begun.elapsed() < PATIENCE => {
                std::thread::sleep(Duration::from_millis(20));
            }
            _ => {
                let _ = child.kill();
                let _ = child.wait();
                return None;
            }
        }
    }
}
