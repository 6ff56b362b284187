//! Byte pipes to an autopilot behind one address syntax (rust-mavlink's, plus `pty:`): serial ports, UDP, TCP, recorded
//! logs, and a pseudo-terminal made by the program itself.

mod address;
mod file;
mod pty;
mod reconnect;
mod serial;
mod tcp;
mod udp;
mod wire;

use std::net::SocketAddr;
use std::path::Path;
use std::time::Duration;

pub use address::LinkAddress;
pub use file::TlogLink;
pub use pty::PtyLink;
pub use reconnect::Reconnecting;
pub use serial::SerialLink;
pub use tcp::TcpLink;
pub use udp::UdpLink;
pub use wire::WireLink;

use crate::error::HalError;
use crate::traits::{Flow, Link, Received};

/// Any of the links.
pub enum AnyLink {
    /// A serial port, or the other end of a pseudo-terminal.
    Serial(SerialLink),
    /// UDP, either way round.
    Udp(UdpLink),
    /// TCP, either way round.
    Tcp(Box<TcpLink>),
    /// A recorded log.
    Tlog(TlogLink),
    /// The near end of a pseudo-terminal.
    Pty(PtyLink),
}

/// Opens the link at `address`.
///
/// # Errors
/// [`HalError::Open`] with the system's reason.
pub fn open(address: &LinkAddress) -> Result<AnyLink, HalError> {
    Ok(match address {
        LinkAddress::Serial { path, baud } => AnyLink::Serial(SerialLink::open(path, *baud)?),
        LinkAddress::UdpIn(host) => AnyLink::Udp(UdpLink::listen(host)?),
        LinkAddress::UdpOut(host) => AnyLink::Udp(UdpLink::connect(host)?),
        LinkAddress::TcpIn(host) => AnyLink::Tcp(TcpLink::listen(host)?.into()),
        LinkAddress::TcpOut(host) => AnyLink::Tcp(TcpLink::connect(host)?.into()),
        LinkAddress::File(path) => AnyLink::Tlog(TlogLink::open(path)?),
        LinkAddress::Pty(alias) => AnyLink::Pty(PtyLink::create(alias.as_deref())?),
    })
}

impl AnyLink {
    /// The path that a peer opens as its serial port, for a pseudo-terminal.
    pub fn pty_path(&self) -> Option<&Path> {
        match self {
            Self::Pty(pty) => Some(pty.path()),
            _ => None,
        }
    }

    /// The log, when this link replays one.
    pub fn tlog(&self) -> Option<&TlogLink> {
        match self {
            Self::Tlog(log) => Some(log),
            _ => None,
        }
    }
}

impl Link for AnyLink {
    type Error = HalError;

    fn read(&mut self, into: &mut [u8], timeout: Duration) -> Result<Received, HalError> {
        match self {
            Self::Serial(link) => link.read(into, timeout),
            Self::Udp(link) => link.read(into, timeout),
            Self::Tcp(link) => link.read(into, timeout),
            Self::Tlog(link) => link.read(into, timeout),
            Self::Pty(link) => link.read(into, timeout),
        }
    }

    fn pin(&mut self, peer: SocketAddr) {
        match self {
            Self::Udp(link) => link.pin(peer),
            Self::Tcp(link) => link.pin(peer),
            _ => {}
        }
    }

    fn vouch(&mut self, peer: SocketAddr) {
        if let Self::Tcp(link) = self {
            link.vouch(peer);
        }
    }

    fn senders(&self) -> usize {
        match self {
            Self::Tcp(link) => link.senders(),
            _ => 1,
        }
    }

    fn write(&mut self, frame: &[u8]) -> Result<(), HalError> {
        match self {
            Self::Serial(link) => link.write(frame),
            Self::Udp(link) => link.write(frame),
            Self::Tcp(link) => link.write(frame),
            Self::Tlog(link) => link.write(frame),
            Self::Pty(link) => link.write(frame),
        }
    }
}

/// Nothing came in time: not an error on a live link.
const NOTHING: Received = Received { bytes: 0, time_ns: None, peer: None, flow: Flow::Continues };

fn is_timeout(e: &std::io::Error) -> bool {
    use std::io::ErrorKind::{Interrupted, TimedOut, WouldBlock};
    matches!(e.kind(), TimedOut | WouldBlock | Interrupted)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Reads until `wanted` bytes came.
    fn read(link: &mut impl Link<Error = HalError>, wanted: usize) -> Vec<u8> {
        let (mut all, mut buffer, until) = (Vec::new(), [0; 64], std::time::Instant::now() + Duration::from_secs(10));
        while all.len() < wanted && std::time::Instant::now() < until {
            let received = link.read(&mut buffer, Duration::from_millis(20)).expect("open");
            all.extend_from_slice(&buffer[..received.bytes]);
        }
        all
    }

    #[test]
    fn udp_answers_whoever_spoke_last() {
        let mut here = UdpLink::listen("127.0.0.1:0").expect("a port");
        assert!(here.write(b"nobody yet").is_err());
        let mut there = UdpLink::connect(&here.local().expect("its port").to_string()).expect("opens");
        there.write(b"hello").expect("sent");
        assert_eq!(read(&mut here, 5), b"hello");
        here.write(b"answer").expect("sent");
        assert_eq!(read(&mut there, 6), b"answer");
    }

    #[test]
    fn tcp_takes_one_peer_after_the_other() {
        let mut here = TcpLink::listen("127.0.0.1:0").expect("a port");
        let host = here.local().expect("its port").to_string();
        for word in [b"first", b"later"] {
            let mut there = TcpLink::connect(&host).expect("listening");
            there.write(word).expect("sent");
            assert_eq!(read(&mut here, 5), word);
            here.write(word).expect("sent");
            assert_eq!(read(&mut there, 5), word);
            drop(there);
            let mut buffer = [0; 8];
            let closed = (0..500).any(|_| here.read(&mut buffer, Duration::from_millis(10)).is_err());
            assert!(closed, "the end of a connection is an error, once");
        }
        assert!(TcpLink::connect("127.0.0.1:1").err().expect("closed").to_string().contains("tcpout:127.0.0.1:1"));
    }
}
