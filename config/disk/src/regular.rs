//! Opening what somebody else named or left in a folder: only regular files, and never waiting. Opening a FIFO waits for its
//! writer, reading a terminal for its keys, for ever. What is written to is never reached through a link: whoever left it there would
//! choose the file.

use std::fs::{File, OpenOptions};
use std::io::{self, Read};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;

use rustix::fs::OFlags;
use rustix::io::Errno;

/// Opens the file at `path` for reading.
///
/// # Errors
/// The system's; `InvalidInput` for what is no regular file.
pub fn open(path: &Path) -> io::Result<File> {
    opened(path, OpenOptions::new().read(true), OFlags::empty())
}

/// Opens the file at `path` for reading, in a folder that is only written by its owner.
///
/// # Errors
/// As [`open`]; `InvalidInput` for a link, too.
pub fn open_not_linked(path: &Path) -> io::Result<File> {
    not_linked(path, OpenOptions::new().read(true))
}

/// The whole of an open file of at most `limit` bytes, else how many bytes it has at least. The bound holds also for a file that grows
/// while it is read.
///
/// # Errors
/// The system's.
pub fn read_at_most(file: File, limit: u64) -> io::Result<Result<Vec<u8>, u64>> {
    let size = file.metadata()?.len();
    if size > limit {
        return Ok(Err(size));
    }
    let mut bytes = Vec::with_capacity(size as usize);
    file.take(limit.saturating_add(1)).read_to_end(&mut bytes)?;
    let read = bytes.len() as u64;
    Ok(if read > limit { Err(read) } else { Ok(bytes) })
}

/// Opens the file at `path` to write it anew, made where there is none, for what is of use while it is written: a log, a trace.
/// Everything else is written by [`crate::Disk`].
///
/// # Errors
/// As [`open_not_linked`].
pub fn create(path: &Path) -> io::Result<File> {
    // Emptied only once it is known to be a file.
    let file = not_linked(path, OpenOptions::new().write(true).create(true).truncate(false))?;
    file.set_len(0)?;
    Ok(file)
}

/// Opens the file at `path`, which is made where there is none, to write behind its end.
///
/// # Errors
/// As [`create`].
pub(crate) fn append(path: &Path) -> io::Result<File> {
    not_linked(path, OpenOptions::new().append(true).create(true))
}

fn not_linked(path: &Path, options: &mut OpenOptions) -> io::Result<File> {
    opened(path, options, OFlags::NOFOLLOW).map_err(|e| match e.raw_os_error() {
        Some(code) if code == Errno::LOOP.raw_os_error() => {
            invalid("is a link; name the file it leads to, or remove it")
        }
        _ => e,
    })
}

fn invalid(what: &'static str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidInput, what)
}

fn opened(path: &Path, options: &mut OpenOptions, also: OFlags) -> io::Result<File> {
    let flags = OFlags::NONBLOCK | OFlags::NOCTTY | also;
    let file = options.custom_flags(flags.bits().cast_signed()).open(path)?;
    if file.metadata()?.is_file() { Ok(file) } else { Err(invalid("is no regular file")) }
}

/// Opens a file that holds a secret.
///
/// # Errors
/// As [`open`]; `PermissionDenied` for one that others than its owner and its group may read, or others than its owner may write.
pub fn open_secret(path: &Path) -> io::Result<File> {
    let file = open(path)?;
    let mode = file.metadata()?.mode() & 0o777;
    if mode & 0o027 == 0 {
        return Ok(file);
    }
    let what = format!(
        "can be read or written by others (mode {mode:o}); chmod 600 it, or make a new one if somebody may have read it"
    );
    Err(io::Error::new(io::ErrorKind::PermissionDenied, what))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    #[test]
    fn nothing_is_written_through_a_link_into_a_pipe_or_a_device() {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        std::fs::write(at("mine"), b"mine").expect("written");
        let linked = [("link", at("mine")), ("dangling", at("none")), ("device", "/dev/null".into())];
        for (name, to) in linked {
            std::os::unix::fs::symlink(to, at(name)).expect("linked");
            for open in [create, append, open_not_linked] {
                let said = open(&at(name)).expect_err(name).to_string();
                assert_eq!(said, "is a link; name the file it leads to, or remove it", "{name}");
            }
        }
        assert!(!at("none").exists());
        let made = std::process::Command::new("mkfifo").arg(at("pipe")).status().expect("mkfifo");
        assert!(made.success());
        for path in [at("pipe"), "/dev/null".into(), folder.path().into()] {
            assert!(create(&path).is_err() && append(&path).is_err(), "{}", path.display());
        }
        // A file is emptied only where that was meant.
        append(&at("mine")).expect("opened");
        assert_eq!(std::fs::read(at("mine")).expect("read"), b"mine");
        create(&at("mine")).expect("opened");
        create(&at("new")).expect("opened");
        assert_eq!(std::fs::read(at("mine")).expect("read"), b"");
    }

    #[test]
    fn a_file_longer_than_its_limit_is_not_read() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("file");
        std::fs::write(&path, [7; 5]).expect("written");
        let read = |path: &Path, limit| read_at_most(open(path).expect("opened"), limit).expect("read");
        assert_eq!((read(&path, 5), read(&path, 4), read(&path, u64::MAX)), (Ok(vec![7; 5]), Err(5), Ok(vec![7; 5])));
        // Its size says nothing of what it will hold.
        let without_size = Path::new("/proc/self/status");
        assert!(read(without_size, 1 << 20).is_ok_and(|bytes| !bytes.is_empty()) && read(without_size, 4) == Err(5));
    }

    #[test]
    fn a_secret_that_others_may_read_or_write_is_refused_with_what_to_do() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("secret");
        std::fs::write(&path, b"x").expect("written");
        let opened = |mode| {
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).expect("its own");
            open_secret(&path).map(drop).map_err(|e| e.to_string())
        };
        for mode in [0o600, 0o400, 0o640, 0o440, 0o700] {
            assert_eq!(opened(mode), Ok(()), "{mode:o}");
        }
        for mode in [0o644, 0o604, 0o660, 0o620, 0o602, 0o666, 0o777] {
            assert!(
                opened(mode).is_err_and(|e| e.contains("chmod 600") && e.contains(&format!("{mode:o}"))),
                "{mode:o}"
            );
        }
    }
}
