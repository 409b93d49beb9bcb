//! Which exposure comes next at a pose: a pure function of the frames it has, so that an interrupted pose goes on where
//! it was.
//!
//! Frames are judged by their brightest pixel over the crop as a fraction of the range from black to white level
//! ([`Exposedness::peak`]). Frames that turn out clipped or too dark stay in the session: the measurement leaves out
//! what is clipped and gives what is dark its small weight.

use super::description::{CameraDescription, Metering};
use crate::session::{Exposedness, FrameRecord};

/// A frame counts as clipped from here on; a little below what the measurement leaves out (92 % of the white level).
pub const CLIPPED: f64 = 0.9;
/// Metering takes the longest exposure that is expected to stay below this.
const AIM: f64 = 0.8;
/// A pose is under-exposed while its brightest usable frame stays below this.
const DIM: f64 = 0.1;
/// Below this a metering frame says too little to choose from.
const BLIND: f64 = 0.02;
/// Steps of metering and re-shooting when a frame does not tell how far to go.
const STEP_DOWN: f64 = 4.0;
const STEP_UP: f64 = 8.0;
/// How far beyond the list re-shooting may go when the rig file does not say.
const BEYOND: f64 = 16.0;

/// How the exposures of a pose are chosen.
#[derive(Debug, Clone, PartialEq)]
pub struct ExposureRule {
    /// The list, milliseconds, ascending, at least one.
    pub ladder_ms: Vec<f64>,
    /// The whole list, or chosen by metering.
    pub metering: Metering,
    /// Metered: how many neighbors of the list.
    pub bracket: usize,
    /// Frames per exposure.
    pub repeats: u32,
    /// Further exposures when none is good.
    pub reshoots: u32,
    /// The camera's range, milliseconds.
    pub range_ms: [f64; 2],
}

impl ExposureRule {
    /// The rule of a rig file's camera.
    pub fn of(camera: &CameraDescription) -> Self {
        let first = camera.exposures_ms.first().copied().unwrap_or(1.0);
        let last = camera.exposures_ms.last().copied().unwrap_or(1.0);
        Self {
            ladder_ms: camera.exposures_ms.clone(),
            metering: camera.metering,
            bracket: camera.bracket as usize,
            repeats: camera.repeats,
            reshoots: camera.reshoots,
            range_ms: [
                camera.min_exposure_ms.unwrap_or(first / BEYOND),
                camera.max_exposure_ms.unwrap_or(last * BEYOND),
            ],
        }
    }

    /// The rule for a pose whose exposures are given.
    pub fn given(&self, exposures_ms: Vec<f64>) -> Self {
        Self {
            ladder_ms: exposures_ms,
            metering: Metering::Fixed,
            reshoots: 0,
            ..self.clone()
        }
    }
}

/// How a finished pose is exposed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// At least one exposure is neither clipped nor too dark, or nobody looked.
    Good,
    /// Every exposure is clipped.
    Clipped,
    /// No exposure is clipped, and all are dark.
    Dim,
}

/// What comes next at a pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Next {
    /// This exposure, milliseconds, and repeat.
    Shoot(f64, u32),
    /// Nothing.
    Done(Verdict),
}

/// What comes next at a pose that has these frames (in any order); metering begins at `start_ms`.
pub fn next_exposure(rule: &ExposureRule, frames: &[&FrameRecord], start_ms: f64) -> Next {
    let mut script = Script {
        rule,
        frames,
        used: Vec::new(),
    };
    match script.run(start_ms) {
        Ok(verdict) => Next::Done(verdict),
        Err((exposure, repeat)) => Next::Shoot(exposure, repeat),
    }
}

/// Plays the pose from its beginning; the first frame that is needed and not there ends it.
struct Script<'a> {
    rule: &'a ExposureRule,
    frames: &'a [&'a FrameRecord],
    /// Frames looked at so far.
    used: Vec<&'a FrameRecord>,
}

type Missing = (f64, u32);

impl<'a> Script<'a> {
    fn need(&mut self, exposure: f64, repeat: u32) -> Result<&'a FrameRecord, Missing> {
        let frame = self
            .frames
            .iter()
            .find(|f| f.repeat == repeat && same(f.asked_ms(), exposure))
            .ok_or((exposure, repeat))?;
        self.used.push(frame);
        Ok(frame)
    }

    fn run(&mut self, start_ms: f64) -> Result<Verdict, Missing> {
        let wanted = match self.rule.metering {
            Metering::Fixed => self.rule.ladder_ms.clone(),
            Metering::Metered => self.metered(start_ms)?,
        };
        for exposure in wanted {
            self.repeats(exposure)?;
        }
        for _ in 0..self.rule.reshoots {
            match self.another() {
                Some(exposure) => self.repeats(exposure)?,
                None => break,
            }
        }
        Ok(self.verdict())
    }

    fn repeats(&mut self, exposure: f64) -> Result<(), Missing> {
        for repeat in 0..self.rule.repeats {
            self.need(exposure, repeat)?;
        }
        Ok(())
    }

    /// The bracket: looks from `start_ms` on until a frame tells how bright the pose is.
    fn metered(&mut self, start_ms: f64) -> Result<Vec<f64>, Missing> {
        let ladder = &self.rule.ladder_ms;
        let mut at = nearest(ladder, start_ms);
        // Each look goes one way only, so that it ends.
        for _ in 0..ladder.len() {
            let Some(peak) = peak(self.need(ladder[at], 0)?) else {
                return Ok(ladder.clone());
            };
            let next = if peak >= CLIPPED {
                step(ladder, at, 1.0 / STEP_DOWN)
            } else if peak < BLIND {
                step(ladder, at, STEP_UP)
            } else {
                None
            };
            match next {
                Some(next) if !self.used.iter().any(|f| same(f.asked_ms(), ladder[next])) => {
                    at = next;
                }
                _ => return Ok(self.bracket(at, peak)),
            }
        }
        Ok(ladder.clone())
    }

    /// The longest exposure expected to stay below the aim, and its shorter neighbors.
    fn bracket(&self, at: usize, peak: f64) -> Vec<f64> {
        let ladder = &self.rule.ladder_ms;
        let top = if peak >= CLIPPED {
            // Clipped and nowhere shorter to go.
            0
        } else {
            let fits = |e: &&f64| peak * **e / ladder[at] <= AIM;
            ladder.iter().filter(fits).count().saturating_sub(1)
        };
        let low = (top + 1).saturating_sub(self.rule.bracket);
        ladder[low..=top].to_vec()
    }

    fn verdict(&self) -> Verdict {
        let mut judged = self.used.iter().filter_map(|f| peak(f)).peekable();
        if judged.peek().is_none() {
            return Verdict::Good;
        }
        match judged.filter(|p| *p < CLIPPED).reduce(f64::max) {
            None => Verdict::Clipped,
            Some(best) if best < DIM && !self.any_clipped() => Verdict::Dim,
            Some(_) => Verdict::Good,
        }
    }

    fn any_clipped(&self) -> bool {
        self.used
            .iter()
            .filter_map(|f| peak(f))
            .any(|p| p >= CLIPPED)
    }

    /// A further exposure that may turn out good; none when it is good already or the camera's range ends.
    fn another(&self) -> Option<f64> {
        let [shortest, longest] = self.rule.range_ms;
        let taken = || self.used.iter().map(|f| f.asked_ms());
        let wanted = match self.verdict() {
            Verdict::Good => return None,
            Verdict::Clipped => taken().reduce(f64::min)? / STEP_DOWN,
            Verdict::Dim => {
                let longest_taken = taken().reduce(f64::max)?;
                let best = self.used.iter().filter_map(|f| peak(f)).reduce(f64::max)?;
                longest_taken * (0.5 * AIM / best.max(1e-3)).clamp(2.0, BEYOND)
            }
        };
        let exposure = round_to_3_digits(wanted).clamp(shortest, longest);
        (!taken().any(|t| same(t, exposure))).then_some(exposure)
    }
}

fn peak(frame: &FrameRecord) -> Option<f64> {
    let Exposedness { peak, .. } = frame.exposed?;
    Some(peak.into_iter().fold(0.0, f64::max))
}

fn same(a: f64, b: f64) -> bool {
    (a / b - 1.0).abs() < 1e-6
}

fn nearest(ladder: &[f64], exposure: f64) -> usize {
    let distance = |e: f64| (e / exposure).ln().abs();
    (0..ladder.len())
        .min_by(|a, b| distance(ladder[*a]).total_cmp(&distance(ladder[*b])))
        .unwrap_or(0)
}

/// The place on the ladder at least this factor away, or its end; none at the end.
fn step(ladder: &[f64], at: usize, factor: f64) -> Option<usize> {
    let goal = ladder[at] * factor;
    if factor < 1.0 {
        (at > 0).then(|| ladder[..at].iter().rposition(|e| *e <= goal).unwrap_or(0))
    } else {
        let longer = &ladder[at + 1..];
        let found = longer.iter().position(|e| *e >= goal);
        (!longer.is_empty()).then(|| at + 1 + found.unwrap_or(longer.len() - 1))
    }
}

/// Exposure times people can read.
fn round_to_3_digits(value: f64) -> f64 {
    let scale = 10f64.powf(2.0 - value.log10().floor());
    (value * scale).round() / scale
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::session::FrameKind;

    fn rule(metering: Metering) -> ExposureRule {
        ExposureRule {
            ladder_ms: vec![1.0, 4.0, 16.0, 64.0, 256.0, 1024.0],
            metering,
            bracket: 2,
            repeats: 2,
            reshoots: 2,
            range_ms: [0.25, 4096.0],
        }
    }

    fn frame(exposure_ms: f64, repeat: u32, peak: Option<f64>) -> FrameRecord {
        FrameRecord {
            file: String::new(),
            kind: FrameKind::Sample,
            config: Some(1),
            exposure_ms,
            requested_ms: None,
            repeat,
            visit: 0,
            filter: None,
            exposed: peak.map(|p| Exposedness {
                peak: [p, 0.5 * p, 0.1 * p],
                mean: [0.3 * p; 3],
            }),
            utc: None,
            axes_deg: Default::default(),
            sha256: String::new(),
        }
    }

    /// Shoots a pose of this brightness (peak per millisecond) to its end; the exposures in order, and the verdict.
    fn shot(rule: &ExposureRule, rate: Option<f64>, start: f64) -> (Vec<f64>, Verdict) {
        let mut frames: Vec<FrameRecord> = Vec::new();
        loop {
            let all: Vec<&FrameRecord> = frames.iter().collect();
            match next_exposure(rule, &all, start) {
                Next::Done(verdict) => {
                    return (frames.iter().map(|f| f.exposure_ms).collect(), verdict);
                }
                Next::Shoot(e, repeat) => {
                    assert!(
                        !frames
                            .iter()
                            .any(|f| same(f.exposure_ms, e) && f.repeat == repeat),
                        "{e} ms is shot twice"
                    );
                    frames.push(frame(e, repeat, rate.map(|r| (r * e).min(1.0))));
                }
            }
        }
    }

    #[test]
    fn a_fixed_list_is_shot_whole_whatever_comes() {
        let fixed = rule(Metering::Fixed);
        let (exposures, verdict) = shot(&fixed, None, 1.0);
        assert_eq!(exposures.len(), 12);
        assert_eq!(verdict, Verdict::Good);
        assert_eq!(shot(&fixed, Some(0.01), 1.0), (exposures, Verdict::Good));
    }

    #[test]
    fn metering_takes_the_longest_exposures_that_do_not_clip() {
        let metered = rule(Metering::Metered);
        // Peak 0.64 at 64 ms: 256 would clip.
        let (exposures, verdict) = shot(&metered, Some(0.01), 64.0);
        assert_eq!(exposures, [64.0, 16.0, 16.0, 64.0]);
        assert_eq!(verdict, Verdict::Good);
        // Clipped at first, then seen at 16 ms.
        let (exposures, _) = shot(&metered, Some(0.04), 64.0);
        assert_eq!(exposures, [64.0, 16.0, 4.0, 4.0, 16.0]);
        // Nothing to see at first.
        let (exposures, _) = shot(&metered, Some(0.0005), 4.0);
        assert_eq!(exposures, [4.0, 64.0, 256.0, 256.0, 1024.0, 1024.0]);
        for decade in -50..30 {
            for start in [1.0, 16.0, 1024.0] {
                let rate = 10f64.powf(f64::from(decade) / 10.0);
                let (exposures, verdict) = shot(&metered, Some(rate), start);
                assert!(exposures.len() <= 12, "{rate}: {exposures:?}");
                let reached = exposures
                    .iter()
                    .any(|e| (DIM..CLIPPED).contains(&(e * rate)));
                assert_eq!(verdict == Verdict::Good, reached, "{rate}: {exposures:?}");
            }
        }
    }

    #[test]
    fn clipped_and_dark_poses_are_shot_again_inside_the_cameras_range() {
        let fixed = rule(Metering::Fixed);
        let (exposures, verdict) = shot(&fixed, Some(2.0), 1.0);
        assert_eq!(exposures[12..], [0.25, 0.25]);
        assert_eq!(verdict, Verdict::Good);
        let (exposures, verdict) = shot(&fixed, Some(50.0), 1.0);
        assert_eq!(exposures[12..], [0.25, 0.25], "the range ends there");
        assert_eq!(verdict, Verdict::Clipped);
        let (exposures, verdict) = shot(&fixed, Some(4e-5), 1.0);
        assert_eq!(exposures[12..], [4096.0, 4096.0]);
        assert_eq!(verdict, Verdict::Good);
        let (_, verdict) = shot(&fixed, Some(1e-6), 1.0);
        assert_eq!(verdict, Verdict::Dim);
        let patient = ExposureRule {
            reshoots: 0,
            ..fixed
        };
        assert_eq!(shot(&patient, Some(2.0), 1.0).1, Verdict::Clipped);
    }

    #[test]
    fn one_clipped_channel_is_clipped() {
        let mut only_blue = frame(1.0, 0, Some(0.2));
        only_blue.exposed = Some(Exposedness {
            peak: [0.1, 0.1, 0.95],
            mean: [0.1; 3],
        });
        assert!(peak(&only_blue).unwrap() >= CLIPPED);
    }

    #[test]
    fn an_interrupted_pose_goes_on_with_the_same_shots() {
        for metering in [Metering::Fixed, Metering::Metered] {
            let rule = rule(metering);
            for rate in [1e-6, 4e-5, 0.0005, 0.01, 0.04, 2.0, 50.0] {
                let (whole, _) = shot(&rule, Some(rate), 16.0);
                let mut frames = Vec::new();
                for e in &whole {
                    // A new run that knows only the journal asks for the next shot of the old one.
                    let known: Vec<&FrameRecord> = frames.iter().collect();
                    let Next::Shoot(next, repeat) = next_exposure(&rule, &known, 16.0) else {
                        panic!("done after {} of {} shots", frames.len(), whole.len());
                    };
                    assert!(same(next, *e));
                    frames.push(frame(next, repeat, Some((rate * next).min(1.0))));
                }
            }
        }
    }
}
