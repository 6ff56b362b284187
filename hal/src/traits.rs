//! The five seams of the HAL, small and fallible, in the spirit of embedded-hal. [`crate::vehicle`] is the generic
//! driver over all of them; nothing above it knows which implementation it talks to.

use core::net::SocketAddr;
use core::time::Duration;

use crate::error::Error;
use crate::trigger::Trigger;

pub use crate::pose::PoseSource;

/// A monotonic clock: the companion's.
pub trait Clock {
    /// Nanoseconds since an arbitrary start; never goes back.
    fn now_ns(&self) -> u64;
}

/// What one [`Link::read`] brought.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Received {
    /// Bytes written to the start of the caller's buffer; 0 when nothing came in time.
    pub bytes: usize,
    /// When they were received, for recordings, which carry their own clock; `None` on live links (= now).
    pub time_ns: Option<u64>,
    /// Who sent them, on links where anybody may.
    pub peer: Option<SocketAddr>,
    /// How they belong to what came from there before.
    pub flow: Flow,
}

/// Where the bytes of one [`Link::read`] stand in what their sender says. Half a frame must not be completed by bytes that do
/// not follow it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Flow {
    /// They follow what was read from this sender before.
    #[default]
    Continues,
    /// A connection begins with them.
    Begins,
    /// A datagram: nothing before them and nothing behind them belongs to them.
    Whole,
}

/// Whether a link is open.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LinkState {
    /// Open.
    Up,
    /// Lost, being reopened.
    Down,
    /// A recording at its end: nothing will come any more.
    Ended,
}

/// A byte pipe to an autopilot.
pub trait Link {
    /// What can go wrong.
    type Error: Error;

    /// Reads what is there into `into`, waiting `timeout` at most for the first byte.
    ///
    /// # Errors
    /// `ErrorKind::Closed` when the other end is gone for now; the caller may keep reading (a link that reconnects
    /// comes back by itself).
    fn read(&mut self, into: &mut [u8], timeout: Duration) -> Result<Received, Self::Error>;

    /// Writes one whole frame, or nothing.
    ///
    /// # Errors
    /// `ErrorKind::Busy` when the other end does not read; the frame is then dropped, never half written.
    fn write(&mut self, frame: &[u8]) -> Result<(), Self::Error>;

    /// From now on answers go to this peer, whoever else speaks, on links where anybody may.
    fn pin(&mut self, peer: SocketAddr) {
        let _ = peer;
    }

    /// Says that a whole frame in the autopilot's name came from this peer, which is not pinned: of several connections those
    /// without make room first.
    fn vouch(&mut self, peer: SocketAddr) {
        let _ = peer;
    }

    /// How many peers may be half through a frame at the same time.
    fn senders(&self) -> usize {
        1
    }

    /// Why it is not open, where it is not.
    #[cfg(feature = "std")]
    fn why_down(&self) -> Option<std::string::String> {
        None
    }

    /// Whether it is open; links that do not reconnect are always up and report their end as an error.
    fn state(&self) -> LinkState {
        LinkState::Up
    }
}

/// Where exposures are announced.
pub trait TriggerSource {
    /// The next announced exposure, oldest first; each one exactly once.
    fn next_trigger(&mut self) -> Option<Trigger>;
}

/// What is known about a picture besides its pixels: the clues the matcher works with.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PictureClues {
    /// When it was complete, companion clock, ns: the exposure was some latency earlier.
    pub arrived_ns: u64,
    /// The driver's time stamp on the companion's clock, ns, when there is one: the middle of the exposure is the lens's
    /// `exposure_delay_ms` later.
    pub stamped_ns: Option<u64>,
    /// Number in its file name or stream.
    pub number: Option<u64>,
    /// The camera's own clock at exposure (EXIF), ns since an arbitrary start.
    pub camera_ns: Option<u64>,
    /// Resolution of `camera_ns`, ns (1 s for EXIF without sub-seconds).
    pub camera_resolution_ns: u64,
    /// When its file was written, on the wall clock, ns since 1970.
    pub written_ns: Option<u64>,
}

/// A source of pictures.
pub trait Camera {
    /// Path or pixels.
    type Picture;
    /// What can go wrong.
    type Error: Error;

    /// The next complete picture, if one is there; never waits. `now_ns` is the companion's clock.
    ///
    /// # Errors
    /// One bad picture is an error of its own (`ErrorKind::Device`) and does not stop the source.
    fn next_picture(&mut self, now_ns: u64) -> Result<Option<(PictureClues, Self::Picture)>, Self::Error>;

    /// True for video: its pictures belong to no announced exposure, each is posed by its own time.
    fn is_continuous(&self) -> bool {
        false
    }

    /// True while the place that pictures come to is not there; it is waited for.
    fn is_missing(&self) -> bool {
        false
    }

    /// Pictures that the camera took and that were not given out by [`Camera::next_picture`], by the camera's own numbers.
    fn lost_pictures(&self) -> u64 {
        0
    }
}
