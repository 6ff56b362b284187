//! The sparse points of a reconstruction, with a bound on how many are held.

use std::collections::{HashMap, HashSet};

use glam::DVec3;

use super::sources::TRANSFORMS;
use super::{Dataset, DatasetError, picture_names};
use models::formats::transforms::{self, PointsOf};
use models::formats::{colmap, opensfm, ply};

/// Sparse points held at most (some 100 bytes each); initialisation needs far fewer.
const MAX_POINTS: usize = 2_000_000;

/// A triangulated point.
#[derive(Clone, Debug)]
pub struct SparsePoint {
    /// ENU metres.
    pub position: [f64; 3],
    /// 8-bit sRGB.
    pub color: [u8; 3],
    /// Mean reprojection error, pixels at full size.
    pub error_px: f64,
    /// Frames that saw it, sorted; empty when the file has no tracks.
    pub frames: Vec<u32>,
}

impl Dataset {
    /// The coloured sparse points of the reconstruction; none where it has no file of them.
    ///
    /// # Errors
    /// A file of the reconstruction is damaged.
    pub fn sparse_points(&self) -> Result<Vec<SparsePoint>, DatasetError> {
        self.points_where(&|_| true)
    }

    /// The points that at least two of `frames` saw: what a strict held-out test may start from. Points without
    /// tracks (some writers leave them out) are kept.
    ///
    /// # Errors
    /// As [`Dataset::sparse_points`].
    pub fn sparse_points_of(&self, frames: &[usize]) -> Result<Vec<SparsePoint>, DatasetError> {
        let chosen: HashSet<u32> = frames.iter().map(|&i| i as u32).collect();
        self.points_where(&|p| p.frames.is_empty() || p.frames.iter().filter(|f| chosen.contains(f)).count() >= 2)
    }

    /// Whatever the size of the file, at most [`MAX_POINTS`] points are held: every second is let go each time the room is
    /// full, so that what remains is an even sample.
    fn points_where(&self, wanted: &dyn Fn(&SparsePoint) -> bool) -> Result<Vec<SparsePoint>, DatasetError> {
        let (mut points, mut seen, mut every) = (Vec::new(), 0u64, 1u64);
        let mut take = |mut point: SparsePoint| {
            if let Some(local) = self.local {
                point.position = local.into_own(DVec3::from_array(point.position)).to_array();
            }
            if !wanted(&point) {
                return;
            }
            if seen.is_multiple_of(every) {
                if points.len() == MAX_POINTS {
                    let mut number = 0;
                    points.retain(|_| {
                        number += 1;
                        number % 2 == 1
                    });
                    every *= 2;
                }
                if seen.is_multiple_of(every) {
                    points.push(point);
                }
            }
            seen += 1;
        };
        let described = self.root.join(TRANSFORMS);
        let of = if described.is_file() { transforms::points_of(&described)? } else { PointsOf::default() };
        let own = of.ply.map(|path| self.root.join(path)).filter(|path| path.is_file());
        let place = |p: DVec3| of.applied.map_or(p, |(turn, shift)| turn * p + shift);
        if let Some(file) = own {
            ply::points(&file, &mut |position, color| {
                take(SparsePoint { position, color, error_px: 0.0, frames: Vec::new() });
            })?;
        } else if let Some(model) = colmap::Model::find(&self.root)? {
            let names = picture_names(self);
            let by_id: HashMap<u32, u32> =
                model.images()?.iter().filter_map(|m| Some((m.id, names.find(&m.name)? as u32))).collect();
            let dropped = model.points(&mut |p| {
                let mut frames: Vec<u32> = p.images.iter().filter_map(|id| by_id.get(id).copied()).collect();
                frames.sort_unstable();
                let position = place(p.position).to_array();
                take(SparsePoint { position, color: p.color, error_px: p.error, frames });
            })?;
            if dropped > 0 {
                let file = model.file("points3D");
                tracing::warn!("{}: {dropped} points are not at a finite position and were left out", file.display());
            }
        } else if let Some(file) = opensfm::find(&self.root) {
            opensfm::points(&file, &mut |position, color| {
                take(SparsePoint { position, color, error_px: 0.0, frames: Vec::new() });
            })?;
        }
        if every > 1 {
            tracing::warn!("{}: of {seen} sparse points every {every}th is kept", self.root.display());
        }
        Ok(points)
    }
}
