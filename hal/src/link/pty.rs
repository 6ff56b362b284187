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

/// A pseudo-terminal; dropping it hangs up on the far end.
pub struct PtyLink {
    near: OwnedFd,
    /// Kept open so that reading the near end is not an error while nobody has opened the far end.
    _far: OwnedFd,
    path: PathBuf,
    alias: Option<PathBuf>,
    address: String,
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
            Ok((near, far, path)) => Ok(Self { near, _far: far, path, alias: alias.map(Path::to_path_buf), address }),
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
        match rustix::io::write(&self.near, frame) {
            Ok(n) if n == frame.len() => Ok(()),
            // A full line: the rest is lost, as on a real one; the peer's framer resynchronises.
            Ok(_) | Err(Errno::AGAIN | Errno::INTR) => Err(HalError::Full { address: self.address.clone() }),
            Err(e) => Err(self.failed(e)),
        }
    }
}
