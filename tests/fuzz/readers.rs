//! One function for each reader of files that come from outside. Whatever the bytes, a reader returns; what it accepts is
//! as good as what was written by the program itself.

use goniofit::measure::calibration::Calibrations;
use goniofit::rig::capture::{Order, plan_capture};
use goniofit::rig::{History, RigDescription, parse_wire_log};
use goniofit::session::{
    Event, FrameRecord, Measurements, Plan, SessionFolder, read_journal, sha256,
};
use std::path::Path;

/// Takes the bytes of a file.
pub(crate) type Reader = fn(&[u8]);

/// Each with the name of its target.
pub(crate) const READERS: [(&str, Reader); 6] = [
    ("journal", journal),
    ("rig", rig),
    ("plan", plan),
    ("calibration", calibration),
    ("measurements", measurements),
    ("frame", frame),
];

const RIG: &str = include_str!("../../rig_configs/virtual.toml");
const PLAN: &str = include_str!("../../rig_configs/plans/khungurn16.toml");

/// Calls with a folder that is there once per thread; in memory where the system has such a place.
fn in_folder(work: impl FnOnce(&Path)) {
    thread_local! {
        static FOLDER: tempfile::TempDir = {
            let memory = Path::new("/dev/shm");
            let made = if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() };
            made.expect("a temporary folder")
        };
    }
    FOLDER.with(|folder| work(folder.path()));
}

fn write(path: &Path, bytes: &[u8]) {
    std::fs::write(path, bytes).expect("a temporary file");
}

/// A journal; what it tells a capture that goes on from it.
pub(crate) fn journal(bytes: &[u8]) {
    in_folder(|folder| {
        let path = folder.join("journal.jsonl");
        write(&path, bytes);
        let Ok(entries) = read_journal(&path) else {
            return;
        };
        let again: Vec<_> = entries
            .iter()
            .map(|e| serde_json::to_string(e).expect("an entry is written"))
            .collect();
        write(&path, (again.join("\n") + "\n").as_bytes());
        assert_eq!(
            read_journal(&path).expect("what was read is written again"),
            entries
        );
        let rig = RigDescription::from_toml(RIG).expect("the rig file");
        let plan = Plan::from_toml(PLAN).expect("the plan");
        let work = plan_capture(&rig, &plan, Order::Plan).expect("a plan within reach");
        let history = History::of(&entries);
        let _ = work.next(&history);
        let _ = work.badly_exposed(&history);
        for entry in &entries {
            if let Event::Frame(FrameRecord { file, .. }) = &entry.event {
                assert!(!file.is_empty());
            }
        }
    });
}

/// A rig file, and the dialogue log that lies beside its copy in a session.
pub(crate) fn rig(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else {
        return;
    };
    if let Ok(rig) = RigDescription::from_toml(text) {
        let plan = Plan::from_toml(PLAN).expect("the plan");
        let _ = rig.plan_angles(&plan);
    }
    let _ = parse_wire_log(text);
}

/// A plan; what is accepted survives the round trip.
pub(crate) fn plan(bytes: &[u8]) {
    let Ok(text) = std::str::from_utf8(bytes) else {
        return;
    };
    if let Ok(plan) = Plan::from_toml(text) {
        let again = plan.to_toml().expect("a plan is written");
        let again = Plan::from_toml(&again).expect("what was read is written again");
        assert_eq!(again.configurations.len(), plan.configurations.len());
    }
}

/// Calibration files: the first byte says of which kind. A flat field is followed by its map: everything after a zero byte.
pub(crate) fn calibration(bytes: &[u8]) {
    const KINDS: [&str; 7] = [
        "dark",
        "linearity",
        "flat",
        "white",
        "color",
        "geometry",
        "drift",
    ];
    let Some((first, bytes)) = bytes.split_first() else {
        return;
    };
    let kind = KINDS[usize::from(*first) % KINDS.len()];
    let (json, map) = match bytes.iter().position(|b| *b == 0) {
        Some(at) => (&bytes[..at], &bytes[at + 1..]),
        None => (bytes, &[][..]),
    };
    in_folder(|folder| {
        for old in std::fs::read_dir(folder).expect("the folder").flatten() {
            let _ = std::fs::remove_file(old.path());
        }
        // The hash would keep every changed map out.
        let json = String::from_utf8_lossy(json).replace("SHA256", &sha256(map));
        write(
            &folder.join(format!("2026-01-01_{kind}.json")),
            json.as_bytes(),
        );
        write(&folder.join("map.exr"), map);
        let _ = Calibrations::read(folder);
    });
}

/// Measurements, and the manifest of their session: a first byte `{` means a manifest.
pub(crate) fn measurements(bytes: &[u8]) {
    if bytes.first() == Some(&b'{') {
        in_folder(|folder| {
            write(&folder.join("session.json"), bytes);
            let session = SessionFolder::open(folder).expect("a manifest is there");
            let _ = session.manifest();
        });
        return;
    }
    let Ok(text) = std::str::from_utf8(bytes) else {
        return;
    };
    if let Ok(measured) = Measurements::from_csv(text) {
        let again = measured.to_csv().expect("measurements are written");
        Measurements::from_csv(&again).expect("what was read is written again");
    }
}

/// A frame of any kind.
pub(crate) fn frame(bytes: &[u8]) {
    if let Ok(frame) = goniofit::measure::decode(bytes) {
        let values = frame.width * frame.height * frame.layout.values_per_pixel();
        assert_eq!(frame.data.len(), values);
        assert!(frame.black.iter().all(|b| b.is_finite()));
    }
}
