//! What the operator asks for: it only becomes more urgent, until a pause is over.

use crate::rig::Request;
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};

/// Told at once, on the thread that heard it, when motion shall end.
pub(super) type StopHook = Box<dyn Fn(Request) + Send>;

/// In order of urgency.
const LEVELS: [Request; 5] = [
    Request::Go,
    Request::Pause,
    Request::PauseNow,
    Request::Abort,
    Request::Halt,
];

/// What is asked for now; shared between the threads that hear and the loop that obeys.
#[derive(Default)]
pub(super) struct Requests {
    level: AtomicU8,
    /// To go on was asked for; it counts once the pause is reached, so that the loop never sees a request vanish.
    go_on: AtomicBool,
    hook: Mutex<Option<StopHook>>,
}

impl Requests {
    pub(super) fn now(&self) -> Request {
        let level = usize::from(self.level.load(Ordering::SeqCst));
        LEVELS.get(level).copied().unwrap_or(Request::Halt)
    }

    pub(super) fn on_stop(&self, hook: StopHook) {
        if let Ok(mut place) = self.hook.lock() {
            *place = Some(hook);
        }
    }

    /// Asks for this, unless something more urgent is asked for already; true when it is new.
    pub(super) fn raise(&self, request: Request) -> bool {
        let before = self.level.fetch_max(request as u8, Ordering::SeqCst);
        if before >= request as u8 {
            return false;
        }
        self.go_on.store(false, Ordering::SeqCst);
        if request >= Request::PauseNow
            && let Ok(hook) = self.hook.lock()
            && let Some(hook) = hook.as_ref()
        {
            hook(request);
        }
        true
    }

    /// One interrupt asks for the next worse thing; none when nothing worse is left.
    pub(super) fn interrupt(&self) -> Option<Request> {
        loop {
            let next = match self.now() {
                Request::Go => Request::Pause,
                Request::Pause | Request::PauseNow => Request::Abort,
                Request::Abort => Request::Halt,
                Request::Halt => return None,
            };
            if self.raise(next) {
                return Some(next);
            }
        }
    }

    /// Asks to go on after a pause; true when there is a pause to end.
    pub(super) fn go_on(&self) -> bool {
        let pausing = matches!(self.now(), Request::Pause | Request::PauseNow);
        self.go_on.store(pausing, Ordering::SeqCst);
        pausing
    }

    /// At rest in a pause: takes the request to go on, if there is one.
    pub(super) fn take_go_on(&self) -> bool {
        if !self.go_on.swap(false, Ordering::SeqCst) {
            return false;
        }
        let back = |level| (level <= Request::PauseNow as u8).then_some(Request::Go as u8);
        self.level
            .fetch_update(Ordering::SeqCst, Ordering::SeqCst, back)
            .is_ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::Arc;

    #[test]
    fn each_interrupt_asks_for_something_worse_and_the_fourth_for_nothing() {
        let requests = Requests::default();
        let asked: Vec<_> = (0..5).map(|_| requests.interrupt()).collect();
        assert_eq!(
            asked,
            [
                Some(Request::Pause),
                Some(Request::Abort),
                Some(Request::Halt),
                None,
                None
            ]
        );
    }

    #[test]
    fn requests_only_grow_until_a_pause_is_over() {
        let requests = Requests::default();
        assert!(requests.raise(Request::PauseNow) && !requests.raise(Request::Pause));
        assert_eq!(requests.now(), Request::PauseNow);
        assert!(!requests.take_go_on(), "nobody asked to go on");
        assert!(requests.go_on());
        assert_eq!(
            requests.now(),
            Request::PauseNow,
            "until the pause is reached"
        );
        assert!(requests.take_go_on());
        assert_eq!(requests.now(), Request::Go);
        assert!(
            !requests.go_on() && !requests.take_go_on(),
            "nothing to go on from"
        );
        // An abort is not taken back, also not by a key pressed before it.
        requests.raise(Request::Pause);
        requests.go_on();
        requests.raise(Request::Abort);
        assert!(!requests.take_go_on() && !requests.go_on());
        assert_eq!(requests.now(), Request::Abort);
    }

    #[test]
    fn the_hook_hears_what_stops_motion_once_and_nothing_else() {
        let requests = Requests::default();
        let heard = Arc::new(Mutex::new(Vec::new()));
        let ear = heard.clone();
        requests.on_stop(Box::new(move |r| ear.lock().unwrap().push(r)));
        for request in [
            Request::Pause,
            Request::PauseNow,
            Request::PauseNow,
            Request::Halt,
            Request::Abort,
        ] {
            requests.raise(request);
        }
        assert_eq!(*heard.lock().unwrap(), [Request::PauseNow, Request::Halt]);
    }
}
