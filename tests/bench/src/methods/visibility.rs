//! Which pictures of others see a region: VastGaussian's airspace-aware visibility (Lin et al. 2024, 3.2). The region is the box over
//! its rectangle from the lowest to the highest of its points, so that what stands in the air above the ground counts where it hides or
//! shows ground; a picture belongs to the region when the box fills a quarter of it.

use glam::DVec3;
use models::camera::{Pinhole, View};
use survey::dataset::{Dataset, SparsePoint};

use super::territory::Territory;

/// Share of a picture that a region must fill (VastGaussian's T_h).
const LEAST_SHARE: f64 = 0.25;
/// Rays along and across a picture: its share to a third of a percent.
const RAYS: [u32; 2] = [32, 24];
/// Points of a region that are strays above or below it, as a share of all on each side.
const STRAY_SHARE: usize = 100;
/// Ground whose height nobody knows is taken to lie within so much of zero, metres.
const UNKNOWN_M: f64 = 1.0;

/// Share of a picture's rays that meet the box between two corners.
pub fn share(view: &View, low: DVec3, high: DVec3) -> f64 {
    let (camera, k) = (Pinhole::from(view), &view.intrinsics);
    let along = |i: u32, of: u32, side: u32| (i as f32 + 0.5) / of as f32 * side as f32;
    let mut met = 0u32;
    for y in 0..RAYS[1] {
        for x in 0..RAYS[0] {
            let ray = camera.world_ray([along(x, RAYS[0], k.width), along(y, RAYS[1], k.height)]);
            met += u32::from(meets(view.pose.center, ray, low, high));
        }
    }
    f64::from(met) / f64::from(RAYS[0] * RAYS[1])
}

/// Whether a ray meets a box before it ends: slab by slab.
fn meets(from: DVec3, ray: DVec3, low: DVec3, high: DVec3) -> bool {
    let (mut enters, mut leaves) = (0.0f64, f64::INFINITY);
    for axis in 0..3 {
        if ray[axis] == 0.0 {
            if from[axis] < low[axis] || from[axis] > high[axis] {
                return false;
            }
            continue;
        }
        let [a, b] = [low[axis], high[axis]].map(|side| (side - from[axis]) / ray[axis]);
        (enters, leaves) = (enters.max(a.min(b)), leaves.min(a.max(b)));
    }
    enters <= leaves
}

/// The box over a territory, as high as its points are.
fn airspace(territory: &Territory, points: &[SparsePoint]) -> [DVec3; 2] {
    let region = territory.region();
    let inside = |p: &&SparsePoint| region.contains(DVec3::from(p.position).truncate());
    let mut heights: Vec<f64> = points.iter().filter(inside).map(|p| p.position[2]).collect();
    if heights.is_empty() {
        heights = points.iter().map(|p| p.position[2]).collect();
    }
    heights.sort_by(f64::total_cmp);
    let stray = heights.len() / STRAY_SHARE;
    let lowest = heights.get(stray).copied().unwrap_or(-UNKNOWN_M);
    let highest = heights.get(heights.len().saturating_sub(1 + stray)).copied().unwrap_or(UNKNOWN_M);
    [territory.low.extend(lowest), territory.high.extend(highest)]
}

/// For each territory its own training pictures and those of others that see it, in order.
pub fn seen(set: &Dataset, territories: &[Territory], points: &[SparsePoint]) -> Vec<Vec<usize>> {
    let of = |territory: &Territory| {
        let [low, high] = airspace(territory, points);
        let sees = |i: &usize| share(&set.frames[*i].view, low, high) >= LEAST_SHARE;
        let mut all: Vec<usize> = territories
            .iter()
            .flat_map(|t| t.own.iter().copied())
            .filter(|i| territory.own.contains(i) || sees(i))
            .collect();
        all.sort_unstable();
        all
    };
    territories.iter().map(of).collect()
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec2};
    use models::camera::{Intrinsics, Pose};
    use survey::dataset::{DatasetFrame, Split};

    use super::*;

    /// 40 m above the ground, 40 m of it in the picture along both sides.
    fn nadir(x: f64, y: f64) -> View {
        let intrinsics = Intrinsics { width: 64, height: 64, fx: 64.0, fy: 64.0, cx: 32.0, cy: 32.0 };
        let pose = Pose { rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), center: DVec3::new(x, y, 40.0) };
        View { intrinsics, pose }
    }

    fn set(cameras: &[[f64; 2]]) -> Dataset {
        let frame = |(i, c): (usize, &[f64; 2])| DatasetFrame {
            name: format!("{i}.png"),
            path: format!("{i}.png").into(),
            view: nadir(c[0], c[1]),
            distortion: geometry::lens::Distortion::default(),
            orientation: models::picture::Orientation::default(),
            mask: None,
            values: None,
            prior: None,
            telemetry: None,
        };
        let frames = cameras.iter().enumerate().map(frame).collect();
        Dataset { root: "set".into(), frames, split: Split::default(), origin: None, local: None, card: None }
    }

    fn territory(name: &str, x: f64, own: Vec<usize>) -> Territory {
        let (low, high) = (DVec2::new(x, 0.0), DVec2::new(x + 100.0, 100.0));
        Territory { name: name.into(), low, high, own, held_out: Vec::new() }
    }

    #[test]
    fn a_flat_region_fills_the_share_of_a_picture_that_geometry_says() {
        let (low, high) = (DVec3::new(0.0, 0.0, 0.0), DVec3::new(100.0, 100.0, 0.0));
        for (x, wanted) in [(50.0, 1.0), (0.0, 0.5), (-10.0, 0.25), (-19.0, 0.025), (-30.0, 0.0)] {
            let share = share(&nadir(x, 50.0), low, high);
            assert!((share - wanted).abs() < 0.02, "{x}: {share}, not {wanted}");
        }
        // Above 20 m of airspace a camera 5 m inside sees less that is not the region's.
        let [flat, tall] = [0.0, 20.0].map(|top| share(&nadir(5.0, 50.0), low, high.with_z(top)));
        assert!((flat - 0.625).abs() < 0.02 && (tall - 0.75).abs() < 0.02, "{flat} {tall}");
        // Nothing behind a camera is seen.
        let mut up = nadir(50.0, 50.0);
        up.pose.rotation = DQuat::IDENTITY;
        assert_eq!(share(&up, low, high), 0.0);
    }

    #[test]
    fn a_region_gets_the_pictures_that_see_it_and_no_others() {
        // West: cameras 0 to 3; east: 4 to 7. A picture shows 20 m to each side.
        let cameras = [-90.0, -50.0, -12.0, -8.0, 8.0, 12.0, 50.0, 90.0].map(|x| [x, 50.0]);
        let territories = [territory("west", -100.0, vec![0, 1, 2, 3]), territory("east", 0.0, vec![4, 5, 6, 7])];
        let ground: Vec<SparsePoint> = (-100..100)
            .map(|x| SparsePoint { position: [x.into(), 50.0, 0.0], color: [0; 3], error_px: 0.0, frames: vec![] })
            .collect();
        // 12 m off a fifth of the picture shows the other side, 8 m off three tenths.
        assert_eq!(seen(&set(&cameras), &territories, &ground), [vec![0, 1, 2, 3, 4], vec![3, 4, 5, 6, 7]]);
        // Without points the ground is taken to be flat at zero.
        assert_eq!(seen(&set(&cameras), &territories, &[]), [vec![0, 1, 2, 3, 4], vec![3, 4, 5, 6, 7]]);
    }

    #[test]
    fn its_own_pictures_stay_even_where_they_look_elsewhere() {
        let territories = [territory("west", -100.0, vec![0]), territory("east", 0.0, vec![1])];
        assert_eq!(seen(&set(&[[50.0, 50.0], [60.0, 50.0]]), &territories, &[]), [vec![0], vec![0, 1]]);
    }
}
