//! Which pictures show a place, and how well their rays meet there.
//!
//! A picture shows the nearest surface along its rays, not all that lies in its frustum. Ground that one picture shows gets a depth that
//! nothing tests; a point at that depth lies in other pictures' frusta, behind what they show. Small depth maps of the views tell.

use std::collections::BTreeMap;

use glam::{DMat3, DVec2, DVec3};
use models::camera::View;

use super::extent::ViewsAround;

/// Longest side of a depth map, samples; less where a block has many views.
const LONGEST: f64 = 160.0;
/// A picture shows what lies within this share of the depth that it sees, in front or behind.
const NEAR: f32 = 0.02;
/// Samples of a block's views, at most, and of those that earlier blocks needed: these give way, the oldest first.
const KEPT: usize = 1 << 20;

/// Depth maps of views, those that were needed last.
#[derive(Clone, Debug, Default)]
pub struct DepthMaps {
    maps: BTreeMap<usize, DepthMap>,
    /// Counts what was asked, so that the oldest is known.
    now: u64,
}

#[derive(Clone, Debug)]
struct DepthMap {
    size: [u32; 2],
    /// NaN where there is no surface.
    depths: Vec<f32>,
    used: u64,
}

/// How a place is seen.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Vantage {
    /// Pictures that show it, less those that look through it at what lies behind.
    pub views: usize,
    /// Standard deviations along an axis of the plane and in height, metres, that one pixel's noise in every picture gives the place.
    /// None: fewer than two pictures show it, or all from one side.
    pub per_pixel: Option<[f64; 2]>,
    /// How far the mean of the rays goes aside for each metre that it rises.
    pub slope: f64,
}

impl DepthMaps {
    /// The views around a place whose depth maps are to be rendered first, as small as is enough.
    pub fn lacking(&mut self, around: &ViewsAround<'_>) -> Vec<(usize, View)> {
        self.now += 1;
        let most = KEPT as f64 / around.views().max(1) as f64;
        let (mut lacking, mut coming) = (Vec::new(), 0);
        for (i, view) in around.each() {
            if let Some(map) = self.maps.get_mut(&i) {
                map.used = self.now;
                continue;
            }
            let k = view.intrinsics;
            let [width, height] = [k.width, k.height].map(f64::from);
            let share = (LONGEST / width.max(height)).min((most / (width * height)).sqrt()).min(1.0);
            let small = k.resized(((width * share) as u32).max(1), ((height * share) as u32).max(1));
            coming += small.pixels();
            lacking.push((i, View { intrinsics: small, ..*view }));
        }
        while self.samples() + coming > KEPT {
            let oldest = self.maps.iter().filter(|(_, map)| map.used < self.now).min_by_key(|(_, map)| map.used);
            let Some(oldest) = oldest.map(|(i, _)| *i) else { break };
            self.maps.remove(&oldest);
        }
        lacking
    }

    fn samples(&self) -> usize {
        self.maps.values().map(|map| map.depths.len()).sum()
    }

    /// Takes a view's depth map: columns and rows, and depths along the optical axis row by row, NaN where there is no surface.
    pub fn insert(&mut self, view: usize, size: [u32; 2], depths: Vec<f32>) {
        debug_assert_eq!(depths.len(), size[0] as usize * size[1] as usize);
        self.maps.insert(view, DepthMap { size, depths, used: self.now });
    }

    /// How the pictures around it see a world point. One without a depth map shows all that lies in its frustum.
    pub fn vantage(&self, around: &ViewsAround<'_>, point: DVec3) -> Vantage {
        let (mut information, mut slope, mut views, mut against) = (DMat3::ZERO, DVec2::ZERO, 0, 0);
        for (i, view, [x, y, depth]) in around.showing(point) {
            match self.maps.get(&i).map_or(Said::Shown, |map| map.says(view, [x, y], depth)) {
                Said::Shown => views += 1,
                Said::Hidden => continue,
                Said::LookedThrough => {
                    against += 1;
                    continue;
                }
            }
            let ray = (point - view.pose.center).normalize();
            // A pixel is z/f metres across the ray.
            let weight = (f64::from(view.intrinsics.fx) / f64::from(depth)).powi(2);
            let along = DMat3::from_cols(ray * ray.x, ray * ray.y, ray * ray.z);
            information += weight * (DMat3::IDENTITY - along);
            slope += ray.truncate() / ray.z.abs().max(1e-6);
        }
        let covariance = (views >= 2).then(|| information.inverse()).filter(DMat3::is_finite);
        let variances = covariance.map(|c| [0.5 * (c.x_axis.x + c.y_axis.y), c.z_axis.z]);
        Vantage {
            views: usize::saturating_sub(views, against),
            per_pixel: variances.filter(|v| v.iter().all(|v| *v >= 0.0)).map(|v| v.map(f64::sqrt)),
            slope: slope.length() / views.max(1) as f64,
        }
    }
}

/// What a picture says of a point in its frustum.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Said {
    Shown,
    /// Something is in front of it, or the picture shows nothing there.
    Hidden,
    /// The picture shows what lies behind it.
    LookedThrough,
}

impl DepthMap {
    /// What the view says of a point at this depth, by the samples around it: at an edge a third of them lie on either side.
    fn says(&self, view: &View, at: [f32; 2], depth: f32) -> Said {
        let k = &view.intrinsics;
        let near = |p: f32, whole: u32, side: u32| {
            let sample = (p / whole as f32 * side as f32) as u32;
            sample.saturating_sub(1)..(sample + 2).min(side)
        };
        let (xs, ys) = (near(at[0], k.width, self.size[0]), near(at[1], k.height, self.size[1]));
        let around = ys.flat_map(|y| xs.clone().map(move |x| self.depths[(y * self.size[0] + x) as usize]));
        let [mut before, mut here, mut behind] = [0; 3];
        for sample in around.filter(|sample| sample.is_finite()) {
            let count = match (sample < depth * (1.0 - NEAR), sample > depth * (1.0 + NEAR)) {
                (true, _) => &mut before,
                (_, true) => &mut behind,
                _ => &mut here,
            };
            *count += 1;
        }
        match 3 * here >= (before + here + behind).max(1) {
            true => Said::Shown,
            false if behind > before => Said::LookedThrough,
            false => Said::Hidden,
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a test fails by panicking")]
mod tests {
    use super::*;
    use crate::ortho::extent::Extent;
    use glam::DQuat;
    use models::camera::{Intrinsics, Pose};
    use models::cloud::GaussianCloud;

    const HEIGHT_M: f64 = 50.0;

    /// Looks straight down from above a place, east to the right.
    fn nadir(east: f64) -> View {
        let rotation = DQuat::from_mat3(&DMat3::from_cols(DVec3::X, -DVec3::Y, -DVec3::Z));
        let intrinsics = Intrinsics { width: 640, height: 480, fx: 480.0, fy: 480.0, cx: 320.0, cy: 240.0 };
        View { intrinsics, pose: Pose { rotation, center: DVec3::new(east, 0.0, HEIGHT_M) } }
    }

    fn level_ground(views: &[View]) -> Extent {
        let places = (0..60).flat_map(|i| (0..60).map(move |j| [i as f32 - 30.0, j as f32 - 30.0, 0.0]));
        let mut cloud = GaussianCloud { sh_degree: 0, ..Default::default() };
        cloud.means = places.collect();
        cloud.opacity_logits = vec![2.0; cloud.means.len()];
        Extent::of(&cloud, views, &[]).unwrap()
    }

    #[test]
    fn what_lies_behind_the_ground_that_others_show_is_seen_by_one_alone() {
        let extent = level_ground(&[nadir(-10.0), nadir(0.0), nadir(10.0)]);
        let around = extent.views_around(DVec2::ZERO, 5.0);
        let mut depths = DepthMaps::default();
        for (i, view) in depths.lacking(&around) {
            let k = view.intrinsics;
            assert_eq!([k.width, k.height], [160, 120]);
            // One of them looks into a hole that is none.
            let depth = if i == 1 { HEIGHT_M as f32 + 12.0 } else { HEIGHT_M as f32 };
            depths.insert(i, [k.width, k.height], vec![depth; 160 * 120]);
        }
        assert!(depths.lacking(&around).is_empty());
        let views = |z: f64| depths.vantage(&around, DVec3::new(0.0, 0.0, z)).views;
        // The one that looks into the hole looks through the ground, and speaks against it.
        assert_eq!([views(0.0), views(-12.0), views(5.0)], [1, 1, 0]);
        assert_eq!(DepthMaps::default().vantage(&around, DVec3::new(0.0, 0.0, -12.0)).views, 3, "frusta alone");
    }

    #[test]
    fn rays_that_meet_at_a_wide_angle_place_a_point_best() {
        let of = |baseline: f64| {
            let extent = level_ground(&[nadir(-0.5 * baseline), nadir(0.5 * baseline)]);
            let around = extent.views_around(DVec2::ZERO, 5.0);
            DepthMaps::default().vantage(&around, DVec3::ZERO)
        };
        let (narrow, wide) = (of(5.0), of(20.0));
        let pixel = HEIGHT_M / 480.0;
        // Two rays: σ_z = σ·z/b·√2 for small angles, with σ a pixel on the ground.
        let expected = pixel * HEIGHT_M / 5.0 * 2f64.sqrt();
        let [_, height] = narrow.per_pixel.unwrap();
        assert!((height / expected - 1.0).abs() < 0.02, "{height} for {expected}");
        assert!(wide.per_pixel.unwrap()[1] < 0.3 * height);
        assert!(narrow.slope < 1e-9 && wide.views == 2);
        let one = level_ground(&[nadir(7.0)]);
        let alone = DepthMaps::default().vantage(&one.views_around(DVec2::ZERO, 5.0), DVec3::ZERO);
        assert_eq!((alone.views, alone.per_pixel), (1, None));
        assert!((alone.slope - 0.14).abs() < 1e-3, "{}", alone.slope);
    }

    #[test]
    fn depth_maps_of_long_ago_give_way() {
        let views: Vec<View> = (0..400).map(|i| nadir(50.0 * f64::from(i))).collect();
        let extent = level_ground(&views);
        let mut depths = DepthMaps::default();
        for i in 0..400 {
            fill(&mut depths, &extent.views_around(DVec2::new(50.0 * f64::from(i), 0.0), 5.0));
            assert!(depths.samples() <= KEPT, "{}", depths.samples());
        }
        assert!(depths.maps.len() < 60 && depths.maps.contains_key(&399));
    }

    #[test]
    fn thousands_of_views_of_one_block_have_small_depth_maps() {
        let views: Vec<View> = (0..4096).map(|i| nadir(0.01 * f64::from(i))).collect();
        let extent = level_ground(&views);
        let around = extent.views_around(DVec2::ZERO, 500.0);
        let mut depths = DepthMaps::default();
        fill(&mut depths, &around);
        assert_eq!(depths.maps.len(), 4096);
        assert!((KEPT / 2..=KEPT).contains(&depths.samples()), "{}", depths.samples());
    }

    fn fill(depths: &mut DepthMaps, around: &ViewsAround<'_>) {
        for (view, small) in depths.lacking(around) {
            let k = small.intrinsics;
            depths.insert(view, [k.width, k.height], vec![1.0; k.pixels()]);
        }
    }
}
