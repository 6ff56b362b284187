//! MAVLink 2 message signing (<https://mavlink.io/en/guide/message_signing.html>): SHA-256 over key and frame, cut to
//! 48 bits, with time stamps that only grow per (link, system, component), so that a recorded frame cannot be replayed.

use heapless::LinearMap;
use sha2::{Digest, Sha256};

use super::frame::{Frame, SIGNATURE_LEN};

/// Unix seconds of 2015-01-01, the epoch of signing time stamps.
const EPOCH_UNIX_S: u64 = 1_420_070_400;
/// Time stamps count 10 µs.
const TICKS_PER_S: u64 = 100_000;
/// A stream not heard before may lag our clock by one minute (the guide's rule).
const NEW_STREAM_LAG: u64 = 60 * TICKS_PER_S;
/// Streams remembered; further ones are refused, so that a flood of ids cannot push out a known one.
const STREAMS: usize = 16;
/// RADIO_STATUS: telemetry radios insert it and cannot sign (the guide's exception).
const RADIO_STATUS: u32 = 109;

/// What is asked of incoming frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SigningMode {
    /// Nothing is signed, signatures are not looked at.
    #[default]
    Off,
    /// We sign; unsigned frames are accepted, wrongly signed ones are not.
    Accept,
    /// We sign; only rightly signed frames (and RADIO_STATUS) are accepted.
    Require,
}

/// Why a frame was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// Unsigned where signatures are required.
    Unsigned,
    /// The hash does not fit: another key, or a damaged or forged frame.
    WrongKey,
    /// The time stamp did not grow: a replayed frame, or a sender whose clock went back.
    Replayed,
    /// More senders than are remembered.
    TooManyStreams,
}

/// Key, own time stamp, and the last time stamp of every sender.
pub struct Signer {
    mode: SigningMode,
    key: [u8; 32],
    link_id: u8,
    timestamp: u64,
    streams: LinearMap<(u8, u8, u8), u64, STREAMS>,
}

/// The stream and time stamp of a frame whose signature is right; nothing of an unsigned one.
pub(super) struct Stamp(Option<((u8, u8, u8), u64)>);

/// A Unix time in microseconds as a signing time stamp; 0 before 2015.
pub fn timestamp_of_unix_us(unix_us: u64) -> u64 {
    (unix_us / 10).saturating_sub(EPOCH_UNIX_S * TICKS_PER_S)
}

impl Signer {
    /// `timestamp` is the last one persisted (see `signing_store`); it only grows from there.
    pub fn new(mode: SigningMode, key: [u8; 32], link_id: u8, timestamp: u64) -> Self {
        Self { mode, key, link_id, timestamp, streams: LinearMap::new() }
    }

    /// A signer that neither signs nor checks.
    pub fn off() -> Self {
        Self::new(SigningMode::Off, [0; 32], 0, 0)
    }

    /// Whether outgoing frames are signed.
    pub fn signs(&self) -> bool {
        self.mode != SigningMode::Off
    }

    /// The newest time stamp used or seen.
    pub fn timestamp(&self) -> u64 {
        self.timestamp
    }

    /// Moves our time stamp up to `timestamp`; never back.
    pub fn advance_to(&mut self, timestamp: u64) {
        self.timestamp = self.timestamp.max(timestamp);
    }

    /// Writes the signature into the last 13 bytes of `frame`.
    pub(super) fn sign(&mut self, frame: &mut [u8]) {
        self.timestamp += 1;
        let body = frame.len() - SIGNATURE_LEN;
        frame[body] = self.link_id;
        frame[body + 1..body + 7].copy_from_slice(&self.timestamp.to_le_bytes()[..6]);
        let hash = self.hash(&frame[..body + 7]);
        frame[body + 7..].copy_from_slice(&hash);
    }

    /// Checks an incoming frame and remembers its time stamp.
    ///
    /// # Errors
    /// Why the frame must not be used.
    pub fn check(&mut self, frame: &Frame<'_>) -> Result<(), Refusal> {
        let stamp = self.verify(frame)?;
        self.note(stamp);
        Ok(())
    }

    /// Checks an incoming frame without remembering it: a copy that comes from a peer who is not believed must not make the
    /// original a replayed one.
    ///
    /// # Errors
    /// Why the frame must not be used.
    pub(super) fn verify(&self, frame: &Frame<'_>) -> Result<Stamp, Refusal> {
        let Some(signature) = frame.signature() else {
            let exempt = self.mode != SigningMode::Require || frame.id() == RADIO_STATUS;
            return if exempt { Ok(Stamp(None)) } else { Err(Refusal::Unsigned) };
        };
        if self.mode == SigningMode::Off {
            return Ok(Stamp(None));
        }
        let bytes = frame.bytes();
        if self.hash(&bytes[..bytes.len() - 6]) != bytes[bytes.len() - 6..] {
            return Err(Refusal::WrongKey);
        }
        let mut stamp = [0; 8];
        stamp[..6].copy_from_slice(&signature[1..7]);
        let timestamp = u64::from_le_bytes(stamp);
        let stream = (signature[0], frame.system(), frame.component());
        match self.streams.get(&stream) {
            Some(last) if timestamp <= *last => Err(Refusal::Replayed),
            None if timestamp + NEW_STREAM_LAG < self.timestamp => Err(Refusal::Replayed),
            None if self.streams.len() == STREAMS => Err(Refusal::TooManyStreams),
            _ => Ok(Stamp(Some((stream, timestamp)))),
        }
    }

    /// Remembers the time stamp of a frame that is used.
    pub(super) fn note(&mut self, Stamp(stamp): Stamp) {
        if let Some((stream, timestamp)) = stamp {
            // `verify` has seen that there is room.
            let _ = self.streams.insert(stream, timestamp);
            self.advance_to(timestamp);
        }
    }

    fn hash(&self, frame: &[u8]) -> [u8; 6] {
        let digest = Sha256::new().chain_update(self.key).chain_update(frame).finalize();
        let mut cut = [0; 6];
        cut.copy_from_slice(&digest[..6]);
        cut
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mavlink::dialect::{HEARTBEAT_DATA, RADIO_STATUS_DATA};
    use crate::mavlink::{Encoder, Framer};

    const KEY: [u8; 32] = [42; 32];

    fn check(receiver: &mut Signer, bytes: &[u8]) -> Result<(), Refusal> {
        let mut framer = Framer::new();
        framer.push(bytes);
        receiver.check(&framer.next_frame().expect("a frame"))
    }

    fn signed(sender: &mut Signer, encoder: &mut Encoder) -> std::vec::Vec<u8> {
        encoder.encode(&HEARTBEAT_DATA::default(), Some(sender)).to_vec()
    }

    #[test]
    fn a_replayed_frame_is_refused_and_the_next_one_accepted() {
        let (mut sender, mut encoder) = (Signer::new(SigningMode::Require, KEY, 1, 1000), Encoder::new(1, 1));
        let mut receiver = Signer::new(SigningMode::Require, KEY, 0, 1000);
        let first = signed(&mut sender, &mut encoder);
        assert_eq!(check(&mut receiver, &first), Ok(()));
        assert_eq!(check(&mut receiver, &first), Err(Refusal::Replayed));
        assert_eq!(check(&mut receiver, &signed(&mut sender, &mut encoder)), Ok(()));
    }

    #[test]
    fn a_wrong_key_and_a_missing_signature_are_told_apart() {
        let (mut sender, mut encoder) = (Signer::new(SigningMode::Accept, [1; 32], 1, 0), Encoder::new(1, 1));
        let mut receiver = Signer::new(SigningMode::Require, KEY, 0, 0);
        assert_eq!(check(&mut receiver, &signed(&mut sender, &mut encoder)), Err(Refusal::WrongKey));
        let unsigned = encoder.encode(&HEARTBEAT_DATA::default(), None).to_vec();
        assert_eq!(check(&mut receiver, &unsigned), Err(Refusal::Unsigned));
        assert_eq!(check(&mut Signer::new(SigningMode::Accept, KEY, 0, 0), &unsigned), Ok(()));
        let radio = encoder.encode(&RADIO_STATUS_DATA::default(), None).to_vec();
        assert_eq!(check(&mut receiver, &radio), Ok(()));
    }

    #[test]
    fn an_unheard_sender_may_lag_by_a_minute_and_no_more() {
        let mut encoder = Encoder::new(1, 1);
        for (sent, expected) in [(1_000_000, Ok(())), (3_900_000, Ok(())), (900_000, Err(Refusal::Replayed))] {
            let mut receiver = Signer::new(SigningMode::Require, KEY, 0, 6_950_000);
            let frame = signed(&mut Signer::new(SigningMode::Require, KEY, 1, sent), &mut encoder);
            assert_eq!(check(&mut receiver, &frame), expected, "{sent}");
        }
    }
}
