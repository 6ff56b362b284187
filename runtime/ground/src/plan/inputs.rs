//! All that one cell depends on, and its hash.

use std::collections::{BTreeMap, BTreeSet};

use glam::DVec2;
use models::ground_cell::CellKey;
use serde::Serialize;

use super::{Cell, Hash, Piece, Placed, Plan, Recipe, VERSION};
use crate::region::{Region, nearest};
use crate::squares::{SURROUNDINGS, Squares, is_beside};
use crate::store::StoreError;

/// Parts along a square that are asked for owners.
const PARTS: u32 = 16;

/// All that one cell depends on.
#[derive(Clone, Debug)]
pub struct Inputs {
    /// Its square.
    pub key: CellKey,
    /// All squares.
    pub squares: Squares,
    /// Side of the cells in which holes are looked for, metres.
    pub coverage_m: f64,
    /// Ground so near to another aircraft's region is of whoever saw it best, metres.
    pub border_m: f64,
    /// SH degree of the global model.
    pub sh_degree: u8,
    /// Gaussians that it may have.
    pub most: Option<u64>,
    /// How seams are distilled.
    pub recipe: Recipe,
    /// The models with Gaussians in the square or the eight around it, in the order of the plan.
    pub models: Vec<Read>,
    /// The regions that may own ground in the square and its surroundings, with the index of the model among `models` when it is
    /// there; in the order of the plan.
    pub regions: Vec<(Option<u16>, Region)>,
    /// Who owns everything where no model has a region.
    pub owner_of_all: Option<u16>,
}

/// What is read of one model.
#[derive(Clone, Debug)]
pub struct Read {
    /// Index in the plan.
    pub index: usize,
    /// SH degree of the pieces.
    pub sh_degree: u8,
    /// The object.
    pub object: Hash,
    /// Bytes of its header, which comes first, and their BLAKE3.
    pub head: (u64, Hash),
    /// Those in the square and the eight around it.
    pub pieces: Vec<Piece>,
}

/// Of a model: SH degree, header, and per piece square, Gaussians and content.
type HashedModel = (u8, Hash, Vec<(CellKey, u32, Hash)>);

/// What is hashed: nothing that says where in the plan or in an object something is, so that other models may come and go.
#[derive(Serialize)]
struct Hashed<'a> {
    version: u32,
    key: CellKey,
    squares: Squares,
    coverage_m: f64,
    border_m: f64,
    sh_degree: u8,
    most: Option<u64>,
    recipe: &'a Recipe,
    models: Vec<HashedModel>,
    regions: &'a [(Option<u16>, Region)],
    owner_of_all: Option<u16>,
}

impl Plan {
    /// What one of its cells depends on.
    pub fn inputs(&self, cell: &Cell) -> Inputs {
        let key = cell.key;
        let read = |(index, m): (usize, &Placed)| {
            let pieces: Vec<Piece> = m.pieces.iter().filter(|p| is_beside(p.key, key)).cloned().collect();
            let (sh_degree, object, head) = (m.sh_degree, m.object, m.head);
            (!pieces.is_empty()).then_some(Read { index, sh_degree, object, head, pieces })
        };
        let models: Vec<Read> = self.models.iter().enumerate().filter_map(read).collect();
        let local = |index: usize| models.binary_search_by_key(&index, |m| m.index).ok().map(|i| i as u16);
        let reach_m = self.squares.side_m() + 2.0 * SURROUNDINGS as f64 * f64::from(self.squares.seam_m);
        let regions = || self.models.iter().enumerate().filter_map(|(i, m)| Some((i, m.region.as_ref()?)));
        let near = owners(&regions().collect::<Vec<_>>(), self.squares.middle(key), reach_m, self.border_m);
        let regions = near.into_iter().filter_map(|i| Some((local(i), self.models[i].region.clone()?))).collect();
        let mut recipe = Recipe { seconds: cell.seconds, ..self.recipe.clone() };
        if models.len() < 2 {
            // Nobody to meet.
            recipe.epochs = 0;
        }
        Inputs {
            key,
            squares: self.squares,
            coverage_m: self.coverage_m,
            border_m: self.border_m,
            sh_degree: self.sh_degree,
            most: cell.most,
            recipe,
            owner_of_all: local(0),
            regions,
            models,
        }
    }
}

/// Regions among `regions` that may own a point of the square of this side around `middle`, in their order: examined more closely than a
/// square of ground as a whole, so that whoever joins changes few.
fn owners(regions: &[(usize, &Region)], middle: DVec2, side: f64, border_m: f64) -> BTreeSet<usize> {
    let all: BTreeMap<usize, &Region> = regions.iter().copied().collect();
    let near = nearest(all.iter().map(|(i, r)| (*i, *r)), middle, side, border_m);
    let part = side / f64::from(PARTS);
    let parts = (0..PARTS * PARTS).flat_map(|n| {
        let at = DVec2::new((n % PARTS).into(), (n / PARTS).into()) + 0.5 - 0.5 * f64::from(PARTS);
        nearest(near.iter().map(|i| (*i, all[i])), middle + at * part, part, border_m)
    });
    parts.collect()
}

impl Inputs {
    /// This cell merged and not distilled.
    pub fn merged_only(mut self) -> Self {
        (self.recipe.epochs, self.recipe.seconds) = (0, None);
        self
    }

    /// Of all of it.
    ///
    /// # Errors
    /// It cannot be encoded.
    pub fn hash(&self) -> Result<Hash, StoreError> {
        let of = |m: &Read| (m.sh_degree, m.head.1, m.pieces.iter().map(|p| (p.key, p.rows, p.hash)).collect());
        let hashed = Hashed {
            version: VERSION,
            key: self.key,
            squares: self.squares,
            coverage_m: self.coverage_m,
            border_m: self.border_m,
            sh_degree: self.sh_degree,
            most: self.most,
            recipe: &self.recipe,
            models: self.models.iter().map(of).collect(),
            regions: &self.regions,
            // Regions say it where there are any.
            owner_of_all: self.owner_of_all.filter(|_| self.regions.is_empty()),
        };
        let damaged = |_| StoreError::Damaged { name: self.key.to_string(), what: "its inputs cannot be encoded" };
        Ok(*blake3::hash(&postcard::to_allocvec(&hashed).map_err(damaged)?).as_bytes())
    }
}
