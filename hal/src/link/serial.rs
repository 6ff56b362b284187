//! A serial port. Also opens the far end of a pseudo-terminal, which is how simulators are attached.

use std::io::{Read, Write};
use std::path::Path;
use std::time::Duration;

use serialport::{SerialPort, TTYPort};

use super::{NOTHING, is_timeout};
use crate::error::HalError;
use crate::traits::{Link, Received};

/// A frame that the port does not take within this time is dropped: its telemetry would be stale anyway.
const WRITE_TIMEOUT: Duration = Duration::from_millis(20);

/// An open serial port, 8N1, raw, no flow control.
pub struct SerialLink {
    port: TTYPort,
    address: String,
}

impl SerialLink {
    /// Opens `path` at `baud` bits per second.
    ///
    /// # Errors
    /// [`HalError::Open`], e.g. when it is missing, busy, or the user may not open it.
    pub fn open(path: &Path, baud: u32) -> Result<Self, HalError> {
        let address = format!("serial:{}:{baud}", path.display());
        let builder = serialport::new(path.to_string_lossy(), baud).timeout(WRITE_TIMEOUT);
        match TTYPort::open(&builder) {
            Ok(port) => Ok(Self { port, address }),
            Err(e) => Err(HalError::Open { address, source: e.into() }),
        }
    }

    fn failed(&self, source: std::io::Error) -> HalError {
        HalError::Link { address: self.address.clone(), source }
    }

    fn wait_at_most(&mut self, timeout: Duration) -> Result<(), HalError> {
        if self.port.timeout() != timeout {
            self.port.set_timeout(timeout).map_err(|e| self.failed(e.into()))?;
        }
        Ok(())
    }
}

impl Link for SerialLink {
    type Error = HalError;

    fn read(&mut self, into: &mut [u8], timeout: Duration) -> Result<Received, HalError> {
        self.wait_at_most(timeout)?;
        match self.port.read(into) {
            Ok(0) => Err(HalError::Closed { address: self.address.clone() }),
            Ok(bytes) => Ok(Received { bytes, ..NOTHING }),
            Err(e) if is_timeout(&e) => Ok(NOTHING),
            Err(e) => Err(self.failed(e)),
        }
    }

    fn write(&mut self, frame: &[u8]) -> Result<(), HalError> {
        self.wait_at_most(WRITE_TIMEOUT)?;
        match self.port.write_all(frame) {
            Ok(()) => Ok(()),
            Err(e) if is_timeout(&e) => Err(HalError::Full { address: self.address.clone() }),
            Err(e) => Err(self.failed(e)),
        }
    }
}
