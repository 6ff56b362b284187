//! Which pictures are looked at together: sliding-window and co-visible pairs, scored by overlap and baseline. Pairs
//! that cannot give depth are skipped before the network sees them, and counted.

use serde::Serialize;

use config::init::InitSettings;

use crate::camera::{Pinhole, View};

/// Baseline ÷ depth at which multi-view networks are best (MVSNet's view selection peaks at a triangulation
/// angle of 5–10°; aerial surveys at 75 % overlap fly 0.2–0.4).
const BEST_BASELINE: f64 = 0.25;
/// Width of the preference, in natural logarithm of the baseline.
const BASELINE_SPREAD: f64 = 0.8;

/// Pairs that were not used, by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct SkippedPairs {
    /// Neighbours in the window without a baseline: pure rotation, hovering, duplicates.
    pub no_baseline: usize,
    /// Baseline too wide for the depth.
    pub too_wide: usize,
    /// Optical axes too far apart.
    pub too_oblique: usize,
    /// Too little ground in common.
    pub no_overlap: usize,
}

/// What one picture sees of another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Relation {
    /// Usable, with a score in 0…1.
    Good(f64),
    /// Useless, with the reason's counter.
    Bad(Fault),
}

/// Why a pair is useless.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// Too short a baseline.
    NoBaseline,
    /// Too long a baseline.
    TooWide,
    /// Axes diverge.
    TooOblique,
    /// Nothing in common.
    NoOverlap,
}

impl SkippedPairs {
    /// Counts one.
    pub fn count(&mut self, fault: Fault) {
        match fault {
            Fault::NoBaseline => self.no_baseline += 1,
            Fault::TooWide => self.too_wide += 1,
            Fault::TooOblique => self.too_oblique += 1,
            Fault::NoOverlap => self.no_overlap += 1,
        }
    }

    /// These and those.
    pub fn plus(self, other: Self) -> Self {
        Self {
            no_baseline: self.no_baseline + other.no_baseline,
            too_wide: self.too_wide + other.too_wide,
            too_oblique: self.too_oblique + other.too_oblique,
            no_overlap: self.no_overlap + other.no_overlap,
        }
    }

    /// All of them.
    pub fn total(&self) -> usize {
        self.no_baseline + self.too_wide + self.too_oblique + self.no_overlap
    }
}

/// Judges `source` as a partner of `reference`, whose scene is about `depth` metres away.
pub fn relate(reference: &View, source: &View, depth: f64, settings: &InitSettings) -> Relation {
    let baseline = reference.pose.center.distance(source.pose.center) / depth;
    if baseline.is_nan() || baseline < f64::from(settings.baseline[0]) {
        return Relation::Bad(Fault::NoBaseline);
    }
    if baseline > f64::from(settings.baseline[1]) {
        return Relation::Bad(Fault::TooWide);
    }
    let cosine = reference.pose.forward().dot(source.pose.forward());
    if cosine < f64::from(settings.max_angle_deg).to_radians().cos() {
        return Relation::Bad(Fault::TooOblique);
    }
    let overlap = overlap(reference, source, depth);
    if overlap < f64::from(settings.min_overlap) {
        return Relation::Bad(Fault::NoOverlap);
    }
    let off = (baseline / BEST_BASELINE).ln() / BASELINE_SPREAD;
    Relation::Good(overlap * (-0.5 * off * off).exp())
}

/// Share of the reference picture, put at `depth`, that the source sees.
pub fn overlap(reference: &View, source: &View, depth: f64) -> f64 {
    const COLUMNS: usize = 8;
    const ROWS: usize = 6;
    let (k, s) = (&reference.intrinsics, &source.intrinsics);
    let (from, to) = (Pinhole::from(reference), Pinhole::from(source));
    let mut seen = 0;
    for j in 0..ROWS {
        for i in 0..COLUMNS {
            let u = (i as f32 + 0.5) / COLUMNS as f32 * k.width as f32;
            let v = (j as f32 + 0.5) / ROWS as f32 * k.height as f32;
            seen += usize::from(to.project(from.unproject([u, v], depth)).is_some_and(|q| s.contains(q)));
        }
    }
    seen as f64 / (COLUMNS * ROWS) as f64
}

/// The best partners of picture `i`, taken at `own`, among all `views`, best first: neighbours within the window and other
/// co-visible ones alike. Faults of window neighbours are counted in `skipped` (each pair once, from its first picture).
pub fn partners<'a>(
    (i, own): (usize, &View),
    views: impl IntoIterator<Item = &'a View>,
    depth: f64,
    settings: &InitSettings,
    skipped: &mut SkippedPairs,
) -> Vec<(usize, f64)> {
    let mut good: Vec<(usize, f64)> = Vec::new();
    let mut others: Vec<(usize, f64)> = Vec::new();
    for (j, other) in views.into_iter().enumerate().filter(|(j, _)| *j != i) {
        let in_window = i.abs_diff(j) <= settings.window;
        match relate(own, other, depth, settings) {
            Relation::Good(score) if in_window => good.push((j, score)),
            Relation::Good(score) => others.push((j, score)),
            Relation::Bad(fault) if in_window && j > i => skipped.count(fault),
            Relation::Bad(_) => {}
        }
    }
    let by_score = |a: &(usize, f64), b: &(usize, f64)| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0));
    others.sort_by(by_score);
    good.extend(others.into_iter().take(settings.covisible));
    good.sort_by(by_score);
    good
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Intrinsics, Pose};
    use glam::{DQuat, DVec3};

    fn nadir(x: f64) -> View {
        let intrinsics = Intrinsics { width: 640, height: 480, fx: 400.0, fy: 400.0, cx: 320.0, cy: 240.0 };
        let rotation = DQuat::from_rotation_x(std::f64::consts::PI);
        View { intrinsics, pose: Pose { rotation, center: DVec3::new(x, 0.0, 60.0) } }
    }

    #[test]
    fn pairs_without_baseline_or_overlap_are_skipped_and_counted() {
        let settings = InitSettings::default();
        // Hovering, hovering, a step, then far away.
        let views = [nadir(0.0), nadir(0.1), nadir(15.0), nadir(500.0)];
        let mut skipped = SkippedPairs::default();
        let found: Vec<Vec<usize>> = (0..4)
            .map(|i| partners((i, &views[i]), &views, 60.0, &settings, &mut skipped).iter().map(|p| p.0).collect())
            .collect();
        assert_eq!(found, vec![vec![2], vec![2], vec![0, 1], vec![]]);
        assert_eq!(skipped, SkippedPairs { no_baseline: 1, too_wide: 2, too_oblique: 0, no_overlap: 0 });
    }

    #[test]
    fn overlap_of_a_half_shifted_picture_is_a_half() {
        // 640 px / 400 px · 60 m = 96 m wide.
        assert!((overlap(&nadir(0.0), &nadir(48.0), 60.0) - 0.5).abs() < 1e-9);
        let mut up = nadir(0.0);
        up.pose.rotation = DQuat::IDENTITY;
        assert_eq!(overlap(&nadir(0.0), &up, 60.0), 0.0);
    }
}
