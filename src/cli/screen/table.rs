//! What the screen shows, as text: pure, from what was seen and a size in characters.

use crate::rig::{AxisName, Metering, RigDescription, Seen, Shot, Taken};
use crate::session::{Configuration, FrameKind, Plan};
use std::time::Duration;

/// A channel counts as clipped from this fraction of full scale on.
const CLIPPED: f64 = 0.99;

/// How a line is to look, if colors are wanted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Style {
    Plain,
    Bold,
    Faint,
    Good,
    Warning,
    Bad,
}

/// One line of the screen.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Line {
    pub(super) text: String,
    pub(super) style: Style,
}

fn line(text: impl Into<String>, style: Style) -> Line {
    Line {
        text: text.into(),
        style,
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    Waiting,
    Moving,
    Exposing,
    Done,
    Reshot,
    Clipped,
}

impl State {
    fn name(self) -> &'static str {
        match self {
            Self::Waiting => "waiting",
            Self::Moving => "moving",
            Self::Exposing => "exposing",
            Self::Done => "done",
            Self::Reshot => "re-shot",
            Self::Clipped => "clipped",
        }
    }

    fn style(self) -> Style {
        match self {
            Self::Waiting => Style::Faint,
            Self::Moving | Self::Exposing => Style::Bold,
            Self::Done => Style::Good,
            Self::Reshot => Style::Warning,
            Self::Clipped => Style::Bad,
        }
    }
}

/// What a row stands for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Place {
    White,
    Reference,
    Configuration(u32),
    Dark,
}

impl Place {
    fn of(shot: &Shot) -> Self {
        match (shot.kind, shot.config) {
            (FrameKind::White, _) => Self::White,
            (FrameKind::Reference, _) => Self::Reference,
            (FrameKind::Dark, _) | (_, None) => Self::Dark,
            (_, Some(id)) => Self::Configuration(id),
        }
    }

    fn name(self) -> String {
        match self {
            Self::White => "white".to_owned(),
            Self::Reference => "ref".to_owned(),
            Self::Configuration(id) => id.to_string(),
            Self::Dark => "dark".to_owned(),
        }
    }
}

#[derive(Debug)]
struct Row {
    place: Place,
    pose: Option<Configuration>,
    state: State,
    /// Exposures of the measured frames, ms, in the order they were first taken.
    exposures_ms: Vec<f64>,
    mean: Option<[f64; 3]>,
    frames: usize,
    /// Measured frames of which no channel clipped.
    unclipped: usize,
}

impl Row {
    fn new(place: Place, pose: Option<Configuration>) -> Self {
        Self {
            place,
            pose,
            state: State::Waiting,
            exposures_ms: Vec::new(),
            mean: None,
            frames: 0,
            unclipped: 0,
        }
    }

    /// What it ends as when the rig goes on to another place.
    fn ended(&self, exposures_planned: usize) -> State {
        if self.frames == 0 {
            State::Waiting
        } else if self.unclipped == 0 {
            State::Clipped
        } else if self.exposures_ms.len() > exposures_planned {
            State::Reshot
        } else {
            State::Done
        }
    }

    fn text(&self, wide: bool) -> String {
        let degrees = |radians: f64| format!("{:.0}", radians.to_degrees() + 0.0);
        let [light, camera, turn] = match self.pose {
            None => [const { String::new() }; 3],
            Some(c) => [
                format!("{:>3} {:>4}", degrees(c.light.theta), degrees(c.light.phi)),
                format!(
                    "{:>3} {:>4}",
                    degrees(c.camera.theta),
                    degrees(c.camera.phi)
                ),
                degrees(c.rotation),
            ],
        };
        let mean = self.mean.map_or(String::new(), |m| {
            format!("{:.3} {:.3} {:.3}", m[0], m[1], m[2])
        });
        let exposures = exposures(&self.exposures_ms);
        let pose = if wide {
            format!("{light:>8}  {camera:>8} {turn:>5}  ")
        } else {
            String::new()
        };
        format!(
            "{:>6}  {pose}{:<8}  {exposures:>12}  {mean:>17} {:>3}",
            self.place.name(),
            self.state.name(),
            self.frames,
        )
    }
}

/// The last exposures that fit into a column.
fn exposures(all_ms: &[f64]) -> String {
    let mut text = String::new();
    for (i, ms) in all_ms.iter().enumerate().rev() {
        let next = if *ms >= 100.0 {
            format!("{ms:.0}")
        } else {
            format!("{}", (ms * 100.0).round() / 100.0)
        };
        let longer = if text.is_empty() {
            next
        } else {
            format!("{next} {text}")
        };
        if longer.len() > if i == 0 { 12 } else { 9 } && !text.is_empty() {
            return format!(".. {text}");
        }
        text = longer;
    }
    text
}

/// Minutes and seconds, with hours when there are any.
pub(super) fn clock(time: Duration) -> String {
    let s = time.as_secs();
    if s >= 3600 {
        format!("{}:{:02}:{:02}", s / 3600, s / 60 % 60, s % 60)
    } else {
        format!("{}:{:02}", s / 60, s % 60)
    }
}

/// Everything that is shown.
pub(super) struct Table {
    heading: String,
    rows: Vec<Row>,
    active: Option<usize>,
    exposures_planned: usize,
    frames: usize,
    frames_planned: usize,
    /// Time to the end, and when it was told, from the start.
    remaining: Option<(f64, Duration)>,
    /// What the rig is doing as a whole.
    pub(super) status: String,
    note: String,
    /// The last line: keys, or a question.
    pub(super) keys: String,
}

impl Table {
    pub(super) fn new(rig: &RigDescription, plan: &Plan, session: &str) -> Self {
        let white = rig.white.configuration(0);
        let mut rows = vec![Row::new(Place::White, Some(white))];
        if rig.lamp.reference_every > 0 {
            rows.push(Row::new(Place::Reference, Some(white)));
        }
        let each = plan.configurations.iter();
        rows.extend(each.map(|c| Row::new(Place::Configuration(c.id), Some(*c))));
        rows.push(Row::new(Place::Dark, None));
        let camera = &rig.camera;
        Self {
            heading: format!("rig {}   plan {}   session {session}", rig.name, plan.name),
            rows,
            active: None,
            exposures_planned: match camera.metering {
                Metering::Fixed => camera.exposures_ms.len(),
                Metering::Metered => camera.exposures_ms.len().min(camera.bracket as usize),
            },
            frames: 0,
            frames_planned: 0,
            remaining: None,
            status: String::new(),
            note: String::new(),
            keys: String::new(),
        }
    }

    /// Takes in what was seen `elapsed` after the start; returns a line worth a place in a log.
    pub(super) fn see(&mut self, seen: &Seen<'_>, elapsed: Duration) -> Option<String> {
        match seen {
            Seen::Moving(shot, seconds) => {
                self.status = format!("moving, about {seconds:.0} s");
                self.enter(shot, State::Moving)
            }
            Seen::Begins { frames, seconds } => {
                self.frames_planned = *frames;
                self.remaining = Some((*seconds, elapsed));
                None
            }
            Seen::WarmingUp(seconds) => {
                self.status = format!("lamp warming up, {seconds:.0} s");
                Some(self.status.clone())
            }
            Seen::Exposing(shot) => {
                self.status = format!("exposing {} ms", exposures(&[shot.exposure_ms]));
                self.enter(shot, State::Exposing)
            }
            Seen::Taken(taken) => {
                self.take(taken, elapsed);
                None
            }
            Seen::Note(text) => {
                self.note = (*text).to_owned();
                Some(self.note.clone())
            }
        }
    }

    /// The rig is at a shot's place, or on its way there.
    fn enter(&mut self, shot: &Shot, state: State) -> Option<String> {
        let place = Place::of(shot);
        let index = self.rows.iter().position(|r| r.place == place)?;
        let came = self.active != Some(index);
        if came {
            self.leave();
        }
        self.active = Some(index);
        self.rows[index].state = state;
        came.then(|| {
            let angle = |d: AxisName| {
                let c = shot.pose;
                match d {
                    AxisName::LightElevation => c.light.theta,
                    AxisName::LightAzimuth => c.light.phi,
                    AxisName::CameraElevation => c.camera.theta,
                    AxisName::CameraAzimuth => c.camera.phi,
                    AxisName::Turntable => c.rotation,
                }
                .to_degrees()
            };
            let what = match place {
                Place::Configuration(id) => format!("configuration {id}"),
                other => other.name(),
            };
            format!(
                "{what}: light {:.1} {:.1}, camera {:.1} {:.1}, turntable {:.1}",
                angle(AxisName::LightElevation),
                angle(AxisName::LightAzimuth),
                angle(AxisName::CameraElevation),
                angle(AxisName::CameraAzimuth),
                angle(AxisName::Turntable)
            )
        })
    }

    /// Nothing happens at the active place any more.
    pub(super) fn leave(&mut self) {
        if let Some(index) = self.active.take() {
            self.rows[index].state = self.rows[index].ended(self.exposures_planned);
        }
    }

    fn take(&mut self, taken: &Taken<'_>, elapsed: Duration) {
        self.frames = taken.frames;
        self.frames_planned = taken.frames_planned;
        self.remaining = Some((taken.remaining_s, elapsed));
        let place = Place::of(taken.shot);
        let Some(row) = self.rows.iter_mut().find(|r| r.place == place) else {
            return;
        };
        row.frames += 1;
        let peaks = taken.record.exposed.map_or([0.0; 3], |e| e.peak);
        let unclipped = peaks.iter().all(|p| *p < CLIPPED);
        // A bracket's longest exposure may clip as it should: the brightest that does not is what counts.
        if let Some(exposed) = taken.record.exposed
            && (unclipped || row.unclipped == 0)
        {
            row.mean = Some(exposed.mean);
        }
        row.unclipped += usize::from(unclipped);
        let ms = taken.shot.exposure_ms;
        if !row.exposures_ms.iter().any(|e| (e - ms).abs() < 1e-9) {
            row.exposures_ms.push(ms);
        }
    }

    /// Frames, time and what goes on, in one line.
    pub(super) fn progress(&self, elapsed: Duration) -> String {
        let planned = match self.frames_planned {
            0 => "?".to_owned(),
            n => n.to_string(),
        };
        let eta = self
            .remaining
            .and_then(|(s, at)| {
                let total = Duration::try_from_secs_f64(s).ok()?;
                Some(clock(total.saturating_sub(elapsed.saturating_sub(at))))
            })
            .unwrap_or_else(|| "?".to_owned());
        format!(
            "{}/{planned} frames   elapsed {}   ETA {eta}   {}",
            self.frames,
            clock(elapsed),
            self.status
        )
        .trim_end()
        .to_owned()
    }

    /// The screen in `height` lines of `width` characters at most.
    pub(super) fn lines(&self, width: usize, height: usize, elapsed: Duration) -> Vec<Line> {
        let wide = width >= 80;
        let pose = if wide {
            "   light    camera  turn  "
        } else {
            ""
        };
        let titles = format!(
            "{:>6}  {pose}{:<8}  {:>12}  {:>17} {:>3}",
            "config", "state", "exposures ms", "mean r g b", "n"
        );
        let mut lines = vec![
            line(&self.heading, Style::Bold),
            line(self.progress(elapsed), Style::Plain),
            line(titles, Style::Faint),
        ];
        // The note, the keys, and the line the cursor stands on.
        let room = height.saturating_sub(lines.len() + 3).max(1);
        lines.extend(
            self.window(room)
                .map(|row| line(row.text(wide), row.state.style())),
        );
        lines.push(line(&self.note, Style::Warning));
        lines.push(line(&self.keys, Style::Plain));
        let most = height.saturating_sub(1).max(1);
        if lines.len() > most {
            lines.drain(..lines.len() - most);
        }
        for line in &mut lines {
            // Not the last column: writing there wraps on some terminals.
            line.text = line.text.chars().take(width.saturating_sub(1)).collect();
        }
        lines
    }

    /// As many rows as there is room for, the active one among them.
    fn window(&self, room: usize) -> impl Iterator<Item = &Row> {
        let ended = self.rows.iter().rposition(|r| r.state != State::Waiting);
        let active = self.active.or(ended).unwrap_or(0);
        let last = self.rows.len().saturating_sub(room);
        let first = active.saturating_sub(room / 2).min(last);
        self.rows.iter().skip(first).take(room)
    }
}
