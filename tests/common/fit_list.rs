//! What the tests of lists of fits share: a folder with tiny inputs, the commands on it, and processes to signal.

#![allow(dead_code)]

use assert_cmd::cargo::cargo_bin;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Longest time to wait for anything; a machine under load is slow.
pub(crate) const PATIENCE: Duration = Duration::from_secs(120);

/// A folder with a coarse net, two measurements of it, and a list.
pub(crate) struct Place(pub(crate) tempfile::TempDir);

/// Columns of a measurement.
pub(crate) const HEAD: &str = "config,light_theta_deg,light_phi_deg,camera_theta_deg,camera_phi_deg,rotation_deg,r,g,b,r_se,g_se,b_se\n";

impl Place {
    pub(crate) fn new(list: &str) -> Self {
        let place = Self(tempfile::tempdir().unwrap());
        let mut csv = String::from("# tile_mm = [1, 1]\nx0,y0,z0,x1,y1,z1,radius_mm,yarn_system\n");
        for i in 0..5 {
            let at = 0.2 * (f64::from(i) + 0.5);
            csv += &format!("0,{at},0.1,1,{at},0.1,0.08,1\n{at},0,-0.1,{at},1,-0.1,0.08,0\n");
        }
        place.write("net.csv", &csv);
        place.write("net.toml", "name = 'net'\nfibers = 'net.csv'\n");
        place.measure("m1.csv", 1.0);
        place.measure("m2.csv", 1.2);
        place.write("work.toml", list);
        place
    }

    /// Two poses, as bright as `level`; errors so small that no fit ends early.
    pub(crate) fn measure(&self, name: &str, level: f64) {
        let [r, g, b] = [0.2, 0.1, 0.06].map(|x| x * level);
        let poses = ["1,30,180,30,0,0", "2,50,90,20,0,0"];
        let row = |pose| format!("{pose},{r},{g},{b},0.00001,0.00001,0.00001\n");
        self.write(name, &(HEAD.to_owned() + &poses.map(row).concat()));
    }

    pub(crate) fn at(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    pub(crate) fn write(&self, name: &str, text: &str) {
        std::fs::write(self.at(name), text).unwrap();
    }

    pub(crate) fn read(&self, name: &str) -> String {
        std::fs::read_to_string(self.at(name)).unwrap()
    }

    /// `fit-all` on the list, into `out`.
    pub(crate) fn command(&self, out: &str, more: &[&str]) -> Command {
        let mut command = Command::new(cargo_bin("goniofit"));
        command.current_dir(self.0.path());
        // Slow enough to be caught at work on any machine.
        command.env("RAYON_NUM_THREADS", "2");
        command.args(["fit-all", "--list", "work.toml", "--out", out]);
        command.args(more);
        command
    }

    /// Exit code, stdout, stderr.
    pub(crate) fn run(&self, out: &str, more: &[&str]) -> (i32, String, String) {
        let output = self.command(out, more).output().unwrap();
        let text = |bytes| String::from_utf8(bytes).unwrap();
        let code = output.status.code().unwrap();
        (code, text(output.stdout), text(output.stderr))
    }

    pub(crate) fn start(&self, out: &str, more: &[&str]) -> Running {
        let mut command = self.command(out, more);
        let quiet = command.stdout(Stdio::null()).stderr(Stdio::null());
        Running(quiet.spawn().unwrap())
    }

    pub(crate) fn status(&self, out: &str) -> Vec<Value> {
        let (code, text, err) = self.run(out, &["--status", "--json"]);
        assert_eq!(code, 0, "{err}");
        serde_json::from_str(&text).unwrap()
    }

    /// State of every task.
    pub(crate) fn states(&self, out: &str) -> Vec<String> {
        let word = |row: &Value| row["state"].as_str().unwrap().to_owned();
        self.status(out).iter().map(word).collect()
    }

    pub(crate) fn ids(&self) -> Vec<String> {
        let id = |row: &Value| row["id"].as_str().unwrap().to_owned();
        self.status("unseen").iter().map(id).collect()
    }

    /// How often a task was tried.
    pub(crate) fn tries(&self, out: &str, id: &str) -> usize {
        let log = std::fs::read_to_string(self.at(out).join(id).join("log.txt"));
        log.map_or(0, |log| log.matches("goniofit fit --measurements").count())
    }

    /// The numbers of a fit: all but what depends on clocks and places.
    pub(crate) fn numbers(&self, out: &str, id: &str) -> Value {
        let text = std::fs::read_to_string(self.at(out).join(id).join("fit.json")).unwrap();
        let mut fit: Value = serde_json::from_str(&text).unwrap();
        for key in ["time", "command"] {
            fit.as_object_mut().unwrap().remove(key).unwrap();
        }
        for iteration in fit["history"].as_array_mut().unwrap() {
            iteration["wall_s"].take();
        }
        fit
    }

    /// Waits for a line with `text` in a task's log.
    pub(crate) fn wait_for(&self, out: &str, id: &str, text: &str) {
        let path = self.at(out).join(id).join("log.txt");
        let begun = Instant::now();
        while !std::fs::read_to_string(&path).is_ok_and(|log| log.contains(text)) {
            assert!(
                begun.elapsed() < PATIENCE,
                "no '{text}' in {}",
                path.display()
            );
            std::thread::sleep(Duration::from_millis(2));
        }
    }
}

/// A process that does not outlive its test.
pub(crate) struct Running(pub(crate) Child);

impl Running {
    pub(crate) fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.0), signal).unwrap();
    }

    /// Its exit code; none when a signal killed it.
    pub(crate) fn code(&mut self) -> Option<i32> {
        self.0.wait().unwrap().code()
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Whether there is a result, good or not.
pub(crate) fn finished(state: &str) -> bool {
    state == "done" || state == "not_converged"
}

/// Two measurements of one fabric, quickly.
pub(crate) const TWO: &str =
    "measurements = ['m1.csv', 'm2.csv']\nfabrics = ['net.toml']\n[[options]]\npaths = 12000\n";
/// The same, long enough to be caught in the middle.
pub(crate) const LONG: &str = "measurements = ['m1.csv', 'm2.csv']\nfabrics = ['net.toml']\nseeds = [1, 2]\n[[options]]\npaths = 400000\n";
/// A stage of the search, after its first renders and long before its end.
pub(crate) const UNDER_WAY: &str = "fit: search 10 %";
