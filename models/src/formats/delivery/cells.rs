//! A cloud as cells of ground, each encoded on its own: what does not change keeps its words, whatever happens elsewhere. Each in two
//! layers: its Gaussians merged to a few of one colour each, which stand for them until they are there, and all of them.

use std::collections::BTreeMap;

use super::coder::{Encoder, Garbled};
use super::{Given, LEAST_BYTES, Rounding, Scope, code, encode_rows};
use crate::camera::View;
use crate::cloud::{GaussianCloud, coarser};
use crate::ground_cell::{CellKey, Grid, MOST_LEVEL};

/// Gaussians that a cell of the finest level should hold about: fewer cost more for each, more come back as one.
const USUAL: f64 = 6000.0;
/// Fewer than so many belong to the next level's cell.
const LEAST: usize = 512;
/// A coarse layer has at most this share of its cell's Gaussians.
const COARSE_SHARE: f64 = 1.0 / 16.0;
/// Voxels along a cell's side with which that is tried first, how they grow, and how often.
const COARSE_VOXELS: f64 = 24.0;
const COARSER: f64 = 1.25;
const TRIES: i32 = 20;
/// Standard deviations up to which a Gaussian is said to reach.
const REACH: f32 = 3.0;
/// Outermost share of the means, on each side, that does not count to the ground when cells are sized.
const STRAY: usize = 20;
/// Binary logarithms of the sides that cells may have, metres.
const SIDES: (f64, f64) = (-10.0, 14.0);

/// Some Gaussians' words.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Layer {
    /// How many they are.
    pub count: u32,
    /// Their delivery encoding.
    pub words: Vec<u32>,
}

/// One cell's words.
#[derive(Clone, Debug, PartialEq)]
pub struct CodedCell {
    /// Which square of ground.
    pub key: CellKey,
    /// Square metres that its Gaussians cover, by opacity.
    pub importance: f32,
    /// They, merged, of SH degree 0; none where that is not worth its bytes.
    pub coarse: Layer,
    /// All of them.
    pub whole: Layer,
}

/// All cells of a cloud.
#[derive(Clone, Debug, PartialEq)]
pub struct CodedCells {
    /// The squares.
    pub grid: Grid,
    /// The most important first.
    pub cells: Vec<CodedCell>,
}

/// Encodes the cells of a cloud that `wanted` asks for, the most important first. Rows that are not valid are left out.
///
/// # Errors
/// None in practice: what is encoded is what was rounded.
pub fn encode_cells(
    cloud: &GaussianCloud,
    views: &[View],
    rounding: &Rounding,
    wanted: &dyn Fn(Grid, CellKey) -> bool,
) -> Result<CodedCells, Garbled> {
    let scope = Scope::of(cloud, rounding);
    let grid = grid_of(cloud, &scope.rows);
    let mut cells = Vec::new();
    for (key, rows) in split(grid, cloud, &scope.rows) {
        if !wanted(grid, key) {
            continue;
        }
        let whole = Layer::of(cloud, views, rounding, &scope, &rows)?;
        let coarse = match coarse(cloud, &rows, grid.side_at(key.level).into()) {
            Some(coarse) => {
                let scope = Scope::of(&coarse, rounding);
                Layer::of(&coarse, &[], rounding, &scope, &scope.rows)?
            }
            None => Layer::default(),
        };
        let importance = rows.iter().map(|i| cloud.covered_m2(*i as usize)).sum::<f64>() as f32;
        cells.push(CodedCell { key, importance, coarse, whole });
    }
    cells.sort_by(|a, b| b.importance.total_cmp(&a.importance).then(a.key.cmp(&b.key)));
    Ok(CodedCells { grid, cells })
}

impl Layer {
    pub(super) fn of(
        cloud: &GaussianCloud,
        views: &[View],
        rounding: &Rounding,
        scope: &Scope,
        rows: &[u32],
    ) -> Result<Self, Garbled> {
        let mut words = encode_rows(cloud, views, rounding, scope, rows)?;
        words.resize(words.len().max((rows.len() * LEAST_BYTES as usize).div_ceil(4)), 0);
        Ok(Self { count: rows.len() as u32, words })
    }
}

/// Rows of a cell of `side` metres merged in voxels, of SH degree 0; `None` where they do not become few.
fn coarse(cloud: &GaussianCloud, rows: &[u32], side: f64) -> Option<GaussianCloud> {
    let (mut own, stride) = (GaussianCloud::with_capacity(0, rows.len()), cloud.sh_stride());
    for i in rows.iter().map(|i| *i as usize) {
        let color = &cloud.sh[i * stride..][..3];
        own.push(cloud.means[i], cloud.log_scales[i], cloud.rotations[i], cloud.opacity_logits[i], color);
    }
    let most = (COARSE_SHARE * rows.len() as f64).ceil() as usize;
    let voxels = |n: i32| side / COARSE_VOXELS * COARSER.powi(n);
    (0..TRIES).map(|n| coarser(&own, voxels(n))).find(|merged| merged.len() <= most)
}

/// The cloud with places, sizes, rotations and opacities as its cells will have them, and colours as they are. Encoded with the same
/// steps, places, sizes and opacities come back as they are.
///
/// # Errors
/// None in practice, as [`encode_cells`].
pub fn round_shapes(cloud: &GaussianCloud, rounding: &Rounding) -> Result<GaussianCloud, Garbled> {
    let scope = Scope::of(cloud, rounding);
    let stride = cloud.sh_stride();
    let mut rounded = GaussianCloud::with_capacity(cloud.sh_degree, scope.rows.len());
    for (_, rows) in split(grid_of(cloud, &scope.rows), cloud, &scope.rows) {
        let given = Given::new(cloud, &[], *rounding, &scope, &rows);
        let (mut cell, rows) = code(&mut Encoder::new(), rows.len(), cloud.sh_degree, Some(&given))?;
        for (to, row) in cell.sh.chunks_exact_mut(stride).zip(rows) {
            to.copy_from_slice(&cloud.sh[row as usize * stride..][..stride]);
        }
        rounded.extend(&cell);
    }
    Ok(rounded)
}

/// Squares that hold about as many Gaussians as they should; a power of two, so that a scene that grows keeps them.
fn grid_of(cloud: &GaussianCloud, rows: &[u32]) -> Grid {
    let span = |axis: usize| {
        let mut along: Vec<f32> = rows.iter().map(|i| cloud.means[*i as usize][axis]).collect();
        along.sort_unstable_by(f32::total_cmp);
        let out = along.len() / STRAY;
        match (along.get(out), along.get(along.len().saturating_sub(1 + out))) {
            (Some(low), Some(high)) => f64::from(high - low),
            _ => 0.0,
        }
    };
    let side = (span(0) * span(1) * USUAL / rows.len().max(1) as f64).sqrt();
    Grid { side: side.log2().clamp(SIDES.0, SIDES.1).round().exp2() as f32 }
}

/// Rows by cell, in their order within it. Cells of few are part of the next level's.
fn split(grid: Grid, cloud: &GaussianCloud, rows: &[u32]) -> BTreeMap<CellKey, Vec<u32>> {
    let mut cells: BTreeMap<CellKey, Vec<u32>> = BTreeMap::new();
    for row in rows {
        let widest = cloud.log_scales[*row as usize].into_iter().fold(f32::NEG_INFINITY, f32::max);
        let key = grid.key(cloud.means[*row as usize], REACH * widest.min(80.0).exp());
        cells.entry(key).or_default().push(*row);
    }
    for level in 0..=MOST_LEVEL {
        let few: Vec<CellKey> =
            cells.iter().filter(|(k, r)| k.level == level && r.len() < LEAST).map(|(k, _)| *k).collect();
        let last = CellKey { level: MOST_LEVEL, y: 0, x: 0 };
        for key in few {
            let rows = cells.remove(&key).unwrap_or_default();
            let coarser = if level == MOST_LEVEL { last } else { key.parent() };
            cells.entry(coarser).or_default().extend(rows);
        }
    }
    cells.values_mut().for_each(|rows| rows.sort_unstable());
    cells
}

#[cfg(test)]
mod tests;
