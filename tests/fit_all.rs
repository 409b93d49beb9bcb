//! Promise: `goniofit fit-all` does every task of a list once, tells what is left, and never mistakes one state for another:
//! not after changed inputs, a failure, an interruption, a kill, or with another process at the same list.
#![allow(clippy::unwrap_used, missing_docs)]

use assert_cmd::cargo::cargo_bin;
use goniofit::fit::FitResult;
use rustix::process::Signal;
use serde_json::Value;
use std::process::Command;

#[path = "common/fit_list.rs"]
mod fit_list;
use fit_list::{HEAD, LONG, Place, Running, TWO, UNDER_WAY, finished};

/// The exit code that these states stand for.
fn code_of(states: &[String]) -> i32 {
    let has = |state: &str| states.iter().any(|s| s == state);
    if has("failed") {
        2
    } else {
        i32::from(states.iter().any(|s| s != "done"))
    }
}

#[test]
fn what_is_done_is_not_done_again_and_changes_are_noticed() {
    let place = Place::new(TWO);
    let ids = place.ids();
    let (code, count, _) = place.run("out", &["--count"]);
    assert_eq!((code, count.as_str()), (0, "2\n"));
    assert!(!place.at("out").exists(), "counting leaves nothing behind");
    assert_eq!(place.states("out"), ["waiting", "waiting"]);

    let (code, table, err) = place.run("out", &[]);
    let states = place.states("out");
    assert!(states.iter().all(|s| finished(s)), "{table}{err}");
    assert_eq!(code, code_of(&states), "{table}{err}");
    for id in &ids {
        for name in ["fit.json", "report.html", "log.txt", "task.json"] {
            assert!(place.at("out").join(id).join(name).is_file(), "{id}/{name}");
        }
        assert!(!place.at("out").join(id).join("lock").exists());
    }
    let before = ids
        .iter()
        .map(|id| place.read(&format!("out/{id}/fit.json")));
    let before: Vec<String> = before.collect();

    // Again: nothing is touched, the exit code is the same.
    let (again, ..) = place.run("out", &[]);
    assert_eq!(again, code);
    let after = ids
        .iter()
        .map(|id| place.read(&format!("out/{id}/fit.json")));
    assert!(after.eq(before.iter().cloned()));

    // One measurement changes: that task alone is done again, and it is said why; the earlier fit is kept aside.
    place.measure("m2.csv", 0.9);
    let row = &place.status("out")[1];
    assert_eq!(row["state"], "waiting");
    let note = row["note"].as_str().unwrap();
    assert!(note.ends_with(": measurements"), "{note}");
    let (_, _, err) = place.run("out", &[]);
    assert!(err.contains(&format!("{}: changed", ids[1])), "{err}");
    assert_eq!(
        [place.tries("out", &ids[0]), place.tries("out", &ids[1])],
        [1, 2]
    );
    let aside = format!("out/{}/fit.earlier.json", ids[1]);
    assert_eq!(place.read(&aside), before[1]);
    assert_ne!(place.read(&format!("out/{}/fit.json", ids[1])), before[1]);

    // So are fibers behind a description, options, and a fit.json that is not the one that was made.
    place.write("net.csv", &place.read("net.csv").replace("0.08", "0.07"));
    let note = |number: usize| place.status("out")[number]["note"].to_string();
    assert!(note(0).contains(": fibers"), "{}", note(0));
    place.write("net.csv", &place.read("net.csv").replace("0.07", "0.08"));
    assert!(finished(&place.states("out")[0]));
    let fit = format!("out/{}/fit.json", ids[0]);
    place.write(&fit, &before[0][..before[0].len() / 2]);
    assert!(note(0).contains("not the one that was made"), "{}", note(0));
    place.write(&fit, &before[0]);
    assert!(finished(&place.states("out")[0]));
    place.write("work.toml", &TWO.replace("12000", "13000"));
    assert!(note(0).contains(": options"), "{}", note(0));
    assert_eq!(place.ids(), ids);
}

#[test]
fn one_bad_file_stops_nothing_and_is_tried_again_only_when_asked() {
    let place = Place::new(&TWO.replace("'m1.csv'", "'bad.csv', 'm1.csv', 'none.csv'"));
    place.write(
        "bad.csv",
        &format!("{HEAD}1,30,180,30,0,0,NaN,0.1,0.1,0.01,0.01,0.01\n"),
    );
    let ids = place.ids();
    let (code, table, err) = place.run("out", &[]);
    assert_eq!(code, 2, "{table}{err}");
    assert!(
        err.contains("2 of 4 fits failed") && err.contains("hint:"),
        "{err}"
    );
    let rows = place.status("out");
    assert_eq!([&rows[0]["state"], &rows[2]["state"]], ["failed", "failed"]);
    assert!(
        rows[0]["note"].as_str().unwrap().contains("r is NaN"),
        "{}",
        rows[0]
    );
    assert!(
        rows[2]["note"].as_str().unwrap().contains("none.csv"),
        "{}",
        rows[2]
    );
    let states = place.states("out");
    assert!(finished(&states[1]) && finished(&states[3]), "{states:?}");
    assert!(
        place
            .read(&format!("out/{}/log.txt", ids[0]))
            .contains("r is NaN")
    );

    assert_eq!(place.run("out", &[]).0, 2);
    assert_eq!(place.tries("out", &ids[0]), 1);
    assert_eq!(place.run("out", &["--retry"]).0, 2);
    let tries = [0, 1, 2].map(|i| place.tries("out", &ids[i]));
    assert_eq!(tries, [2, 1, 2]);

    // A mended file is a changed input: it needs no --retry.
    place.measure("bad.csv", 1.1);
    place.measure("none.csv", 1.1);
    let (code, ..) = place.run("out", &[]);
    let states = place.states("out");
    assert!(states.iter().all(|s| finished(s)), "{states:?}");
    assert_eq!(code, code_of(&states));
}

#[test]
fn jobs_and_single_tasks_give_the_numbers_of_a_plain_fit() {
    let place = Place::new(&TWO.replace("[[options]]", "seeds = [5, 6]\n[[options]]"));
    let ids = place.ids();
    let serial = place.run("serial", &["--json"]);
    let rows: Vec<Value> = serde_json::from_str(&serial.1).unwrap();
    assert_eq!(rows.len(), 4, "{}", serial.2);
    let mut command = place.command("jobs", &["--jobs", "3"]);
    let together = command.env("RAYON_NUM_THREADS", "4").output().unwrap();
    assert_eq!(together.status.code(), Some(serial.0));
    for id in &ids {
        assert_eq!(place.numbers("serial", id), place.numbers("jobs", id));
        // A fit's CPU time is its own: never more than its threads (at most two of the four) had, whatever ran beside it.
        let record: Value =
            serde_json::from_str(&place.read(&format!("jobs/{id}/task.json"))).unwrap();
        let fit = FitResult::read(&place.at(&format!("jobs/{id}/fit.json"))).unwrap();
        let most = 2.0 * record["elapsed_s"].as_f64().unwrap() + 0.05;
        assert!(
            (0.0..most).contains(&fit.time.cpu_s),
            "{} s",
            fit.time.cpu_s
        );
    }
    assert_ne!(
        place.numbers("serial", &ids[0]),
        place.numbers("serial", &ids[1])
    );

    // One task by number, another by id; the others stay.
    for which in ["2", ids[1].as_str()] {
        let (code, table, err) = place.run("single", &["--task", which, "--json"]);
        let rows: Vec<Value> = serde_json::from_str(&table).unwrap();
        assert_eq!(
            (rows.len(), code),
            (1, code_of(&[rows[0]["state"].as_str().unwrap().into()])),
            "{err}"
        );
    }
    let started = ids.iter().map(|id| place.at("single").join(id).exists());
    assert_eq!(started.collect::<Vec<_>>(), [false, true, true, false]);
    assert_eq!(
        place.numbers("single", &ids[2]),
        place.numbers("serial", &ids[2])
    );
    let (code, _, err) = place.run("single", &["--task", "4"]);
    assert!(
        code == 2 && err.contains("no task 4") && err.contains("0 to 3"),
        "{err}"
    );

    // The command in fit.json repeats the fit.
    let fit = FitResult::read(&place.at(&format!("serial/{}/fit.json", ids[3]))).unwrap();
    let words = fit.command.replace("--out serial/", "--out plain/");
    let mut plain = Command::new(cargo_bin("goniofit"));
    let plain = plain
        .current_dir(place.at(""))
        .args(words.split(' ').skip(1));
    assert!(plain.output().unwrap().status.code() <= Some(1));
    assert_eq!(
        place.numbers("plain", &ids[3]),
        place.numbers("serial", &ids[3])
    );

    // The summary has the parameters with their intervals, and empty cells where there is no fit.
    assert_eq!(place.run("single", &["--summary", "s.csv"]).0, 0);
    assert_eq!(
        place.run("single", &["--summary", "s.csv"]).0,
        2,
        "it is not replaced"
    );
    assert_eq!(place.run("single", &["--summary", "s.csv", "--force"]).0, 0);
    let mut reader = csv::Reader::from_path(place.at("s.csv")).unwrap();
    let head = reader.headers().unwrap().clone();
    let column = |name: &str| head.iter().position(|h| h == name).unwrap();
    let rows: Vec<csv::StringRecord> = reader.records().map(|r| r.unwrap()).collect();
    assert_eq!(rows.len(), 4);
    let truth = FitResult::read(&place.at(&format!("single/{}/fit.json", ids[1]))).unwrap();
    let beta = truth
        .uncertainty
        .iter()
        .find(|p| p.name == "beta_tt")
        .unwrap();
    for (name, expected) in [
        ("beta_tt_deg", beta.value),
        ("beta_tt_deg_low_95", beta.interval_95[0]),
        ("beta_tt_deg_high_95", beta.interval_95[1]),
    ] {
        let cell = &rows[1][column(name)];
        assert_eq!(cell.parse::<f64>().unwrap().to_bits(), expected.to_bits());
        assert_eq!(&rows[0][column(name)], "");
    }
    assert_eq!(&rows[0][column("state")], "waiting");
}

#[test]
fn an_interruption_leaves_whole_files_and_the_next_run_goes_on() {
    let place = Place::new(LONG);
    let ids = place.ids();
    let mut running = place.start("out", &["--jobs", "2"]);
    for id in &ids[..2] {
        place.wait_for("out", id, UNDER_WAY);
    }
    assert_eq!(place.states("out")[..2], ["running", "running"]);
    running.signal(Signal::INT);
    assert_eq!(running.code(), Some(1));
    assert_eq!(place.states("out"), ["waiting"; 4]);
    for (number, id) in ids.iter().enumerate() {
        let folder = place.at("out").join(id);
        let fit = FitResult::read(&folder.join("fit.json"));
        assert_eq!(fit.is_ok(), number < 2, "{id}");
        if let Ok(fit) = fit {
            assert!(fit.reason.contains("interrupted"), "{}", fit.reason);
            assert!(
                place
                    .read(&format!("out/{id}/report.html"))
                    .ends_with("</html>\n")
            );
            let mut names = std::fs::read_dir(folder)
                .unwrap()
                .map(|e| e.unwrap().file_name());
            assert!(!names.any(|n| n == "lock" || n.to_str().unwrap().ends_with(".part")));
        }
    }
    // Going on gives what an uninterrupted run gives.
    for out in ["out", "fresh"] {
        assert!(place.run(out, &["--task", "1"]).0 <= 1);
    }
    assert_eq!(
        place.numbers("out", &ids[1]),
        place.numbers("fresh", &ids[1])
    );
}

#[test]
fn two_processes_share_a_list_and_a_killed_one_is_noticed() {
    let place = Place::new(LONG);
    let ids = place.ids();
    let running = place.start("out", &["--task", "0"]);
    place.wait_for("out", &ids[0], UNDER_WAY);
    let (code, _, err) = place.run("out", &["--task", "0"]);
    let holder = format!("is being done by process {} on ", running.0.id());
    assert!(code == 2 && err.contains(&holder), "{err}");
    running.signal(Signal::KILL);
    drop(running);

    // A killed process leaves its lock: said, and taken over only when asked to.
    let row = &place.status("out")[0];
    assert_eq!(row["state"], "failed");
    assert!(
        row["note"]
            .as_str()
            .unwrap()
            .contains("ended without a result: process"),
        "{row}"
    );
    assert_eq!(place.run("out", &["--task", "0"]).0, 2);
    assert_eq!(place.tries("out", &ids[0]), 1);

    place.write("work.toml", &LONG.replace("400000", "12000"));
    let mut both = [0, 1].map(|_| place.start("out", &["--retry"]));
    let codes = both.each_mut().map(Running::code);
    let states = place.states("out");
    assert!(states.iter().all(|s| finished(s)), "{states:?} {codes:?}");
    let tries: Vec<usize> = ids.iter().map(|id| place.tries("out", id)).collect();
    assert_eq!(tries, [2, 1, 1, 1]);
}

/// The published descent and Adam, each on a schedule of its own.
const SCHEDULES: &str = "measurements = ['m1.csv']\nfabrics = ['net.toml']\n\
    [[options]]\nname = 'published'\nmethod = 'sgd'\niteration_paths = 2000\niterations = 5\nrates = [1, 16.0]\npaths = 400000\n\
    [[options]]\nname = 'adam'\nmethod = 'adam'\niterations = 25\nrates = [0.2]\npaths = 100000\n";

#[test]
fn a_killed_task_goes_on_from_its_renders_on_its_own_schedule() {
    let place = Place::new(SCHEDULES);
    let ids = place.ids();
    assert!(place.run("fresh", &[]).0 <= 1);
    let iterations = |id: &str| {
        place.numbers("fresh", id)["history"]
            .as_array()
            .unwrap()
            .len()
    };
    // Two runs of five and the last ten; Adam's own number.
    assert_eq!([iterations(&ids[0]), iterations(&ids[1])], [20, 25]);

    let running = place.start("out", &["--task", "0"]);
    let journal = place.at("out").join(&ids[0]).join("renders.jsonl");
    let begun = std::time::Instant::now();
    while std::fs::read_to_string(&journal).map_or(0, |t| t.lines().count()) < 20 {
        assert!(begun.elapsed() < fit_list::PATIENCE);
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    running.signal(Signal::KILL);
    drop(running);
    assert_eq!(place.states("out")[0], "failed");
    assert!(place.run("out", &["--retry"]).0 <= 1);
    for id in &ids {
        assert_eq!(place.numbers("out", id), place.numbers("fresh", id));
    }
    let log = place.read(&format!("out/{}/log.txt", ids[0]));
    let resumed = log.split("going on with ").nth(1).unwrap();
    let pairs: usize = resumed.split(' ').next().unwrap().parse().unwrap();
    assert!((18..73).contains(&pairs), "{pairs} pairs");

    // More paths in the list: done again, with what was rendered; other rates are another fit.
    place.write("work.toml", &SCHEDULES.replace("400000", "500000"));
    assert!(place.run("out", &[]).0 <= 1);
    let log = place.read(&format!("out/{}/log.txt", ids[0]));
    assert_eq!(log.matches("going on with ").count(), 2, "{log}");
    place.write("work.toml", &SCHEDULES.replace("16.0", "8.0"));
    let row = &place.status("out")[0];
    assert!(
        row["note"].as_str().unwrap().ends_with(": options"),
        "{row}"
    );
    assert!(place.run("out", &[]).0 <= 1);
    let log = place.read(&format!("out/{}/log.txt", ids[0]));
    assert!(
        log.contains("from the start, because of other options (16.0 then, 8.0 now)"),
        "{log}"
    );
}
