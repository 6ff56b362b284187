//! Ends the process with the reader's name and the number of the input when a reader waits or works for ever; puts what is no file in the
//! place of one.

use std::os::unix::fs::symlink;
use std::os::unix::net::UnixListener;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

/// No input takes so long, on any machine.
const LIMIT: Duration = Duration::from_secs(120);
const LOOK_UP: Duration = Duration::from_millis(500);

/// Watches one reader; ends with it.
pub struct Patience {
    at: Arc<AtomicUsize>,
    over: Arc<AtomicBool>,
}

impl Patience {
    pub fn with(name: &'static str) -> Self {
        let patience = Self { at: Arc::default(), over: Arc::default() };
        let (at, over) = (patience.at.clone(), patience.over.clone());
        std::thread::spawn(move || {
            let (mut seen, mut waited) = (0, Duration::ZERO);
            while !over.load(Ordering::Relaxed) {
                std::thread::sleep(LOOK_UP);
                let now = at.load(Ordering::Relaxed);
                waited = if now == seen { waited + LOOK_UP } else { Duration::ZERO };
                seen = now;
                if waited >= LIMIT {
                    eprintln!("{name}: input {} takes longer than {} s", now.saturating_sub(1), LIMIT.as_secs());
                    std::process::abort();
                }
            }
        });
        patience
    }

    /// Its next input is this one.
    pub fn begin(&self, input: usize) {
        self.at.store(input + 1, Ordering::Relaxed);
    }
}

impl Drop for Patience {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
    }
}

/// What is no regular file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    Pipe,
    Socket,
    Folder,
    /// To a device, to nothing, to the folder it lies in, to itself.
    Link(&'static str),
}

pub const KINDS: [Kind; 9] = [
    Kind::Pipe,
    Kind::Socket,
    Kind::Folder,
    Kind::Link("/dev/zero"),
    Kind::Link("/dev/ptmx"),
    Kind::Link("/dev/null"),
    Kind::Link("nowhere"),
    Kind::Link("."),
    Kind::Link("itself"),
];

/// Puts it at `path`, in place of what is there.
pub fn put(kind: Kind, path: &Path) {
    if std::fs::remove_file(path).is_err() {
        let _ = std::fs::remove_dir_all(path);
    }
    let put = match kind {
        Kind::Pipe => std::process::Command::new("mkfifo").arg(path).status().map(|status| assert!(status.success())),
        Kind::Socket => UnixListener::bind(path).map(drop),
        Kind::Folder => std::fs::create_dir(path),
        Kind::Link("itself") => symlink(path, path),
        Kind::Link(to) => symlink(to, path),
    };
    put.expect("made");
}
