//! Keeps a link open: when it closes or fails, it is opened again, first soon, then ever more rarely. Nothing above
//! has to know that a cable was unplugged, except through [`LinkState`].

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use super::{AnyLink, LinkAddress, NOTHING, open};
use crate::error::{Error, ErrorKind, HalError};
use crate::traits::{Flow, Link, LinkState, Received};

/// First wait after a loss.
const FIRST_DELAY: Duration = Duration::from_millis(100);
/// Longest wait between attempts; a plugged-in cable is found again within this time.
const LONGEST_DELAY: Duration = Duration::from_secs(3);

/// A link that is reopened when it is lost.
pub struct Reconnecting {
    address: LinkAddress,
    link: Option<AnyLink>,
    ended: bool,
    /// Nothing was read since it was opened again.
    reopened: bool,
    delay: Duration,
    retry_at: Instant,
    losses: u64,
    last_error: Option<HalError>,
}

impl Reconnecting {
    /// Opens `address`; with `patient`, an address that cannot be opened yet is no error.
    ///
    /// # Errors
    /// [`HalError::Open`] from the first attempt unless `patient`.
    pub fn open(address: LinkAddress, patient: bool) -> Result<Self, HalError> {
        let (link, last_error) = match open(&address) {
            Ok(link) => (Some(link), None),
            Err(e) if patient => (None, Some(e)),
            Err(e) => return Err(e),
        };
        Ok(Self {
            address,
            link,
            ended: false,
            reopened: false,
            delay: FIRST_DELAY,
            retry_at: Instant::now() + FIRST_DELAY,
            losses: 0,
            last_error,
        })
    }

    /// The open link, if it is.
    pub fn link(&self) -> Option<&AnyLink> {
        self.link.as_ref()
    }

    /// The address being kept open.
    pub fn address(&self) -> &LinkAddress {
        &self.address
    }

    /// How often the link was lost.
    pub fn losses(&self) -> u64 {
        self.losses
    }

    /// Why the link is down, or was last.
    pub fn last_error(&self) -> Option<&HalError> {
        self.last_error.as_ref()
    }

    fn lost(&mut self, error: HalError) {
        // A listening TCP link waits for the next peer by itself.
        if !matches!((&self.address, error.kind()), (LinkAddress::TcpIn(_), ErrorKind::Closed)) {
            self.ended = matches!(self.address, LinkAddress::File(_));
            if !self.ended {
                self.link = None;
            }
        }
        self.losses += u64::from(!self.ended);
        self.delay = FIRST_DELAY;
        self.retry_at = Instant::now() + self.delay;
        self.last_error = Some(error);
    }

    fn retry(&mut self) {
        match open(&self.address) {
            Ok(link) => {
                (self.link, self.reopened) = (Some(link), true);
                self.delay = FIRST_DELAY;
            }
            Err(e) => {
                self.last_error = Some(e);
                self.delay = (self.delay * 2).min(LONGEST_DELAY);
                self.retry_at = Instant::now() + self.delay;
            }
        }
    }
}

impl Link for Reconnecting {
    type Error = HalError;

    /// Never fails: a lost link reads as silence, see [`Reconnecting::state`].
    fn read(&mut self, into: &mut [u8], timeout: Duration) -> Result<Received, HalError> {
        if self.link.is_none() {
            let wait = self.retry_at.saturating_duration_since(Instant::now());
            if wait > timeout {
                std::thread::sleep(timeout);
                return Ok(NOTHING);
            }
            std::thread::sleep(wait);
            self.retry();
        }
        let Some(link) = &mut self.link else { return Ok(NOTHING) };
        if self.ended {
            std::thread::sleep(timeout);
            return Ok(NOTHING);
        }
        match link.read(into, timeout) {
            Ok(mut received) => {
                if received.bytes > 0 && std::mem::take(&mut self.reopened) && received.flow == Flow::Continues {
                    received.flow = Flow::Begins;
                }
                Ok(received)
            }
            Err(e) => {
                self.lost(e);
                Ok(NOTHING)
            }
        }
    }

    fn write(&mut self, frame: &[u8]) -> Result<(), HalError> {
        let Some(link) = &mut self.link else { return Err(HalError::Full { address: self.address.to_string() }) };
        match link.write(frame) {
            Err(e) if e.kind() != ErrorKind::Busy => {
                self.lost(e);
                Err(HalError::Full { address: self.address.to_string() })
            }
            other => other,
        }
    }

    fn pin(&mut self, peer: SocketAddr) {
        if let Some(link) = &mut self.link {
            link.pin(peer);
        }
    }

    fn vouch(&mut self, peer: SocketAddr) {
        if let Some(link) = &mut self.link {
            link.vouch(peer);
        }
    }

    fn senders(&self) -> usize {
        if matches!(self.address, LinkAddress::TcpIn(_)) { super::tcp::CONNECTIONS } else { 1 }
    }

    fn why_down(&self) -> Option<String> {
        self.last_error.as_ref().filter(|_| self.link.is_none()).map(ToString::to_string)
    }

    fn state(&self) -> LinkState {
        match (&self.link, self.ended) {
            (_, true) => LinkState::Ended,
            (Some(_), _) => LinkState::Up,
            (None, _) => LinkState::Down,
        }
    }
}
