//! Levels of detail: a scene of any size as something that viewers stream.
//!
//! Each level has one Gaussian for every voxel in which the one below has several, merged, never picked (`coarser`): a quarter of a surface's Gaussians, or less
//! of what lies in layers. Voxels double, at least, from level to level; a level stands for the one below where a voxel is as small as a
//! pixel. The scene is sorted into leaves of ground in a file (`scratch`), and each leaf is divided into levels on its own: memory does not grow with
//! the scene, only the index does, by some hundred bytes a leaf.

use std::path::Path;

use crate::cloud::{GaussianCloud, coarser};
use crate::formats::FormatError;
use crate::formats::model::Chunks;
use crate::formats::sog::streamed::Writer;
use leaves::{Counts, Ground};
pub use scratch::Rows;
use scratch::Scratch;

mod leaves;
mod scratch;

/// Side of a level's voxels, in those of the level below or in usual distances between neighbours: four to one on a surface.
const WIDER: f64 = 2.0;
/// A level has so many times fewer Gaussians than the one below.
const THINNED: f64 = 3.5;
/// Sides that are tried for it, and how they grow.
const MOST_TRIES: usize = 12;
const GROWTH: f64 = 1.25;
/// Leaves that they are tried with.
const SAMPLED_LEAVES: usize = 4;
/// Gaussians that the coarsest level may have about: what a viewer loads before anything else, half a megabyte.
const COARSEST: f64 = 50_000.0;
/// Levels at most, the finest among them.
const MAX_LEVELS: usize = 8;
/// Means that say how far a scene extends.
const SAMPLE: usize = 1 << 16;

/// What was written.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Report {
    /// Gaussians of each level, the finest first.
    pub counts: Vec<u64>,
    /// Sides of the voxels of each level above the finest, metres.
    pub voxels_m: Vec<f64>,
    /// Leaves of ground.
    pub leaves: usize,
    /// Left out: so far from everything else that they are strays of a training.
    pub strays: u64,
    /// Left out: not finite.
    pub non_finite: u64,
    /// What is to be added to the files' coordinates for the model's, metres.
    pub shift: [f32; 3],
    /// The coarsest level.
    pub coarsest: GaussianCloud,
}

/// Sides of the voxels of the levels above the finest, for a scene of `count` Gaussians so far apart on the ground: each the first
/// of growing sides with which `sample`, some of its leaves, is thinned enough. Where Gaussians lie above each other, in trees
/// and on walls, they are farther apart than on the ground.
fn voxels_m(count: u64, spacing_m: f64, mut sample: GaussianCloud) -> Vec<f64> {
    let sampled = count as f64 / sample.len().max(1) as f64;
    let mut sides = Vec::new();
    let mut side = spacing_m;
    while sides.is_empty() || (sampled * sample.len() as f64 > COARSEST && sides.len() < MAX_LEVELS - 1) {
        side *= WIDER;
        let enough = (sample.len() as f64 / THINNED).ceil() as usize;
        let mut level = coarser(&sample, side);
        for _ in 0..MOST_TRIES {
            if level.len() <= enough {
                break;
            }
            side *= GROWTH;
            level = coarser(&sample, side);
        }
        sides.push(side);
        sample = level;
    }
    sides
}

/// All levels of a cloud, the finest first.
pub fn of(cloud: GaussianCloud, voxels_m: &[f64]) -> Vec<GaussianCloud> {
    let mut levels = vec![cloud];
    for side in voxels_m {
        // From the level below: moments of moments are those of the whole, but for what was bounded.
        levels.push(coarser(&levels[levels.len() - 1], *side));
    }
    levels
}

/// Writes `model` as streamed SOG into `folder`, colours up to `sh_degree`. Rows wait in a file without a name in `folder`, as large as the model.
///
/// # Errors
/// As [`Chunks::open`], a model without Gaussians, the operating system's.
pub fn write(model: &Chunks, folder: &Path, sh_degree: u8) -> Result<Report, FormatError> {
    write_and_see(model, folder, sh_degree, &mut |_| Ok(()))
}

/// Writes the levels of a model; `see` is given the levels of each leaf as they are before they are packed, the finest first.
///
/// # Errors
/// As [`write()`]; those of `see`.
pub fn write_and_see(
    model: &Chunks,
    folder: &Path,
    sh_degree: u8,
    see: &mut dyn FnMut(&[GaussianCloud]) -> std::io::Result<()>,
) -> Result<Report, FormatError> {
    let scratch_failed = |e| FormatError::io(folder, "sorting Gaussians in a scratch file", e);
    std::fs::create_dir_all(folder).map_err(|e| FormatError::io(folder, "creating", e))?;
    let degree = sh_degree.min(model.sh_degree);

    let (mut sample, mut row) = (Vec::with_capacity(SAMPLE), 0);
    let every = model.count.div_ceil(SAMPLE).max(1);
    let non_finite = model.each(&mut |cloud| {
        sample.extend(cloud.means.iter().skip((every - row % every) % every).step_by(every));
        row += cloud.len();
        Ok::<(), FormatError>(())
    })?;
    let empty = || FormatError::invalid(folder, "no Gaussians to write; train the model first");
    let middle = GaussianCloud { means: std::mem::take(&mut sample), ..Default::default() };
    let shift = middle.middle().map(|v| v.round() + 0.0);
    let mut sample = middle.means;
    let mut counts = Counts::new(Ground::around(&mut sample).ok_or_else(empty)?);
    drop(sample);

    model.each(&mut |cloud| {
        cloud.means.iter().for_each(|m| counts.add(*m));
        Ok::<(), FormatError>(())
    })?;
    let (strays, spacing_m) = (counts.strays, counts.spacing_m());
    let leaves = counts.leaves();
    let mut scratch = Scratch::create(folder, degree, &leaves.counts).map_err(scratch_failed)?;
    model.each(&mut |cloud| {
        let mut lowered;
        let cloud = if degree == cloud.sh_degree {
            &*cloud
        } else {
            lowered = cloud.clone();
            lowered.lower_sh_degree(degree);
            &lowered
        };
        (0..cloud.len()).try_for_each(|i| match leaves.of(cloud.means[i]) {
            Some(leaf) => scratch.push(leaf, cloud, i).map_err(scratch_failed),
            None => Ok(()),
        })
    })?;
    let mut sorted = scratch.finish().map_err(scratch_failed)?;

    let mut some = GaussianCloud::with_capacity(degree, 0);
    for k in 0..SAMPLED_LEAVES {
        let leaf = (2 * k + 1) * leaves.counts.len() / (2 * SAMPLED_LEAVES);
        some.extend(&sorted.read(leaf).map_err(scratch_failed)?);
    }
    let voxels_m = voxels_m(leaves.counts.iter().map(|n| u64::from(*n)).sum(), spacing_m, some);
    let mut writer = Writer::create(folder, voxels_m.len() + 1, degree, shift)?;
    let mut coarsest = GaussianCloud::with_capacity(degree, 0);
    for leaf in 0..leaves.counts.len() {
        let levels = of(sorted.read(leaf).map_err(scratch_failed)?, &voxels_m);
        writer.leaf(&levels)?;
        see(&levels).map_err(|e| FormatError::io(folder, "keeping levels", e))?;
        levels.last().into_iter().for_each(|level| coarsest.extend(level));
    }
    let counts = writer.finish()?;
    Ok(Report { counts, voxels_m, leaves: leaves.counts.len(), strays, non_finite, shift, coarsest })
}
