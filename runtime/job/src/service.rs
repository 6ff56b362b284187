//! What the service manager is told of a job: ready, how it stands, still at work, ending (sd_notify(3), systemd). Silent
//! where nobody listens.
//!
//! Own lines instead of a crate: those there are open a socket for every word, and the training loop allocates nothing.

use std::cell::Cell;
use std::ffi::OsString;
use std::io;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::time::{Duration, Instant};

pub mod limits;

/// A manager that does not read must not hold up the job.
const PATIENCE: Duration = Duration::from_secs(1);
/// Signs of life within the time that the manager waits for one (sd_watchdog_enabled(3) asks for two at least): a step
/// that took three quarters of it costs nothing.
const SIGNS: u32 = 4;

/// The connection to the service manager. Says STOPPING=1 when it is dropped.
#[derive(Debug, Default)]
pub struct Supervisor {
    socket: Option<UnixDatagram>,
    /// Least time between two signs of life; absent: nobody waits for one.
    every: Option<Duration>,
    last: Cell<Option<Instant>>,
    ready: Cell<bool>,
    stopping: Cell<bool>,
}

impl Supervisor {
    fn new(socket: Option<UnixDatagram>, limit: Option<Duration>) -> Self {
        let every = limit.map(|limit| limit / SIGNS);
        Self { socket, every, last: Cell::default(), ready: Cell::default(), stopping: Cell::default() }
    }

    /// The manager of this process, as `NOTIFY_SOCKET`, `WATCHDOG_USEC` and `WATCHDOG_PID` say.
    pub fn from_environment() -> Self {
        let Some(address) = std::env::var_os("NOTIFY_SOCKET") else { return Self::default() };
        let number = |name| std::env::var(name).ok()?.parse::<u64>().ok();
        let ours = number("WATCHDOG_PID").is_none_or(|pid| pid == u64::from(std::process::id()));
        let limit = number("WATCHDOG_USEC").filter(|_| ours).map(Duration::from_micros);
        match connected(&address) {
            Ok(socket) => Self::new(Some(socket), limit),
            Err(e) => {
                tracing::warn!("NOTIFY_SOCKET {}: {e}; the service manager hears nothing", address.display());
                Self::default()
            }
        }
    }

    /// The job listens: what waits for it may start. Said once.
    pub fn ready(&self) {
        if !self.ready.replace(true) {
            self.tell(b"READY=1");
        }
    }

    /// How the job stands, in a line for `systemctl status`.
    pub fn status(&self, line: &str) {
        if self.socket.is_some() {
            self.tell(format!("STATUS={}", line.replace('\n', " ")).as_bytes());
        }
    }

    /// A sign of life: from the loop that does the work and nowhere else, so that a job that hangs gives none. Cheap enough
    /// for every step.
    pub fn alive(&self) {
        let Some(every) = self.every else { return };
        if self.last.get().is_none_or(|last| last.elapsed() >= every) {
            self.last.set(Some(Instant::now()));
            self.tell(b"WATCHDOG=1");
        }
    }

    /// The job comes to its end. Said once.
    pub fn stopping(&self) {
        if !self.stopping.replace(true) {
            self.tell(b"STOPPING=1");
        }
    }

    fn tell(&self, words: &[u8]) {
        let Some(socket) = &self.socket else { return };
        // A manager that cannot be told is no reason not to fly.
        if let Err(e) = socket.send(words) {
            tracing::debug!("the service manager was not told: {e}");
        }
    }
}

impl Drop for Supervisor {
    fn drop(&mut self) {
        self.stopping();
    }
}

fn connected(address: &OsString) -> io::Result<UnixDatagram> {
    let socket = UnixDatagram::unbound()?;
    match address.as_bytes() {
        // Abstract, as some containers have it.
        [b'@', name @ ..] => socket.connect_addr(&SocketAddr::from_abstract_name(name)?)?,
        _ => socket.connect(address)?,
    }
    socket.set_write_timeout(Some(PATIENCE))?;
    Ok(socket)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A manager that waits `limit` for a sign of life, and the job's end of the line.
    fn manager(limit: Duration) -> (UnixDatagram, Supervisor) {
        let (ours, socket) = UnixDatagram::pair().expect("a pair of sockets");
        ours.set_nonblocking(true).expect("looks without waiting");
        (ours, Supervisor::new(Some(socket), Some(limit)))
    }

    fn heard(manager: &UnixDatagram) -> Vec<String> {
        let mut bytes = [0; 256];
        let words = std::iter::from_fn(|| manager.recv(&mut bytes).ok().map(|n| bytes[..n].to_vec()));
        words.map(|w| String::from_utf8(w).expect("text")).collect()
    }

    #[test]
    fn ready_and_goodbye_are_said_once_and_a_line_stays_a_line() {
        let (manager, supervisor) = manager(Duration::from_secs(3600));
        (0..2).for_each(|_| supervisor.ready());
        supervisor.status("two\nlines");
        supervisor.stopping();
        drop(supervisor);
        assert_eq!(heard(&manager), ["READY=1", "STATUS=two lines", "STOPPING=1"]);
    }

    #[test]
    fn many_steps_are_one_sign_of_life_until_the_next_is_due() {
        let (manager, supervisor) = manager(Duration::from_millis(40));
        (0..100).for_each(|_| supervisor.alive());
        let at_first = heard(&manager).len();
        assert!((1..=2).contains(&at_first), "{at_first}");
        std::thread::sleep(Duration::from_millis(15));
        supervisor.alive();
        assert_eq!(heard(&manager), ["WATCHDOG=1"]);
    }

    #[test]
    fn a_job_whose_manager_has_gone_or_never_was_goes_on() {
        let (manager, supervisor) = manager(Duration::ZERO);
        drop(manager);
        supervisor.ready();
        supervisor.alive();
        Supervisor::default().alive();
    }
}
