//! What the noise tests of all drivers share: keyed dice, and a cable that damages what passes.

#![allow(dead_code)]

use goniofit::rig::{Clock, ModelTransport, Transport, VirtualClock};
use std::io;
use std::sync::Arc;

/// xorshift64*; `SEED` overrides the test's own seed.
pub(crate) struct Dice(u64);

impl Dice {
    pub(crate) fn of(seed: u64, case: u64) -> Self {
        let given = std::env::var("SEED").ok().and_then(|s| s.parse().ok());
        let seed = given.unwrap_or(seed);
        let mut dice = Self((seed ^ case.wrapping_mul(0x9e37_79b9_7f4a_7c15)) | 1);
        for _ in 0..4 {
            dice.next();
        }
        dice
    }

    pub(crate) fn next(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_f491_4f6c_dd1d)
    }

    pub(crate) fn below(&mut self, n: usize) -> usize {
        ((self.next() >> 33) as usize) % n
    }

    pub(crate) fn one_in(&mut self, n: usize) -> bool {
        self.below(n) == 0
    }
}

/// A cable that damages what passes, in one direction, from a time on.
pub(crate) struct Noisy {
    pub(crate) inner: ModelTransport,
    pub(crate) dice: Dice,
    pub(crate) clock: Arc<VirtualClock>,
    pub(crate) from: f64,
    pub(crate) to_board: bool,
    pub(crate) one_in: usize,
    /// Bytes that mean something to the device, slipped in.
    pub(crate) live: &'static [u8],
}

impl Noisy {
    fn damaged(&mut self, bytes: &[u8]) -> Vec<u8> {
        let mut out = Vec::new();
        for &byte in bytes {
            if self.clock.now() < self.from || !self.dice.one_in(self.one_in) {
                out.push(byte);
                continue;
            }
            match self.dice.below(5) {
                0 => {}
                1 => out.extend([byte, byte]),
                2 => out.push(byte ^ (1 << self.dice.below(8))),
                3 => out.extend([byte, self.dice.next() as u8]),
                _ => out.extend([byte, self.live[self.dice.below(self.live.len())]]),
            }
        }
        out
    }
}

impl Transport for Noisy {
    fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        let bytes = if self.to_board {
            self.damaged(bytes)
        } else {
            bytes.to_vec()
        };
        self.inner.write(&bytes)
    }

    fn read(&mut self, buffer: &mut [u8], timeout: f64) -> io::Result<usize> {
        // Half the room, as damage may double the bytes.
        let mut clean = vec![0; buffer.len() / 2];
        let n = self.inner.read(&mut clean, timeout)?;
        if self.to_board || n == 0 {
            buffer[..n].copy_from_slice(&clean[..n]);
            return Ok(n);
        }
        let bytes = self.damaged(&clean[..n]);
        if bytes.is_empty() {
            return Err(io::ErrorKind::TimedOut.into());
        }
        buffer[..bytes.len()].copy_from_slice(&bytes);
        Ok(bytes.len())
    }
}
