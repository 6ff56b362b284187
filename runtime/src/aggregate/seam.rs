//! Which views see a seam. Away from seams the global model *is* the local one, so there is nothing to distil there:
//! only views that look at ground where two aircraft's Gaussians meet take part.

use std::collections::HashMap;

use models::camera::View;

use super::merge::Merged;

/// Gaussians looked at per view; more would not change a share in the percents.
const SAMPLE: usize = 20_000;

/// The sampled Gaussians, each with whether it lies in a seam.
pub struct Seams {
    points: Vec<(glam::Vec3, bool)>,
    /// Share of all Gaussians that lie in a seam.
    pub share: f64,
}

impl Seams {
    /// A Gaussian lies in a seam when one of another aircraft is in the same or a touching cell of side `seam_m`.
    pub fn find(merged: &Merged, seam_m: f32) -> Self {
        let cell = |m: &[f32; 3]| ((m[0] / seam_m).floor() as i64, (m[1] / seam_m).floor() as i64);
        // Source of the cell, or None once two are in it.
        let mut cells: HashMap<(i64, i64), Option<u16>> = HashMap::new();
        for (mean, &source) in merged.cloud.means.iter().zip(&merged.source) {
            let entry = cells.entry(cell(mean)).or_insert(Some(source));
            if *entry != Some(source) {
                *entry = None;
            }
        }
        let in_seam = |mean: &[f32; 3], source: u16| {
            let (x, y) = cell(mean);
            (-1..=1).any(|v| (-1..=1).any(|u| cells.get(&(x + u, y + v)).is_some_and(|s| *s != Some(source))))
        };
        let stride = merged.cloud.len().div_ceil(SAMPLE).max(1);
        let sampled = merged.cloud.means.iter().zip(&merged.source).step_by(stride);
        let points: Vec<_> = sampled.map(|(m, &s)| (glam::Vec3::from(*m), in_seam(m, s))).collect();
        let share = points.iter().filter(|p| p.1).count() as f64 / points.len().max(1) as f64;
        Self { points, share }
    }

    /// Share of the Gaussians in front of this view, and inside its picture, that lie in a seam.
    pub fn seen_by(&self, view: &View) -> f64 {
        let (rotation, translation) = view.pose.world_to_camera();
        let k = &view.intrinsics;
        let (mut seen, mut seam) = (0usize, 0usize);
        for (p, in_seam) in &self.points {
            let c = rotation * *p + translation;
            if c.z <= 0.0 {
                continue;
            }
            let (u, v) = (k.fx * c.x / c.z + k.cx, k.fy * c.y / c.z + k.cy);
            if u >= 0.0 && v >= 0.0 && u < k.width as f32 && v < k.height as f32 {
                seen += 1;
                seam += usize::from(*in_seam);
            }
        }
        seam as f64 / seen.max(1) as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::aggregate::testing::{carpet, model, nadir, united};

    #[test]
    fn only_views_over_the_border_see_the_seam() {
        let west = [[-100.0, -50.0], [0.0, -50.0], [0.0, 50.0], [-100.0, 50.0]];
        let east = [[0.0, -50.0], [100.0, -50.0], [100.0, 50.0], [0.0, 50.0]];
        let all = carpet([-100.0, -50.0], [100.0, 50.0], 1.0);
        let models = [model("west", &west, all.clone()), model("east", &east, all)];
        let merged = united(&models, usize::MAX);
        let seams = Seams::find(&merged, 4.0);
        assert!(seams.share > 0.03 && seams.share < 0.1, "{}", seams.share);
        assert_eq!(seams.seen_by(&nadir(-60.0, 0.0, 30.0)), 0.0);
        assert!(seams.seen_by(&nadir(1.0, 0.0, 30.0)) > 0.1);
    }

    #[test]
    fn one_model_has_no_seam() {
        let models = [model("a", &[], carpet([0.0, 0.0], [20.0, 20.0], 1.0))];
        let merged = united(&models, usize::MAX);
        assert_eq!(Seams::find(&merged, 4.0).share, 0.0);
    }
}
