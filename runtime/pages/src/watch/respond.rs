//! What is sent back. Every answer closes its connection, is written within a bounded time, and tells the browser to load nothing
//! from anywhere else.

use std::fmt::Write as _;
use std::io::{self, Read, Write};
use std::net::TcpStream;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use super::access::Token;
use super::request::{COOKIE, Refusal, Route};
use super::room::Room;
use super::{GAPS, Watch};
use crate::report::{self, SCRIPT, STYLE, picture};

/// A document is sent within this: 1 MB over 100 kB/s three times over.
const SENDING: Duration = Duration::from_secs(30);
/// Bytes between two looks at the clock.
const PIECE: usize = 16 << 10;
/// Between two looks at the state for those who hear of changes, and between two signs of life when there is none.
const LOOK_EVERY: Duration = Duration::from_millis(500);
const SIGN_EVERY: Duration = Duration::from_secs(10);
/// Nothing from elsewhere, nothing inline, in nobody's frame.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; \
                      base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// Head of an answer; `length` is unknown for one that goes on.
fn head(status: &str, kind: &str, length: Option<u64>, more: &str) -> String {
    let mut head = format!(
        "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nConnection: close\r\nCache-Control: no-store\r\n\
         X-Content-Type-Options: nosniff\r\nCross-Origin-Resource-Policy: same-origin\r\nReferrer-Policy: no-referrer\r\nContent-Security-Policy: {POLICY}\r\n{more}"
    );
    if let Some(length) = length {
        // Writing into a String cannot fail.
        let _ = write!(head, "Content-Length: {length}\r\n");
    }
    head + "\r\n"
}

/// Writes within the time there is for a document.
struct Sender<'a> {
    stream: &'a TcpStream,
    until: Instant,
}

impl<'a> Sender<'a> {
    fn new(stream: &'a TcpStream) -> Self {
        Self { stream, until: Instant::now() + SENDING }
    }

    fn send(&mut self, bytes: &[u8]) -> io::Result<()> {
        for piece in bytes.chunks(PIECE) {
            let left = self.until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(io::ErrorKind::TimedOut.into());
            }
            self.stream.set_write_timeout(Some(left))?;
            (&mut self.stream).write_all(piece)?;
        }
        Ok(())
    }
}

/// A status without a document.
pub(super) fn status(stream: &TcpStream, status: &str, more: &str) -> io::Result<()> {
    let words = format!("{status}\n");
    let head = head(status, "text/plain; charset=utf-8", Some(words.len() as u64), more);
    Sender::new(stream).send((head + &words).as_bytes())
}

/// Why a request is not answered.
pub(super) fn refusal(stream: &TcpStream, why: Refusal) -> io::Result<()> {
    match why {
        Refusal::Garbled => status(stream, "400 Bad Request", ""),
        Refusal::Method => status(stream, "405 Method Not Allowed", "Allow: GET\r\n"),
        Refusal::TooLarge => status(stream, "431 Request Header Fields Too Large", ""),
    }
}

/// The browser keeps the token where no script and no other site reaches it, and asks again without it in the address.
pub(super) fn keep_token(stream: &TcpStream, token: &Token) -> io::Result<()> {
    let cookie = format!("Set-Cookie: {COOKIE}={}; HttpOnly; SameSite=Strict; Path=/\r\nLocation: /\r\n", token.text());
    status(stream, "303 See Other", &cookie)
}

fn document(stream: &TcpStream, kind: &str, bytes: &[u8]) -> io::Result<()> {
    let mut sender = Sender::new(stream);
    sender.send(head("200 OK", kind, Some(bytes.len() as u64), "").as_bytes())?;
    sender.send(bytes)
}

/// A file piece by piece; it may be replaced meanwhile.
fn file(stream: &TcpStream, kind: &str, path: &std::path::Path) -> io::Result<()> {
    let Ok(mut file) = disk::regular::open(path) else { return status(stream, "404 Not Found", "") };
    let length = file.metadata()?.len();
    let mut sender = Sender::new(stream);
    sender.send(head("200 OK", kind, Some(length), "").as_bytes())?;
    let mut piece = [0; PIECE];
    loop {
        match file.read(&mut piece)? {
            0 => return Ok(()),
            n => sender.send(&piece[..n])?,
        }
    }
}

/// Sends what `route` names.
pub(super) fn answer(stream: &TcpStream, route: Option<Route>, watch: &Watch, room: &Room) -> io::Result<()> {
    match route {
        None => status(stream, "404 Not Found", ""),
        Some(Route::Page) => document(stream, "text/html; charset=utf-8", report::live_page().as_bytes()),
        Some(Route::Style) => document(stream, "text/css; charset=utf-8", STYLE.as_bytes()),
        Some(Route::Script) => document(stream, "text/javascript; charset=utf-8", SCRIPT.as_bytes()),
        Some(Route::State) => document(stream, "application/json", state(watch, room)?.as_bytes()),
        Some(Route::Ground) => document(stream, "application/json", &watch.ground()),
        Some(Route::Ortho) => file(stream, "image/png", &watch.map_file("ortho.png")),
        Some(Route::Coverage) => file(stream, "application/geo+json", &watch.out_file(GAPS)),
        Some(Route::Thumbnail(i)) => thumbnail(stream, watch, i),
        Some(Route::Events) => events(stream, watch, room),
    }
}

fn state(watch: &Watch, room: &Room) -> io::Result<String> {
    watch.state(room.closing.load(Ordering::Relaxed)).map(|s| s.to_string()).map_err(io::Error::other)
}

fn thumbnail(stream: &TcpStream, watch: &Watch, i: usize) -> io::Result<()> {
    let mut image = None;
    watch.craft(i, |craft| image = craft.thumbnail.image());
    match image.map(|image| picture::encode(&image)) {
        Some(Ok((kind, bytes))) => document(stream, kind, &bytes),
        _ => status(stream, "404 Not Found", ""),
    }
}

/// Server-sent events: the state at once and after every change, until the browser goes or the job ends.
fn events(stream: &TcpStream, watch: &Watch, room: &Room) -> io::Result<()> {
    let Some(_place) = room.listen() else { return status(stream, "503 Service Unavailable", "Retry-After: 5\r\n") };
    Sender::new(stream).send(head("200 OK", "text/event-stream", None, "").as_bytes())?;
    let (mut last, mut sent) = (String::new(), Instant::now());
    loop {
        let over = room.closing.load(Ordering::Relaxed);
        let now = state(watch, room)?;
        if now != last {
            // JSON has no line ends of its own.
            Sender::new(stream).send(format!("data: {now}\n\n").as_bytes())?;
            (last, sent) = (now, Instant::now());
        } else if sent.elapsed() >= SIGN_EVERY {
            Sender::new(stream).send(b":\n\n")?;
            sent = Instant::now();
        }
        if over {
            return Ok(());
        }
        room.pause(LOOK_EVERY);
    }
}
