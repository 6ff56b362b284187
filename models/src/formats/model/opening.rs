//! The fixed part of a model file: what it says is there, held against the file's size before anything is allocated.

use std::fs::File;
use std::io::{BufReader, Read};
use std::path::Path;

use super::hashing::Hashing;
use super::{CELLED, EXACT, FIXED, FormatError, HASH, MAGIC, MAX_HEADER, exact_bytes};
use crate::formats::delivery;

/// A file whose fixed part is read and holds with its size; the header comes next.
pub(super) struct Opened {
    pub input: Hashing<BufReader<File>>,
    pub size: u64,
    pub count: usize,
    pub sh_degree: u8,
    pub header_len: usize,
    pub body: Body,
}

/// How the Gaussians are there.
#[derive(Clone, Copy, PartialEq)]
pub(super) enum Body {
    /// As exact columns.
    Columns,
    /// In the delivery encoding, cell by cell; each with a coarse layer before all of them.
    Cells,
}

/// Opens a model and takes its fixed part; nothing is allocated yet for what it says.
///
/// # Errors
/// As [`super::read`], of what the fixed part and the file's size tell.
pub(super) fn open(path: &Path) -> Result<Opened, FormatError> {
    open_to(path, true)
}

/// As [`open`]; what is not `whole` may end before its Gaussians do, when they lie in cells.
pub(super) fn open_to(path: &Path, whole: bool) -> Result<Opened, FormatError> {
    let file = disk::regular::open(path).map_err(|e| FormatError::io(path, "opening", e))?;
    let size = file.metadata().map_err(|e| FormatError::io(path, "reading", e))?.len();
    let mut input = Hashing { inner: BufReader::with_capacity(1 << 16, file), hasher: blake3::Hasher::new() };
    let truncated = |what| FormatError::Truncated { path: path.to_owned(), at: size, what };
    if size < FIXED {
        return Err(truncated("its first 28 bytes"));
    }
    let mut fixed = [0; FIXED as usize];
    input.read_exact(&mut fixed).map_err(|e| FormatError::io(path, "reading", e))?;
    if fixed[..8] != MAGIC {
        return Err(FormatError::invalid(path, "is not a dgtr model (its first bytes differ); give a .dgtr file"));
    }
    let word = |at: usize| u32::from_le_bytes([fixed[at], fixed[at + 1], fixed[at + 2], fixed[at + 3]]);
    let version = word(8);
    if ![EXACT, CELLED].contains(&version) {
        let what = format!(
            "model file version {version}; this dgtr reads versions {EXACT} and {CELLED}: use the dgtr that wrote it"
        );
        return Err(FormatError::invalid(path, what));
    }
    let header_len = u64::from(word(12));
    let count = u64::from(word(16)) | u64::from(word(20)) << 32;
    let degree = word(24);
    if degree > 3 {
        return Err(FormatError::invalid(path, format!("SH degree {degree}; 0 to 3 is possible (damaged file?)")));
    }
    if header_len > MAX_HEADER {
        let limit = MAX_HEADER;
        return Err(FormatError::TooLarge { path: path.to_owned(), what: "its header", size: header_len, limit });
    }
    let header_len = header_len as usize;
    if version != EXACT {
        let Some(coded) = size.checked_sub(FIXED + header_len as u64 + HASH) else {
            return Err(truncated("its header"));
        };
        let limit = delivery::most_gaussians(coded);
        if count > limit && whole {
            let what = "its number of Gaussians";
            return Err(FormatError::TooLarge { path: path.to_owned(), what, size: count, limit });
        }
        let (count, sh_degree) = (count as usize, degree as u8);
        return Ok(Opened { input, size, count, sh_degree, header_len, body: Body::Cells });
    }
    let expected =
        count.checked_mul(exact_bytes(degree as u8)).and_then(|c| c.checked_add(FIXED + header_len as u64 + HASH));
    match expected {
        Some(expected) if expected == size => {}
        Some(expected) if expected < size => {
            let what = format!("is {} bytes longer than its {count} Gaussians; copy it again", size - expected);
            return Err(FormatError::invalid(path, what));
        }
        _ => return Err(truncated("its Gaussians")),
    }
    Ok(Opened { input, size, count: count as usize, sh_degree: degree as u8, header_len, body: Body::Columns })
}

/// The header's bytes, not decoded yet.
///
/// # Errors
/// The operating system's.
pub(super) fn read_header_of(path: &Path, opened: &mut Opened) -> Result<Vec<u8>, FormatError> {
    let mut bytes = vec![0; opened.header_len];
    opened.input.read_exact(&mut bytes).map_err(|e| FormatError::io(path, "reading", e))?;
    Ok(bytes)
}
