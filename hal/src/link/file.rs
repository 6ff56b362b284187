//! Plays a recorded telemetry log (`.tlog`: 64-bit big-endian Unix microseconds before each frame) as if it came over a
//! link, on the recording's own clock. Damaged stretches are passed over and counted; a truncated end is reported.

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::time::Duration;

use crate::error::HalError;
use crate::traits::{Link, Received};

/// Time stamp, then a frame of at most 280 bytes.
const STAMP: usize = 8;
/// Read-ahead; larger than any record.
const BUFFER: usize = 1 << 16;
/// Time stamps outside 2000–2100 are not time stamps.
const PLAUSIBLE_US: std::ops::Range<u64> = 946_684_800_000_000..4_102_444_800_000_000;
/// Nor are those further than a day from the last one.
const DAY_US: u64 = 86_400_000_000;

/// A recorded log being read.
pub struct TlogLink {
    reader: BufReader<File>,
    path: PathBuf,
    last_us: Option<u64>,
    records: u64,
    damaged: u64,
    truncated: bool,
    searching: bool,
}

impl TlogLink {
    /// Opens the log at `path`.
    ///
    /// # Errors
    /// [`HalError::Open`] when it cannot be read.
    pub fn open(path: &Path) -> Result<Self, HalError> {
        match disk::regular::open(path) {
            Ok(file) => Ok(Self {
                reader: BufReader::with_capacity(BUFFER, file),
                path: path.into(),
                last_us: None,
                records: 0,
                damaged: 0,
                truncated: false,
                searching: false,
            }),
            Err(source) => Err(HalError::Open { address: format!("file:{}", path.display()), source }),
        }
    }

    /// Records found so far.
    pub fn records(&self) -> u64 {
        self.records
    }

    /// Stretches that were no record.
    pub fn damaged(&self) -> u64 {
        self.damaged
    }

    /// True when the log ended inside a record.
    pub fn truncated(&self) -> bool {
        self.truncated
    }

    fn closed(&self) -> HalError {
        HalError::Closed { address: format!("file:{}", self.path.display()) }
    }

    /// Makes at least `wanted` bytes visible unless the file ends before.
    fn at_least(&mut self, wanted: usize) -> Result<usize, HalError> {
        let buffered = self.reader.buffer().len();
        if buffered >= wanted {
            return Ok(buffered);
        }
        // BufReader refills only when empty; records straddling its end are moved to the front by seeking back.
        let fill = |reader: &mut BufReader<File>| -> std::io::Result<usize> {
            use std::io::{Seek, SeekFrom};
            let position = reader.stream_position()?;
            reader.seek(SeekFrom::Start(position))?;
            Ok(reader.fill_buf()?.len())
        };
        fill(&mut self.reader)
            .map_err(|source| HalError::Link { address: format!("file:{}", self.path.display()), source })
    }
}

/// Length of the record at the start of `data` when it looks like one.
fn record_len(data: &[u8], last_us: Option<u64>) -> Option<(u64, usize)> {
    let stamp = u64::from_be_bytes(*data.first_chunk()?);
    let near = last_us.is_none_or(|last| stamp.abs_diff(last) < DAY_US);
    if !PLAUSIBLE_US.contains(&stamp) || !near {
        return None;
    }
    let payload = usize::from(*data.get(STAMP + 1)?);
    let frame = match data.get(STAMP)? {
        0xFE => payload + 8,
        0xFD => payload + 12 + if data.get(STAMP + 2)? & 1 != 0 { 13 } else { 0 },
        _ => return None,
    };
    Some((stamp, STAMP + frame))
}

impl Link for TlogLink {
    type Error = HalError;

    fn read(&mut self, into: &mut [u8], _timeout: Duration) -> Result<Received, HalError> {
        loop {
            let available = self.at_least(STAMP + 280)?;
            if available < STAMP + 8 {
                self.truncated |= available > 0;
                return Err(self.closed());
            }
            let data = self.reader.buffer();
            match record_len(data, self.last_us) {
                Some((_, len)) if len > available => {
                    self.truncated = true;
                    self.reader.consume(available);
                    return Err(self.closed());
                }
                Some((stamp, len)) => {
                    let frame = &data[STAMP..len];
                    let Some(target) = into.get_mut(..frame.len()) else { return Ok(super::NOTHING) };
                    target.copy_from_slice(frame);
                    self.reader.consume(len);
                    self.last_us = Some(stamp);
                    self.records += 1;
                    self.searching = false;
                    return Ok(Received { bytes: len - STAMP, time_ns: Some(stamp * 1000), ..super::NOTHING });
                }
                None => {
                    if !std::mem::replace(&mut self.searching, true) {
                        self.damaged += 1;
                    }
                    self.reader.consume(1);
                }
            }
        }
    }

    fn write(&mut self, _frame: &[u8]) -> Result<(), HalError> {
        Ok(()) // a recording does not answer
    }
}
