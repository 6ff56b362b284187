//! A little-endian reader over a file of any size: holds a buffer, never the file; every count is checked against what
//! the rest of the file can hold.

use std::fs::File;
use std::io::{BufRead, BufReader, ErrorKind, Read};
use std::path::Path;

use super::FormatError;

/// Bytes read at once.
const BUFFER: usize = 1 << 15;
/// Longest name or text line that is kept.
const MAX_TEXT: usize = 4096;

/// A file being read from front to back.
pub(crate) struct Stream<'p> {
    path: &'p Path,
    reader: BufReader<File>,
    len: u64,
    at: u64,
}

impl<'p> Stream<'p> {
    pub(crate) fn open(path: &'p Path) -> Result<Self, FormatError> {
        let file = disk::regular::open(path).map_err(|e| FormatError::io(path, "opening", e))?;
        let len = file.metadata().map_err(|e| FormatError::io(path, "reading", e))?.len();
        Ok(Self { path, reader: BufReader::with_capacity(BUFFER, file), len, at: 0 })
    }

    fn truncated(&self, what: &'static str) -> FormatError {
        FormatError::Truncated { path: self.path.to_owned(), at: self.len, what }
    }

    fn array<const N: usize>(&mut self, what: &'static str) -> Result<[u8; N], FormatError> {
        let mut out = [0; N];
        match self.reader.read_exact(&mut out) {
            Ok(()) => {
                self.at += N as u64;
                Ok(out)
            }
            Err(e) if e.kind() == ErrorKind::UnexpectedEof => Err(self.truncated(what)),
            Err(e) => Err(FormatError::io(self.path, "reading", e)),
        }
    }

    pub(crate) fn u8(&mut self, what: &'static str) -> Result<u8, FormatError> {
        Ok(self.array::<1>(what)?[0])
    }

    pub(crate) fn u32(&mut self, what: &'static str) -> Result<u32, FormatError> {
        Ok(u32::from_le_bytes(self.array(what)?))
    }

    pub(crate) fn u64(&mut self, what: &'static str) -> Result<u64, FormatError> {
        Ok(u64::from_le_bytes(self.array(what)?))
    }

    pub(crate) fn f64(&mut self, what: &'static str) -> Result<f64, FormatError> {
        Ok(f64::from_le_bytes(self.array(what)?))
    }

    /// A count of items of at least `each` bytes: never more than the rest of the file can hold.
    pub(crate) fn count(&mut self, each: u64, what: &'static str) -> Result<u64, FormatError> {
        let size = self.u64(what)?;
        let limit = self.len.saturating_sub(self.at) / each;
        if size > limit {
            return Err(FormatError::TooLarge { path: self.path.to_owned(), what, size, limit });
        }
        Ok(size)
    }

    pub(crate) fn skip(&mut self, bytes: u64, what: &'static str) -> Result<(), FormatError> {
        if bytes > self.len.saturating_sub(self.at) {
            return Err(self.truncated(what));
        }
        let by = i64::try_from(bytes).map_err(|_| self.truncated(what))?;
        self.reader.seek_relative(by).map_err(|e| FormatError::io(self.path, "reading", e))?;
        self.at += bytes;
        Ok(())
    }

    /// Up to the next zero byte.
    pub(crate) fn c_str(&mut self, what: &'static str) -> Result<String, FormatError> {
        let mut bytes = Vec::new();
        loop {
            match self.u8(what)? {
                0 => break,
                b => bytes.push(b),
            }
            if bytes.len() > MAX_TEXT {
                return Err(FormatError::invalid(self.path, format!("{what} is longer than {MAX_TEXT} bytes")));
            }
        }
        String::from_utf8(bytes).map_err(|_| FormatError::invalid(self.path, format!("{what} is not UTF-8")))
    }
}

/// Lines of a text file, of which only the first bytes are kept: what COLMAP writes on one line has no bound.
pub(crate) struct Lines<'p> {
    path: &'p Path,
    reader: BufReader<File>,
    line: Vec<u8>,
    limit: usize,
    /// Number of the present line, from 1.
    pub(crate) number: u64,
}

impl<'p> Lines<'p> {
    /// Keeps at most `limit` bytes of a line; the rest is read and forgotten.
    pub(crate) fn open(path: &'p Path, limit: usize) -> Result<Self, FormatError> {
        let file = disk::regular::open(path).map_err(|e| FormatError::io(path, "opening", e))?;
        Ok(Self { path, reader: BufReader::with_capacity(BUFFER, file), line: Vec::new(), limit, number: 0 })
    }

    /// The next line without its end, `None` at the end of the file.
    pub(crate) fn next_line(&mut self) -> Result<Option<&str>, FormatError> {
        self.line.clear();
        let mut any = false;
        loop {
            let buffer = match self.reader.fill_buf() {
                Ok(b) => b,
                Err(e) if e.kind() == ErrorKind::Interrupted => continue,
                Err(e) => return Err(FormatError::io(self.path, "reading", e)),
            };
            if buffer.is_empty() {
                break;
            }
            any = true;
            let end = buffer.iter().position(|&b| b == b'\n');
            let part = &buffer[..end.unwrap_or(buffer.len())];
            let room = self.limit - self.line.len().min(self.limit);
            self.line.extend_from_slice(&part[..part.len().min(room)]);
            let used = end.map_or(buffer.len(), |e| e + 1);
            self.reader.consume(used);
            if end.is_some() {
                break;
            }
        }
        if !any {
            return Ok(None);
        }
        self.number += 1;
        // A cut in the middle of a character must not make the kept part unreadable.
        let valid = match std::str::from_utf8(&self.line) {
            Ok(_) => self.line.len(),
            Err(e) if self.line.len() == self.limit => e.valid_up_to(),
            Err(_) => {
                return Err(FormatError::invalid(self.path, format!("line {} is not UTF-8 text", self.number)));
            }
        };
        let line = std::str::from_utf8(&self.line[..valid]).unwrap_or_default();
        Ok(Some(line.trim_start_matches('\u{feff}').trim_end_matches('\r')))
    }

    /// The next line that is neither empty nor a comment.
    pub(crate) fn next_row(&mut self) -> Result<Option<String>, FormatError> {
        while let Some(line) = self.next_line()? {
            let line = line.trim();
            if !line.is_empty() && !line.starts_with('#') {
                return Ok(Some(line.to_owned()));
            }
        }
        Ok(None)
    }

    pub(crate) fn bad(&self, what: &str) -> FormatError {
        FormatError::invalid(self.path, format!("line {}: {what}", self.number))
    }
}
