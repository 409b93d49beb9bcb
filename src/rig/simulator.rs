//! A device model behind a transport: in process on a virtual clock, or on a real pseudo-terminal.

use super::model::GrblModel;
use super::transport::{Clock, Transport, VirtualClock, duration, timed_out};
use super::wire_log::{Way, WireEntry, WireLog};
use crate::base::{Context, Error, Result};
use serialport::{SerialPort, TTYPort};
use std::io::{self, Read, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Instant;

/// A device as a wire sees it: bytes and the time go in, bytes come out. Times never go backwards.
pub trait ByteModel: Send {
    /// Takes bytes that arrive at time `now`, seconds.
    fn receive(&mut self, bytes: &[u8], now: f64);

    /// What has been sent by time `now`.
    fn take_output(&mut self, now: f64) -> Vec<u8>;

    /// The next time at which something happens by itself, if anything will.
    fn next_event(&self) -> Option<f64>;

    /// True when the device has disappeared.
    fn is_gone(&self) -> bool;
}

impl ByteModel for GrblModel {
    fn receive(&mut self, bytes: &[u8], now: f64) {
        Self::receive(self, bytes, now);
    }

    fn take_output(&mut self, now: f64) -> Vec<u8> {
        Self::take_output(self, now)
    }

    fn next_event(&self) -> Option<f64> {
        Self::next_event(self)
    }

    fn is_gone(&self) -> bool {
        Self::is_gone(self)
    }
}

impl ByteModel for Box<dyn ByteModel> {
    fn receive(&mut self, bytes: &[u8], now: f64) {
        self.as_mut().receive(bytes, now);
    }

    fn take_output(&mut self, now: f64) -> Vec<u8> {
        self.as_mut().take_output(now)
    }

    fn next_event(&self) -> Option<f64> {
        self.as_ref().next_event()
    }

    fn is_gone(&self) -> bool {
        self.as_ref().is_gone()
    }
}

/// A GRBL model shared between its transport and whoever looks at it.
pub type SharedModel = Arc<Mutex<GrblModel>>;

/// Any model shared between its transport and whoever looks at it.
pub type SharedDevice = Arc<Mutex<dyn ByteModel>>;

/// A cable to a model in the same process; waiting on it moves the virtual clock.
pub struct ModelTransport {
    model: SharedDevice,
    clock: Arc<VirtualClock>,
    pending: Vec<u8>,
}

impl ModelTransport {
    /// A cable to `model`, in the time of `clock`.
    pub fn new(model: SharedDevice, clock: Arc<VirtualClock>) -> Self {
        Self {
            model,
            clock,
            pending: Vec::new(),
        }
    }

    fn model(&self) -> std::sync::MutexGuard<'_, dyn ByteModel + 'static> {
        self.model
            .lock()
            .expect("the model's lock is never poisoned")
    }
}

impl Transport for ModelTransport {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        let mut model = self.model();
        if model.is_gone() {
            return Err(io::ErrorKind::BrokenPipe.into());
        }
        model.receive(bytes, self.clock.now());
        Ok(())
    }

    fn read(&mut self, buffer: &mut [u8], timeout: f64) -> io::Result<usize> {
        let deadline = self.clock.now() + timeout;
        loop {
            let now = self.clock.now();
            let output = self.model().take_output(now);
            self.pending.extend(output);
            if !self.pending.is_empty() {
                let n = self.pending.len().min(buffer.len());
                buffer[..n].copy_from_slice(&self.pending[..n]);
                self.pending.drain(..n);
                return Ok(n);
            }
            if self.model().is_gone() {
                return Ok(0);
            }
            if now >= deadline {
                return Err(timed_out());
            }
            let next = self.model().next_event();
            self.clock.advance_to(
                next.filter(|t| *t > now)
                    .map_or(deadline, |t| t.min(deadline)),
            );
        }
    }
}

/// A model that lives on a pseudo-terminal, so that the real serial code can talk to it. Stops when dropped.
pub struct PtySimulator<M = GrblModel> {
    path: String,
    model: Arc<Mutex<M>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl<M: ByteModel + 'static> PtySimulator<M> {
    /// Starts a thread that serves `model`; its time runs `speed` times as fast as real time. Traffic goes to `log`,
    /// in the model's time, under the name `board`.
    ///
    /// # Errors
    /// When the system has no pseudo-terminal left or the speed is not positive.
    pub fn spawn(model: M, speed: f64, log: Option<(WireLog, String)>) -> Result<Self> {
        if !(1e-3..=1e4).contains(&speed) {
            return Err(Error::new(format!(
                "simulator speed is {speed}, expected 0.001 to 10000"
            )));
        }
        let (mut master, slave) =
            TTYPort::pair().context(|| "no pseudo-terminal can be opened for the simulator")?;
        let path = slave
            .name()
            .ok_or_else(|| Error::new("the pseudo-terminal has no name"))?;
        let model = Arc::new(Mutex::new(model));
        let stop = Arc::new(AtomicBool::new(false));
        let (shared, stopping) = (model.clone(), stop.clone());
        let thread = std::thread::spawn(move || {
            // The slave end stays open here: without it the pseudo-terminal hangs up between two clients.
            let _slave = slave;
            serve(&mut master, &shared, speed, log, &stopping);
        });
        Ok(Self {
            path,
            model,
            stop,
            thread: Some(thread),
        })
    }

    /// The device path to open, e.g. `/dev/pts/3`.
    pub fn path(&self) -> &str {
        &self.path
    }

    /// The model, to look at or to disturb.
    pub fn model(&self) -> Arc<Mutex<M>> {
        self.model.clone()
    }

    /// True while the device exists; false after the model disappeared.
    pub fn is_running(&self) -> bool {
        self.thread.as_ref().is_some_and(|t| !t.is_finished())
    }
}

impl<M> Drop for PtySimulator<M> {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::SeqCst);
        if let Some(thread) = self.thread.take() {
            // A panic in the thread has been printed already.
            let _ = thread.join();
        }
    }
}

fn serve(
    master: &mut TTYPort,
    model: &Mutex<impl ByteModel>,
    speed: f64,
    log: Option<(WireLog, String)>,
    stop: &AtomicBool,
) {
    let start = Instant::now();
    let model_time = || start.elapsed().as_secs_f64() * speed;
    let record = |way: Way, bytes: &[u8]| {
        if let Some((log, board)) = &log {
            // A log that cannot be written must not stop the simulator.
            let _ = log.add(&WireEntry {
                t: model_time(),
                board: board.clone(),
                way,
                bytes: bytes.to_vec(),
            });
        }
    };
    let mut buffer = [0; 1024];
    while !stop.load(Ordering::SeqCst) {
        let (output, next, gone) = {
            let mut model = model.lock().expect("the model's lock is never poisoned");
            let output = model.take_output(model_time());
            (output, model.next_event(), model.is_gone())
        };
        if !output.is_empty() {
            // Nobody listens and the buffer is full: the bytes are lost, as on a wire.
            let _ = master.write_all(&output);
            record(Way::FromBoard, &output);
        }
        if gone {
            return;
        }
        let wait = next.map_or(0.02, |t| (t - model_time()) / speed);
        let _ = master.set_timeout(duration(wait.clamp(0.0, 0.02)));
        match master.read(&mut buffer) {
            Ok(n) if n > 0 => {
                record(Way::ToBoard, &buffer[..n]);
                let mut model = model.lock().expect("the model's lock is never poisoned");
                model.receive(&buffer[..n], model_time());
            }
            _ => {}
        }
    }
}
