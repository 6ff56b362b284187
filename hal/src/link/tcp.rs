//! TCP, either way round: `tcpin` serves a few peers at once until one is pinned, `tcpout` connects.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream, ToSocketAddrs};
use std::time::{Duration, Instant};

use heapless::Vec;
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::{NOTHING, is_timeout};
use crate::error::HalError;
use crate::traits::{Flow, Link, Received};

/// How long a connection attempt may take before the back-off of the caller goes on.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(2);
/// As for serial ports: telemetry that cannot leave within this time is stale.
const WRITE_TIMEOUT: Duration = Duration::from_millis(50);
/// Connections of `tcpin` at the same time.
pub(super) const CONNECTIONS: usize = 8;
/// Connections taken in one read at most.
const ACCEPTED_AT_ONCE: usize = 16;
/// A connection that is not pinned by then is closed: what [`crate::peer`] asks for takes 10 s at most.
const PROOF_TIME: Duration = Duration::from_secs(15);
/// A connection this young makes room for no other.
const GRACE: Duration = Duration::from_secs(1);

/// One connection.
struct Connection {
    stream: TcpStream,
    peer: SocketAddr,
    since: Instant,
    /// Whole frames in the autopilot's name.
    vouched: u32,
    begun: bool,
}

/// TCP connections, and the listener they came from.
pub struct TcpLink {
    listener: Option<TcpListener>,
    connections: Vec<Connection, CONNECTIONS>,
    /// Whom to answer: the pinned peer, before that whoever spoke last.
    answered: Option<SocketAddr>,
    is_pinned: bool,
    /// Where reading goes on, so that each has its turn.
    turn: usize,
    address: String,
}

impl TcpLink {
    /// Waits for peers at `host` (`ADDRESS:PORT`).
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
                connections: Vec::new(),
                answered: None,
                is_pinned: false,
                turn: 0,
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
            Connection::over(TcpStream::connect_timeout(&peer, CONNECT_TIMEOUT)?, peer)
        };
        match open() {
            Ok(connection) => {
                let (answered, mut connections) = (Some(connection.peer), Vec::new());
                // There is room for one.
                let _ = connections.push(connection);
                Ok(Self { listener: None, connections, answered, is_pinned: true, turn: 0, address })
            }
            Err(source) => Err(HalError::Open { address, source }),
        }
    }

    /// The local address, with the port that the system chose for port 0.
    pub fn local(&self) -> Option<SocketAddr> {
        match (&self.listener, self.connections.first()) {
            (Some(listener), _) => listener.local_addr().ok(),
            (None, Some(connection)) => connection.stream.local_addr().ok(),
            (None, None) => None,
        }
    }

    /// Takes whoever wants in, and sends away who has had his time.
    fn admit(&mut self) -> Result<(), HalError> {
        let Some(listener) = &self.listener else { return Ok(()) };
        let kept = self.answered.filter(|_| self.is_pinned);
        self.connections.retain(|c| kept == Some(c.peer) || c.since.elapsed() < PROOF_TIME);
        for _ in 0..ACCEPTED_AT_ONCE {
            let accepted = listener.accept().and_then(|(stream, peer)| Connection::over(stream, peer));
            let connection = match accepted {
                Ok(connection) => connection,
                Err(e) if is_timeout(&e) => return Ok(()),
                // It was gone before it was taken; the system's own limits end here, too, and pass.
                Err(e) if e.kind() == std::io::ErrorKind::ConnectionAborted => continue,
                Err(source) => return Err(HalError::Link { address: self.address.clone(), source }),
            };
            if self.connections.is_full() {
                let makes_room = |c: &&Connection| kept != Some(c.peer) && c.since.elapsed() >= GRACE;
                let least = self.connections.iter().filter(makes_room).min_by_key(|c| (c.vouched, c.since));
                let Some(least) = least.map(|c| c.peer) else { continue };
                self.connections.retain(|c| c.peer != least);
            }
            // There is room now.
            let _ = self.connections.push(connection);
        }
        Ok(())
    }

    /// Waits until somebody has spoken or wants in.
    fn wait(&self, timeout: Duration) -> Result<(), HalError> {
        let mut ready: Vec<PollFd<'_>, { CONNECTIONS + 1 }> = Vec::new();
        let all = self.connections.iter().map(|c| PollFd::new(&c.stream, PollFlags::IN));
        let listener = self.listener.iter().map(|l| PollFd::new(l, PollFlags::IN));
        for fd in all.chain(listener) {
            // There is room for all of them.
            let _ = ready.push(fd);
        }
        let wait = Timespec { tv_sec: timeout.as_secs().min(3600) as i64, tv_nsec: timeout.subsec_nanos().into() };
        match poll(&mut ready, Some(&wait)) {
            Ok(_) | Err(rustix::io::Errno::INTR) => Ok(()),
            Err(e) => Err(HalError::Link { address: self.address.clone(), source: e.into() }),
        }
    }

    /// A connection is over. It is an error when it was the one that is answered.
    fn drop_peer(&mut self, peer: SocketAddr, source: Option<std::io::Error>) -> Result<(), HalError> {
        self.connections.retain(|c| c.peer != peer);
        if self.answered != Some(peer) {
            return Ok(());
        }
        (self.answered, self.is_pinned) = (None, self.listener.is_none());
        let address = self.address.clone();
        Err(match source {
            Some(source) => HalError::Link { address, source },
            None => HalError::Closed { address },
        })
    }

    /// What the next one who has spoken said.
    fn take(&mut self, into: &mut [u8]) -> Result<Option<Received>, HalError> {
        let listens = self.listener.is_some();
        for _ in 0..self.connections.len() {
            self.turn = (self.turn + 1) % self.connections.len().max(1);
            let Some(connection) = self.connections.get_mut(self.turn) else { break };
            let peer = connection.peer;
            match connection.stream.read(into) {
                Ok(0) => self.drop_peer(peer, None)?,
                Ok(bytes) => {
                    let flow = if connection.begun { Flow::Continues } else { Flow::Begins };
                    connection.begun = true;
                    if !self.is_pinned {
                        self.answered = Some(peer);
                    }
                    // The peer of `tcpout` is whom the mission names: nobody has to be told apart.
                    return Ok(Some(Received { bytes, peer: listens.then_some(peer), flow, ..NOTHING }));
                }
                Err(e) if is_timeout(&e) => {}
                Err(e) => self.drop_peer(peer, Some(e))?,
            }
        }
        Ok(None)
    }
}

impl Connection {
    fn over(stream: TcpStream, peer: SocketAddr) -> std::io::Result<Self> {
        stream.set_nonblocking(true)?;
        stream.set_nodelay(true)?;
        Ok(Self { stream, peer, since: Instant::now(), vouched: 0, begun: false })
    }

    /// Writes all of `frame`, waiting [`WRITE_TIMEOUT`] at most for room.
    fn write(&mut self, frame: &[u8]) -> std::io::Result<()> {
        let (mut rest, until) = (frame, Instant::now() + WRITE_TIMEOUT);
        loop {
            match self.stream.write(rest) {
                Ok(count) if count == rest.len() => return Ok(()),
                Ok(count) => rest = &rest[count..],
                Err(e) if is_timeout(&e) && Instant::now() < until => {
                    let left = until.saturating_duration_since(Instant::now());
                    let wait = Timespec { tv_sec: 0, tv_nsec: left.subsec_nanos().into() };
                    poll(&mut [PollFd::new(&self.stream, PollFlags::OUT)], Some(&wait))?;
                }
                Err(e) => return Err(e),
            }
        }
    }
}

impl Link for TcpLink {
    type Error = HalError;

    fn read(&mut self, into: &mut [u8], timeout: Duration) -> Result<Received, HalError> {
        if self.listener.is_none() && self.connections.is_empty() {
            return Err(HalError::Closed { address: self.address.clone() });
        }
        let until = Instant::now() + timeout;
        loop {
            self.admit()?;
            if let Some(received) = self.take(into)? {
                return Ok(received);
            }
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(NOTHING);
            }
            self.wait(left)?;
        }
    }

    fn pin(&mut self, peer: SocketAddr) {
        if self.listener.is_some() && self.connections.iter().any(|c| c.peer == peer) {
            (self.answered, self.is_pinned) = (Some(peer), true);
        }
    }

    fn vouch(&mut self, peer: SocketAddr) {
        if let Some(connection) = self.connections.iter_mut().find(|c| c.peer == peer) {
            connection.vouched = connection.vouched.saturating_add(1);
        }
    }

    fn senders(&self) -> usize {
        if self.listener.is_some() { CONNECTIONS } else { 1 }
    }

    fn write(&mut self, frame: &[u8]) -> Result<(), HalError> {
        let full = || HalError::Full { address: self.address.clone() };
        let Some(peer) = self.answered else { return Err(full()) };
        let Some(connection) = self.connections.iter_mut().find(|c| c.peer == peer) else { return Err(full()) };
        match connection.write(frame) {
            Ok(()) => Ok(()),
            // After a timeout part of the frame may be on its way; the peer's framer resynchronises.
            Err(e) if is_timeout(&e) => Err(full()),
            Err(e) => self.drop_peer(peer, Some(e)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn connections_that_say_nothing_keep_nobody_out() {
        let mut here = TcpLink::listen("127.0.0.1:0").expect("a port");
        let port = here.local().expect("its port");
        let mut buffer = [0; 64];
        let silent: std::vec::Vec<_> = (0..100).map(|_| TcpStream::connect(port).expect("listening")).collect();
        let _ = here.read(&mut buffer, Duration::from_millis(10)).expect("open");
        std::thread::sleep(GRACE);
        // One of many who try: whoever is turned away tries again.
        let heard = (0..20).any(|_| {
            let mut autopilot = TcpStream::connect(port).expect("listening");
            autopilot.write_all(b"autopilot").expect("sent");
            (0..50).any(|_| here.read(&mut buffer, Duration::from_millis(10)).is_ok_and(|r| r.bytes == 9))
        });
        assert!(heard);
        assert!(here.connections.len() <= CONNECTIONS);
        drop(silent);
    }

    /// So many connections to `here`, all of them taken.
    fn connected(here: &mut TcpLink, count: usize) -> std::vec::Vec<TcpStream> {
        let port = here.local().expect("its port");
        let all = (0..count).map(|_| TcpStream::connect(port).expect("listening")).collect();
        let until = Instant::now() + Duration::from_secs(10);
        while here.connections.len() < count && Instant::now() < until {
            let _ = here.read(&mut [0; 64], Duration::from_millis(10)).expect("open");
        }
        assert_eq!(here.connections.len(), count);
        all
    }

    fn age(here: &mut TcpLink, by: Duration) {
        here.connections.iter_mut().for_each(|c| c.since = c.since.checked_sub(by).expect("up for longer"));
    }

    #[test]
    fn who_has_not_proven_himself_in_time_is_sent_away_and_the_pinned_one_stays() {
        let mut here = TcpLink::listen("127.0.0.1:0").expect("a port");
        let others = connected(&mut here, 3);
        let autopilot = here.connections[1].peer;
        here.pin(autopilot);
        age(&mut here, PROOF_TIME - GRACE);
        let _ = here.read(&mut [0; 64], Duration::from_millis(10)).expect("open");
        assert_eq!(here.connections.len(), 3, "there is time left");
        age(&mut here, GRACE);
        let _ = here.read(&mut [0; 64], Duration::from_millis(10)).expect("a stranger's end is no end");
        assert!(matches!(&here.connections[..], [one] if one.peer == autopilot));
        drop(others);
    }

    #[test]
    fn of_too_many_the_oldest_who_said_nothing_makes_room_and_never_the_pinned_one() {
        let mut here = TcpLink::listen("127.0.0.1:0").expect("a port");
        let mut all = connected(&mut here, CONNECTIONS);
        let peers: std::vec::Vec<_> = here.connections.iter().map(|c| c.peer).collect();
        // The two that have been here for longest: one is pinned, the other speaks as an autopilot does.
        here.pin(peers[0]);
        here.vouch(peers[1]);
        age(&mut here, GRACE);
        let port = here.local().expect("its port");
        all.push(TcpStream::connect(port).expect("listening"));
        let newest = all[CONNECTIONS].local_addr().expect("connected");
        let until = Instant::now() + Duration::from_secs(10);
        while !here.connections.iter().any(|c| c.peer == newest) && Instant::now() < until {
            let _ = here.read(&mut [0; 64], Duration::from_millis(10)).expect("open");
        }
        let kept: std::vec::Vec<_> = here.connections.iter().map(|c| c.peer).collect();
        let expected: std::vec::Vec<_> =
            peers.iter().copied().filter(|peer| *peer != peers[2]).chain([newest]).collect();
        assert_eq!(kept, expected);
    }

    #[test]
    fn once_pinned_a_peer_is_answered_and_kept_whoever_else_connects() {
        let mut here = TcpLink::listen("127.0.0.1:0").expect("a port");
        let port = here.local().expect("its port");
        let mut autopilot = TcpStream::connect(port).expect("listening");
        autopilot.write_all(b"me").expect("sent");
        let mut buffer = [0; 64];
        let received =
            (0..100).find_map(|_| here.read(&mut buffer, Duration::from_millis(10)).ok().filter(|r| r.bytes > 0));
        here.pin(received.and_then(|r| r.peer).expect("its address"));
        let mut others: std::vec::Vec<_> = (0..40).map(|_| TcpStream::connect(port).expect("listening")).collect();
        for (k, other) in others.iter_mut().enumerate() {
            // Some are closed already.
            let _ = other.write_all(&[k as u8; 8]);
            let _ = here.read(&mut buffer, Duration::from_millis(1)).expect("a stranger's end is no end");
        }
        drop(others);
        for _ in 0..50 {
            here.read(&mut buffer, Duration::from_millis(1)).expect("a stranger's end is no end");
        }
        here.write(b"you").expect("sent");
        autopilot.read_exact(&mut buffer[..3]).expect("answered");
        assert_eq!(&buffer[..3], b"you");
    }
}
