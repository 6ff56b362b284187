//! Gaussians sorted by leaf, in a file without a name: a scene larger than memory is read once and written once, a leaf at a time.

use std::fs::File;
use std::io::{self, BufReader, Read, Seek, SeekFrom, Write};
use std::path::Path;

use crate::cloud::{GaussianCloud, sh_coefficients};

/// Bytes that wait for the file, of all leaves together.
const WAITING: usize = 64 << 20;
/// Of one leaf, at the most.
const MOST_WAITING: usize = 32 << 10;

/// The rows of all leaves, each leaf in one piece.
pub(super) struct Scratch {
    file: File,
    sh_degree: u8,
    leaves: Vec<Leaf>,
    most_waiting: usize,
}

struct Leaf {
    /// Where its first row lies, and the next one will.
    start: u64,
    next: u64,
    waiting: Vec<u8>,
}

/// Bytes of a row: mean, log scales, rotation, opacity, SH.
pub(super) fn row_bytes(sh_degree: u8) -> usize {
    4 * (11 + 3 * sh_coefficients(sh_degree))
}

/// The bytes of row `i`.
fn row(cloud: &GaussianCloud, i: usize) -> impl Iterator<Item = u8> {
    let stride = cloud.sh_stride();
    let row = cloud.means[i].iter().chain(&cloud.log_scales[i]).chain(&cloud.rotations[i]);
    let row = row.chain(&cloud.opacity_logits[i..=i]).chain(&cloud.sh[i * stride..(i + 1) * stride]);
    row.flat_map(|v| v.to_le_bytes())
}

impl Scratch {
    /// Room for so many rows of each leaf, in `folder`.
    ///
    /// # Errors
    /// The operating system's.
    pub fn create(folder: &Path, sh_degree: u8, counts: &[u32]) -> io::Result<Self> {
        let file = tempfile::tempfile_in(folder)?;
        let mut start = 0;
        let leaves = counts.iter().map(|n| {
            let leaf = Leaf { start, next: start, waiting: Vec::new() };
            start += u64::from(*n) * row_bytes(sh_degree) as u64;
            leaf
        });
        let leaves: Vec<Leaf> = leaves.collect();
        let most_waiting = (WAITING / leaves.len().max(1)).min(MOST_WAITING).max(row_bytes(sh_degree));
        Ok(Self { file, sh_degree, leaves, most_waiting })
    }

    /// Adds row `i` of `cloud` to a leaf.
    ///
    /// # Errors
    /// The operating system's.
    pub fn push(&mut self, leaf: usize, cloud: &GaussianCloud, i: usize) -> io::Result<()> {
        let into = &mut self.leaves[leaf];
        if into.waiting.capacity() == 0 {
            into.waiting.reserve_exact(self.most_waiting);
        }
        into.waiting.extend(row(cloud, i));
        if into.waiting.len() + row_bytes(self.sh_degree) > self.most_waiting { self.flush(leaf) } else { Ok(()) }
    }

    fn flush(&mut self, leaf: usize) -> io::Result<()> {
        let from = &mut self.leaves[leaf];
        self.file.seek(SeekFrom::Start(from.next))?;
        self.file.write_all(&from.waiting)?;
        from.next += from.waiting.len() as u64;
        from.waiting.clear();
        Ok(())
    }

    /// All rows are there; what waits is written.
    ///
    /// # Errors
    /// The operating system's.
    pub fn finish(mut self) -> io::Result<Rows> {
        for leaf in 0..self.leaves.len() {
            self.flush(leaf)?;
            self.leaves[leaf].waiting = Vec::new();
        }
        let spans = self.leaves.iter().map(|l| (l.start, l.next)).collect();
        Ok(Rows { file: self.file, sh_degree: self.sh_degree, spans })
    }
}

/// The rows of a scene in a file, leaf by leaf.
#[derive(Debug)]
pub struct Rows {
    file: File,
    sh_degree: u8,
    spans: Vec<(u64, u64)>,
}

impl Rows {
    /// None yet, in a file without a name in `folder`.
    ///
    /// # Errors
    /// The operating system's.
    pub fn create(folder: &Path, sh_degree: u8) -> io::Result<Self> {
        Ok(Self { file: tempfile::tempfile_in(folder)?, sh_degree, spans: Vec::new() })
    }

    /// Appends the next leaf; of this SH degree.
    ///
    /// # Errors
    /// The operating system's.
    pub fn push(&mut self, leaf: &GaussianCloud) -> io::Result<()> {
        let start = self.spans.last().map_or(0, |s| s.1);
        let bytes: Vec<u8> = (0..leaf.len()).flat_map(|i| row(leaf, i)).collect();
        self.file.seek(SeekFrom::Start(start))?;
        self.file.write_all(&bytes)?;
        self.spans.push((start, start + bytes.len() as u64));
        Ok(())
    }

    /// The Gaussians of a leaf, in the order in which they came.
    ///
    /// # Errors
    /// The operating system's.
    pub fn read(&mut self, leaf: usize) -> io::Result<GaussianCloud> {
        let (start, end) = self.spans[leaf];
        let bytes = row_bytes(self.sh_degree);
        let n = ((end - start) / bytes as u64) as usize;
        self.file.seek(SeekFrom::Start(start))?;
        let mut input = BufReader::with_capacity(1 << 18, &self.file);
        let mut cloud = GaussianCloud::with_capacity(self.sh_degree, n);
        let mut row = vec![0; bytes];
        for _ in 0..n {
            input.read_exact(&mut row)?;
            let mut floats = row.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b));
            let mut next = || floats.next().unwrap_or(f32::NAN);
            cloud.means.push([next(), next(), next()]);
            cloud.log_scales.push([next(), next(), next()]);
            cloud.rotations.push([next(), next(), next(), next()]);
            cloud.opacity_logits.push(next());
            cloud.sh.extend(floats);
        }
        Ok(cloud)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_come_back_leaf_by_leaf_and_bit_by_bit() {
        let mut cloud = GaussianCloud::with_capacity(1, 3_000);
        for i in 0..3_000 {
            let v = i as f32;
            let sh: Vec<f32> = (0..12).map(|k| v + 0.01 * k as f32).collect();
            cloud.push([v, -v, 0.5], [v.sin(); 3], [1.0, v, 0.0, -v], v.cos(), &sh);
        }
        let leaf_of = |i: usize| (i * i) % 3;
        let counts = [0, 1, 2].map(|leaf| (0..3_000).filter(|i| leaf_of(*i) == leaf).count() as u32);
        let folder = tempfile::tempdir().expect("a folder");
        let mut scratch = Scratch::create(folder.path(), 1, &counts).expect("a file");
        (0..3_000).for_each(|i| scratch.push(leaf_of(i), &cloud, i).expect("written"));
        let mut sorted = scratch.finish().expect("written");
        for leaf in [2, 0, 1] {
            let mut expected = cloud.clone();
            expected.retain(|i| leaf_of(i) == leaf);
            assert_eq!(sorted.read(leaf).expect("read"), expected);
        }
        let mut appended = Rows::create(folder.path(), 1).expect("a file");
        let leaves = [0, 1, 2].map(|leaf| sorted.read(leaf).expect("read"));
        leaves.iter().for_each(|leaf| appended.push(leaf).expect("written"));
        assert_eq!(
            [2, 0, 1].map(|leaf| appended.read(leaf).expect("read")),
            [2, 0, 1].map(|i: usize| leaves[i].clone())
        );
    }
}
