//! Files this project reads and writes. Everything that comes from outside is bounded before memory is taken
//! for it, and every error is one line: which file, what is wrong with it, how to mend it.

use std::cmp::Ordering;
use std::io::Write;
use std::path::{Path, PathBuf};

use config::error::{Error, ErrorKind};
use disk::{Disk, DiskError};

pub mod colmap;
pub mod delivery;
pub mod flight_plan;
pub mod gltf;
pub mod mega_nerf;
pub mod model;
pub mod opensfm;
pub mod ply;
pub mod reconstruction;
pub mod sog;
pub mod splat;
pub mod splats;
pub mod split;
pub mod spz;
mod stream;
pub mod telemetry;
pub mod torch;
pub mod transforms;

/// Why a file could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum FormatError {
    /// The operating system said no.
    #[error("{}: {action} failed: {}", shown(path), disk::told(source))]
    Io {
        /// The file.
        path: PathBuf,
        /// What was tried.
        action: &'static str,
        /// The operating system's word.
        source: std::io::Error,
    },
    /// More bytes, or more items, than the format's bound.
    #[error("{}: {what} is {size}, at most {limit} can be taken; is it the right file?", shown(path))]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// What is too large.
        what: &'static str,
        /// What the file says.
        size: u64,
        /// The bound.
        limit: u64,
    },
    /// The file ends too early.
    #[error("{}: ends at byte {at} in the middle of {what}; copy or write it again", shown(path))]
    Truncated {
        /// The file.
        path: PathBuf,
        /// Where it ends.
        at: u64,
        /// What was being read.
        what: &'static str,
    },
    /// The content hash does not fit the content.
    #[error("{}: its content does not match its checksum (damaged in storage or transfer); copy it again", shown(path))]
    Damaged {
        /// The file.
        path: PathBuf,
    },
    /// The content makes no sense.
    #[error("{}: {}", shown(path), disk::escaped(what))]
    Invalid {
        /// The file.
        path: PathBuf,
        /// What, where and how to mend.
        what: String,
    },
}

impl Error for FormatError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Io { source, .. } => Error::kind(source),
            _ => ErrorKind::Input,
        }
    }
}

impl FormatError {
    /// Content of `path` that makes no sense: what, where and how to mend.
    pub fn invalid(path: &Path, what: impl Into<String>) -> Self {
        Self::Invalid { path: path.to_owned(), what: what.into() }
    }

    /// What the operating system said to `action` on `path`.
    pub fn io(path: &Path, action: &'static str, source: std::io::Error) -> Self {
        Self::Io { path: path.to_owned(), action, source }
    }

    /// A durable write that failed.
    pub fn disk(path: &Path, e: DiskError) -> Self {
        Self::io(path, e.action, e.source)
    }

    /// Whether it is the disk's fault and room or a medium that comes back may mend it.
    pub fn may_pass(&self) -> bool {
        matches!(self, Self::Io { source, .. } if disk::may_pass(source))
    }

    /// The file the error is about.
    pub fn path(&self) -> &Path {
        match self {
            Self::Io { path, .. }
            | Self::TooLarge { path, .. }
            | Self::Truncated { path, .. }
            | Self::Damaged { path }
            | Self::Invalid { path, .. } => path,
        }
    }
}

/// The whole of a file of at most `limit` bytes.
///
/// # Errors
/// [`FormatError::TooLarge`], else the operating system's.
pub fn read_bounded(path: &Path, limit: u64) -> Result<Vec<u8>, FormatError> {
    let file = disk::regular::open(path).map_err(|e| FormatError::io(path, "opening", e))?;
    let read = disk::regular::read_at_most(file, limit).map_err(|e| FormatError::io(path, "reading", e))?;
    read.map_err(|size| FormatError::TooLarge { path: path.to_owned(), what: "its size in bytes", size, limit })
}

/// Names in the order in which people count: `_9` before `_20`, capitals beside small letters.
pub fn natural(a: &str, b: &str) -> Ordering {
    fn next<'t>(rest: &mut &'t str) -> Option<(bool, &'t str)> {
        let is_digit = rest.chars().next()?.is_ascii_digit();
        let end = rest.find(|c: char| c.is_ascii_digit() != is_digit).unwrap_or(rest.len());
        let (part, after) = rest.split_at(end);
        *rest = after;
        Some((is_digit, part))
    }
    let (mut x, mut y) = (a, b);
    loop {
        let order = match (next(&mut x), next(&mut y)) {
            (None, None) => return a.cmp(b),
            (Some((true, m)), Some((true, n))) => {
                let (m, n) = (m.trim_start_matches('0'), n.trim_start_matches('0'));
                m.len().cmp(&n.len()).then_with(|| m.cmp(n))
            }
            (m, n) => m.map(|m| m.1.to_lowercase()).cmp(&n.map(|n| n.1.to_lowercase())),
        };
        if order != Ordering::Equal {
            return order;
        }
    }
}

/// The bytes of a text without the byte order mark that some editors put before it.
pub fn without_mark(bytes: &[u8]) -> &[u8] {
    bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes)
}

/// What another library says, on one line: decoders' and ONNX Runtime's messages span several.
pub fn one_line(error: impl std::fmt::Display) -> String {
    disk::escaped(&error.to_string().split_whitespace().collect::<Vec<_>>().join(" "))
}

/// A path within an error's line: a line end in a name, which a file may have chosen, begins no line of its own.
pub(crate) fn shown(path: &Path) -> String {
    disk::escaped(&path.to_string_lossy())
}

/// Writes a file whole or not at all, see [`Disk::replace`].
///
/// # Errors
/// [`FormatError::Io`] with the step that failed; what the file held before stays.
pub fn write_atomic(path: &Path, fill: impl FnOnce(&mut dyn Write) -> std::io::Result<()>) -> Result<(), FormatError> {
    Disk::default().replace(path, fill).map_err(|e| FormatError::disk(path, e))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_end_in_a_name_begins_no_line_in_an_error() {
        let path = Path::new("a/b\n INFO forged\u{1b}[2J.json");
        for error in [
            FormatError::invalid(path, "is empty"),
            FormatError::io(path, "opening", std::io::ErrorKind::NotFound.into()),
            // As parsers quote what they met.
            FormatError::invalid(path, "expected '>' not '\n' or '\u{1b}'"),
        ] {
            let said = error.to_string();
            assert!(
                said.starts_with("a/b\\n INFO forged\\u001b[2J.json: ") && !said.contains(char::is_control),
                "{said}"
            );
        }
        assert_eq!(one_line("at line 6\n| a = \"\u{1}\""), "at line 6 | a = \"\\u0001\"");
        let said = crate::picture::decode(path).unwrap_err().to_string();
        assert!(said.starts_with("a/b\\n INFO") && !said.contains(char::is_control), "{said}");
    }

    #[test]
    fn names_are_ordered_as_people_count() {
        let mut names = ["a_20.jpg", "a_9.jpg", "A_10.JPG", "b", "a_09.jpg", "a", "2/x", "10/x", ""];
        names.sort_by(|a, b| natural(a, b));
        assert_eq!(names, ["", "2/x", "10/x", "a", "a_09.jpg", "a_9.jpg", "A_10.JPG", "a_20.jpg", "b"]);
    }
}
