//! Version 3 of the file: cells of ground, each in words of its own and named by their hash, behind an index of all of them.

use std::fs::File;
use std::io::{BufReader, Read, Write};
use std::path::Path;

use config::disk::Disk;

use super::hashing::Hashing;
use super::{Body, CELLED, FIXED, FormatError, HASH, ModelHeader, begin, check_columns, encode_header, finish, open};
use super::{columns::read_words, read_header_of};
use crate::camera::View;
use crate::cloud::GaussianCloud;
use crate::formats::delivery::{self, CodedCells, Form, Rounding};
use crate::ground_cell::{CellKey, Grid, MOST_LEVEL};

/// Cells of a file at most: what an offer on the wire can name.
const MOST_CELLS: u64 = 1 << 15;
/// Bytes of the index before its entries, and of an entry.
const HEAD: u64 = 8;
const ENTRY: u64 = 53;

/// A cell as the index has it.
struct Entry {
    key: CellKey,
    count: u32,
    words: u32,
    importance: f32,
    hash: [u8; HASH as usize],
}

/// The index of a file.
pub(super) struct Cells(Vec<Entry>);

/// As [`super::write_rounded`], of the cells that `wanted` asks for.
///
/// # Errors
/// Those of [`super::write()`].
pub fn write_cells(
    disk: &Disk,
    path: &Path,
    header: &ModelHeader,
    cloud: &GaussianCloud,
    rounding: &Rounding,
    wanted: &dyn Fn(Grid, CellKey) -> bool,
) -> Result<usize, FormatError> {
    let views: Vec<View> = header.views.iter().map(|(_, view)| *view).collect();
    check_columns(path, cloud)?;
    let garbled = |e| FormatError::invalid(path, format!("not written: {e}"));
    let CodedCells { grid, cells } = delivery::encode_cells(cloud, &views, rounding, wanted).map_err(garbled)?;
    if cells.len() as u64 > MOST_CELLS {
        return Err(FormatError::invalid(path, format!("not written: {} cells of {MOST_CELLS} at most", cells.len())));
    }
    let head = encode_header(path, header)?;
    let n = cells.iter().map(|cell| cell.count as usize).sum();
    let coded: Vec<Vec<u8>> = cells.iter().map(|c| c.words.iter().flat_map(|w| w.to_le_bytes()).collect()).collect();
    disk.replace(path, |file| {
        let mut out = begin(file, CELLED, &head, n, cloud.sh_degree)?;
        out.write_all(&grid.side.to_le_bytes())?;
        out.write_all(&(cells.len() as u32).to_le_bytes())?;
        for (cell, bytes) in cells.iter().zip(&coded) {
            out.write_all(&[cell.key.level])?;
            out.write_all(&cell.key.y.to_le_bytes())?;
            out.write_all(&cell.key.x.to_le_bytes())?;
            out.write_all(&cell.count.to_le_bytes())?;
            out.write_all(&(cell.words.len() as u32).to_le_bytes())?;
            out.write_all(&cell.importance.to_le_bytes())?;
            out.write_all(blake3::hash(bytes).as_bytes())?;
        }
        let file = finish(out)?;
        coded.iter().try_for_each(|bytes| file.write_all(bytes))
    })
    .map_err(|e| FormatError::disk(path, e))?;
    Ok(n)
}

/// The lengths of the pieces that a file is best sent in: everything up to the cells, then each cell, the most important first.
/// `None`: not in cells, any cut is as good.
///
/// # Errors
/// As [`super::read_header`].
pub fn pieces(path: &Path) -> Result<Option<Vec<u64>>, FormatError> {
    let mut opened = open(path)?;
    if opened.body != Body::Cells {
        return Ok(None);
    }
    read_header_of(path, &mut opened)?;
    let before = FIXED + opened.header_len as u64;
    let cells = Cells::read(path, &mut opened.input, opened.count, opened.size - before)?.0;
    let head = before + HEAD + ENTRY * cells.len() as u64 + HASH;
    Ok(Some(std::iter::once(head).chain(cells.iter().map(|c| 4 * u64::from(c.words)).filter(|n| *n > 0)).collect()))
}

impl Cells {
    /// The index of `count` Gaussians that `left` bytes of the file begin with.
    pub fn read(
        path: &Path,
        input: &mut Hashing<BufReader<File>>,
        count: usize,
        left: u64,
    ) -> Result<Self, FormatError> {
        let failed = |e| FormatError::io(path, "reading", e);
        let bad = |what: String| Err(FormatError::invalid(path, format!("{what} (damaged file?)")));
        let mut head = [0; HEAD as usize];
        input.read_exact(&mut head).map_err(failed)?;
        let [a, b, c, d, cells @ ..] = head;
        let (side, cells) = (f32::from_le_bytes([a, b, c, d]), u64::from(u32::from_le_bytes(cells)));
        let Some(room) = left.checked_sub(HEAD + HASH + ENTRY * cells).filter(|_| cells <= MOST_CELLS) else {
            return bad(format!("its index names {cells} cells, for which it has no room"));
        };
        if !(side.is_finite() && side > 0.0) {
            return bad(format!("cells of {side} m"));
        }
        let mut entries = Vec::with_capacity(cells as usize);
        for i in 0..cells {
            let mut bytes = [0; ENTRY as usize];
            input.read_exact(&mut bytes).map_err(failed)?;
            let entry = Entry::of(&bytes);
            let most = delivery::most_gaussians(Form::Cell, 4 * u64::from(entry.words));
            let Entry { key: CellKey { level, .. }, count: own, .. } = entry;
            if level > MOST_LEVEL || u64::from(own) > most || entry.importance.is_nan() {
                return bad(format!("cell {i} of level {level} with {own} Gaussians in {} words", entry.words));
            }
            entries.push(entry);
        }
        let sum = |of: fn(&Entry) -> u32| entries.iter().map(|e| u64::from(of(e))).sum::<u64>();
        let (gaussians, bytes) = (sum(|e| e.count), 4 * sum(|e| e.words));
        match (gaussians == count as u64, bytes == room) {
            (true, true) => Ok(Self(entries)),
            (true, false) if bytes > room => {
                Err(FormatError::Truncated { path: path.to_owned(), at: room, what: "its cells" })
            }
            _ => bad(format!("its cells hold {gaussians} of {count} Gaussians in {bytes} of {room} bytes")),
        }
    }

    /// Gives the Gaussians of each cell to `each`.
    ///
    /// # Errors
    /// A damaged cell, the operating system's, and those of `each`.
    pub fn each<E: From<FormatError>>(
        self,
        path: &Path,
        input: &mut BufReader<File>,
        sh_degree: u8,
        each: &mut dyn FnMut(GaussianCloud) -> Result<(), E>,
    ) -> Result<(), E> {
        for entry in self.0 {
            let mut hashing = Hashing { inner: &mut *input, hasher: blake3::Hasher::new() };
            let words = read_words(&mut hashing, entry.words as usize, u32::from_le_bytes);
            let words = words.map_err(|e| FormatError::io(path, "reading", e))?;
            if hashing.hasher.finalize() != blake3::Hash::from_bytes(entry.hash) {
                return Err(FormatError::Damaged { path: path.to_owned() }.into());
            }
            let cell = delivery::decode(Form::Cell, words, entry.count as usize, sh_degree);
            each(cell.map_err(|e| FormatError::invalid(path, e.to_string()))?)?;
        }
        Ok(())
    }
}

impl Entry {
    fn of(bytes: &[u8; ENTRY as usize]) -> Self {
        let word = |at: usize| [bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]];
        let mut hash = [0; HASH as usize];
        hash.copy_from_slice(&bytes[21..]);
        Self {
            key: CellKey { level: bytes[0], y: i32::from_le_bytes(word(1)), x: i32::from_le_bytes(word(5)) },
            count: u32::from_le_bytes(word(9)),
            words: u32::from_le_bytes(word(13)),
            importance: f32::from_le_bytes(word(17)),
            hash,
        }
    }
}
