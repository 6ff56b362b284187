//! TCP, either way round: `tcpin` waits for one peer at a time, `tcpout` connects.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, ToSocketAddrs};
use std::time::{Duration, Instant};

use super::{NOTHING, is_timeout};
use crate::error::HalError;
use crate::traits::{Link, Received};

/// How long a connection attempt may take before the back-off of the caller goes on.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(2);
/// As for serial ports: telemetry that cannot leave within this time is stale.
const WRITE_TIMEOUT: Duration = Duration::from_millis(50);
/// How often a waiting `tcpin` looks for its peer.
const ACCEPT_EVERY: Duration = Duration::from_millis(5);
/// A peer of `tcpin` that says nothing for this long makes room for the next: an autopilot's heart beats at 1 Hz.
const MUTE_TIMEOUT: Duration = Duration::from_secs(10);

/// A TCP connection, and the listener it came from.
pub struct TcpLink {
    listener: Option<TcpListener>,
    stream: Option<TcpStream>,
    peer: Option<SocketAddr>,
    /// When it last sent something.
    spoke: Instant,
    timeout: Option<Duration>,
    address: String,
}

impl TcpLink {
    /// Waits for a peer at `host` (`ADDRESS:PORT`).
    ///
    /// # Errors
    /// [`HalError::Open`], e.g. when the port is taken.
    pub fn listen(host: &str) -> Result<Self, HalError> {
        let address = format!("tcpin:{host}");
        let open = || {
            let listener = TcpListener::bind(host)?;
            listener.set_nonblocking(true)?;
            Ok(listener)
        };
        match open() {
            Ok(listener) => Ok(Self {
                listener: Some(listener),
                stream: None,
                peer: None,
                spoke: Instant::now(),
                timeout: None,
                address,
            }),
            Err(source) => Err(HalError::Open { address, source }),
        }
    }

    /// Connects to `host`.
    ///
    /// # Errors
    /// [`HalError::Open`], e.g. when nobody listens there.
    pub fn connect(host: &str) -> Result<Self, HalError> {
        let address = format!("tcpout:{host}");
        let open = || {
            let peer = host.to_socket_addrs()?.next().ok_or(std::io::ErrorKind::AddrNotAvailable)?;
            prepare(TcpStream::connect_timeout(&peer, CONNECT_TIMEOUT)?)
        };
        match open() {
            Ok(stream) => {
                let peer = stream.peer_addr().ok();
                Ok(Self { listener: None, stream: Some(stream), peer, spoke: Instant::now(), timeout: None, address })
            }
            Err(source) => Err(HalError::Open { address, source }),
        }
    }

    /// The local address, with the port that the system chose for port 0.
    pub fn local(&self) -> Option<SocketAddr> {
        match (&self.listener, &self.stream) {
            (Some(listener), _) => listener.local_addr().ok(),
            (None, Some(stream)) => stream.local_addr().ok(),
            (None, None) => None,
        }
    }

    fn accept(&mut self, timeout: Duration) -> Result<bool, HalError> {
        let Some(listener) = &self.listener else {
            return Err(HalError::Closed { address: self.address.clone() });
        };
        let until = Instant::now() + timeout;
        loop {
            match listener.accept().and_then(|(stream, _)| prepare(stream)) {
                Ok(stream) => {
                    (self.peer, self.spoke) = (stream.peer_addr().ok(), Instant::now());
                    (self.stream, self.timeout) = (Some(stream), None);
                    return Ok(true);
                }
                Err(e) if is_timeout(&e) && Instant::now() < until => std::thread::sleep(ACCEPT_EVERY.min(timeout)),
                Err(e) if is_timeout(&e) => return Ok(false),
                Err(source) => return Err(HalError::Link { address: self.address.clone(), source }),
            }
        }
    }

    /// The peer is gone: a listener waits for the next one, a client is closed.
    fn drop_peer(&mut self, source: Option<std::io::Error>) -> HalError {
        self.stream = None;
        let address = self.address.clone();
        match source {
            Some(source) => HalError::Link { address, source },
            None => HalError::Closed { address },
        }
    }
}

fn prepare(stream: TcpStream) -> std::io::Result<TcpStream> {
    stream.set_nonblocking(false)?;
    stream.set_nodelay(true)?;
    stream.set_write_timeout(Some(WRITE_TIMEOUT))?;
    Ok(stream)
}

impl Link for TcpLink {
    type Error = HalError;

    fn read(&mut self, into: &mut [u8], timeout: Duration) -> Result<Received, HalError> {
        if self.stream.is_none() && !self.accept(timeout)? {
            return Ok(NOTHING);
        }
        let Some(stream) = &mut self.stream else { return Ok(NOTHING) };
        // A zero read timeout means "for ever" to the system.
        let timeout = timeout.max(Duration::from_micros(100));
        if self.timeout != Some(timeout) {
            if let Err(e) = stream.set_read_timeout(Some(timeout)) {
                return Err(self.drop_peer(Some(e)));
            }
            self.timeout = Some(timeout);
        }
        match stream.read(into) {
            Ok(0) => Err(self.drop_peer(None)),
            Ok(bytes) => {
                self.spoke = Instant::now();
                Ok(Received { bytes, peer: self.peer, ..NOTHING })
            }
            Err(e) if is_timeout(&e) && self.listener.is_some() && self.spoke.elapsed() > MUTE_TIMEOUT => {
                Err(self.drop_peer(None))
            }
            Err(e) if is_timeout(&e) => Ok(NOTHING),
            Err(e) => Err(self.drop_peer(Some(e))),
        }
    }

    fn dismiss(&mut self) {
        if self.listener.is_some() {
            self.stream = None;
        }
    }

    fn write(&mut self, frame: &[u8]) -> Result<(), HalError> {
        let Some(stream) = &mut self.stream else { return Err(HalError::Full { address: self.address.clone() }) };
        match stream.write_all(frame) {
            Ok(()) => Ok(()),
            // After a timeout part of the frame may be on its way; the peer's framer resynchronises.
            Err(e) if is_timeout(&e) => Err(HalError::Full { address: self.address.clone() }),
            Err(e) => Err(self.drop_peer(Some(e))),
        }
    }
}
