//! Two independent recordings for paired renders.

use super::{RecordOptions, Recording, Trust};
use crate::base::{Error, Result, Watch};
use crate::render::estimate::interrupted;
use crate::render::{Estimates, FiberScene, Request, Scene};
use crate::scatter::{Parameters, Parametric};

/// Two recordings that share no random number, as a scene: even streams are answered from the first, odd ones from the
/// second, so that a pair of renders (`fit::RenderPair`) made from it is independent. What a request says of effort and
/// seed is already decided.
#[derive(Debug)]
pub struct RecordingPair {
    recordings: [Recording; 2],
}

impl Recording {
    /// Two recordings on streams `2 stream` and `2 stream + 1` of the request's seed, each with the whole effort; the
    /// budget is for each.
    ///
    /// # Errors
    /// As [`FiberScene::record`].
    pub fn pair(
        scene: &FiberScene,
        request: &Request<'_>,
        options: &RecordOptions,
        watch: &dyn Watch,
    ) -> Result<RecordingPair> {
        let one = |which: u64| {
            let request = Request {
                stream: 2 * request.stream + which,
                ..request.clone()
            };
            scene.record(&request, options, watch)
        };
        Ok(RecordingPair {
            recordings: [one(0)?, one(1)?],
        })
    }
}

impl RecordingPair {
    /// The two recordings.
    pub fn recordings(&self) -> &[Recording; 2] {
        &self.recordings
    }

    /// The lesser trust of the two, per configuration.
    ///
    /// # Errors
    /// As [`Recording::means`].
    pub fn trust(&self, parameters: &Parameters) -> Result<Trust> {
        let [a, b] = &self.recordings;
        Ok(a.means(parameters)?
            .trust
            .lesser(b.means(parameters)?.trust))
    }
}

impl Scene for RecordingPair {
    fn model(&self) -> &'static dyn Parametric {
        self.recordings[0].model
    }

    fn estimate(&self, request: &Request<'_>, watch: &dyn Watch) -> Result<Estimates> {
        if watch.cancelled() {
            return Err(interrupted());
        }
        let recording = &self.recordings[(request.stream % 2) as usize];
        let recorded = recording.configurations.iter().map(|(id, _)| *id);
        if !recorded.eq(request.configurations.iter().map(|c| c.id)) {
            return Err(
                Error::new("the recording has other configurations than asked for")
                    .with_hint("record the same list of configurations, in the same order"),
            );
        }
        Ok(recording.estimate(request.parameters)?.estimates)
    }
}
