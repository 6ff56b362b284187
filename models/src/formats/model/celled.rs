//! Version 4 of the file: cells of ground, each in words of its own and named by their hash, behind an index of all of them and a coarse layer
//! of each.

use std::fs::File;
use std::io::{BufReader, Read, Write};
use std::path::Path;

use disk::Disk;

use super::hashing::Hashing;
use super::{Body, CELLED, FIXED, FormatError, HASH, ModelHeader, begin, check_columns, encode_header, finish, open};
use super::{columns::read_words, read_header_of};
use crate::camera::View;
use crate::cloud::GaussianCloud;
use crate::formats::delivery::{self, CodedCells, Layer, Rounding};
use crate::ground_cell::{CellKey, Grid, MOST_LEVEL};

/// Cells of a file at most: what an offer on the wire can name, with two layers each.
const MOST_CELLS: u64 = 1 << 14;
/// Bytes of the index before its entries, of an entry, and of what says of the whole cell in it; the rest is its coarse layer's.
const HEAD: u64 = 8;
const ENTRY: u64 = WHOLE + 40;
const WHOLE: u64 = 53;

/// Bytes below which a piece is not worth its name on the wire.
const LEAST_PIECE: u64 = 8 << 10;

/// Words that lie together.
pub(super) struct Piece {
    count: u32,
    words: u32,
    hash: [u8; HASH as usize],
}

/// A cell as the index has it.
struct Entry {
    key: CellKey,
    importance: f32,
    whole: Piece,
    coarse: Piece,
}

/// The index of a file.
pub(super) struct Cells(Vec<Entry>);

/// As [`super::write_rounded`], of the cells that `wanted` asks for.
///
/// # Errors
/// Errors of [`super::write()`].
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
    let n = cells.iter().map(|cell| cell.whole.count as usize).sum();
    let bytes = |layer: &Layer| -> Vec<u8> { layer.words.iter().flat_map(|w| w.to_le_bytes()).collect() };
    disk.replace(path, |file| {
        let mut out = begin(file, CELLED, &head, n, cloud.sh_degree)?;
        out.write_all(&grid.side.to_le_bytes())?;
        out.write_all(&(cells.len() as u32).to_le_bytes())?;
        for cell in &cells {
            out.write_all(&[cell.key.level])?;
            out.write_all(&cell.key.y.to_le_bytes())?;
            out.write_all(&cell.key.x.to_le_bytes())?;
            out.write_all(&cell.whole.count.to_le_bytes())?;
            out.write_all(&(cell.whole.words.len() as u32).to_le_bytes())?;
            out.write_all(&cell.importance.to_le_bytes())?;
            out.write_all(blake3::hash(&bytes(&cell.whole)).as_bytes())?;
            out.write_all(&cell.coarse.count.to_le_bytes())?;
            out.write_all(&(cell.coarse.words.len() as u32).to_le_bytes())?;
            out.write_all(blake3::hash(&bytes(&cell.coarse)).as_bytes())?;
        }
        let file = finish(out)?;
        cells.iter().try_for_each(|cell| file.write_all(&bytes(&cell.coarse)))?;
        cells.iter().try_for_each(|cell| file.write_all(&bytes(&cell.whole)))
    })
    .map_err(|e| FormatError::disk(path, e))?;
    Ok(n)
}

/// The lengths of the pieces that a file is best sent in: everything up to the cells, then their coarse layers, then each cell, the
/// most important first; what is small goes with what comes next. `None`: not in cells, any cut is as good.
///
/// # Errors
/// As [`super::read_header`].
pub fn pieces(path: &Path) -> Result<Option<Vec<u64>>, FormatError> {
    let mut opened = open(path)?;
    let Body::Cells = opened.body else { return Ok(None) };
    read_header_of(path, &mut opened)?;
    let before = FIXED + opened.header_len as u64;
    let cells = Cells::read(path, &mut opened.input, opened.count, opened.size - before)?;
    let head = before + index_bytes(cells.0.len() as u64) + HASH;
    let mut pieces = vec![head];
    for layer in cells.layers() {
        let mut open = false;
        for bytes in layer.into_iter().map(Piece::bytes).filter(|n| *n > 0) {
            match pieces.last_mut().filter(|_| open) {
                Some(last) => *last += bytes,
                None => pieces.push(bytes),
            }
            open = pieces.last().is_some_and(|last| *last < LEAST_PIECE);
        }
    }
    Ok(Some(pieces))
}

fn index_bytes(cells: u64) -> u64 {
    HEAD + cells * ENTRY
}

impl Cells {
    /// The index of `count` Gaussians that `left` bytes of the file begin with.
    pub fn read(
        path: &Path,
        input: &mut Hashing<BufReader<File>>,
        count: usize,
        left: u64,
    ) -> Result<Self, FormatError> {
        let (index, room) = Self::read_index(path, input, count, left)?;
        match index.layers().concat().into_iter().map(Piece::bytes).sum::<u64>() {
            bytes if bytes == room => Ok(index),
            bytes if bytes > room => Err(FormatError::Truncated { path: path.to_owned(), at: room, what: "its cells" }),
            bytes => {
                let what = format!("its cells take {bytes} of {room} bytes (damaged file?)");
                Err(FormatError::invalid(path, what))
            }
        }
    }

    /// The index alone, and how many bytes of the cells are there.
    pub fn read_index(
        path: &Path,
        input: &mut Hashing<BufReader<File>>,
        count: usize,
        left: u64,
    ) -> Result<(Self, u64), FormatError> {
        let failed = |e| FormatError::io(path, "reading", e);
        let bad = |what: String| Err(FormatError::invalid(path, format!("{what} (damaged file?)")));
        let mut head = [0; HEAD as usize];
        input.read_exact(&mut head).map_err(failed)?;
        let [a, b, c, d, cells @ ..] = head;
        let (side, cells) = (f32::from_le_bytes([a, b, c, d]), u64::from(u32::from_le_bytes(cells)));
        let room = left.checked_sub(HASH + index_bytes(cells)).filter(|_| cells <= MOST_CELLS);
        let Some(room) = room else {
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
            let whole = &entry.whole;
            let too_many = [&entry.coarse, whole].into_iter().any(Piece::is_absurd);
            if entry.key.level > MOST_LEVEL || too_many || entry.importance.is_nan() {
                let what = format!("cell {i} of level {} with {} Gaussians", entry.key.level, whole.count);
                return bad(format!("{what} in {} words", whole.words));
            }
            entries.push(entry);
        }
        let gaussians = entries.iter().map(|e| u64::from(e.whole.count)).sum::<u64>();
        match gaussians == count as u64 {
            true => Ok((Self(entries), room)),
            false => bad(format!("its cells hold {gaussians} of {count} Gaussians")),
        }
    }

    /// What lies in the file, in its order: coarse layers, then whole cells.
    fn layers(&self) -> [Vec<&Piece>; 2] {
        [self.0.iter().map(|e| &e.coarse).collect(), self.0.iter().map(|e| &e.whole).collect()]
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
        for coarse in self.0.iter().map(|e| &e.coarse) {
            coarse.words(path, input)?;
        }
        for entry in self.0 {
            each(entry.whole.read(path, input, sh_degree)?)?;
        }
        Ok(())
    }

    /// What `room` bytes of the cells show: each as it is where it is there, else its coarse layer. How many of them are there, and how many
    /// coarse layers.
    ///
    /// # Errors
    /// A damaged cell, the operating system's.
    pub fn there(
        self,
        path: &Path,
        input: &mut BufReader<File>,
        sh_degree: u8,
        room: u64,
    ) -> Result<(GaussianCloud, [usize; 2]), FormatError> {
        let (mut left, mut coarse) = (room, Vec::new());
        let mut fits = |piece: &Piece| {
            let rest = left.checked_sub(piece.bytes());
            // What comes after a piece that ends early is not there either.
            left = rest.unwrap_or(0);
            rest.is_some()
        };
        for piece in self.0.iter().map(|e| &e.coarse) {
            if !fits(piece) {
                break;
            }
            coarse.push(piece.read(path, input, 0)?);
        }
        let (coarse_there, mut whole) = (coarse.len(), 0);
        let mut cloud = GaussianCloud::with_capacity(sh_degree, 0);
        let mut coarse = coarse.into_iter();
        let mut ends = coarse_there < self.0.len();
        for entry in &self.0 {
            let own = coarse.next();
            ends |= !fits(&entry.whole);
            if ends {
                own.iter().for_each(|own| cloud.extend(own));
            } else {
                cloud.extend(&entry.whole.read(path, input, sh_degree)?);
                whole += 1;
            }
        }
        Ok((cloud, [whole, coarse_there]))
    }

    /// How many cells there are.
    pub fn count(&self) -> usize {
        self.0.len()
    }
}

impl Piece {
    fn of([numbers, hash]: [&[u8]; 2]) -> Self {
        let word = |at: usize| u32::from_le_bytes([numbers[at], numbers[at + 1], numbers[at + 2], numbers[at + 3]]);
        let mut own = [0; HASH as usize];
        own.copy_from_slice(hash);
        Self { count: word(0), words: word(4), hash: own }
    }

    fn bytes(&self) -> u64 {
        4 * u64::from(self.words)
    }

    /// More Gaussians than its words can hold.
    fn is_absurd(&self) -> bool {
        u64::from(self.count) > delivery::most_gaussians(self.bytes())
    }

    /// Its words, when their hash is right.
    fn words(&self, path: &Path, input: &mut BufReader<File>) -> Result<Vec<u32>, FormatError> {
        let mut hashing = Hashing { inner: &mut *input, hasher: blake3::Hasher::new() };
        let words = read_words(&mut hashing, self.words as usize, u32::from_le_bytes);
        let words = words.map_err(|e| FormatError::io(path, "reading", e))?;
        match hashing.hasher.finalize() == blake3::Hash::from_bytes(self.hash) {
            true => Ok(words),
            false => Err(FormatError::Damaged { path: path.to_owned() }),
        }
    }

    fn read(&self, path: &Path, input: &mut BufReader<File>, sh_degree: u8) -> Result<GaussianCloud, FormatError> {
        let words = self.words(path, input)?;
        if self.count == 0 {
            return Ok(GaussianCloud::with_capacity(sh_degree, 0));
        }
        let cloud = delivery::decode(words, self.count as usize, sh_degree);
        cloud.map_err(|e| FormatError::invalid(path, e.to_string()))
    }
}

impl Entry {
    fn of(bytes: &[u8; ENTRY as usize]) -> Self {
        let word = |at: usize| [bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]];
        Self {
            key: CellKey { level: bytes[0], y: i32::from_le_bytes(word(1)), x: i32::from_le_bytes(word(5)) },
            importance: f32::from_le_bytes(word(17)),
            whole: Piece::of([&bytes[9..17], &bytes[21..WHOLE as usize]]),
            coarse: Piece::of([&bytes[WHOLE as usize..][..8], &bytes[WHOLE as usize + 8..]]),
        }
    }
}
