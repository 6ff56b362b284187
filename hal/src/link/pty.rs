//! The near end of a pseudo-terminal made by the program itself. The far end is a real serial port to whoever opens
//! its path: the same termios calls, the same bytes, so that nothing in the flight code knows it is being tested.

use std::os::fd::OwnedFd;
use std::os::unix::ffi::OsStringExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags};
use rustix::io::Errno;
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

use super::NOTHING;
use crate::error::HalError;
use crate::traits::{Link, Received};

/// How long and how often a write waits for a reader that is held up: a pseudo-terminal holds some 12 KiB. Counted, so that a machine
/// that stood still has not waited all of it.
const WAIT: Timespec = Timespec { tv_sec: 0, tv_nsec: 100_000_000 };
const WAITS: u32 = 10;

/// A pseudo-terminal; dropping it hangs up on the far end.
pub struct PtyLink {
    near: OwnedFd,
    /// Kept open so that reading the near end is not an error while nobody has opened the far end.
    _far: OwnedFd,
    path: PathBuf,
    alias: Option<PathBuf>,
    address: String,
    /// Nobody read while a write waited: no other one waits before somebody does.
    unread: bool,
}

impl PtyLink {
    /// Makes a pseudo-terminal; `alias` becomes a symbolic link to its far end.
    ///
    /// # Errors
    /// [`HalError::Open`] when the system has none left or `alias` is an existing file.
    pub fn create(alias: Option<&Path>) -> Result<Self, HalError> {
        let address = format!("pty:{}", alias.map(|a| a.display().to_string()).unwrap_or_default());
        let open = || -> std::io::Result<(OwnedFd, OwnedFd, PathBuf)> {
            let near = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC)?;
            grantpt(&near)?;
            unlockpt(&near)?;
            let path = PathBuf::from(std::ffi::OsString::from_vec(ptsname(&near, Vec::new())?.into_bytes()));
            let far = rustix::fs::open(&path, OFlags::RDWR | OFlags::NOCTTY | OFlags::CLOEXEC, Mode::empty())?;
            let mut settings = tcgetattr(&far)?;
            settings.make_raw();
            tcsetattr(&far, OptionalActions::Now, &settings)?;
            let flags = rustix::fs::fcntl_getfl(&near)?;
            rustix::fs::fcntl_setfl(&near, flags | OFlags::NONBLOCK)?;
            if let Some(alias) = alias {
                if alias.is_symlink() {
                    std::fs::remove_file(alias)?;
                }
                std::os::unix::fs::symlink(&path, alias)?;
            }
            Ok((near, far, path))
        };
        match open() {
            Ok((near, far, path)) => {
                Ok(Self { near, _far: far, path, alias: alias.map(Path::to_path_buf), address, unread: false })
            }
            Err(source) => Err(HalError::Open { address, source }),
        }
    }

    /// The path of the far end, to be opened as a serial port.
    pub fn path(&self) -> &Path {
        &self.path
    }

    fn failed(&self, e: Errno) -> HalError {
        HalError::Link { address: self.address.clone(), source: e.into() }
    }
}

impl Drop for PtyLink {
    fn drop(&mut self) {
        if let Some(alias) = &self.alias {
            // Best effort: a stale link is replaced by the next run.
            let _ = std::fs::remove_file(alias);
        }
    }
}

impl Link for PtyLink {
    type Error = HalError;

    fn read(&mut self, into: &mut [u8], timeout: Duration) -> Result<Received, HalError> {
        let mut ready = [PollFd::new(&self.near, PollFlags::IN)];
        let wait = Timespec { tv_sec: timeout.as_secs() as i64, tv_nsec: timeout.subsec_nanos().into() };
        match poll(&mut ready, Some(&wait)) {
            Ok(0) | Err(Errno::INTR) => return Ok(NOTHING),
            Ok(_) => {}
            Err(e) => return Err(self.failed(e)),
        }
        match rustix::io::read(&self.near, into) {
            Ok(0) => Err(HalError::Closed { address: self.address.clone() }),
            Ok(bytes) => Ok(Received { bytes, ..NOTHING }),
            Err(Errno::AGAIN | Errno::INTR) => Ok(NOTHING),
            Err(e) => Err(self.failed(e)),
        }
    }

    fn write(&mut self, frame: &[u8]) -> Result<(), HalError> {
        let (mut rest, mut waited) = (frame, 0);
        loop {
            match rustix::io::write(&self.near, rest) {
                Ok(n) => {
                    rest = &rest[n..];
                    self.unread &= n == 0;
                }
                Err(Errno::AGAIN | Errno::INTR) => {}
                Err(e) => return Err(self.failed(e)),
            }
            if rest.is_empty() {
                return Ok(());
            }
            if self.unread || waited == WAITS {
                // A full line: the rest is lost, as on a real one; the peer's framer resynchronises.
                self.unread = true;
                return Err(HalError::Full { address: self.address.clone() });
            }
            match poll(&mut [PollFd::new(&self.near, PollFlags::OUT)], Some(&WAIT)) {
                Ok(0) => waited += 1,
                Ok(_) | Err(Errno::INTR) => {}
                Err(e) => return Err(self.failed(e)),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::SerialLink;

    #[test]
    fn a_reader_that_is_held_up_loses_nothing_and_one_that_is_not_there_holds_nobody_up() {
        let mut pty = PtyLink::create(None).expect("a pty");
        let mut far = SerialLink::open(pty.path(), 921_600).expect("its far end");
        // Several times what the system holds.
        let all: Vec<u8> = (0..64 << 10).map(|k| (k % 251) as u8).collect();
        std::thread::scope(|scope| {
            let writer = scope.spawn(|| all.chunks(64).try_for_each(|frame| pty.write(frame)));
            std::thread::sleep(Duration::from_millis(200));
            let (mut read, mut buffer, mut nothing) = (Vec::new(), [0; 512], 0);
            while read.len() < all.len() && nothing < WAITS {
                let received = far.read(&mut buffer, Duration::from_millis(100)).expect("open");
                nothing = if received.bytes == 0 { nothing + 1 } else { 0 };
                read.extend_from_slice(&buffer[..received.bytes]);
            }
            assert!(read == all && writer.join().expect("no panic").is_ok());
        });
        // Nobody reads: one write waits, the others know.
        let full = all.chunks(64).filter(|frame| matches!(pty.write(frame), Err(HalError::Full { .. }))).count();
        assert!(full > 100 && pty.unread, "{full}");
        let mut buffer = [0; 4096];
        while far.read(&mut buffer, Duration::ZERO).expect("open").bytes > 0 {}
        assert!(pty.write(b"again").is_ok() && !pty.unread);
    }
}
