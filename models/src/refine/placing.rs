//! Where tracks are at the present poses: the sightings that agree, triangulated, and those that do not left out.

use super::Refiner;
use super::tracks::{Sighting, Tracks};
use super::triangulate::{Triangulated, triangulate};
use crate::camera::Pinhole;
use rayon::prelude::*;

/// Tracks that a core takes at once.
const LEAST_TRACKS: usize = 64;

/// A track at the present poses.
pub(super) struct Placed {
    /// Sightings it had.
    pub all: usize,
    /// Where it is, and the sightings that agree.
    pub found: Option<(Triangulated, Vec<Sighting>)>,
}

impl Refiner {
    /// Sightings of a track by key frames that have a place.
    pub(super) fn sightings(&self, tracks: &Tracks, track: u32) -> Vec<Sighting> {
        let placed = |s: &&Sighting| !self.frames[s.frame as usize].unplaced;
        tracks.get(track as usize).iter().filter(placed).copied().collect()
    }

    /// Every one of these tracks by the sightings that `keeps` keeps, triangulated to below `max_px` at the present poses; on all cores,
    /// in their order.
    pub(super) fn placed(
        &self,
        cameras: &[Pinhole],
        tracks: &Tracks,
        chosen: &[u32],
        max_px: f64,
        keeps: impl Fn(&Sighting) -> bool + Sync,
    ) -> Vec<Placed> {
        let place = |views: &mut Vec<_>, t: &u32| {
            let mut seen = self.sightings(tracks, *t);
            seen.retain(&keeps);
            let all = seen.len();
            Placed { all, found: self.robust_point(cameras, &mut seen, max_px, views).map(|point| (point, seen)) }
        };
        chosen.par_iter().with_min_len(LEAST_TRACKS).map_init(Vec::new, place).collect()
    }

    /// Triangulates a track; while it does not fit, the sighting furthest off is left out, down to two.
    pub(super) fn robust_point(
        &self,
        cameras: &[Pinhole],
        seen: &mut Vec<Sighting>,
        max_px: f64,
        views: &mut Vec<(Pinhole, [f32; 2])>,
    ) -> Option<Triangulated> {
        let min_angle = self.settings.min_angle_deg.to_radians();
        loop {
            views.clear();
            views.extend(seen.iter().map(|s| {
                let frame = s.frame as usize;
                (cameras[frame], self.frames[frame].keypoints()[s.feature as usize])
            }));
            let found = triangulate(views, min_angle)?;
            let error = |v: &(Pinhole, [f32; 2])| match v.0.project(found.world) {
                Some(q) => (q - glam::DVec2::new(v.1[0].into(), v.1[1].into())).length(),
                None => f64::INFINITY,
            };
            let worst = views.iter().map(error).enumerate().max_by(|a, b| a.1.total_cmp(&b.1))?;
            if worst.1 <= max_px {
                return Some(found);
            }
            // Two rays always nearly meet somewhere; a third must agree before one of three is dropped.
            if seen.len() <= 3 {
                return None;
            }
            seen.remove(worst.0);
        }
    }
}
