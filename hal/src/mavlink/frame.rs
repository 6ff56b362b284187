//! Finds MAVLink 1 and 2 frames in a stream of bytes that may be damaged anywhere, without allocating and without
//! losing a good frame that begins inside a damaged one: after a bad checksum the search goes on one byte later.

use ::mavlink::dialects::ardupilotmega::MavMessage;
use ::mavlink::{MavlinkVersion, Message, MessageData, calculate_crc};

/// First byte of a MAVLink 1 frame.
const STX_V1: u8 = 0xFE;
/// First byte of a MAVLink 2 frame.
const STX_V2: u8 = 0xFD;
/// Incompatibility flag of MAVLink 2: a signature follows the checksum.
pub(super) const SIGNED: u8 = 0x01;
/// Signature: link id, 48-bit time stamp, 48-bit hash.
pub(super) const SIGNATURE_LEN: usize = 13;
/// Largest frame: header, payload, checksum, signature.
const MAX_FRAME: usize = 10 + 255 + 2 + SIGNATURE_LEN;
/// Room for several frames, so that one read call drains a serial driver's buffer.
const CAPACITY: usize = 4096;

/// One frame whose checksum is right.
#[derive(Clone, Copy, Debug)]
pub struct Frame<'a> {
    bytes: &'a [u8],
}

impl<'a> Frame<'a> {
    /// The whole frame as it came, signature included.
    pub fn bytes(&self) -> &'a [u8] {
        self.bytes
    }

    fn is_v2(&self) -> bool {
        self.bytes[0] == STX_V2
    }

    /// Protocol version.
    pub fn version(&self) -> MavlinkVersion {
        if self.is_v2() { MavlinkVersion::V2 } else { MavlinkVersion::V1 }
    }

    /// Sender's counter, wraps at 256.
    pub fn sequence(&self) -> u8 {
        self.bytes[if self.is_v2() { 4 } else { 2 }]
    }

    /// Sender's system id.
    pub fn system(&self) -> u8 {
        self.bytes[if self.is_v2() { 5 } else { 3 }]
    }

    /// Sender's component id.
    pub fn component(&self) -> u8 {
        self.bytes[if self.is_v2() { 6 } else { 4 }]
    }

    /// Message id.
    pub fn id(&self) -> u32 {
        if self.is_v2() {
            u32::from_le_bytes([self.bytes[7], self.bytes[8], self.bytes[9], 0])
        } else {
            u32::from(self.bytes[5])
        }
    }

    /// Payload as sent (MAVLink 2 cuts trailing zeros).
    pub fn payload(&self) -> &'a [u8] {
        let start = header_len(self.bytes[0]);
        &self.bytes[start..start + usize::from(self.bytes[1])]
    }

    /// Link id, time stamp and hash bytes when the frame is signed.
    pub fn signature(&self) -> Option<&'a [u8; SIGNATURE_LEN]> {
        if self.is_v2() && self.bytes[2] & SIGNED != 0 { self.bytes.last_chunk() } else { None }
    }

    /// The payload as message `D`; `None` when this frame is another message or holds an unknown enum value.
    pub fn message<D: MessageData>(&self) -> Option<D> {
        if self.id() == D::ID { D::deser(self.version(), self.payload()).ok() } else { None }
    }
}

fn header_len(stx: u8) -> usize {
    if stx == STX_V2 { 10 } else { 6 }
}

/// What the framer met.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameCounters {
    /// Frames with a right checksum.
    pub frames: u64,
    /// Stretches of the stream where a frame was expected and none was found (checksum, start byte).
    pub damaged: u64,
    /// Bytes passed over while searching for the next frame.
    pub skipped_bytes: u64,
    /// Whole frames of message ids that the dialect does not know.
    pub unknown: u64,
    /// Whole frames with incompatibility flags that this code does not know; the protocol orders to drop them.
    pub unsupported: u64,
}

impl core::ops::Add for FrameCounters {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            frames: self.frames + other.frames,
            damaged: self.damaged + other.damaged,
            skipped_bytes: self.skipped_bytes + other.skipped_bytes,
            unknown: self.unknown + other.unknown,
            unsupported: self.unsupported + other.unsupported,
        }
    }
}

/// Finds frames in a byte stream; fixed memory.
pub struct Framer {
    buffer: [u8; CAPACITY],
    start: usize,
    end: usize,
    last_len: usize,
    in_sync: bool,
    /// No more bytes will come: half a frame is a damaged one.
    ended: bool,
    /// The bytes being passed over may be one whole frame of an unknown message.
    guess: Option<Guess>,
    counters: FrameCounters,
}

impl Default for Framer {
    fn default() -> Self {
        Self {
            buffer: [0; CAPACITY],
            start: 0,
            end: 0,
            last_len: 0,
            in_sync: true,
            ended: false,
            guess: None,
            counters: FrameCounters::default(),
        }
    }
}

/// The checksum of an unknown message cannot be checked, so it looks like noise that begins with a start byte. It is
/// searched like noise, lest a good frame inside it be lost; when the search comes out just behind it, it was whole.
#[derive(Clone, Copy)]
struct Guess {
    /// Index behind its last byte.
    end: usize,
    /// [`FrameCounters::skipped_bytes`] before it.
    skipped_before: u64,
}

enum Found {
    Frame(usize),
    Skip(usize),
    /// Perhaps a frame of an unknown message, this long.
    Unknown(usize),
    Damaged,
    NeedMore,
}

impl Framer {
    /// An empty framer.
    pub fn new() -> Self {
        Self::default()
    }

    /// What was met so far.
    pub fn counters(&self) -> FrameCounters {
        self.counters
    }

    /// Room to read into; call [`Framer::filled`] with what was written. Never empty once [`Framer::next_frame`]
    /// returned `None`.
    pub fn space(&mut self) -> &mut [u8] {
        self.ended = false;
        self.last_len = 0;
        if self.start > 0 {
            self.buffer.copy_within(self.start..self.end, 0);
            self.end -= self.start;
            if let Some(guess) = &mut self.guess {
                guess.end = guess.end.saturating_sub(self.start);
            }
            self.start = 0;
        }
        &mut self.buffer[self.end..]
    }

    /// Says that `bytes` were written to the start of [`Framer::space`].
    pub fn filled(&mut self, bytes: usize) {
        self.end = (self.end + bytes).min(CAPACITY);
    }

    /// Copies what fits of `bytes`; returns how many were taken. Take out frames and push the rest.
    pub fn push(&mut self, bytes: &[u8]) -> usize {
        let space = self.space();
        let n = bytes.len().min(space.len());
        space[..n].copy_from_slice(&bytes[..n]);
        self.filled(n);
        n
    }

    /// Says that no more bytes will come, so that frames behind half a damaged one are found.
    pub fn end(&mut self) {
        self.ended = true;
    }

    /// Forgets half a frame, for a link that was reopened.
    pub fn reset(&mut self) {
        self.start = 0;
        self.end = 0;
        self.last_len = 0;
        self.in_sync = true;
        self.guess = None;
    }

    /// The next frame with a right checksum; `None` when more bytes are needed.
    pub fn next_frame(&mut self) -> Option<Frame<'_>> {
        loop {
            self.settle_guess();
            match self.look() {
                Found::NeedMore if self.ended && self.start < self.end => self.pass_over(),
                Found::NeedMore => return None,
                Found::Frame(len) => {
                    self.in_sync = true;
                    self.counters.damaged += u64::from(self.guess.take().is_some());
                    self.counters.frames += 1;
                    self.start += len;
                    self.last_len = len;
                    return self.last_frame();
                }
                Found::Skip(len) => {
                    self.in_sync = true;
                    self.counters.damaged += u64::from(self.guess.take().is_some());
                    self.start += len;
                }
                Found::Unknown(len) => {
                    let end = self.start + len;
                    self.guess.get_or_insert(Guess { end, skipped_before: self.counters.skipped_bytes });
                    self.pass_over();
                }
                Found::Damaged => self.pass_over(),
            }
        }
    }

    /// Once the search has passed the bytes of a guess: what follows tells whether it was a frame or damage.
    fn settle_guess(&mut self) {
        let Some(guess) = self.guess.filter(|guess| self.start == guess.end) else { return };
        self.guess = None;
        if matches!(self.buffer[..self.end].get(self.start), None | Some(&STX_V1 | &STX_V2)) {
            self.counters.unknown += 1;
            self.counters.skipped_bytes = guess.skipped_before;
            self.in_sync = true;
        } else {
            self.counters.damaged += 1;
        }
    }

    /// Goes on to the next byte that may start a frame.
    fn pass_over(&mut self) {
        if core::mem::replace(&mut self.in_sync, false) && self.guess.is_none() {
            self.counters.damaged += 1;
        }
        // Not beyond the end of a guess, which is where it is judged.
        let end = self.guess.map_or(self.end, |guess| guess.end.min(self.end));
        let rest = &self.buffer[self.start + 1..end];
        let next = rest.iter().position(|b| matches!(*b, STX_V1 | STX_V2)).unwrap_or(rest.len()) + 1;
        self.counters.skipped_bytes += next as u64;
        self.start += next;
    }

    /// The frame that [`Framer::next_frame`] returned last, until [`Framer::space`] or [`Framer::push`] is called.
    pub fn last_frame(&self) -> Option<Frame<'_>> {
        let bytes = self.buffer.get(self.start.checked_sub(self.last_len)?..self.start)?;
        (!bytes.is_empty()).then_some(Frame { bytes })
    }

    fn look(&mut self) -> Found {
        let data = &self.buffer[self.start..self.end];
        let (Some(&stx), payload_len) = (data.first(), data.get(1)) else { return Found::NeedMore };
        if !matches!(stx, STX_V1 | STX_V2) {
            return Found::Damaged;
        }
        let (Some(&payload_len), Some(&flags)) = (payload_len, data.get(2)) else { return Found::NeedMore };
        let header = header_len(stx);
        let checked = header + usize::from(payload_len);
        let signed = stx == STX_V2 && flags & SIGNED != 0;
        let len = checked + 2 + if signed { SIGNATURE_LEN } else { 0 };
        debug_assert!(len <= MAX_FRAME);
        if data.len() < len {
            return Found::NeedMore;
        }
        let frame = Frame { bytes: &data[..len] };
        let sent = u16::from_le_bytes([data[checked], data[checked + 1]]);
        // A checksum is right only with the number that belongs to its message: without one it says nothing.
        let is_known = MavMessage::default_message_from_id(frame.id()).is_some();
        if is_known && calculate_crc(&data[1..checked], MavMessage::extra_crc(frame.id())) == sent {
            if stx == STX_V2 && flags & !SIGNED != 0 {
                self.counters.unsupported += 1;
                return Found::Skip(len);
            }
            return Found::Frame(len);
        }
        let known_flags = stx == STX_V1 || flags & !SIGNED == 0;
        if self.in_sync && known_flags && !is_known {
            return Found::Unknown(len);
        }
        Found::Damaged
    }
}

#[cfg(test)]
mod tests;
