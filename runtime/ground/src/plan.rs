//! What is global about a merge, in one file: where each model lies and in what light, who answers for which ground, and the cells with
//! the hash of all that each depends on. Whoever has it and the models' pieces can make any cell, in any order, on any machine.

use config::ground::GroundSettings;
use config::keys::to_hex;
use geometry::geodesy::Geodetic;
use models::formats::model::MAX_HEADER;
use models::ground_cell::CellKey;
use serde::{Deserialize, Serialize};

use super::region::Region;
use super::squares::Squares;
use super::store::{Store, StoreError};

mod inputs;
#[cfg(test)]
mod tests;

pub use inputs::{Inputs, Read};

/// A BLAKE3.
pub type Hash = [u8; 32];

/// Name of the plan in a store.
pub const NAME: &str = "plan";
/// Begins the file.
const MAGIC: [u8; 8] = *b"dgtrplan";
/// Of this file and of all that a cell depends on; another one when cells are made in another way.
pub const VERSION: u32 = 2;
const HEAD: usize = MAGIC.len() + 4;
const HASH: usize = 32;
/// Longest plan taken: a thousand aircraft of 256 key frames have a tenth of it.
const MOST_BYTES: u64 = 256 << 20;
/// Cells of a plan, at most.
pub const MOST_CELLS: usize = 1 << 17;
/// Models of a plan, at most.
pub const MOST_MODELS: usize = u16::MAX as usize;

/// The plan of a merge.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Plan {
    /// Name of the mission.
    pub mission: String,
    /// Of the frame that all is in.
    pub origin: Option<Geodetic>,
    /// The jobs' squares.
    pub squares: Squares,
    /// Side of the cells in which holes are looked for, metres.
    pub coverage_m: f64,
    /// Ground so near to another aircraft's region is of whoever saw it best, metres.
    pub border_m: f64,
    /// SH degree of the global model.
    pub sh_degree: u8,
    /// Share of its Gaussians that every cell keeps, where the global model is bounded.
    pub share: Option<f64>,
    /// How seams are distilled.
    pub recipe: Recipe,
    /// In the order in which they were given.
    pub models: Vec<Placed>,
    /// In the order of the global model.
    pub cells: Vec<Cell>,
}

/// How seams are distilled: those settings of `[ground]` that a cell depends on, by their names.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Recipe {
    /// Passes over the views.
    pub epochs: u32,
    /// What a job may take; it is part of a job's own share only.
    pub seconds: Option<f64>,
    /// Size of the pictures.
    pub scale: f32,
    /// Share of what a view sees that must lie in a seam.
    pub seam_share: f32,
    /// Views half-way between views take part.
    pub between_views: bool,
    /// Learning rates, as a fraction of the trainer's.
    pub rate: f32,
    /// Gaussians at or below this opacity go.
    pub prune_opacity: f32,
    /// Of the order of views.
    pub seed: u64,
    /// Device memory, MiB: what does not fit is not distilled.
    pub device_mib: u32,
}

impl From<&GroundSettings> for Recipe {
    fn from(s: &GroundSettings) -> Self {
        Self {
            epochs: s.epochs,
            seconds: s.seconds,
            scale: s.scale,
            seam_share: s.seam_share,
            between_views: s.between_views,
            rate: s.rate,
            prune_opacity: s.prune_opacity,
            seed: s.seed,
            device_mib: s.device_mib,
        }
    }
}

/// A model where it goes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Placed {
    /// Of its aircraft.
    pub name: String,
    /// BLAKE3 of its file.
    pub content: Hash,
    /// What registration moved it by, beyond its own GPS: x y z w, scale, shift.
    pub correction: Option<[f64; 8]>,
    /// Log gain of its light over the common one.
    pub gain: [f32; 3],
    /// Gaussians of its file.
    pub gaussians: u64,
    /// Gaussians that lie so far from all others that they are in no piece.
    pub strays: u64,
    /// SH degree of the pieces.
    pub sh_degree: u8,
    /// Name of the object that holds its header and pieces.
    pub object: Hash,
    /// Bytes of the header, which comes first, and their BLAKE3.
    pub head: (u64, Hash),
    /// The ground it answers for.
    pub region: Option<Region>,
    /// Its Gaussians by square, in the common frame and light, in the order of keys.
    pub pieces: Vec<Piece>,
}

/// A model's Gaussians in one square.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Piece {
    /// The square.
    pub key: CellKey,
    /// Gaussians.
    pub rows: u32,
    /// Where in the object its columns begin.
    pub from: u64,
    /// BLAKE3 of the columns.
    pub hash: Hash,
}

/// One job.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Cell {
    /// Its square.
    pub key: CellKey,
    /// Gaussians that it may have, where the global model is bounded.
    pub most: Option<u64>,
    /// Seconds that it may be distilled for, where that is bounded.
    pub seconds: Option<f64>,
    /// Of all that it depends on: the name of what it comes to.
    pub input: Hash,
}

impl Cell {
    /// Name of what it comes to in a store.
    pub fn name(&self) -> String {
        cell_name(&self.input)
    }
}

/// Folder of the cells in a store.
pub const CELLS: &str = "cells";
/// Folder of the models' pieces.
pub const MODELS: &str = "models";

/// Name of the cell with this input.
pub fn cell_name(input: &Hash) -> String {
    format!("{CELLS}/{}", to_hex(input))
}

/// Name of a model's pieces.
pub fn model_name(object: &Hash) -> String {
    format!("{MODELS}/{}", to_hex(object))
}

impl Plan {
    /// The plan in a store; None: there is none.
    ///
    /// # Errors
    /// It cannot be read, is damaged or of another version.
    pub fn read(store: &Store) -> Result<Option<Self>, StoreError> {
        let Some(size) = store.size(NAME)? else { return Ok(None) };
        let damaged = |what| StoreError::Damaged { name: NAME.into(), what };
        if size > MOST_BYTES || size < (HEAD + HASH) as u64 {
            return Err(damaged("it is not as long as a plan is"));
        }
        let bytes = store.range(NAME, 0, size)?;
        Self::parse(&bytes).map(Some).map_err(damaged)
    }

    /// As [`Plan::read`], where there must be one.
    ///
    /// # Errors
    /// There is no plan, or it cannot be read.
    pub fn of(store: &Store) -> Result<Self, StoreError> {
        Self::read(store)?.ok_or_else(|| StoreError::Missing(NAME.into()))
    }

    fn parse(bytes: &[u8]) -> Result<Self, &'static str> {
        let (content, hash) = bytes.split_at_checked(bytes.len().saturating_sub(HASH)).ok_or("it ends too early")?;
        let (magic, rest) = content.split_at_checked(MAGIC.len()).ok_or("it ends too early")?;
        let (version, body) = rest.split_at_checked(4).ok_or("it ends too early")?;
        if magic != MAGIC {
            return Err("it is no plan");
        }
        if version != VERSION.to_le_bytes() {
            return Err("it is a plan of another version of dgtr");
        }
        if blake3::hash(content).as_bytes() != hash {
            return Err("its checksum is wrong");
        }
        let plan: Self = postcard::from_bytes(body).map_err(|_| "it cannot be decoded")?;
        if plan.is_usable() { Ok(plan) } else { Err("it holds what no plan can") }
    }

    /// The file.
    ///
    /// # Errors
    /// It would be longer than a plan may be.
    pub fn bytes(&self) -> Result<Vec<u8>, StoreError> {
        let mut bytes = [&MAGIC[..], &VERSION.to_le_bytes()].concat();
        let body = postcard::to_allocvec(self);
        bytes.extend(body.map_err(|_| StoreError::Damaged { name: NAME.into(), what: "it cannot be encoded" })?);
        bytes.extend(blake3::hash(&bytes).as_bytes());
        match bytes.len() as u64 > MOST_BYTES {
            true => Err(StoreError::Damaged { name: NAME.into(), what: "it is longer than a plan may be" }),
            false => Ok(bytes),
        }
    }

    fn is_usable(&self) -> bool {
        let model = |m: &Placed| {
            m.sh_degree <= self.sh_degree
                && m.head.0 <= MAX_HEADER
                && m.pieces.is_sorted_by(|a, b| a.key < b.key)
                && m.pieces.iter().all(|p| p.rows > 0 && p.from >= m.head.0)
                && m.region.as_ref().is_none_or(Region::is_usable)
        };
        let r = &self.recipe;
        self.squares.is_usable()
            && self.coverage_m.is_finite()
            && self.coverage_m > 0.0
            && self.border_m.is_finite()
            && self.border_m >= 0.0
            && self.sh_degree <= 3
            && r.scale > 0.0
            && r.scale <= 1.0
            && r.rate.is_finite()
            && (1..=MOST_MODELS).contains(&self.models.len())
            && self.models.iter().all(model)
            && self.cells.len() <= MOST_CELLS
            && self.cells.is_sorted_by(|a, b| a.key < b.key)
    }
}
