//! A line that loses and damages bytes and frames, or falls silent, as told.

use std::collections::HashMap;
use std::time::Duration;

use config::faults::FaultSettings;

use super::random::{About, bits, strikes};
use hal::error::HalError;
use hal::link::Reconnecting;
use hal::traits::{Link, Received};

/// What was done to the line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LineFaults {
    /// Frames not sent at all.
    pub frames_lost: u64,
    /// Frames not sent because the line was silent.
    pub frames_paused: u64,
    /// Bytes lost out of frames.
    pub bytes_lost: u64,
    /// Bytes with a flipped bit.
    pub bytes_flipped: u64,
}

/// The simulator's end of a link.
pub struct FaultyLink<L = Reconnecting> {
    link: L,
    seed: u64,
    acting: FaultSettings,
    /// Frames seen per message id: the key of the random.
    ordinals: HashMap<u32, u64>,
    done: LineFaults,
}

impl<L> FaultyLink<L> {
    /// A link without faults until [`FaultyLink::set`].
    pub fn new(link: L, seed: u64) -> Self {
        Self { link, seed, acting: FaultSettings::default(), ordinals: HashMap::new(), done: LineFaults::default() }
    }

    /// The faults acting from now on.
    pub fn set(&mut self, acting: FaultSettings) {
        self.acting = acting;
    }

    /// Counts frames anew: what befalls the n-th frame of a flight does not depend on how long the wait before it was.
    pub fn restart(&mut self) {
        self.ordinals.clear();
    }

    /// What was done so far.
    pub fn done(&self) -> LineFaults {
        self.done
    }

    /// The link below.
    pub fn inner(&self) -> &L {
        &self.link
    }
}

/// MAVLink 2 message id of a whole frame.
fn message_id(frame: &[u8]) -> u32 {
    match frame {
        [0xFD, _, _, _, _, _, _, a, b, c, ..] => u32::from_le_bytes([*a, *b, *c, 0]),
        [0xFE, _, _, _, _, id, ..] => u32::from(*id),
        _ => u32::MAX,
    }
}

impl<L: Link<Error = HalError>> Link for FaultyLink<L> {
    type Error = HalError;

    fn read(&mut self, into: &mut [u8], timeout: Duration) -> Result<Received, HalError> {
        let received = self.link.read(into, timeout)?;
        Ok(if self.acting.link_pause >= 0.5 { Received::default() } else { received })
    }

    fn write(&mut self, frame: &[u8]) -> Result<(), HalError> {
        let id = message_id(frame);
        let n = self.ordinals.entry(id).or_default();
        let ordinal = *n;
        *n += 1;
        if self.acting.link_pause >= 0.5 {
            self.done.frames_paused += 1;
            return Ok(());
        }
        if strikes(self.acting.frame_loss_pct, self.seed, About::Frame, id, ordinal) {
            self.done.frames_lost += 1;
            return Ok(());
        }
        if self.acting.byte_loss_pct <= 0.0 && self.acting.bit_flip_pct <= 0.0 {
            return self.link.write(frame);
        }
        let mut damaged = Vec::with_capacity(frame.len());
        for (k, byte) in frame.iter().enumerate() {
            let event = (ordinal << 9) | k as u64;
            if strikes(self.acting.byte_loss_pct, self.seed, About::ByteLoss, id, event) {
                self.done.bytes_lost += 1;
            } else if strikes(self.acting.bit_flip_pct, self.seed, About::BitFlip, id, event) {
                self.done.bytes_flipped += 1;
                damaged.push(byte ^ (1 << (bits(self.seed, About::BitFlip, id, event) & 7)));
            } else {
                damaged.push(*byte);
            }
        }
        self.link.write(&damaged)
    }
}
