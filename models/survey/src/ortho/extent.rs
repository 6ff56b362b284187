//! What ground a map of a model covers, how high that ground is, from how high it may be looked at, and the views around it.

use geometry::median;
use glam::{DVec2, DVec3, Vec3};

use models::camera::{Pinhole, Projector, View};
use models::cloud::GaussianCloud;

/// Rays farther from the vertical than 60° are cut there: what they meet is too oblique to be mapped.
const STEEPEST: f64 = 1.732;
/// Cells of the coarse relief along each side.
const CELLS: usize = 64;
/// Of the height between the ground and the lowest camera over it, this share is looked at. What floats above is seen by no
/// camera well, and in the way of all.
const LOOKED_AT: f64 = 0.8;
/// Gaussians sampled, at most, evenly over the cloud: medians do not need more.
pub const SAMPLE: usize = 100_000;
/// Gaussians beyond these quantiles of their own coordinates do not stretch a map that has no views to go by.
const QUANTILE: f64 = 0.01;

/// The ground of a model and its cameras.
pub struct Extent {
    views: Vec<Footprint>,
    low: DVec2,
    high: DVec2,
    /// Median height by cell, model metres.
    relief: Vec<f32>,
    gsd: Option<f64>,
}

/// A view and the box around the ground that its picture shows.
struct Footprint {
    projector: Projector,
    view: View,
    low: DVec2,
    high: DVec2,
}

impl Extent {
    /// Of a cloud trained on `views`, inside of `region` (a polygon, model metres; empty: everywhere). `None` when no solid
    /// Gaussian is there.
    pub fn of(cloud: &GaussianCloud, views: &[View], region: &[[f64; 2]]) -> Option<Self> {
        let solid = |i: &usize| cloud.opacity_logits[*i] > 0.0 && Vec3::from(cloud.means[*i]).is_finite();
        let every = cloud.len().div_ceil(SAMPLE).max(1);
        let means: Vec<[f32; 3]> = (0..cloud.len()).step_by(every).filter(solid).map(|i| cloud.means[i]).collect();
        let mut heights: Vec<f64> = means.iter().map(|m| f64::from(m[2])).collect();
        let ground = median(&mut heights)?;
        let views: Vec<Footprint> =
            views.iter().filter(|v| v.is_usable()).filter_map(|v| Footprint::of(v, ground)).collect();
        let inside = |(low, high): (DVec2, DVec2), [a, b]: [DVec2; 2]| (low.min(a), high.max(b));
        let nothing = (DVec2::INFINITY, DVec2::NEG_INFINITY);
        let (mut low, mut high) = views.iter().map(|v| [v.low, v.high]).fold(nothing, inside);
        if views.is_empty() {
            let range = |k: usize| -> Option<(f64, f64)> {
                let mut all: Vec<f32> = means.iter().map(|m| m[k]).collect();
                all.sort_by(f32::total_cmp);
                let at = |share: f64| f64::from(all[((all.len() - 1) as f64 * share) as usize]);
                (!all.is_empty()).then(|| (at(QUANTILE), at(1.0 - QUANTILE)))
            };
            let ((x0, x1), (y0, y1)) = (range(0)?, range(1)?);
            (low, high) = (DVec2::new(x0, y0), DVec2::new(x1, y1));
        }
        let corners = region.iter().filter(|c| c[0].is_finite() && c[1].is_finite()).map(|c| DVec2::from(*c));
        let (first, last) = corners.map(|c| [c, c]).fold(nothing, inside);
        if first.x < last.x && first.y < last.y {
            (low, high) = (low.max(first), high.min(last));
        }
        if !(low.x < high.x && low.y < high.y) {
            return None;
        }
        let relief = relief(&means, low, high, ground as f32);
        let mut sizes: Vec<f64> = views.iter().map(|v| v.gsd(ground)).collect();
        let gsd = median(&mut sizes).map(two_digits);
        Some(Self { views, low, high, relief, gsd })
    }

    /// South-western and north-eastern corner, model metres.
    pub fn bounds(&self) -> [DVec2; 2] {
        [self.low, self.high]
    }

    /// What a pixel of the training pictures covers on the ground: the median, two digits, metres. `None` without views.
    pub fn gsd(&self) -> Option<f64> {
        self.gsd
    }

    /// Height of the ground at a place, model metres: a median over a cell of a 64th of the extent.
    pub fn ground(&self, place: DVec2) -> f64 {
        f64::from(self.relief[cell(place, self.low, self.high)])
    }

    /// Height, in model metres, of the plane that the ground at a place is looked at from.
    pub fn top(&self, place: DVec2) -> f64 {
        let ground = self.ground(place);
        let above = |v: &&Footprint| v.view.pose.center.z > ground;
        let away = |v: &Footprint| (v.view.pose.center.truncate() - place).length();
        let near = |v: &&Footprint| away(v) <= v.view.pose.center.z - ground;
        let over = self.views.iter().filter(above).filter(near).map(|v| v.view.pose.center.z).reduce(f64::min);
        let nearest = || self.views.iter().filter(above).min_by(|a, b| away(a).total_cmp(&away(b)));
        match over.or_else(|| nearest().map(|v| v.view.pose.center.z)) {
            Some(camera) => ground + LOOKED_AT * (camera - ground),
            // Nobody looked from anywhere: from above all that is there.
            None => f64::from(self.relief.iter().copied().fold(f32::NEG_INFINITY, f32::max)) + 100.0,
        }
    }

    /// Whether there are views to say who saw what.
    pub fn has_views(&self) -> bool {
        !self.views.is_empty()
    }

    /// The views whose ground overlaps a square of half side `reach` around a place.
    pub fn views_around(&self, place: DVec2, reach: f64) -> ViewsAround<'_> {
        let (low, high) = (place - reach, place + reach);
        let overlaps = |(_, v): &(usize, &Footprint)| v.low.cmple(high).all() && v.high.cmpge(low).all();
        ViewsAround(self.views.iter().enumerate().filter(overlaps).collect())
    }
}

/// Views around a place, each with its number among those of the extent.
pub struct ViewsAround<'a>(Vec<(usize, &'a Footprint)>);

impl ViewsAround<'_> {
    /// How many views there are.
    pub fn views(&self) -> usize {
        self.0.len()
    }

    /// Each of them.
    pub fn each(&self) -> impl Iterator<Item = (usize, &View)> {
        self.0.iter().map(|(i, footprint)| (*i, &footprint.view))
    }

    /// Those that have a world point in their frusta: the pixel where, and the depth.
    pub fn showing(&self, point: DVec3) -> impl Iterator<Item = (usize, &View, [f32; 3])> {
        let p = point.as_vec3();
        self.0.iter().filter_map(move |(i, footprint)| {
            let k = &footprint.view.intrinsics;
            let (x, y, depth) = footprint.projector.project(p)?;
            let is_inside = (0.0..k.width as f32).contains(&x) && (0.0..k.height as f32).contains(&y);
            is_inside.then_some((*i, &footprint.view, [x, y, depth]))
        })
    }
}

impl Footprint {
    /// The box around where the picture's edge meets the ground; `None` for a camera that looks up or stands below it.
    fn of(view: &View, ground: f64) -> Option<Self> {
        let (camera, k) = (Pinhole::from(view), &view.intrinsics);
        let height = view.pose.center.z - ground;
        if height <= 0.0 || camera.pose.forward().z > 0.0 {
            return None;
        }
        let at = |share: [f32; 2]| {
            let ray = camera.world_ray([share[0] * k.width as f32, share[1] * k.height as f32]);
            let aside = ray.truncate();
            let slope = aside.length() / -ray.z;
            let cut = if ray.z < 0.0 && slope < STEEPEST { slope } else { STEEPEST };
            view.pose.center.truncate() + aside.normalize_or_zero() * cut * height
        };
        let steps = [0.0, 0.5, 1.0];
        let edge = steps.iter().flat_map(|x| steps.map(|y| at([*x, y])));
        let (low, high) = edge
            .fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(low, high): (DVec2, DVec2), p| (low.min(p), high.max(p)));
        Some(Self { projector: Projector::new(view), view: *view, low, high })
    }

    fn gsd(&self, ground: f64) -> f64 {
        (self.view.pose.center.z - ground) / f64::from(self.view.intrinsics.fx)
    }
}

/// Median height of the Gaussians of each cell; empty cells take their nearest neighbour's in the row order, else `ground`.
fn relief(means: &[[f32; 3]], low: DVec2, high: DVec2, ground: f32) -> Vec<f32> {
    let inside = |m: &&[f32; 3]| {
        let p = DVec2::new(m[0].into(), m[1].into());
        p.cmpge(low).all() && p.cmple(high).all()
    };
    let mut of_cells: Vec<(usize, f32)> =
        means.iter().filter(inside).map(|m| (cell(DVec2::new(m[0].into(), m[1].into()), low, high), m[2])).collect();
    of_cells.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let mut relief = vec![f32::NAN; CELLS * CELLS];
    for group in of_cells.chunk_by(|a, b| a.0 == b.0) {
        relief[group[0].0] = group[group.len() / 2].1;
    }
    for row in relief.chunks_mut(CELLS) {
        for forward in [true, false] {
            let mut last = f32::NAN;
            for i in 0..CELLS {
                let height = &mut row[if forward { i } else { CELLS - 1 - i }];
                if height.is_nan() {
                    *height = last;
                }
                last = *height;
            }
        }
        row.iter_mut().filter(|h| h.is_nan()).for_each(|h| *h = ground);
    }
    relief
}

fn cell(place: DVec2, low: DVec2, high: DVec2) -> usize {
    let share = ((place - low) / (high - low) * CELLS as f64).clamp(DVec2::ZERO, DVec2::splat(CELLS as f64 - 1.0));
    share.y as usize * CELLS + share.x as usize
}

/// Rounded to two significant digits.
fn two_digits(v: f64) -> f64 {
    let unit = 10f64.powf(v.log10().floor() - 1.0);
    (v / unit).round() * unit
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, DQuat};
    use models::camera::{Intrinsics, Pose};

    /// Looks straight down from `at`, east to the right.
    fn nadir(at: DVec3) -> View {
        let rotation = DQuat::from_mat3(&DMat3::from_cols(DVec3::X, -DVec3::Y, -DVec3::Z));
        let intrinsics = Intrinsics { width: 640, height: 480, fx: 480.0, fy: 480.0, cx: 320.0, cy: 240.0 };
        View { intrinsics, pose: Pose { rotation, center: at } }
    }

    /// A plateau of 10 m with a hill of 50 m in the east.
    fn cloud() -> GaussianCloud {
        let places = (0..100).flat_map(|i| (0..100).map(move |j| (i as f32 - 50.0, j as f32 - 50.0)));
        let means = places.map(|(x, y)| [x, y, if x > 30.0 { 50.0 } else { 10.0 }]).collect::<Vec<_>>();
        let mut cloud = GaussianCloud { sh_degree: 0, ..Default::default() };
        cloud.opacity_logits = vec![2.0; means.len()];
        cloud.means = means;
        cloud
    }

    #[test]
    fn a_map_covers_what_the_pictures_cover_inside_of_the_region() {
        let views = [nadir(DVec3::new(0.0, 0.0, 58.0)), nadir(DVec3::new(20.0, 0.0, 58.0))];
        let all = Extent::of(&cloud(), &views, &[]).unwrap();
        assert!((all.gsd().unwrap() - 0.1).abs() < 1e-9);
        let [low, high] = all.bounds();
        assert!((low - DVec2::new(-32.0, -24.0)).length() < 1e-6 && (high - DVec2::new(52.0, 24.0)).length() < 1e-6);
        let region = [[-10.0, -40.0], [200.0, -40.0], [200.0, 7.0], [-10.0, 7.0]];
        let [low, high] = Extent::of(&cloud(), &views, &region).unwrap().bounds();
        assert!((low - DVec2::new(-10.0, -24.0)).length() < 1e-6 && (high - DVec2::new(52.0, 7.0)).length() < 1e-6);
        let elsewhere = region.map(|c| [c[0] + 1000.0, c[1]]);
        assert!(Extent::of(&cloud(), &views, &elsewhere).is_none());
    }

    #[test]
    fn a_hill_is_looked_at_from_below_its_own_cameras_not_from_below_the_valleys() {
        let views = [nadir(DVec3::new(-20.0, 0.0, 60.0)), nadir(DVec3::new(45.0, 0.0, 90.0))];
        let extent = Extent::of(&cloud(), &views, &[]).unwrap();
        assert_eq!(extent.ground(DVec2::new(-20.0, 0.0)), 10.0);
        assert_eq!(extent.ground(DVec2::new(45.0, 0.0)), 50.0);
        assert!((extent.top(DVec2::new(-20.0, 0.0)) - 50.0).abs() < 1e-6);
        assert!((extent.top(DVec2::new(45.0, 0.0)) - 82.0).abs() < 1e-6);
    }

    #[test]
    fn who_has_a_point_in_its_frustum_is_told() {
        let views = [nadir(DVec3::new(0.0, 0.0, 58.0)), nadir(DVec3::new(20.0, 0.0, 58.0))];
        let extent = Extent::of(&cloud(), &views, &[]).unwrap();
        let count = |x: f64| extent.views_around(DVec2::new(x, 0.0), 5.0).showing(DVec3::new(x, 0.0, 10.0)).count();
        assert_eq!([count(-30.0), count(5.0), count(50.0), count(80.0)], [1, 2, 1, 0]);
    }

    #[test]
    fn oblique_cameras_and_bad_ones_do_not_stretch_the_map() {
        let mut level = nadir(DVec3::new(0.0, 0.0, 60.0));
        level.pose.rotation = DQuat::from_mat3(&DMat3::from_cols(DVec3::X, -DVec3::Z, DVec3::Y));
        let below = nadir(DVec3::new(0.0, 0.0, -5.0));
        let mut broken = level;
        broken.pose.center.x = f64::NAN;
        let extent = Extent::of(&cloud(), &[level, below, broken], &[]).unwrap();
        let [low, high] = extent.bounds();
        assert!(low.is_finite() && high.is_finite() && (high - low).max_element() <= 2.0 * STEEPEST * 50.0);
    }

    #[test]
    fn without_views_the_gaussians_say_where_the_scene_is() {
        let extent = Extent::of(&cloud(), &[], &[]).unwrap();
        assert!(extent.gsd().is_none() && !extent.has_views());
        assert!(extent.top(DVec2::ZERO) > 50.0);
        assert!(Extent::of(&GaussianCloud::default(), &[], &[]).is_none());
    }
}
