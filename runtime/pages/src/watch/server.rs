//! The thread that listens, and a short-lived one for each of a few connections. A slow or silent browser costs one of those for a
//! bounded time, and the job nothing.

use std::io::{self, Read};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::access::{Token, Verdict, address, judge};
use super::request::{Refusal, parse};
use super::respond::{answer, keep_token, refusal, status};
use super::room::{Guest, Room};
use super::{HttpError, Watch};

/// Bytes of a request's head (what nginx and Apache allow).
const HEAD_BYTES: usize = 8 << 10;
/// A head is here within this, however it trickles in.
const HEAD_WITHIN: Duration = Duration::from_secs(5);
/// How long what is refused is still read: nobody else is let in meanwhile where there was no room.
const SEEN_OFF_WITHIN: Duration = Duration::from_millis(50);
/// How soon the listening thread sees that the job is over.
const STOP_WITHIN: Duration = Duration::from_millis(200);
/// At its end the job waits so long for browsers to hear of it.
const GOODBYE: Duration = Duration::from_millis(500);
/// Stack of a connection's thread: head, headers and a piece of a file take 32 KiB, a picture's encoder as much again.
const STACK: usize = 512 << 10;

/// Serves the page until it is dropped.
#[derive(Debug)]
pub struct Server {
    address: SocketAddr,
    room: Arc<Room>,
    thread: Option<JoinHandle<()>>,
}

impl Server {
    /// Listens on `at` (`ADDRESS:PORT`, port 0 = any).
    ///
    /// # Errors
    /// No address, one beyond this machine without a token, or one that cannot be listened on.
    pub fn start(at: &str, token: Option<Token>, watch: Watch) -> Result<Self, HttpError> {
        let wanted = address(at, token.as_ref())?;
        let failed = |source| HttpError::Listen { address: wanted, source };
        let listener = TcpListener::bind(wanted).map_err(failed)?;
        // A connection may be gone between the poll and the accept.
        listener.set_nonblocking(true).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let room = Arc::new(Room::default());
        let inside = room.clone();
        let thread = std::thread::Builder::new()
            .name("http".into())
            .stack_size(STACK)
            .spawn(move || serve(&listener, token.map(Arc::new), &watch, &inside))
            .map_err(failed)?;
        Ok(Self { address, room, thread: Some(thread) })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.room.close();
        if let Some(thread) = self.thread.take() {
            // It holds nothing that could be left half done.
            let _ = thread.join();
        }
        let until = Instant::now() + GOODBYE;
        while !self.room.is_empty() && Instant::now() < until {
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

fn serve(listener: &TcpListener, token: Option<Arc<Token>>, watch: &Watch, room: &Arc<Room>) {
    let patience = Timespec { tv_sec: 0, tv_nsec: STOP_WITHIN.subsec_nanos().into() };
    while !room.closing.load(Ordering::Relaxed) {
        let mut waiting = [PollFd::new(listener, PollFlags::IN)];
        let came = poll(&mut waiting, Some(&patience));
        let Ok((stream, _)) = listener.accept() else {
            // Out of descriptors, it would come again at once.
            if came.is_ok_and(|n| n > 0) {
                room.pause(STOP_WITHIN);
            }
            continue;
        };
        let Some(guest) = Guest::enter(room, &stream) else {
            turn_away(&stream);
            continue;
        };
        let (watch, token) = (watch.clone(), token.clone());
        // Without a thread the connection is closed. Whoever has gone is not missed.
        let _ = std::thread::Builder::new().name("http".into()).stack_size(STACK).spawn(move || {
            let _ = connection(&stream, token.as_deref(), &watch, &guest);
            // Before its number is another's.
            drop((guest, stream));
        });
    }
}

/// Says that there is no room.
fn turn_away(stream: &TcpStream) {
    let _ = stream.set_nonblocking(false);
    let _ = status(stream, "503 Service Unavailable", "Retry-After: 5\r\n");
    see_off(stream);
}

/// Reads what is still on its way: a connection that is closed before takes the answer with it.
fn see_off(mut stream: &TcpStream) {
    let _ = stream.shutdown(Shutdown::Write);
    let until = Instant::now() + SEEN_OFF_WITHIN;
    loop {
        let left = until.saturating_duration_since(Instant::now());
        if left.is_zero() || stream.set_read_timeout(Some(left)).is_err() {
            return;
        }
        match stream.read(&mut [0; HEAD_BYTES]) {
            Ok(1..) => {}
            _ => return,
        }
    }
}

/// A request that is not understood.
fn refuse(stream: &TcpStream, why: Refusal) -> io::Result<()> {
    refusal(stream, why)?;
    see_off(stream);
    Ok(())
}

fn connection(stream: &TcpStream, token: Option<&Token>, watch: &Watch, guest: &Guest) -> io::Result<()> {
    stream.set_nonblocking(false)?;
    stream.set_nodelay(true)?;
    let mut bytes = [0; HEAD_BYTES];
    let (mut n, until) = (0, Instant::now() + HEAD_WITHIN);
    let asked = loop {
        let left = until.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return status(stream, "408 Request Timeout", "");
        }
        stream.set_read_timeout(Some(left))?;
        let mut from = stream;
        match from.read(&mut bytes[n..]) {
            Ok(0) => return Ok(()),
            Ok(more) => n += more,
            Err(e) if matches!(e.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut) => continue,
            Err(e) => return Err(e),
        }
        match parse(&bytes[..n]) {
            Ok(Some(asked)) => break asked,
            Ok(None) if n == HEAD_BYTES => return refuse(stream, Refusal::TooLarge),
            Ok(None) => {}
            Err(why) => return refuse(stream, why),
        }
    };
    guest.has_spoken();
    match (judge(&asked, token), token) {
        (Verdict::Welcome, _) => match guest.seat() {
            Some(seat) => answer(stream, asked.route, watch, seat.room()),
            None => {
                turn_away(stream);
                Ok(())
            }
        },
        (Verdict::Keep, Some(token)) => keep_token(stream, token),
        (Verdict::Keep | Verdict::Stranger, _) => status(stream, "401 Unauthorized", "WWW-Authenticate: Bearer\r\n"),
        (Verdict::Rebound, _) => status(stream, "403 Forbidden", ""),
    }
}
