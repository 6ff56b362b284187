//! UDP, either way round: `udpin` waits and answers the last sender until one is pinned, `udpout` sends first.

use std::net::{SocketAddr, UdpSocket};
use std::time::Duration;

use super::{NOTHING, is_timeout};
use crate::error::HalError;
use crate::traits::{Flow, Link, Received};

/// A UDP socket and the peer it talks to.
pub struct UdpLink {
    socket: UdpSocket,
    peer: Option<SocketAddr>,
    /// `udpin`: whoever sent last is answered, until one is pinned.
    follow: bool,
    listens: bool,
    timeout: Option<Duration>,
    address: String,
}

impl UdpLink {
    /// Waits for datagrams at `host` (`ADDRESS:PORT`).
    ///
    /// # Errors
    /// [`HalError::Open`], e.g. when the port is taken.
    pub fn listen(host: &str) -> Result<Self, HalError> {
        let address = format!("udpin:{host}");
        match UdpSocket::bind(host) {
            Ok(socket) => Ok(Self { socket, peer: None, follow: true, listens: true, timeout: None, address }),
            Err(source) => Err(HalError::Open { address, source }),
        }
    }

    /// Sends to `host` and listens to its answers.
    ///
    /// # Errors
    /// [`HalError::Open`], e.g. when the name cannot be resolved.
    pub fn connect(host: &str) -> Result<Self, HalError> {
        use std::net::ToSocketAddrs;
        let address = format!("udpout:{host}");
        let open = || {
            let peer = host.to_socket_addrs()?.next().ok_or(std::io::ErrorKind::AddrNotAvailable)?;
            let any = if peer.is_ipv4() { "0.0.0.0:0" } else { "[::]:0" };
            Ok((UdpSocket::bind(any)?, peer))
        };
        match open() {
            Ok((socket, peer)) => {
                Ok(Self { socket, peer: Some(peer), follow: false, listens: false, timeout: None, address })
            }
            Err(source) => Err(HalError::Open { address, source }),
        }
    }

    /// The local address, with the port that the system chose for port 0.
    pub fn local(&self) -> Option<SocketAddr> {
        self.socket.local_addr().ok()
    }

    fn failed(&self, source: std::io::Error) -> HalError {
        HalError::Link { address: self.address.clone(), source }
    }
}

impl Link for UdpLink {
    type Error = HalError;

    fn read(&mut self, into: &mut [u8], timeout: Duration) -> Result<Received, HalError> {
        // A zero read timeout means "for ever" to the system.
        let timeout = timeout.max(Duration::from_micros(100));
        if self.timeout != Some(timeout) {
            self.socket.set_read_timeout(Some(timeout)).map_err(|e| self.failed(e))?;
            self.timeout = Some(timeout);
        }
        match self.socket.recv_from(into) {
            Ok((bytes, from)) => {
                if self.follow {
                    self.peer = Some(from);
                } else if !self.listens && self.peer != Some(from) {
                    return Ok(NOTHING);
                }
                // `udpout` has one peer, whom the mission names: nobody has to be told apart.
                Ok(Received { bytes, peer: self.listens.then_some(from), flow: Flow::Whole, ..NOTHING })
            }
            // Linux reports that an earlier datagram met a closed port: the peer is not up yet.
            Err(e) if is_timeout(&e) || e.kind() == std::io::ErrorKind::ConnectionRefused => Ok(NOTHING),
            Err(e) => Err(self.failed(e)),
        }
    }

    fn pin(&mut self, peer: SocketAddr) {
        // `udpout` goes on sending where it was told to.
        if self.listens {
            (self.peer, self.follow) = (Some(peer), false);
        }
    }

    fn write(&mut self, frame: &[u8]) -> Result<(), HalError> {
        let Some(peer) = self.peer else { return Err(HalError::Full { address: self.address.clone() }) };
        match self.socket.send_to(frame, peer) {
            Ok(_) => Ok(()),
            Err(e) if is_timeout(&e) || e.kind() == std::io::ErrorKind::ConnectionRefused => {
                Err(HalError::Full { address: self.address.clone() })
            }
            Err(e) => Err(self.failed(e)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn udpout_hears_the_address_and_the_port_it_sends_to_and_nobody_else() {
        let wait = Duration::from_secs(5);
        let mission = UdpSocket::bind("127.0.0.1:0").expect("a port");
        let port = mission.local_addr().expect("bound").port();
        let mut link = UdpLink::connect(&format!("127.0.0.1:{port}")).expect("a link");
        let here = ("127.0.0.1", link.local().expect("bound").port());
        // The same port at another address, another port at the same address.
        let strangers = [UdpSocket::bind(("127.0.0.2", port)), UdpSocket::bind("127.0.0.1:0")];
        let mut into = [0; 64];
        for stranger in strangers.map(|s| s.expect("a port")) {
            stranger.send_to(b"stranger", here).expect("sent");
            assert_eq!(link.read(&mut into, wait).expect("read").bytes, 0);
        }
        mission.send_to(b"autopilot", here).expect("sent");
        let heard = link.read(&mut into, wait).expect("read").bytes;
        assert_eq!(&into[..heard], b"autopilot");
    }
}
