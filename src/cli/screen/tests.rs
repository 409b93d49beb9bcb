//! The screen on real pseudo-terminals, in this process and in one of its own.

use super::*;
use crate::rig::{CapturedFrame, Shot, Taken};
use crate::session::{Exposedness, FrameKind, FrameRecord};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags};
use rustix::process::{Pid, Signal, kill_process};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{LocalModes, Winsize, tcgetattr, tcsetwinsize};
use std::io::Read;
use std::process::{Child, Command, Stdio};

const PATIENCE: Duration = Duration::from_secs(20);

fn rig() -> RigDescription {
    RigDescription::read(Path::new("rig_configs/five_axis_grblhal.toml")).unwrap()
}

fn plan() -> Plan {
    Plan::read(Path::new("rig_configs/plans/khungurn16.toml")).unwrap()
}

fn shot(kind: FrameKind, config: Option<u32>, exposure_ms: f64) -> Shot {
    let pose = match config {
        Some(id) => *plan().configuration(id).unwrap(),
        None => rig().white.configuration(0),
    };
    Shot {
        kind,
        config,
        pose,
        exposure_ms,
        repeat: 0,
        visit: 0,
    }
}

/// Hands `see` a frame of this shot with this brightness.
fn taken(shot: &Shot, mean: [f64; 3], frames: usize, see: impl FnOnce(&Seen<'_>)) {
    let record = FrameRecord {
        file: "0001.txt".to_owned(),
        kind: shot.kind,
        config: shot.config,
        exposure_ms: shot.exposure_ms,
        requested_ms: None,
        repeat: 0,
        visit: 0,
        filter: None,
        exposed: Some(Exposedness {
            peak: mean.map(|m| (1.5 * m).min(1.0)),
            mean,
        }),
        utc: None,
        axes_deg: std::collections::BTreeMap::new(),
        sha256: String::new(),
    };
    let frame = CapturedFrame {
        bytes: vec![0],
        extension: "txt".to_owned(),
        exposure_ms: shot.exposure_ms,
    };
    see(&Seen::Taken(&Taken {
        shot,
        record: &record,
        frame: &frame,
        frames,
        frames_planned: 36,
        remaining_s: 754.0,
    }));
}

fn story(mut see: impl FnMut(&Seen<'_>)) {
    let white = shot(FrameKind::White, None, 50.0);
    see(&Seen::Moving(&white, 4.0));
    see(&Seen::Exposing(&white));
    taken(&white, [0.31, 0.42, 0.4], 1, &mut see);
    let first = shot(FrameKind::Sample, Some(1), 50.0);
    see(&Seen::Moving(&first, 2.0));
    for (exposure, mean) in [(50.0, 0.9), (400.0, 0.95)] {
        let shot = shot(FrameKind::Sample, Some(1), exposure);
        see(&Seen::Exposing(&shot));
        taken(&shot, [mean; 3], 2, &mut see);
    }
    let second = shot(FrameKind::Sample, Some(2), 50.0);
    see(&Seen::Moving(&second, 2.0));
    for exposure in [50.0, 400.0, 800.0] {
        let shot = shot(FrameKind::Sample, Some(2), exposure);
        see(&Seen::Exposing(&shot));
        taken(&shot, [0.05, 0.051, 0.0523], 5, &mut see);
    }
    see(&Seen::Note(
        "configuration 2 is too dark, shot again at 800 ms",
    ));
    let third = shot(FrameKind::Sample, Some(3), 50.0);
    see(&Seen::Moving(&third, 2.0));
    see(&Seen::Exposing(&third));
}

fn text(lines: &[table::Line]) -> String {
    lines
        .iter()
        .map(|l| format!("{}\n", l.text.trim_end()))
        .collect()
}

#[test]
fn the_table_shows_every_place_with_its_state() {
    let mut table = Table::new(&rig(), &plan(), "new-session");
    KEYS.clone_into(&mut table.keys);
    story(|seen| {
        table.see(seen, Duration::from_secs(10));
    });
    let shown = text(&table.lines(80, 14, Duration::from_secs(70)));
    assert_eq!(
        shown,
        "\
rig five_axis_grblhal   plan khungurn16   session new-session
5/36 frames   elapsed 1:10   ETA 11:34   exposing 50 ms
config     light    camera  turn  state     exposures ms         mean r g b   n
 white   45  180    0    0     0  done                50  0.310 0.420 0.400   1
     1   80  180   80    0     0  clipped         50 400  0.950 0.950 0.950   2
     2   64    0   48    0     0  re-shot     50 400 800  0.050 0.051 0.052   3
     3   32  180   32    0     0  exposing                                    0
     4   80  180   32    0     0  waiting                                     0
     5   80  180   80    0    90  waiting                                     0
     6   64    0   48    0    90  waiting                                     0
     7   32  180   32    0    90  waiting                                     0
configuration 2 is too dark, shot again at 800 ms
p pause after shot  space pause now  a abort  h halt  v preview  ? help  Ctrl-C
"
    );
}

#[test]
fn the_table_fits_every_terminal() {
    let mut table = Table::new(&rig(), &plan(), "a/very/long/path".repeat(9).as_str());
    KEYS.clone_into(&mut table.keys);
    story(|seen| {
        table.see(seen, Duration::ZERO);
    });
    for (width, height) in [(80, 24), (200, 60), (60, 10), (40, 5), (20, 2), (1, 1)] {
        let lines = table.lines(width, height, Duration::from_secs(4000));
        assert!(
            lines.len() < height.max(2),
            "{width} x {height}: {}",
            lines.len()
        );
        let longest = lines.iter().map(|l| l.text.chars().count()).max().unwrap();
        assert!(longest < width.max(2), "{width} x {height}: {longest}");
    }
    // All 16 configurations, the white and the darks at once; the active row is always among those shown.
    let whole = text(&table.lines(80, 24, Duration::ZERO));
    assert!(
        whole.contains(" white ") && whole.contains("\n  dark "),
        "{whole}"
    );
    let small = text(&table.lines(60, 8, Duration::ZERO));
    assert!(small.contains("exposing   "), "{small}");
}

#[test]
fn times_and_exposures_are_short() {
    assert_eq!(table::clock(Duration::from_secs(59)), "0:59");
    assert_eq!(table::clock(Duration::from_secs(3725)), "1:02:05");
}

// -- a terminal ---------------------------------------------------------------------------------------------------------

/// A pseudo-terminal with what was written to it.
struct Pty {
    master: Arc<File>,
    slave: File,
    output: Arc<Mutex<Vec<u8>>>,
    gone: Arc<AtomicBool>,
    reader: JoinHandle<()>,
}

impl Pty {
    fn new() -> Self {
        let master =
            openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).unwrap();
        grantpt(&master).unwrap();
        unlockpt(&master).unwrap();
        let name = ptsname(&master, Vec::new()).unwrap();
        let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC;
        let slave = File::from(rustix::fs::open(name, flags, Mode::empty()).unwrap());
        let size = Winsize {
            ws_row: 24,
            ws_col: 80,
            ws_xpixel: 0,
            ws_ypixel: 0,
        };
        tcsetwinsize(&slave, size).unwrap();
        let output = Arc::new(Mutex::new(Vec::new()));
        let master = Arc::new(File::from(master));
        let gone = Arc::new(AtomicBool::new(false));
        let (end, shared, stop) = (master.clone(), output.clone(), gone.clone());
        let reader = std::thread::spawn(move || {
            let look = Timespec {
                tv_sec: 0,
                tv_nsec: 20_000_000,
            };
            let mut buffer = [0; 4096];
            while !stop.load(Ordering::SeqCst) {
                if poll(&mut [PollFd::new(&*end, PollFlags::IN)], Some(&look)) == Ok(1) {
                    let n = (&*end).read(&mut buffer).unwrap();
                    shared.lock().unwrap().extend_from_slice(&buffer[..n]);
                }
            }
        });
        Self {
            master,
            slave,
            output,
            gone,
            reader,
        }
    }

    /// Somebody closes the terminal's window.
    fn hang_up(self) {
        self.gone.store(true, Ordering::SeqCst);
        self.reader.join().unwrap();
        assert_eq!(Arc::strong_count(&self.master), 1);
    }

    fn slave(&self) -> File {
        self.slave.try_clone().unwrap()
    }

    fn press(&self, keys: &str) {
        (&*self.master).write_all(keys.as_bytes()).unwrap();
    }

    fn written(&self) -> String {
        String::from_utf8_lossy(&self.output.lock().unwrap()).into_owned()
    }

    /// What stands on a terminal that got these bytes: a line each, without end.
    fn shown(&self) -> Vec<String> {
        let mut lines = vec![String::new()];
        let mut row = 0;
        let text = self.written();
        let mut rest = text.as_str();
        while let Some(c) = rest.chars().next() {
            rest = &rest[c.len_utf8()..];
            match c {
                '\r' => {}
                '\n' => {
                    row += 1;
                    if row == lines.len() {
                        lines.push(String::new());
                    }
                }
                '\x1b' => {
                    let end = rest.find(|c: char| c.is_ascii_alphabetic()).unwrap();
                    let (argument, command) = (&rest[1..end], &rest[end..=end]);
                    rest = &rest[end + 1..];
                    match command {
                        "A" => row -= argument.parse::<usize>().unwrap(),
                        // A line is written from its start to its end.
                        "K" => lines[row] = lines[row].split('\0').next_back().unwrap().to_owned(),
                        "J" => lines.truncate(row + 1),
                        "m" | "h" | "l" => {}
                        other => panic!("an escape sequence nobody knows: {other}"),
                    }
                    if command == "A" {
                        for line in &mut lines[row..] {
                            line.push('\0');
                        }
                    }
                }
                c => lines[row].push(c),
            }
        }
        lines
    }

    fn wait_for(&self, what: &str) {
        let begun = Instant::now();
        while !self.written().contains(what) {
            assert!(
                begun.elapsed() < PATIENCE,
                "never shown: {what}\n{}",
                self.written()
            );
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    fn is_as_before(&self) -> bool {
        let modes = tcgetattr(&self.slave).unwrap().local_modes;
        modes.contains(LocalModes::ICANON | LocalModes::ECHO)
    }
}

fn screen_on(pty: &Pty, session: &Path, yes: bool) -> Screen {
    let (rig, plan) = (rig(), plan());
    let setup = Setup {
        rig: &rig,
        plan: &plan,
        session,
        yes,
    };
    Screen::on(&setup, Some(pty.slave()), pty.slave(), true)
}

fn wait_until(what: &str, condition: impl Fn() -> bool) {
    let begun = Instant::now();
    while !condition() {
        assert!(begun.elapsed() < PATIENCE, "never: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

#[test]
fn keys_ask_for_what_they_say_and_the_hook_hears_the_urgent_ones() {
    let pty = Pty::new();
    let screen = screen_on(&pty, Path::new("s"), false);
    let heard = Arc::new(Mutex::new(Vec::new()));
    let ear = heard.clone();
    screen.on_stop(Box::new(move |r| ear.lock().unwrap().push(r)));
    assert_eq!(screen.request(), Request::Go);
    // Unknown keys, and cursor keys that some terminals send with an 'a' or an 'h' in them, ask for nothing.
    pty.press("xyz\x1bOa\x1b[1;2h\x1ba\x1b[Ap");
    wait_until("pause", || screen.request() == Request::Pause);
    assert!(screen.cancelled() && !screen.urgent());
    let begun = Instant::now();
    pty.press(" ");
    wait_until("pause now", || screen.urgent());
    pty.press("a");
    wait_until("abort", || screen.request() == Request::Abort);
    pty.press("ph");
    wait_until("halt", || screen.request() == Request::Halt);
    assert!(
        begun.elapsed() < Duration::from_secs(2),
        "{:?}",
        begun.elapsed()
    );
    assert_eq!(
        *heard.lock().unwrap(),
        [Request::PauseNow, Request::Abort, Request::Halt]
    );
}

#[test]
fn a_pause_waits_for_the_key_that_ends_it() {
    for (key, go_on, request) in [
        ("c", true, Request::Go),
        ("a", false, Request::Abort),
        ("h", false, Request::Halt),
    ] {
        let pty = Pty::new();
        let screen = screen_on(&pty, Path::new("s"), false);
        pty.press("p");
        wait_until("pause", || screen.cancelled());
        std::thread::scope(|scope| {
            let pause = scope.spawn(|| screen.paused());
            pty.wait_for("PAUSED");
            assert!(!pause.is_finished());
            pty.press(key);
            assert_eq!(pause.join().unwrap(), go_on, "{key}");
        });
        assert_eq!(screen.request(), request);
    }
}

#[test]
fn questions_are_answered_by_keys_or_by_yes_or_by_nobody() {
    let pty = Pty::new();
    let screen = screen_on(&pty, Path::new("s"), false);
    for (key, answer) in [("\r", None), ("y", None), ("n", Some("declined"))] {
        std::thread::scope(|scope| {
            let asked = scope.spawn(|| screen.confirm("put the sample in place"));
            pty.wait_for("put the sample in place [Enter = done, n = stop]");
            wait_until("asked", || *locked(&screen.shared.asked) == Asked::Waiting);
            pty.press(key);
            let said = asked.join().unwrap().err().map(|e| e.report());
            assert_eq!(said.is_some(), answer.is_some(), "{said:?}");
            assert!(
                said.unwrap_or_default()
                    .contains(answer.unwrap_or_default())
            );
        });
    }
    // A request to end counts more than the answer.
    std::thread::scope(|scope| {
        let asked = scope.spawn(|| screen.confirm("is it there"));
        wait_until("asked", || *locked(&screen.shared.asked) == Asked::Waiting);
        pty.press("a");
        let error = asked.join().unwrap().unwrap_err();
        assert!(error.report().contains("stopped by the operator"));
    });
    drop(screen);
    let screen = screen_on(&pty, Path::new("s"), true);
    screen.confirm("all in place").unwrap();
    drop(screen);
    let (rig, plan) = (rig(), plan());
    let setup = Setup {
        rig: &rig,
        plan: &plan,
        session: Path::new("s"),
        yes: false,
    };
    let screen = Screen::on(&setup, None, pty.slave(), true);
    let error = screen.confirm("all in place").unwrap_err();
    assert!(error.report().contains("nobody is there") && error.report().contains("--yes"));
    assert!(!screen.paused(), "nobody can end a pause");
}

#[test]
fn the_table_is_redrawn_in_place_and_the_terminal_left_as_it_was() {
    let pty = Pty::new();
    assert!(pty.is_as_before());
    let screen = screen_on(&pty, Path::new("new-session"), false);
    assert!(!pty.is_as_before(), "keys come without Enter");
    for i in 0..5 {
        screen.say(format!("talk {i}"));
        std::thread::sleep(Duration::from_millis(60));
    }
    story(|seen| screen.seen(seen));
    pty.wait_for("exposing   ");
    pty.press("?");
    pty.wait_for("cuts the motors' power");
    drop(screen);
    wait_until("the last bytes", || pty.written().contains("\x1b[?25h"));
    assert!(pty.is_as_before());
    let written = pty.written();
    let (hidden, back) = (written.rfind("\x1b[?25l"), written.rfind("\x1b[?25h"));
    assert!(hidden < back, "the cursor is back");
    let shown = pty.shown();
    let count = |what: &str| shown.iter().filter(|l| l.contains(what)).count();
    assert_eq!(count("rig five_axis_grblhal"), 1, "{shown:#?}");
    assert_eq!(
        (count("talk 0"), count("talk 4"), count(" white ")),
        (1, 1, 1)
    );
    let at = |what: &str| shown.iter().position(|l| l.contains(what)).unwrap();
    assert!(
        at("talk 4") < at("rig five_axis"),
        "talk scrolls away above the table"
    );
}

#[test]
fn a_preview_that_cannot_be_made_is_told() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::create_dir(folder.path().join("frames")).unwrap();
    std::fs::write(folder.path().join("frames/0001.txt"), b"no picture").unwrap();
    let pty = Pty::new();
    let screen = screen_on(&pty, folder.path(), false);
    pty.press("v");
    pty.wait_for("there is no frame yet");
    story(|seen| screen.seen(seen));
    pty.press("v");
    pty.wait_for("no preview: ");
    assert_eq!(screen.request(), Request::Go);
}

// -- a process of its own -----------------------------------------------------------------------------------------------

/// Not a test: what the tests below run in a process of its own, to send it real signals.
#[test]
#[ignore = "run by other tests"]
fn child() {
    let Ok(mode) = std::env::var("GONIOFIT_SCREEN_CHILD") else {
        return;
    };
    let (rig, plan) = (rig(), plan());
    let setup = Setup {
        rig: &rig,
        plan: &plan,
        session: Path::new("s"),
        yes: false,
    };
    let screen = Screen::new(&setup).unwrap();
    story(|seen| screen.seen(seen));
    screen.say("the child is ready");
    assert!(mode != "panic", "as asked for");
    let begun = Instant::now();
    let mut code = 0;
    while begun.elapsed() < PATIENCE && code == 0 {
        std::thread::sleep(Duration::from_millis(10));
        code = match screen.request() {
            _ if mode == "deaf" => 0,
            Request::Pause | Request::PauseNow if !screen.paused() => 1,
            Request::Go | Request::Pause | Request::PauseNow => 0,
            Request::Abort => 3,
            Request::Halt => 4,
        };
        // As a capture does: what became of the pause is asked for again.
        if code == 1 && screen.request() >= Request::Abort {
            code = 0;
        }
    }
    drop(screen);
    std::process::exit(code);
}

struct Process(Child);

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

impl Process {
    fn new(mode: &str, stdin: Stdio, stderr: Stdio) -> Self {
        let mut command = Command::new(std::env::current_exe().unwrap());
        command.args([
            "--exact",
            "cli::screen::tests::child",
            "--ignored",
            "--nocapture",
        ]);
        command
            .env("GONIOFIT_SCREEN_CHILD", mode)
            .env("NO_COLOR", "1");
        command.env("TERM", "xterm");
        command.stdin(stdin).stdout(Stdio::null()).stderr(stderr);
        Self(command.spawn().unwrap())
    }

    fn on(mode: &str, pty: &Pty) -> Self {
        let process = Self::new(mode, pty.slave().into(), pty.slave().into());
        pty.wait_for("the child is ready");
        process
    }

    fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.0), signal).unwrap();
    }

    fn code(&mut self) -> i32 {
        let begun = Instant::now();
        while begun.elapsed() < PATIENCE {
            if let Some(status) = self.0.try_wait().unwrap() {
                return status.code().expect("it ended by itself");
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        panic!("still running");
    }
}

#[test]
fn signals_pause_then_abort() {
    let pty = Pty::new();
    let mut process = Process::on("obey", &pty);
    process.signal(Signal::INT);
    pty.wait_for("PAUSED");
    pty.press("c");
    pty.wait_for("going on");
    process.signal(Signal::TERM);
    pty.wait_for("pausing after the current shot");
    process.signal(Signal::INT);
    assert_eq!(process.code(), 3);
    assert!(pty.is_as_before() && pty.written().ends_with("\x1b[?25h"));
    assert!(!pty.written().contains("\x1b[1m"), "NO_COLOR");
}

#[test]
fn the_third_signal_halts_and_the_fourth_ends_the_program_with_the_terminal_restored() {
    let pty = Pty::new();
    let mut process = Process::on("deaf", &pty);
    for told in ["pausing after", "stopping the rig now", "halting; a fourth"] {
        process.signal(Signal::INT);
        pty.wait_for(told);
    }
    assert!(!pty.is_as_before());
    process.signal(Signal::INT);
    assert_eq!(process.code(), 130);
    wait_until("the cursor", || pty.written().ends_with("\x1b[?25h"));
    assert!(pty.is_as_before());
}

#[test]
fn a_panic_leaves_the_terminal_as_it_was() {
    let pty = Pty::new();
    let mut process = Process::on("panic", &pty);
    assert_ne!(process.code(), 0);
    wait_until("the cursor", || pty.written().contains("\x1b[?25h"));
    assert!(pty.is_as_before());
}

#[test]
fn without_a_terminal_there_are_plain_lines_and_a_pause_is_an_end() {
    let mut process = Process::new("obey", Stdio::null(), Stdio::piped());
    let mut stderr = process.0.stderr.take().unwrap();
    let said = std::thread::spawn(move || {
        let mut text = String::new();
        stderr.read_to_string(&mut text).unwrap();
        text
    });
    // The process takes over the signals before it says a word.
    std::thread::sleep(Duration::from_secs(2));
    process.signal(Signal::HUP);
    assert_eq!(process.code(), 1);
    let said = said.join().unwrap();
    assert!(!said.contains('\x1b'), "{said:?}");
    for line in [
        "configuration 2: light 64.0 0.0, camera 48.0 0.0, turntable 0.0\n",
        "configuration 2 is too dark, shot again at 800 ms\n",
        "stopping after the current shot",
    ] {
        assert!(said.contains(line), "{said}");
    }
}

#[test]
fn a_terminal_that_goes_away_ends_a_pause() {
    let pty = Pty::new();
    let mut process = Process::on("obey", &pty);
    process.signal(Signal::INT);
    pty.wait_for("PAUSED");
    pty.hang_up();
    assert_eq!(process.code(), 1);
}
