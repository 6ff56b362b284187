//! A model read piece by piece, for scenes that are larger than the memory there is.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom, Write};
use std::ops::Range;
use std::path::{Path, PathBuf};

use disk::Disk;

use super::celled::Cells;
use super::columns::{self, read_words, triples, write_floats};
use super::hashing::Hashing;
use super::opening::{Body, Opened, open, read_header_of};
use super::{
    EXACT, FIXED, FormatError, HASH, ModelHeader, begin, decode_header, encode_header, exact_bytes, finish,
    write_atomic,
};
use crate::cloud::{GaussianCloud, sh_coefficients};

/// Gaussians of a piece of exact columns.
const ROWS: usize = 16 << 10;
/// Buffers of readers and writers of columns: 64 KiB for each of five, and as much for numbers on their way.
const COLUMNS_BUFFERED: u64 = 10 << 16;

/// A verified model, whose Gaussians are read as often as they are wanted.
#[derive(Debug)]
pub struct Chunks {
    path: PathBuf,
    /// What the file says about itself.
    pub header: ModelHeader,
    /// Gaussians in the file, not all of them with finite numbers.
    pub count: usize,
    /// Their SH degree.
    pub sh_degree: u8,
}

/// Bytes that reading or writing piece by piece takes of the host for Gaussians of this SH degree: a piece, and buffers of its columns.
pub fn piece_bytes(sh_degree: u8) -> u64 {
    ROWS as u64 * exact_bytes(sh_degree) + COLUMNS_BUFFERED
}

/// What is done with a piece, which is nobody else's.
pub type Each<'a, E> = &'a mut dyn FnMut(&mut GaussianCloud) -> Result<(), E>;

impl Chunks {
    /// Opens a model; the file is read once, to verify it.
    ///
    /// # Errors
    /// As [`super::read`].
    pub fn open(path: &Path) -> Result<Self, FormatError> {
        let mut opened = open(path)?;
        let header = decode_header(path, &read_header_of(path, &mut opened)?)?;
        let (count, sh_degree) = (opened.count, opened.sh_degree);
        // Cells have hashes of their own and are verified when they are read.
        if opened.body == Body::Columns {
            verify(path, opened)?;
        }
        Ok(Self { path: path.to_owned(), header, count, sh_degree })
    }

    /// Gives the valid Gaussians to `each`, piece by piece and always in the same pieces; how many were left out because they hold a number that is not finite.
    ///
    /// # Errors
    /// As [`super::read`], and those of `each`.
    pub fn each<E: From<FormatError>>(&self, each: Each<'_, E>) -> Result<u64, E> {
        let mut dropped = 0;
        let mut valid = |mut cloud: GaussianCloud| {
            dropped += cloud.drop_invalid() as u64;
            each(&mut cloud)
        };
        let mut opened = open(&self.path)?;
        let header = read_header_of(&self.path, &mut opened)?;
        match opened.body {
            Body::Columns => self.columns(header.len(), &mut valid)?,
            Body::Cells => self.cells(opened, header.len(), &mut valid)?,
        }
        Ok(dropped)
    }

    /// At most `most` of the valid Gaussians, evenly chosen, of SH degree 0.
    ///
    /// # Errors
    /// As [`super::read`].
    pub fn sample(&self, most: usize) -> Result<GaussianCloud, FormatError> {
        let every = self.count.div_ceil(most.max(1)).max(1);
        let (mut sample, mut at) = (GaussianCloud::with_capacity(0, self.count.min(most)), 0usize);
        self.each::<FormatError>(&mut |piece| {
            let first = at.next_multiple_of(every) - at;
            for i in (first..piece.len()).step_by(every) {
                let constant = &piece.sh[i * piece.sh_stride()..][..3];
                sample.push(piece.means[i], piece.log_scales[i], piece.rotations[i], piece.opacity_logits[i], constant);
            }
            at += piece.len();
            Ok(())
        })?;
        Ok(sample)
    }

    fn columns<E: From<FormatError>>(
        &self,
        header: usize,
        each: &mut dyn FnMut(GaussianCloud) -> Result<(), E>,
    ) -> Result<(), E> {
        let sh = 3 * sh_coefficients(self.sh_degree);
        let mut start = FIXED + header as u64;
        let mut column = |floats: usize| {
            let mut file = disk::regular::open(&self.path)?;
            file.seek(SeekFrom::Start(start))?;
            start += 4 * (floats * self.count) as u64;
            std::io::Result::Ok(BufReader::with_capacity(1 << 16, file))
        };
        let failed = |e| FormatError::io(&self.path, "reading", e);
        let mut columns =
            [3, 3, 4, 1, sh].map(&mut column).into_iter().collect::<Result<Vec<_>, _>>().map_err(failed)?;
        let mut left = self.count;
        while left > 0 {
            let n = left.min(ROWS);
            let mut words =
                |k: usize, floats: usize| read_words(&mut columns[k], floats * n, f32::from_le_bytes).map_err(failed);
            each(GaussianCloud {
                sh_degree: self.sh_degree,
                means: triples(words(0, 3)?),
                log_scales: triples(words(1, 3)?),
                rotations: words(2, 4)?.as_chunks().0.to_vec(),
                opacity_logits: words(3, 1)?,
                sh: words(4, sh)?,
            })?;
            left -= n;
        }
        Ok(())
    }

    fn cells<E: From<FormatError>>(
        &self,
        opened: Opened,
        header: usize,
        each: &mut dyn FnMut(GaussianCloud) -> Result<(), E>,
    ) -> Result<(), E> {
        let Opened { mut input, count, size, .. } = opened;
        let cells = Cells::read(&self.path, &mut input, count, size - FIXED - header as u64)?;
        compare(&self.path, &mut input)?;
        cells.each(&self.path, &mut input.inner, self.sh_degree, each)
    }
}

/// Writes an exact model of `count` Gaussians that are never all in memory: `rows` makes those of a range, once for each column of the file.
///
/// # Errors
/// As [`super::write()`]; `rows` gave another number or degree than it was asked for.
pub fn write_chunks(
    path: &Path,
    header: &ModelHeader,
    count: usize,
    sh_degree: u8,
    rows: &dyn Fn(Range<usize>) -> GaussianCloud,
) -> Result<(), FormatError> {
    let written = write_columns(path, header, count, sh_degree, &mut |column, out| {
        for start in (0..count).step_by(ROWS) {
            let range = start..count.min(start + ROWS);
            let cloud = rows(range.clone());
            if cloud.len() != range.len() || cloud.sh_degree != sh_degree {
                return Err(std::io::Error::other("rows of another number or degree than was asked for"));
            }
            write_floats(&mut &mut *out, columns::of(&cloud)[column])?;
        }
        Ok(())
    });
    written.map(drop)
}

/// Writes exact columns that `fill` writes one after the other, each as a whole. Returns the file's content hash.
///
/// # Errors
/// As [`super::write()`]; those of `fill`; it wrote columns of another length.
pub fn write_columns(
    path: &Path,
    header: &ModelHeader,
    count: usize,
    sh_degree: u8,
    fill: &mut dyn FnMut(usize, &mut dyn Write) -> std::io::Result<()>,
) -> Result<[u8; HASH as usize], FormatError> {
    let head = encode_header(path, header)?;
    let mut hash = [0; HASH as usize];
    write_atomic(path, |file: &mut dyn Write| {
        hash = columns_into(file, &head, count, sh_degree, fill)?;
        Ok(())
    })?;
    Ok(hash)
}

fn columns_into(
    file: &mut dyn Write,
    head: &[u8],
    count: usize,
    sh_degree: u8,
    fill: &mut dyn FnMut(usize, &mut dyn Write) -> std::io::Result<()>,
) -> std::io::Result<[u8; HASH as usize]> {
    let mut out = begin(file, EXACT, head, count, sh_degree)?;
    for (column, floats) in columns::floats(sh_degree).into_iter().enumerate() {
        let mut counting = Counting { inner: &mut out, bytes: 0 };
        fill(column, &mut counting)?;
        if counting.bytes != 4 * (floats * count) as u64 {
            return Err(std::io::Error::other("a column of another length than its Gaussians have"));
        }
    }
    let hash = *out.hasher.finalize().as_bytes();
    finish(out)?;
    Ok(hash)
}

/// Reads a scene from its beginning to its end into what it is given, piece by piece.
pub type Pieces<'a> = &'a mut dyn FnMut(&mut dyn FnMut(&GaussianCloud) -> std::io::Result<()>) -> std::io::Result<()>;

/// As [`super::write_checkpoint`], of Gaussians that are never all in memory: `pieces` reads them once for each column of the file.
///
/// # Errors
/// As [`super::write()`]; those of `pieces`; it gave another number or degree than it should.
pub fn write_checkpoint_pieces(
    disk: &Disk,
    path: &Path,
    header: &ModelHeader,
    (count, sh_degree): (usize, u8),
    pieces: Pieces<'_>,
) -> Result<(), FormatError> {
    let head = encode_header(path, header)?;
    let fill = &mut |column: usize, mut out: &mut dyn Write| {
        pieces(&mut |cloud| write_floats(&mut out, columns::of(cloud)[column]))
    };
    disk.replace_keeping(path, |file| columns_into(file, &head, count, sh_degree, fill).map(drop))
        .map_err(|e| FormatError::disk(path, e))
}

/// As [`super::read_checkpoint`], to be read piece by piece.
///
/// # Errors
/// Errors of [`super::read_checkpoint`].
pub fn open_checkpoint(disk: &Disk, path: &Path) -> Result<Option<Chunks>, FormatError> {
    let newest = disk.newest(path, Chunks::open).map_err(|e| FormatError::io(path, "setting aside", e))?;
    newest.damaged.iter().for_each(|d| tracing::warn!("{d}"));
    Ok(newest.found)
}

/// Counts what passes through.
struct Counting<T> {
    inner: T,
    bytes: u64,
}

impl<T: Write> Write for Counting<T> {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let n = self.inner.write(bytes)?;
        self.bytes += n as u64;
        Ok(n)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.inner.flush()
    }
}

/// Reads exact columns to their end and compares the hash.
fn verify(path: &Path, mut opened: Opened) -> Result<(), FormatError> {
    let columns = opened.size - FIXED - opened.header_len as u64 - HASH;
    let copied = std::io::copy(&mut opened.input.by_ref().take(columns), &mut std::io::sink());
    copied.map_err(|e| FormatError::io(path, "reading", e))?;
    compare(path, &mut opened.input).map(drop)
}

/// The hash that comes next in the file, when it is that of what was read.
///
/// # Errors
/// [`FormatError::Damaged`] when it is not, else the operating system's.
pub(super) fn compare(path: &Path, input: &mut Hashing<BufReader<File>>) -> Result<[u8; 32], FormatError> {
    let expected = input.hasher.finalize();
    let mut hash = [0; HASH as usize];
    input.inner.read_exact(&mut hash).map_err(|e| FormatError::io(path, "reading", e))?;
    match expected == blake3::Hash::from_bytes(hash) {
        true => Ok(hash),
        false => Err(FormatError::Damaged { path: path.to_owned() }),
    }
}
