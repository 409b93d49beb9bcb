//! Promise: a fit that ended anywhere goes on from its journal of render pairs to the result of the uninterrupted fit, bit for
//! bit; a journal of another fit, or a damaged one, is refused by name; nothing that was rendered is lost.
#![allow(clippy::unwrap_used, missing_docs)]

mod toy;

use assert_cmd::cargo::cargo_bin;
use goniofit::base::{Error, Result, Unwatched, Watch};
use goniofit::fit::{
    Budget, FitResult, Journal, JournalHeader, Loss, Method, Options, fit, fit_with_journal,
};
use goniofit::render::{Estimates, Request, Scene};
use goniofit::scatter::Parametric;
use goniofit::session::Measurements;
use rustix::process::Signal;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicU64, Ordering};
use toy::{INSIDE, TOY, Toy};

#[path = "common/fit_list.rs"]
mod fit_list;
use fit_list::{Place, Running};

/// The toy, counting its renders, refusing those after so many as an interrupted scene does.
struct Counted {
    toy: Toy,
    rendered: AtomicU64,
    interrupt_after: u64,
}

impl Counted {
    fn new(interrupt_after: u64) -> Self {
        Self {
            toy: Toy::default(),
            rendered: AtomicU64::new(0),
            interrupt_after,
        }
    }

    fn rendered(&self) -> u64 {
        self.rendered.load(Ordering::SeqCst)
    }
}

impl Scene for Counted {
    fn model(&self) -> &'static dyn Parametric {
        &TOY
    }

    fn estimate(&self, request: &Request<'_>, watch: &dyn Watch) -> Result<Estimates> {
        let before = self.rendered.fetch_add(1, Ordering::SeqCst);
        if before >= self.interrupt_after && watch.cancelled() {
            return Err(Error::new("cancelled"));
        }
        self.toy.estimate(request, &Unwatched)
    }
}

/// Ctrl-C while the scene works on the render after `interrupt_after`.
impl Watch for Counted {
    fn progress(&self, _stage: &str, _done: u64, _total: u64) {}
    fn cancelled(&self) -> bool {
        self.rendered() > self.interrupt_after
    }
}

const ALWAYS: u64 = u64::MAX;

struct Trial {
    measurements: Measurements,
    options: Options,
    folder: tempfile::TempDir,
}

impl Trial {
    fn new(method: Method) -> Self {
        let toy = Toy::default();
        let budget = Budget {
            paths: Some(3_000_000),
            ..Budget::default()
        };
        let mut options = Options {
            method,
            ..Options::new(toy::seed(7), budget)
        };
        // The published schedule, small.
        options.sgd.rates = vec![1.0, 4.0, 16.0];
        options.sgd.iterations = 3;
        options.sgd.final_iterations = 2;
        options.sgd.rescaling.knots = 3;
        options.adam.iterations = 12;
        Self {
            measurements: toy.measure(&Toy::truth(&INSIDE), 0.002, 5),
            options,
            folder: tempfile::tempdir().unwrap(),
        }
    }

    fn path(&self) -> PathBuf {
        self.folder.path().join("renders.jsonl")
    }

    fn header(&self, options: &Options) -> JournalHeader {
        let inputs = [("measurements".to_owned(), "0123".to_owned())];
        JournalHeader::new(&TOY, options, BTreeMap::from(inputs))
    }

    fn begin(&self) -> Journal {
        patiently(|| Journal::create(&self.path(), &self.header(&self.options), true)).unwrap()
    }

    fn again(&self, options: &Options) -> Result<Journal> {
        patiently(|| Journal::resume(&self.path(), &self.header(options)))
    }

    fn fit(&self, scene: &Counted, options: &Options, journal: &Journal) -> Result<FitResult> {
        fit_with_journal(scene, &self.measurements, options, Some(journal), scene)
    }

    fn lines(&self) -> Vec<String> {
        let text = std::fs::read_to_string(self.path()).unwrap();
        text.split_inclusive('\n').map(str::to_owned).collect()
    }

    fn write(&self, text: &str) {
        std::fs::write(self.path(), text).unwrap();
    }
}

/// Opens a journal that was let go a moment ago: a process that another test starts has its lock too until it begins its
/// own program.
fn patiently(open: impl Fn() -> Result<Journal>) -> Result<Journal> {
    for _ in 0..200 {
        match open() {
            Err(error) if error.report().contains("is in use") => {
                std::thread::sleep(std::time::Duration::from_millis(10));
            }
            opened => return opened,
        }
    }
    open()
}

/// The whole of `fit.json`: seconds too, since those of the toy are virtual.
fn text(result: &FitResult) -> String {
    result.to_json().unwrap()
}

#[test]
fn cut_after_any_line_a_fit_goes_on_to_the_same_result() {
    // Sees a change of the last bit of any number of fit.json.
    let mut trials: Vec<Trial> = Method::GENERAL.into_iter().map(Trial::new).collect();
    // Three stages with random numbers of their own, and a coordinate that is no parameter.
    let mut staged = Trial::new(Method::GaussNewton);
    staged.options.loss = Loss::Huber(2.0);
    staged.options.gain_prior = Some(0.05);
    trials.push(staged);
    for trial in trials {
        let method = (trial.options.method, trial.options.loss);
        let scene = Counted::new(ALWAYS);
        let whole = trial.fit(&scene, &trial.options, &trial.begin()).unwrap();
        let plain = fit(&scene, &trial.measurements, &trial.options, &Unwatched).unwrap();
        assert_eq!(text(&whole), text(&plain), "{method:?}: with a journal");
        let lines = trial.lines();
        let pairs = lines.len() - 1;
        assert!(pairs >= 8, "{method:?}: {pairs} pairs");
        for kept in 0..=pairs {
            for torn in [false, true] {
                let mut cut = lines[..=kept].concat();
                if torn && kept < pairs {
                    let next = &lines[kept + 1];
                    cut += &next[..next.len() / 2];
                }
                trial.write(&cut);
                let journal = trial.again(&trial.options).unwrap();
                assert_eq!(journal.torn(), torn && kept < pairs);
                let scene = Counted::new(ALWAYS);
                let result = trial.fit(&scene, &trial.options, &journal).unwrap();
                assert_eq!(text(&result), text(&whole), "{method:?}: after pair {kept}");
                assert_eq!(journal.used(), (kept, pairs - kept));
                assert_eq!(scene.rendered(), 2 * (pairs - kept) as u64);
                drop(journal);
                assert_eq!(
                    trial.lines(),
                    lines,
                    "{method:?}: the journal is whole again"
                );
            }
        }
        // Negative control: one mean of the first pair, changed by a billionth.
        let number = lines[1].split("\"mean\":[[").nth(1).unwrap();
        let number = number.split(',').next().unwrap();
        let other = (number.parse::<f64>().unwrap() * (1.0 + 1e-9)).to_string();
        trial.write(&lines.concat().replacen(number, &other, 1));
        let changed = trial.fit(
            &scene,
            &trial.options,
            &trial.again(&trial.options).unwrap(),
        );
        assert!(
            changed.map_or(true, |r| text(&r) != text(&whole)),
            "{method:?}: the test cannot see a changed number"
        );
    }
}

#[test]
fn interrupted_anywhere_a_fit_keeps_the_best_and_goes_on() {
    for method in Method::GENERAL {
        let trial = Trial::new(method);
        let scene = Counted::new(ALWAYS);
        let whole = trial.fit(&scene, &trial.options, &trial.begin()).unwrap();
        let renders = scene.rendered();
        // Two renders for each of three knots of five parameters come before sgd's first iteration.
        let first_whole = if method == Method::Sgd { 32 } else { 2 };
        // An odd stride: the first render of a pair and the second.
        let stride = if method == Method::Sgd { 3 } else { 1 };
        for interrupt_after in (0..renders).step_by(stride) {
            let scene = Counted::new(interrupt_after);
            let journal = trial.begin();
            let ended = trial.fit(&scene, &trial.options, &journal);
            let kept = interrupt_after >= first_whole;
            assert_eq!(ended.is_ok(), kept, "{method:?} after {interrupt_after}");
            match ended {
                Ok(result) => {
                    assert!(!result.converged && result.reason.contains("interrupted"));
                    // The two pairs at the end, each a tenth of all at most: the toy's floor of 64 paths aside.
                    let before = result.history.last().unwrap().total_paths;
                    assert!(
                        result.objective.paths <= (before / 8).max(128 * 16),
                        "{method:?}: a check of {} paths after {before}",
                        result.objective.paths
                    );
                }
                Err(error) => assert!(
                    error.report().contains("cancelled") || error.report().contains("interrupted")
                ),
            }
            assert_eq!(journal.used().1 as u64, interrupt_after / 2, "{method:?}");
            drop(journal);
            let journal = trial.again(&trial.options).unwrap();
            let result = trial
                .fit(&Counted::new(ALWAYS), &trial.options, &journal)
                .unwrap();
            assert_eq!(
                text(&result),
                text(&whole),
                "{method:?} after {interrupt_after}"
            );
        }
    }
}

#[test]
fn a_robust_fit_interrupted_between_its_stages_keeps_the_best_of_the_one_before() {
    let mut trial = Trial::new(Method::GaussNewton);
    trial.options.loss = Loss::Huber(2.0);
    let scene = Counted::new(ALWAYS);
    let whole = trial.fit(&scene, &trial.options, &trial.begin()).unwrap();
    // From the first whole pair on there is something to keep, whatever the fit is at.
    for interrupt_after in 0..scene.rendered() {
        let journal = trial.begin();
        let ended = trial.fit(&Counted::new(interrupt_after), &trial.options, &journal);
        assert_eq!(ended.is_ok(), interrupt_after > 1, "{interrupt_after}");
        if let Ok(result) = ended {
            assert!(!result.converged && result.reason.contains("interrupted"));
            let iterations = journal.used().1;
            assert!(!result.history.is_empty() && result.history.len() <= iterations);
        }
        assert_eq!(journal.used().1 as u64, interrupt_after / 2);
        drop(journal);
        if !interrupt_after.is_multiple_of(5) {
            continue;
        }
        let journal = trial.again(&trial.options).unwrap();
        let result = trial
            .fit(&Counted::new(ALWAYS), &trial.options, &journal)
            .unwrap();
        assert_eq!(text(&result), text(&whole), "after {interrupt_after}");
    }
}

#[test]
fn other_limits_give_the_result_of_a_fit_begun_with_them() {
    for (method, reused_at_least) in [
        (Method::GaussNewton, 3),
        (Method::Sgd, 25),
        (Method::Adam, 8),
    ] {
        let mut trial = Trial::new(method);
        if method == Method::GaussNewton {
            // So many that the first pairs do not depend on them.
            trial.options.budget.paths = Some(20_000_000);
        } else {
            trial.options.iteration_paths = Some(20_000);
        }
        let short = trial.options.clone();
        let mut long = short.clone();
        long.budget.paths = short.budget.paths.map(|n| 2 * n);
        let fresh = {
            let journal = trial.begin();
            trial.fit(&Counted::new(ALWAYS), &long, &journal).unwrap()
        };
        trial
            .fit(&Counted::new(ALWAYS), &short, &trial.begin())
            .unwrap();
        let journal = trial.again(&long).unwrap();
        let (found, _) = journal.found();
        let result = trial.fit(&Counted::new(ALWAYS), &long, &journal).unwrap();
        assert_eq!(text(&result), text(&fresh), "{method:?}");
        let (reused, rendered) = journal.used();
        assert!(
            reused >= reused_at_least,
            "{method:?}: {reused} of {found} pairs reused, {rendered} rendered"
        );
        drop(journal);
        // Once more with the same limits: nothing is rendered; and back to the first ones.
        for options in [&long, &short] {
            let journal = trial.again(options).unwrap();
            let result = trial.fit(&Counted::new(ALWAYS), options, &journal).unwrap();
            if options.budget == long.budget {
                assert_eq!((text(&result), journal.used().1), (text(&fresh), 0));
            }
        }
    }
}

#[test]
fn what_differs_is_named_and_damage_is_found() {
    let trial = Trial::new(Method::GaussNewton);
    let scene = Counted::new(ALWAYS);
    trial.fit(&scene, &trial.options, &trial.begin()).unwrap();
    let lines = trial.lines();
    let report = |journal: Result<Journal>| journal.err().unwrap().report();
    let with = |change: &dyn Fn(&mut Options)| {
        let mut options = trial.options.clone();
        change(&mut options);
        report(trial.again(&options))
    };
    assert!(with(&|o| o.seed = 8).contains("other seed (7 then, 8 now)"));
    let tolerance = with(&|o| o.tolerance = 0.1);
    assert!(
        tolerance.contains("options (tolerance: 0.05 then, tolerance: 0.1 now)"),
        "{tolerance}"
    );
    assert!(with(&|o| o.start = Some(Toy::truth(&INSIDE))).contains("other start"));
    let mut header = trial.header(&trial.options);
    header.inputs.insert("measurements".into(), "4567".into());
    let other = report(Journal::resume(&trial.path(), &header));
    assert!(other.contains("other measurements"), "{other}");
    let twice = Journal::create(&trial.path(), &header, false);
    assert!(report(twice).contains("exists already"));

    // A search that went another way.
    let wrong = lines[2].replacen("\"parameters\":[", "\"parameters\":[1.0,", 1);
    assert_ne!(wrong, lines[2]);
    trial.write(&[&lines[0], &lines[1], &wrong].map(String::as_str).concat());
    let journal = trial.again(&trial.options).unwrap();
    let error = trial
        .fit(&scene, &trial.options, &journal)
        .unwrap_err()
        .report();
    assert!(
        error.contains("pair 1: parameters [1.0, ") && error.contains("hint:"),
        "{error}"
    );
    drop(journal);

    // A torn line that is not the last; a file without a whole line; two at once.
    let torn = &lines[2][..lines[2].len() / 3];
    trial.write(&format!("{}{}{torn}\n{}", lines[0], lines[1], lines[3]));
    let error = report(trial.again(&trial.options));
    assert!(
        error.contains("line 3 is damaged") && error.contains("hint:"),
        "{error}"
    );
    trial.write(&lines[0][..40]);
    assert!(report(trial.again(&trial.options)).contains("no whole line"));
    trial.write(&lines.concat());
    let _one = trial.again(&trial.options).unwrap();
    assert!(report(trial.again(&trial.options)).contains("in use"));
}

/// `goniofit fit` in `place`, as quick as a fit of cloth can be.
fn program(place: &Place, words: &str) -> Command {
    let mut command = Command::new(cargo_bin("goniofit"));
    command.current_dir(place.at("")).args(words.split(' '));
    command.env("RAYON_NUM_THREADS", "2");
    command
}

/// Exit code and stderr.
fn run(mut command: Command) -> (Option<i32>, String) {
    let output = command.output().unwrap();
    (
        output.status.code(),
        String::from_utf8(output.stderr).unwrap(),
    )
}

/// `fit.json` but for seconds.
fn numbers(path: &Path) -> Value {
    let mut fit: Value = serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
    fit["time"]["wall_s"].take();
    fit["time"]["cpu_s"].take();
    for iteration in fit["history"].as_array_mut().unwrap() {
        iteration["wall_s"].take();
    }
    fit
}

/// The published method, its schedule small.
const SGD: &str = "fit --measurements m1.csv --fabric net.toml --method sgd --iteration-paths 400 --iterations 6 \
                   --rates 1,16 --paths 60000 --out out";

/// Waits until the journal in `out` has so many lines.
fn wait_for_lines(place: &Place, lines: usize) {
    let begun = std::time::Instant::now();
    let count =
        || std::fs::read_to_string(place.at("out/renders.jsonl")).map_or(0, |t| t.lines().count());
    while count() < lines {
        assert!(begun.elapsed() < fit_list::PATIENCE);
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
}

#[test]
fn a_killed_or_interrupted_fit_is_resumed_by_the_command_line() {
    let place = Place::new("");
    assert!(run(program(&place, SGD)).0 <= Some(1));
    let whole = numbers(&place.at("out/fit.json"));
    let lines = place.read("out/renders.jsonl");

    for (signal, after) in [(Signal::KILL, 20), (Signal::INT, 60)] {
        std::fs::remove_dir_all(place.at("out")).unwrap();
        let mut command = program(&place, SGD);
        let quiet = command.stdout(Stdio::null()).stderr(Stdio::null());
        let mut running = Running(quiet.spawn().unwrap());
        wait_for_lines(&place, after);
        running.signal(signal);
        running.code();
        let left = place.read("out/renders.jsonl").lines().count();
        assert!(left < lines.lines().count(), "it was over already");
        if signal == Signal::KILL {
            assert!(!place.at("out/fit.json").exists());
            // The same command again does not throw away what is there.
            let (code, err) = run(program(&place, SGD));
            assert!(code == Some(2) && err.contains("--resume goes on"), "{err}");
        }
        let (code, err) = run(program(&place, "fit --resume out"));
        assert!(code <= Some(1) && err.contains("going on with"), "{err}");
        assert_eq!(numbers(&place.at("out/fit.json")), whole);
    }

    // Interrupted before there is a result: exit code 130, and how to go on.
    std::fs::remove_dir_all(place.at("out")).unwrap();
    let mut command = program(&place, SGD);
    let quiet = command.stdout(Stdio::null()).stderr(Stdio::piped());
    let running = quiet.spawn().unwrap();
    wait_for_lines(&place, 2);
    rustix::process::kill_process(rustix::process::Pid::from_child(&running), Signal::INT).unwrap();
    let output = running.wait_with_output().unwrap();
    let err = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(130), "{err}");
    assert!(err.contains("goniofit fit --resume out goes on"), "{err}");
    // From another folder, and with a changed input.
    place.measure("m1.csv", 1.01);
    let (code, err) = run(program(&place, "fit --resume out"));
    assert!(
        code == Some(2) && err.contains("other measurements"),
        "{err}"
    );
    place.measure("m1.csv", 1.0);
    let elsewhere = format!("fit --resume {}", place.at("out").display());
    let mut command = program(&place, &elsewhere);
    let (code, err) = run({
        command.current_dir("/");
        command
    });
    assert!(code <= Some(1), "{err}");
    let mut resumed = numbers(&place.at("out/fit.json"));
    for key in ["measurements", "fabric"] {
        resumed[key] = whole[key].clone();
    }
    assert_eq!(resumed, whole);
}

#[test]
fn a_full_disk_loses_nothing() {
    let place = Place::new("");
    assert!(run(program(&place, SGD)).0 <= Some(1));
    let whole = numbers(&place.at("out/fit.json"));
    std::fs::remove_dir_all(place.at("out")).unwrap();
    // No file may grow beyond 64 kB: the write fails as on a full disk.
    let mut shell = Command::new("sh");
    let line = format!(
        "trap '' XFSZ; ulimit -f 128; exec {} {SGD}",
        cargo_bin("goniofit").display()
    );
    shell.args(["-c", &line]).current_dir(place.at(""));
    let (code, err) = run(shell);
    assert_eq!(code, Some(2), "{err}");
    assert!(
        err.contains("cannot be written") && err.contains("--resume"),
        "{err}"
    );
    let left = place.read("out/renders.jsonl");
    assert!(
        left.ends_with('\n') && left.lines().count() > 3,
        "{} lines",
        left.lines().count()
    );
    assert!(run(program(&place, "fit --resume out")).0 <= Some(1));
    assert_eq!(numbers(&place.at("out/fit.json")), whole);
}
