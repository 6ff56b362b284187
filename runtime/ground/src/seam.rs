//! Where regions meet: the cells of ground that are distilled, and which views see them. Away from seams the global model *is* the
//! local one, so there is nothing to distil there.

use std::collections::{BTreeSet, HashMap};

use models::camera::View;

use super::merge::Merged;
use super::squares::{HALO, REACH, Seam as Cell, seam};

/// Gaussians sampled per view; more would not change a share in the percents.
const SAMPLE: usize = 20_000;

/// The seams of a merged scene.
pub struct Seams {
    side_m: f32,
    /// Cells in which Gaussians of two aircraft meet, or that lie within [`REACH`] of one of another aircraft, from south to north and
    /// from west to east.
    pub cells: Vec<Cell>,
    index: HashMap<Cell, u16>,
    /// The sampled Gaussians, each with whether it lies in a seam.
    points: Vec<(glam::Vec3, bool)>,
    /// Share of all Gaussians that lie in a seam.
    pub share: f64,
}

impl Seams {
    /// Those cells of side `seam_m` that `is_inside` holds for, as many as can be numbered.
    pub fn find(merged: &Merged, seam_m: f32, is_inside: &dyn Fn(Cell) -> bool) -> Self {
        let place = |mean: &[f32; 3]| seam(mean, seam_m);
        // Source of the cell, or None once two are in it.
        let mut sources: HashMap<Cell, Option<u16>> = HashMap::new();
        for (mean, &source) in merged.cloud.means.iter().zip(&merged.source) {
            let entry = sources.entry(place(mean)).or_insert(Some(source));
            if *entry != Some(source) {
                *entry = None;
            }
        }
        let meets = |c: &Cell, source: &Option<u16>| {
            source.is_none() || around(*c, REACH).any(|c| sources.get(&c).is_some_and(|other| other != source))
        };
        let inside = sources.iter().filter(|(c, s)| is_inside(**c) && meets(c, s));
        let mut cells: Vec<Cell> = inside.map(|(c, _)| *c).collect();
        cells.sort_unstable_by_key(|c| (c.1, c.0));
        let mut this = Self { side_m: seam_m, cells, index: HashMap::new(), points: Vec::new(), share: 0.0 };
        this.keep(usize::from(u16::MAX));
        let stride = merged.cloud.len().div_ceil(SAMPLE).max(1);
        let sampled = merged.cloud.means.iter().step_by(stride);
        this.points = sampled.map(|m| (glam::Vec3::from(*m), this.index_of(m).is_some())).collect();
        this.share = this.points.iter().filter(|p| p.1).count() as f64 / this.points.len().max(1) as f64;
        this
    }

    /// Gives up all cells but the first `count`.
    pub fn keep(&mut self, count: usize) {
        self.cells.truncate(count);
        self.index = self.cells.iter().zip(0..).map(|(c, i)| (*c, i)).collect();
    }

    /// Which of the cells a place lies in.
    pub fn index_of(&self, place: &[f32; 3]) -> Option<u16> {
        self.index.get(&seam(place, self.side_m)).copied()
    }

    /// Rows of the Gaussians in the cells and around them.
    pub fn with_halo(&self, merged: &Merged) -> Vec<u32> {
        let near: BTreeSet<Cell> = self.cells.iter().flat_map(|c| around(*c, HALO)).collect();
        let rows = merged.cloud.means.iter().zip(0..);
        rows.filter(|(mean, _)| near.contains(&seam(mean, self.side_m))).map(|(_, row)| row).collect()
    }

    /// The part of this view's picture, in whole pixels, that shows Gaussians in seams: left, top, right and bottom; None when
    /// there is none.
    pub fn window(&self, view: &View) -> Option<[u32; 4]> {
        let k = &view.intrinsics;
        let (mut low, mut high) = (glam::Vec2::INFINITY, glam::Vec2::NEG_INFINITY);
        for (at, in_seam) in self.in_picture(view) {
            if in_seam {
                (low, high) = (low.min(at), high.max(at));
            }
        }
        if low.cmpgt(high).any() {
            return None;
        }
        let end = |v: f32, side: u32| (v as u32 + 1).min(side);
        Some([low.x as u32, low.y as u32, end(high.x, k.width), end(high.y, k.height)])
    }

    /// Share of the Gaussians in front of this view, and inside its picture, that lie in a seam.
    pub fn seen_by(&self, view: &View) -> f64 {
        let (mut seen, mut seam) = (0usize, 0usize);
        for (_, in_seam) in self.in_picture(view) {
            seen += 1;
            seam += usize::from(in_seam);
        }
        seam as f64 / seen.max(1) as f64
    }

    /// Where the sampled Gaussians that lie inside the picture lie in it.
    fn in_picture(&self, view: &View) -> impl Iterator<Item = (glam::Vec2, bool)> {
        let (rotation, translation) = view.pose.world_to_camera();
        let k = view.intrinsics;
        self.points.iter().filter_map(move |(p, in_seam)| {
            let c = rotation * *p + translation;
            let at = glam::Vec2::new(k.fx * c.x / c.z + k.cx, k.fy * c.y / c.z + k.cy);
            let inside =
                c.z > 0.0 && at.cmpge(glam::Vec2::ZERO).all() && at.x < k.width as f32 && at.y < k.height as f32;
            inside.then_some((at, *in_seam))
        })
    }
}

fn around((x, y): Cell, reach: i64) -> impl Iterator<Item = Cell> {
    (-reach..=reach).flat_map(move |v| (-reach..=reach).map(move |u| (x.saturating_add(u), y.saturating_add(v))))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{carpet, model, nadir, united};

    #[test]
    fn only_views_over_the_border_see_the_seam() {
        let west = [[-100.0, -50.0], [0.0, -50.0], [0.0, 50.0], [-100.0, 50.0]];
        let east = [[0.0, -50.0], [100.0, -50.0], [100.0, 50.0], [0.0, 50.0]];
        let all = carpet([-100.0, -50.0], [100.0, 50.0], 1.0);
        let models = [model("west", &west, all.clone()), model("east", &east, all)];
        let merged = united(&models, usize::MAX);
        let seams = Seams::find(&merged, 4.0, &|_| true);
        // Six cells of 4 m on both sides of the border, 100 m long.
        assert!(seams.share > 0.2 && seams.share < 0.28, "{}", seams.share);
        assert_eq!(seams.seen_by(&nadir(-60.0, 0.0, 30.0)), 0.0);
        assert!(seams.seen_by(&nadir(-30.0, 0.0, 30.0)) > 0.1);
        assert!(seams.cells.len() == 12 * 25 || seams.cells.len() == 12 * 26, "{}", seams.cells.len());
        assert!(seams.cells.iter().all(|c| (-REACH..REACH).contains(&c.0)));
        assert_eq!(seams.window(&nadir(-60.0, 0.0, 30.0)), None);
        // From 30 m above 64 pixels are 39 m: the seam's last 13 m are 22 of them.
        let [left, top, right, bottom] = seams.window(&nadir(-30.0, 0.0, 30.0)).expect("a window");
        assert!(right - left < 24 && left > 38 && top < 3 && bottom > 45, "{left} {top} {right} {bottom}");
        let near = seams.with_halo(&merged);
        assert!(near.iter().all(|row| merged.cloud.means[*row as usize][0].abs() < 32.0));
        assert_eq!(near.len(), 64 * 100);
    }

    #[test]
    fn one_model_has_no_seam() {
        let models = [model("a", &[], carpet([0.0, 0.0], [20.0, 20.0], 1.0))];
        let merged = united(&models, usize::MAX);
        assert_eq!(Seams::find(&merged, 4.0, &|_| true).share, 0.0);
    }
}
