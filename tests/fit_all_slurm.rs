//! Promise: `docs/fit_all.sbatch` does a list as a job array of a real Slurm: all tasks, exit codes, the time limit, jobs begun
//! anew.
//!
//! Starts munged, slurmctld and slurmd (Debian: `apt-get install slurm-wlm munge`) as this user on ports of their own, with
//! all files in a temporary folder; the machine's own configuration is neither read nor changed.
#![allow(clippy::unwrap_used, clippy::print_stdout, missing_docs)]

use assert_cmd::cargo::cargo_bin;
use goniofit::fit::FitResult;
use rustix::process::{Pid, Signal, kill_process};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

#[path = "common/fit_list.rs"]
mod fit_list;
use fit_list::{LONG, PATIENCE, Place, Running, TWO, UNDER_WAY, finished};

/// A cluster of this machine alone; the daemons end with it.
struct Cluster {
    _daemons: Vec<Running>,
    configuration: PathBuf,
}

/// A daemon's program; Debian keeps them out of a user's path.
fn program(name: &str) -> Option<PathBuf> {
    let places = ["/usr/sbin", "/usr/bin", "/usr/local/sbin", "/usr/local/bin"];
    let paths = places.map(|place| Path::new(place).join(name));
    paths.into_iter().find(|path| path.is_file())
}

fn free_port() -> u16 {
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    listener.local_addr().unwrap().port()
}

fn word_of(command: &str, argument: &str) -> String {
    let output = Command::new(command).arg(argument).output().unwrap();
    String::from_utf8(output.stdout).unwrap().trim().to_owned()
}

impl Cluster {
    /// None where Slurm is not installed.
    fn start(folder: &Path) -> Option<Self> {
        program("sbatch")?;
        let [munged, slurmctld, slurmd] = ["munged", "slurmctld", "slurmd"].map(program);
        let at = |name: &str| folder.join(name).display().to_string();
        for name in ["state", "spool"] {
            std::fs::create_dir(folder.join(name)).unwrap();
        }
        std::fs::write(at("key"), [7_u8; 1024]).unwrap();
        let mode = std::os::unix::fs::PermissionsExt::from_mode(0o600);
        std::fs::set_permissions(at("key"), mode).unwrap();
        let configuration = folder.join("slurm.conf");
        std::fs::write(&configuration, Self::configuration(folder)).unwrap();

        let start = |program: &Path, arguments: &[String]| {
            let mut command = Command::new(program);
            let quiet = command.args(arguments).stdin(Stdio::null());
            let quiet = quiet.stdout(Stdio::null()).stderr(Stdio::null());
            Running(quiet.spawn().unwrap())
        };
        let options = [
            ("--key-file=", "key"),
            ("--socket=", "munge.socket"),
            ("--pid-file=", "munged.pid"),
            ("--log-file=", "munged.log"),
            ("--seed-file=", "seed"),
        ];
        let mut arguments = vec!["--force".to_owned(), "--foreground".to_owned()];
        arguments.extend(options.map(|(option, name)| format!("{option}{}", at(name))));
        let mut daemons = vec![start(&munged?, &arguments)];
        wait("munged", || folder.join("munge.socket").exists());
        let own = ["-D".to_owned(), "-f".to_owned(), at("slurm.conf")];
        daemons.push(start(&slurmctld?, &own));
        daemons.push(start(&slurmd?, &own));
        let cluster = Self {
            _daemons: daemons,
            configuration,
        };
        wait("an idle node", || {
            cluster
                .ask("sinfo", &["-h", "-o", "%T"])
                .starts_with("idle")
        });
        Some(cluster)
    }

    fn configuration(folder: &Path) -> String {
        let (host, user) = (word_of("uname", "-n"), word_of("id", "-un"));
        let (controller, node, at) = (free_port(), free_port(), folder.display());
        format!(
            "ClusterName=test\nSlurmctldHost={host}(127.0.0.1)\nSlurmctldPort={controller}\nSlurmdPort={node}\n\
             SlurmUser={user}\nSlurmdUser={user}\nAuthType=auth/munge\nAuthInfo=socket={at}/munge.socket\n\
             StateSaveLocation={at}/state\nSlurmdSpoolDir={at}/spool\n\
             SlurmctldPidFile={at}/slurmctld.pid\nSlurmdPidFile={at}/slurmd.pid\n\
             SlurmctldLogFile={at}/slurmctld.log\nSlurmdLogFile={at}/slurmd.log\n\
             ProctrackType=proctrack/linuxproc\nTaskPlugin=task/none\nMpiDefault=none\n\
             SelectType=select/cons_tres\nSelectTypeParameters=CR_CPU\nReturnToService=2\nMailProg=/bin/true\n\
             NodeName={host} NodeAddr=127.0.0.1 CPUs=2 State=UNKNOWN\n\
             PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP\n"
        )
    }

    /// A command of this cluster.
    fn command(&self, name: &str, arguments: &[&str]) -> Command {
        let mut command = Command::new(name);
        command
            .args(arguments)
            .env("SLURM_CONF", &self.configuration);
        command.env("GONIOFIT", cargo_bin("goniofit"));
        command
    }

    fn ask(&self, name: &str, arguments: &[&str]) -> String {
        let output = self.command(name, arguments).output().unwrap();
        String::from_utf8(output.stdout).unwrap()
    }

    /// Submits the list of `place` as an array and gives the job's number.
    fn submit(&self, place: &Place, out: &str, options: &[&str]) -> String {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/fit_all.sbatch");
        let mut command = self.command("sbatch", &["--parsable"]);
        command.args(options).arg(script).args(["work.toml", out]);
        let output = command.current_dir(place.0.path()).output().unwrap();
        let text = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{text}");
        String::from_utf8(output.stdout).unwrap().trim().to_owned()
    }

    /// Waits until a job's elements have all ended; their exit codes in the order of the array.
    fn exit_codes(&self, job: &str) -> Vec<String> {
        wait("the job's end", || {
            self.ask("squeue", &["-h", "-j", job]).is_empty()
        });
        let text = self.ask("scontrol", &["show", "job", "-o", job]);
        let field = |line: &str, name: &str| {
            let mut words = line.split_whitespace();
            words.find_map(|w| w.strip_prefix(name).map(str::to_owned))
        };
        let row = |line: &str| {
            let number: usize = field(line, "ArrayTaskId=")?.parse().ok()?;
            Some((number, field(line, "ExitCode=")?))
        };
        let mut rows: Vec<_> = text.lines().filter_map(row).collect();
        rows.sort();
        rows.into_iter().map(|(_, code)| code).collect()
    }
}

impl Drop for Cluster {
    fn drop(&mut self) {
        let everything = ["--full", "--signal=KILL", "--state=RUNNING"];
        self.ask("scancel", &everything);
    }
}

fn wait(what: &str, mut there: impl FnMut() -> bool) {
    let begun = Instant::now();
    while !there() {
        assert!(begun.elapsed() < 2 * PATIENCE, "waited for {what} in vain");
        std::thread::sleep(Duration::from_millis(100));
    }
}

#[test]
#[ignore = "slow: 3 min, starts a Slurm of its own (apt-get install slurm-wlm munge)"]
fn a_job_array_does_a_list() {
    let folder = tempfile::tempdir().unwrap();
    let Some(cluster) = Cluster::start(folder.path()) else {
        println!("skipped: sbatch, munged, slurmctld and slurmd are not all installed");
        return;
    };
    every_element_does_its_task(&cluster);
    the_time_limit_keeps_the_best_so_far(&cluster);
    a_job_begun_anew_takes_over_what_was_killed(&cluster);
}

/// One element fails, the others give the numbers of a serial run; submitted again they end at once.
fn every_element_does_its_task(cluster: &Cluster) {
    let place = Place::new(&TWO.replace("'m1.csv'", "'m1.csv', 'none.csv'"));
    let ids = place.ids();
    let count = place.run("out", &["--count"]).1;
    let array = format!("--array=0-{}", count.trim().parse::<usize>().unwrap() - 1);
    let job = cluster.submit(&place, "out", &[&array]);
    let codes = cluster.exit_codes(&job);
    let states = place.states("out");
    let expected: Vec<&str> = states
        .iter()
        .map(|state| match state.as_str() {
            "done" => "0:0",
            "not_converged" => "1:0",
            _ => "2:0",
        })
        .collect();
    assert_eq!(codes, expected, "{states:?}");
    assert!(finished(&states[0]) && finished(&states[2]), "{states:?}");
    assert_eq!(states[1], "failed");
    place.run("serial", &[]);
    for id in [&ids[0], &ids[2]] {
        assert_eq!(place.numbers("out", id), place.numbers("serial", id));
    }
    let again = cluster.submit(&place, "out", &[&array]);
    assert_eq!(cluster.exit_codes(&again), codes);
    assert_eq!([0, 1, 2].map(|i| place.tries("out", &ids[i])), [1; 3]);
    println!("job array: exit codes {codes:?}");
}

/// Slurm's own warning before the time limit ends the fit in order.
fn the_time_limit_keeps_the_best_so_far(cluster: &Cluster) {
    let place = Place::new(&LONG.replace("400000", "1000000000"));
    let ids = place.ids();
    let begun = Instant::now();
    let job = cluster.submit(&place, "out", &["--array=1", "--time=1"]);
    assert_eq!(cluster.exit_codes(&job), ["1:0"]);
    let fit = FitResult::read(&place.at("out").join(&ids[1]).join("fit.json")).unwrap();
    assert!(fit.reason.contains("interrupted"), "{}", fit.reason);
    assert_eq!(place.states("out"), ["waiting"; 4]);
    assert!(!place.at("out").join(&ids[1]).join("lock").exists());
    let seconds = begun.elapsed().as_secs_f64();
    // At the limit itself Slurm sends the same signal, half a minute before it kills; the warning comes before.
    assert!(fit.time.wall_s < 55.0, "{} s", fit.time.wall_s);
    println!(
        "time limit: ended in order after {seconds:.0} s with {} paths",
        fit.time.paths
    );
}

/// A killed process leaves its lock; the same job, put back into the queue, does not stumble over it.
fn a_job_begun_anew_takes_over_what_was_killed(cluster: &Cluster) {
    let place = Place::new(LONG);
    let ids = place.ids();
    let job = cluster.submit(&place, "out", &["--array=2"]);
    place.wait_for("out", &ids[2], UNDER_WAY);
    let lock = place.read(&format!("out/{}/lock", ids[2]));
    let lock: serde_json::Value = serde_json::from_str(&lock).unwrap();
    let process = lock["process"].as_i64().unwrap() as i32;
    kill_process(Pid::from_raw(process).unwrap(), Signal::KILL).unwrap();
    assert_eq!(cluster.exit_codes(&job), ["0:9"]);
    assert_eq!(place.states("out")[2], "failed");

    // Without more ado a new job leaves it alone, the old one goes on.
    let other = cluster.submit(&place, "out", &["--array=2"]);
    assert_eq!(cluster.exit_codes(&other), ["2:0"]);
    cluster.ask("scontrol", &["requeue", &format!("{job}_2")]);
    wait("the job's second run", || place.tries("out", &ids[2]) == 2);
    let code = cluster.exit_codes(&job);
    let state = &place.states("out")[2];
    assert!(finished(state), "{state} {code:?}");
    println!("killed and begun anew: {state}, exit code {code:?}");
}
