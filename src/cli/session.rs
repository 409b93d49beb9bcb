//! `goniofit session import`: frames that another program took become a session.

mod list;
mod setup;

use super::Outcome;
use super::capture::{host_name, own_sha256};
use super::output::data;
use super::terminal::Terminal;
use crate::base::{Context, Error, Result, Watch};
use crate::measure::{RawFrame, decode};
use crate::rig::capture::config_sha256;
use crate::rig::utc_now;
use crate::session::{
    CameraFacts, Event, FrameRecord, Layout, Manifest, Plan, Provenance, SessionFolder, files,
    sha256,
};
use clap::{Args, Subcommand};
use list::Row;
use rayon::prelude::*;
use setup::Setup;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// Make session folders of frames taken elsewhere
#[derive(Args)]
#[command(after_help = "Examples:
  goniofit session import frames.csv --plan plan.toml --rig rig.toml --out session
  goniofit session import frames.csv --plan plan.toml --camera camera.toml --out session")]
pub(crate) struct Arguments {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    Import(ImportArguments),
}

/// Copy the frames of a list into a new session folder, each decoded, checked and journaled with its SHA-256
///
/// Nothing is moved or changed, and nothing is left behind when a frame is refused or the import is interrupted.
#[derive(Args)]
#[command(
    after_help = "LIST.csv has one row per frame, and a header. Only file and kind are needed in every row:
  file         path, relative to the list
  kind         sample, dark, white, reference, flat, chart or board
  config       the plan's configuration; needed for samples
  exposure_ms  exposure time; where it is empty, EXIF's is taken
  repeat       0, 1, ... for shots of the same thing; where it is empty, they are counted
  visit        0, 1, ... which visit of the reference pose
  filter       r, g or b: the filter in front of a monochrome camera
  elapsed_s    seconds since the first shot: all rows or none
  utc          time of the shot, for the record

  file,kind,config,exposure_ms,filter
  dark_1.tif,dark,,20,
  white_r.tif,white,,20,r
  pose1_r.tif,sample,1,20,r

CAMERA.toml is what a rig file says of camera, white standard and light, without the machine:
  name = \"old gonioreflectometer\"
  [camera]
  name = \"maker and model\"
  pixel_mm = 0.02            # on a plane through the sample center, per pixel
  sample_square_mm = 10.0
  center_px = [2000, 1500]   # image of the sample center; default: the middle
  [white]
  light_theta_deg = 45.0     # the geometry the standard was shot at, and its factor there
  light_phi_deg = 180.0
  camera_theta_deg = 0.0
  camera_phi_deg = 0.0
  reflectance_factor = [1.03, 1.03, 1.03]
  reflectance_factor_se = [0.005, 0.005, 0.005]
  [light]                    # only fitting needs it
  size_mm = [100.0, 100.0]
  distance_mm = 610.0

Files: camera RAW, DNG, linear 16-bit TIFF, PNG and FITS (docs/cameras.md).

Examples:
  goniofit session import frames.csv --plan plan.toml --rig rig.toml --out session
  goniofit session import frames.csv --plan plan.toml --camera camera.toml --out session --note 'June, cloth 3'
  goniofit measure session session"
)]
struct ImportArguments {
    /// List of frames (CSV)
    list: PathBuf,
    /// Plan: the configurations that were visited
    #[arg(long, value_name = "PLAN.toml")]
    plan: PathBuf,
    /// Description of camera, white standard and light
    #[arg(
        long,
        value_name = "CAMERA.toml",
        conflicts_with = "rig",
        required_unless_present = "rig"
    )]
    camera: Option<PathBuf>,
    /// Rig description to take them from
    #[arg(long, value_name = "RIG.toml")]
    rig: Option<PathBuf>,
    /// New session folder
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// The frames were computed: no camera saw any cloth
    #[arg(long)]
    synthetic: bool,
    /// Free text for the session's manifest
    #[arg(long, default_value = "")]
    note: String,
}

pub(crate) fn run(arguments: Arguments) -> Result<Outcome> {
    super::measure::quiet_decoder_panics();
    let What::Import(arguments) = arguments.what;
    import(&arguments)
}

fn import(arguments: &ImportArguments) -> Result<Outcome> {
    let plan = Plan::read(&arguments.plan)?;
    let setup = Setup::read(arguments.rig.as_deref(), arguments.camera.as_deref())?;
    refuse(&arguments.out)?;
    let rows = list::read(&arguments.list, &plan)?;
    let terminal = Terminal::new()?;
    let seen = look(&rows, &terminal)?;
    check_alike(&rows, &seen)?;
    let records = list::records(&rows, &seen)?;
    for warning in warnings(&rows, &seen) {
        terminal.say(format!("warning: {warning}"));
    }
    let manifest = manifest(arguments, &setup, &plan, &rows, &seen[0], &records)?;
    write(
        arguments,
        &manifest,
        &plan,
        &setup.text,
        &rows,
        &records,
        &terminal,
    )?;
    terminal.say(format!(
        "{} frames of {} x {} pixels, {}; next: goniofit measure session {}",
        rows.len(),
        seen[0].size[0],
        seen[0].size[1],
        seen[0].layout,
        arguments.out.display()
    ));
    data!("{}", arguments.out.display());
    Ok(Outcome::Done)
}

/// Passes a folder that is not there, or empty.
fn refuse(out: &Path) -> Result<()> {
    SessionFolder::refuse_existing(out)?;
    let empty = std::fs::read_dir(out).is_ok_and(|mut entries| entries.next().is_none());
    if empty || !out.exists() {
        return Ok(());
    }
    Err(Error::new(format!(
        "{} exists and is not an empty folder",
        out.display()
    ))
    .with_hint("choose another --out"))
}

/// What a frame's file says.
struct Seen {
    size: [usize; 2],
    layout: Layout,
    white: u16,
    camera: String,
    iso: Option<u32>,
    exposure_ms: Option<f64>,
    sha256: String,
    /// The largest value, and how many pixels have it.
    largest: (u16, usize),
}

impl Seen {
    fn of(frame: &RawFrame, bytes: &[u8]) -> Self {
        let largest = frame.data.iter().copied().max().unwrap_or(0);
        let count = frame.data.iter().filter(|&&v| v == largest).count();
        Self {
            size: [frame.width, frame.height],
            layout: frame.layout,
            white: frame.white,
            camera: format!("{} {}", frame.make, frame.model).trim().to_owned(),
            iso: frame.iso,
            exposure_ms: frame.exposure_ms,
            sha256: sha256(bytes),
            largest: (largest, count),
        }
    }

    fn camera(&self) -> String {
        let iso = self.iso.map_or("unknown".to_owned(), |i| i.to_string());
        format!(
            "{} x {} pixels, {}, white level {}, camera '{}', sensitivity {iso}",
            self.size[0], self.size[1], self.layout, self.white, self.camera
        )
    }
}

fn read(row: &Row) -> Result<Vec<u8>> {
    std::fs::read(&row.path).context(|| format!("{} cannot be read", row.title()))
}

/// Decodes every frame once.
fn look(rows: &[Row], terminal: &Terminal) -> Result<Vec<Seen>> {
    let done = AtomicU64::new(0);
    let one = |row: &Row| {
        interrupted(terminal)?;
        let bytes = read(row)?;
        let frame = decode(&bytes).context(|| format!("{} cannot be decoded", row.title()))?;
        let n = done.fetch_add(1, Ordering::Relaxed) + 1;
        terminal.progress("checking frames", n, rows.len() as u64);
        Ok(Seen::of(&frame, &bytes))
    };
    let seen: Vec<Result<Seen>> = rows.par_iter().map(one).collect();
    terminal.finish_stage();
    seen.into_iter().collect()
}

fn interrupted(watch: &dyn Watch) -> Result<()> {
    if watch.cancelled() {
        return Err(Error::new(
            "the import was interrupted; nothing was written",
        ));
    }
    Ok(())
}

/// All frames of a session come from one camera at one setting.
fn check_alike(rows: &[Row], seen: &[Seen]) -> Result<()> {
    for (row, one) in rows.iter().zip(seen) {
        if one.camera() != seen[0].camera() {
            return Err(Error::new(format!(
                "{} has {}; {} has {}",
                row.title(),
                one.camera(),
                rows[0].title(),
                seen[0].camera()
            ))
            .with_hint("all frames of a session must come from one camera at one setting"));
        }
    }
    Ok(())
}

/// What the operator should know though it is no error.
fn warnings(rows: &[Row], seen: &[Seen]) -> Vec<String> {
    let mut warnings = Vec::new();
    let reference = rows
        .iter()
        .any(|r| r.kind == crate::session::FrameKind::Reference);
    if reference && rows.iter().all(|r| r.elapsed_s.is_none()) {
        warnings.push(
            "the list has no elapsed_s: the lamp is followed as if all frames were shot at equal intervals"
                .to_owned(),
        );
    }
    // Many pixels at the largest value of fewer bits: saturated there, whatever the file says.
    let brightest = seen.iter().max_by_key(|s| s.largest);
    if let Some(Seen {
        largest: (value, count),
        white,
        ..
    }) = brightest
        && value < white
        && *count >= 10
        && (u32::from(*value) + 1).is_power_of_two()
    {
        warnings.push(format!(
            "no value is above {value}, which {count} pixels have, but the files state a white level of {white}: if the \
             camera saturates at {value}, saturated frames will not be recognized; state it in the files (TIFF tag \
             MaxSampleValue, FITS keyword SATURATE)"
        ));
    }
    warnings
}

fn manifest(
    arguments: &ImportArguments,
    setup: &Setup,
    plan: &Plan,
    rows: &[Row],
    first: &Seen,
    records: &[FrameRecord],
) -> Result<Manifest> {
    let [width, height] = first.size;
    if let Some(size) = setup.camera.size_px
        && size != first.size
    {
        return Err(Error::new(format!(
            "the frames have {width} x {height} pixels, the rig file states camera.size_px = {size:?}"
        ))
        .with_hint("give the rig file of the camera that took the frames"));
    }
    let mut exposures: Vec<f64> = records
        .iter()
        .filter(|r| r.kind == crate::session::FrameKind::Sample)
        .map(|r| r.exposure_ms)
        .collect();
    exposures.sort_by(f64::total_cmp);
    exposures.dedup();
    let started = rows.iter().find_map(|r| r.utc.clone());
    Ok(Manifest {
        format: Manifest::FORMAT.to_owned(),
        program: format!("goniofit {}", env!("CARGO_PKG_VERSION")),
        started_utc: started.unwrap_or_else(utc_now),
        note: format!(
            "{} [imported from {}]",
            arguments.note,
            arguments.list.display()
        )
        .trim()
        .to_owned(),
        synthetic: arguments.synthetic,
        rig: setup.name.clone(),
        camera: CameraFacts {
            name: setup.camera.name.clone(),
            width,
            height,
            pixel_mm: setup.camera.pixel_mm,
            center_px: setup
                .camera
                .center_px
                .unwrap_or([width, height].map(|n| n as f64 / 2.0)),
            lens: Default::default(),
        },
        white: setup.white.reference(plan),
        sample_square_mm: setup.camera.sample_square_mm,
        exposures_ms: exposures,
        provenance: Provenance {
            config_sha256: config_sha256(&setup.text, plan)?,
            program_sha256: own_sha256(),
            host: host_name(),
            ..Provenance::default()
        },
    })
}

/// Writes the session beside its place and moves it there once it is whole.
fn write(
    arguments: &ImportArguments,
    manifest: &Manifest,
    plan: &Plan,
    rig_toml: &str,
    rows: &[Row],
    records: &[FrameRecord],
    terminal: &Terminal,
) -> Result<()> {
    let out = &arguments.out;
    let name = out
        .file_name()
        .ok_or_else(|| Error::new("--out names no folder"))?;
    let beside = out.with_file_name(format!(".{}.import", name.to_string_lossy()));
    let what = || format!("{} cannot be written", beside.display());
    if beside.exists() {
        // Of an import that was killed: copies only.
        std::fs::remove_dir_all(&beside).context(what)?;
    }
    let written = (|| {
        let (session, mut journal) = SessionFolder::create(&beside, manifest, plan, rig_toml)?;
        session.manifest()?;
        let list = std::fs::read(&arguments.list).context(what)?;
        files::write_atomic(&beside.join("import.csv"), &list)?;
        let ready = Event::Ready {
            firmware: "imported".to_owned(),
            utc: None,
        };
        let start = rows.first().and_then(|r| r.elapsed_s).unwrap_or(0.0);
        journal.append(start, ready)?;
        let mut end = start;
        for (n, (row, record)) in rows.iter().zip(records).enumerate() {
            interrupted(terminal)?;
            let bytes = read(row)?;
            end = row.elapsed_s.unwrap_or(n as f64);
            let added = session.add_frame(&mut journal, end, record.clone(), &bytes)?;
            if added.sha256 != record.sha256 {
                return Err(Error::new(format!(
                    "{} changed while it was read",
                    row.title()
                )));
            }
            terminal.progress("copying frames", n as u64 + 1, rows.len() as u64);
        }
        terminal.finish_stage();
        journal.append(end, Event::Finished)?;
        std::fs::rename(&beside, out).context(|| format!("{} cannot be made", out.display()))
    })();
    if written.is_err() {
        // The error is what matters; copies that stay behind are taken away by the next import.
        let _ = std::fs::remove_dir_all(&beside);
    }
    written
}
