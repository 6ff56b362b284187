//! What a device has to do, whether the driver's or a test's.

use std::io;
use std::path::Path;
use std::time::Duration;

use crate::camera::picture::Picture;
use crate::error::{ErrorKind, HalError};

/// What the driver says about a picture.
#[derive(Clone, Copy, Debug)]
pub(super) struct Stamp {
    pub(super) number: u32,
    /// On CLOCK_MONOTONIC; `None` from drivers that stamp by another clock.
    pub(super) taken: Option<Duration>,
    /// The driver marks its contents as damaged.
    pub(super) damaged: bool,
}

/// A device that streams.
pub(super) trait Stream {
    /// Waits for the next picture.
    fn next(&mut self) -> io::Result<(&[u8], Stamp)>;

    /// The picture in these bytes; `None` when they are too few or too many.
    fn picture(&self, bytes: &[u8]) -> Option<Picture>;
}

/// An error of this device.
pub(super) fn video(device: &Path, kind: ErrorKind, why: impl Into<String>) -> HalError {
    HalError::Video { device: device.into(), kind, why: why.into() }
}
