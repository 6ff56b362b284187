//! What a job comes to: the Gaussians of one square of ground as exact columns, each with its hash, so that a reader takes and checks
//! one column at a time.
//!
//! ```text
//! magic "dgtrcell" (8) · version u32 · report bytes u32 · Gaussians u64 · SH degree u32 · input (32)
//! report (postcard) · BLAKE3 of each of the five columns (160) · BLAKE3 of everything before (32): the cell's content hash
//! columns: means 3N f32 · log scales 3N · rotations 4N (w x y z) · opacity logits N · sh N·D·3
//! ```

use models::cloud::GaussianCloud;
use models::formats::model::columns::{self, COLUMNS, write_floats};
use serde::{Deserialize, Serialize};

use crate::block::column_bytes;
use crate::distil::Learnt;
use crate::merge::Kept;
use crate::plan::{Hash, VERSION, cell_name};
use crate::store::{Store, StoreError};

const MAGIC: [u8; 8] = *b"dgtrcell";
const FIXED: u64 = 28 + HASH as u64;
const HASH: usize = 32;
/// Longest report taken; it has some hundred bytes for each model.
const MOST_REPORT: u64 = 16 << 20;
/// Gaussians of a cell, at most: more than any machine distils.
const MOST_ROWS: u64 = 1 << 32;

/// What became of a cell: the same for the same input, wherever it was made.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// Of the Gaussians in the square, per model of the job.
    pub kept: Vec<Kept>,
    /// What its seams have learnt.
    pub learnt: Learnt,
}

/// Everything of a cell but its Gaussians.
#[derive(Clone, Debug, PartialEq)]
pub struct Head {
    /// Gaussians.
    pub count: u64,
    /// Their SH degree.
    pub sh_degree: u8,
    /// What became of it.
    pub report: Report,
    /// BLAKE3 of each column.
    columns: [Hash; COLUMNS],
    /// Of the whole.
    pub content: Hash,
    /// Where the columns begin.
    start: u64,
}

impl Head {
    /// Of the cell with this input, if it is there and as long as it says; None: it is not there.
    ///
    /// # Errors
    /// The store's; something else lies there, or it is damaged.
    pub fn read(store: &Store, input: &Hash) -> Result<Option<Self>, StoreError> {
        let name = cell_name(input);
        let Some(size) = store.size(&name)? else { return Ok(None) };
        let damaged = |what| StoreError::Damaged { name: name.clone(), what };
        if size < FIXED {
            return Err(damaged("it is too short for a cell"));
        }
        let fixed = store.range(&name, 0, FIXED)?;
        let word = |at: usize| u32::from_le_bytes([fixed[at], fixed[at + 1], fixed[at + 2], fixed[at + 3]]);
        let count = u64::from(word(16)) | u64::from(word(20)) << 32;
        let (report, degree) = (u64::from(word(12)), word(24));
        if fixed[..8] != MAGIC || word(8) != VERSION || fixed[28..] != input[..] {
            return Err(damaged("it is not the cell that its name says"));
        }
        if degree > 3 || report > MOST_REPORT || count > MOST_ROWS {
            return Err(damaged("it says what no cell can"));
        }
        let rest = report + (HASH * (COLUMNS + 1)) as u64;
        let start = FIXED + rest;
        if size != start + column_bytes(degree as u8, count) {
            return Err(damaged("it is not as long as it says"));
        }
        let rest = store.range(&name, FIXED, rest)?;
        let (before, content) = rest.split_at(rest.len() - HASH);
        let mut hasher = blake3::Hasher::new();
        hasher.update(&fixed).update(before);
        if hasher.finalize().as_bytes() != content {
            return Err(damaged("its checksum is wrong"));
        }
        let (report, hashes) = before.split_at(report as usize);
        let report = postcard::from_bytes(report).map_err(|_| damaged("its report cannot be decoded"))?;
        let hash = |at: usize| std::array::from_fn(|i| hashes[at * HASH + i]);
        let (columns, content) = (std::array::from_fn(hash), std::array::from_fn(|i| content[i]));
        Ok(Some(Self { count, sh_degree: degree as u8, report, columns, content, start }))
    }

    /// One of its columns.
    ///
    /// # Errors
    /// The store's; it is damaged.
    pub fn column(&self, store: &Store, input: &Hash, column: usize) -> Result<Vec<u8>, StoreError> {
        let floats = columns::floats(self.sh_degree);
        let bytes = |columns: &[usize]| 4 * self.count * columns.iter().sum::<usize>() as u64;
        let name = cell_name(input);
        let read = store.range(&name, self.start + bytes(&floats[..column]), bytes(&floats[column..=column]))?;
        match *blake3::hash(&read).as_bytes() == self.columns[column] {
            true => Ok(read),
            false => Err(StoreError::Damaged { name, what: "a column does not match its checksum" }),
        }
    }
}

/// Puts a cell where its input says, and gives its head.
///
/// # Errors
/// The store's.
pub fn write(store: &Store, input: &Hash, report: Report, cloud: &GaussianCloud) -> Result<Head, StoreError> {
    let name = cell_name(input);
    let failed = |_| StoreError::Damaged { name: name.clone(), what: "it cannot be encoded" };
    let encoded = postcard::to_allocvec(&report).map_err(failed)?;
    let mut before = MAGIC.to_vec();
    before.extend(VERSION.to_le_bytes());
    before.extend((encoded.len() as u32).to_le_bytes());
    before.extend((cloud.len() as u64).to_le_bytes());
    before.extend(u32::from(cloud.sh_degree).to_le_bytes());
    before.extend(input);
    before.extend(&encoded);
    let hashes = columns::of(cloud).map(|column| {
        let mut hasher = blake3::Hasher::new();
        // Into a hash: there is nothing that could fail.
        let _ = write_floats(&mut hasher, column);
        *hasher.finalize().as_bytes()
    });
    before.extend(hashes.as_flattened());
    let content = *blake3::hash(&before).as_bytes();
    before.extend(content);
    store.put(&name, &|mut out| {
        out.write_all(&before)?;
        columns::of(cloud).into_iter().try_for_each(|column| write_floats(&mut out, column))
    })?;
    let (count, sh_degree, start) = (cloud.len() as u64, cloud.sh_degree, before.len() as u64);
    Ok(Head { count, sh_degree, report, columns: hashes, content, start })
}
