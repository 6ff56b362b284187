//! Opening what somebody else named or left in a folder: only regular files, and never waiting. Opening a FIFO waits for its
//! writer, reading a terminal for its keys, for ever.

use std::fs::{File, OpenOptions};
use std::io;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;

use rustix::fs::OFlags;

/// Opens the file at `path` for reading.
///
/// # Errors
/// The system's; `InvalidInput` for what is no regular file.
pub fn open(path: &Path) -> io::Result<File> {
    opened(path, OpenOptions::new().read(true))
}

/// Opens the file at `path`, which is made where there is none, to write behind its end.
///
/// # Errors
/// As [`open`].
pub(crate) fn append(path: &Path) -> io::Result<File> {
    opened(path, OpenOptions::new().append(true).create(true))
}

fn opened(path: &Path, options: &mut OpenOptions) -> io::Result<File> {
    let flags = OFlags::NONBLOCK | OFlags::NOCTTY;
    let file = options.custom_flags(flags.bits().cast_signed()).open(path)?;
    if file.metadata()?.is_file() {
        Ok(file)
    } else {
        Err(io::Error::new(io::ErrorKind::InvalidInput, "is no regular file"))
    }
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
