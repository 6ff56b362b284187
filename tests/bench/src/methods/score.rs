//! How good a method's model is: all held-out pictures, those of each region, and those that show a border.

use engine::evaluate::{Scores, ViewScore};
use glam::DVec2;
use ground::region::Region;
use models::camera::View;
use serde::{Deserialize, Serialize};
use survey::dataset::Dataset;

use super::territory::Territory;

/// A picture whose middle shows ground no farther from another region shows a seam, metres (as `dgtr aggregate --compare` has it).
const NEAR_M: f64 = 10.0;

/// Means over some held-out pictures.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Means {
    /// How many.
    pub views: usize,
    /// dB.
    pub psnr: f64,
    /// dB, after gain and offset of each channel were fitted.
    pub psnr_colors_fitted: f64,
    /// −1…1.
    pub ssim: f64,
    /// The user's metric, when there is one.
    pub perceptual: Option<f64>,
}

impl Means {
    /// `None` without a picture.
    fn of<'a>(views: impl Iterator<Item = &'a ViewScore>) -> Option<Self> {
        let views: Vec<&ViewScore> = views.collect();
        let n = views.len() as f64;
        let mean = |f: fn(&ViewScore) -> f64| views.iter().map(|v| f(v)).sum::<f64>() / n;
        let distances: Vec<f64> = views.iter().filter_map(|v| v.perceptual).collect();
        (!views.is_empty()).then(|| Self {
            views: views.len(),
            psnr: mean(|v| v.psnr),
            psnr_colors_fitted: mean(|v| v.psnr_colors_fitted),
            ssim: mean(|v| v.ssim),
            perceptual: (distances.len() == views.len()).then(|| distances.iter().sum::<f64>() / n),
        })
    }
}

/// A model's figures.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Quality {
    /// All held-out pictures.
    pub all: Option<Means>,
    /// Those taken in each region, in the order of the regions.
    pub regions: Vec<Option<Means>>,
    /// Those that show a seam.
    pub near_seams: Option<Means>,
    /// Name of the user's metric.
    pub metric: Option<String>,
}

impl Quality {
    /// Of the figures of `frames`, in their order.
    pub fn of(scores: &Scores, set: &Dataset, frames: &[usize], territories: &[Territory], ground_m: f64) -> Self {
        let regions: Vec<Region> = territories.iter().map(Territory::region).collect();
        let pairs = || scores.views.iter().zip(frames);
        let near = |i: &usize| is_near_seam(&set.frames[*i].view, &regions, ground_m);
        let of_region =
            |t: &Territory| Means::of(pairs().filter(|(_, i)| t.held_out.contains(i)).map(|(view, _)| view));
        Self {
            all: Means::of(scores.views.iter()),
            regions: territories.iter().map(of_region).collect(),
            near_seams: Means::of(pairs().filter(|(_, i)| near(i)).map(|(view, _)| view)),
            metric: scores.perceptual.as_ref().map(|p| p.name.clone()),
        }
    }
}

/// Whether the middle of a picture shows ground in or beside two regions.
fn is_near_seam(view: &View, regions: &[Region], ground_m: f64) -> bool {
    let at = looked_at(view, ground_m);
    regions.iter().filter(|r| r.distance(at) <= NEAR_M).count() > 1
}

/// Where the optical axis meets the ground; below the camera where it does not.
fn looked_at(view: &View, ground_m: f64) -> DVec2 {
    let (center, forward) = (view.pose.center, view.pose.forward());
    let reach = (ground_m - center.z) / forward.z;
    let reach = if reach.is_finite() && reach > 0.0 { reach } else { 0.0 };
    (center + forward * reach).truncate()
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};
    use models::camera::{Intrinsics, Pose};

    use super::*;

    fn view(x: f64, tilt: f64) -> View {
        let intrinsics = Intrinsics { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 32.0, cy: 24.0 };
        // Straight down, then turned towards the east.
        let rotation = DQuat::from_rotation_y(-tilt) * DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0);
        View { intrinsics, pose: Pose { rotation, center: DVec3::new(x, 50.0, 42.0) } }
    }

    #[test]
    fn a_seam_is_shown_where_the_middle_of_a_picture_looks_not_where_it_was_taken() {
        let territory = |x: f64| Territory {
            name: String::new(),
            low: DVec2::new(x, 0.0),
            high: DVec2::new(x + 100.0, 100.0),
            own: Vec::new(),
            held_out: Vec::new(),
        };
        let regions = [territory(0.0).region(), territory(100.0).region()];
        let near = |x: f64, tilt: f64| is_near_seam(&view(x, tilt), &regions, 2.0);
        assert_eq!([near(85.0, 0.0), near(95.0, 0.0), near(109.0, 0.0), near(111.0, 0.0)], [false, true, true, false]);
        // 40 m above the ground, 45° to the east: 40 m farther.
        let east = std::f64::consts::FRAC_PI_4;
        assert!((looked_at(&view(60.0, east), 2.0).x - 100.0).abs() < 1e-6);
        assert_eq!([near(60.0, east), near(95.0, east), near(5.0, 0.0)], [true, false, false]);
        assert_eq!(looked_at(&view(60.0, std::f64::consts::PI), 2.0), DVec2::new(60.0, 50.0), "it looks up");
    }

    #[test]
    fn means_are_of_the_pictures_that_count_and_of_none_there_is_none() {
        let score = |psnr, perceptual| ViewScore {
            name: String::new(),
            psnr,
            psnr_colors_fitted: psnr + 1.0,
            ssim: psnr / 100.0,
            perceptual,
        };
        let views = [score(20.0, Some(0.5)), score(30.0, Some(0.1))];
        let means = Means::of(views.iter()).expect("two");
        assert_eq!((means.views, means.psnr, means.psnr_colors_fitted, means.ssim), (2, 25.0, 26.0, 0.25));
        assert!(means.perceptual.is_some_and(|p| (p - 0.3).abs() < 1e-12));
        assert_eq!(Means::of([].into_iter()), None);
        assert_eq!(Means::of([score(20.0, None)].iter()).expect("one").perceptual, None);
    }
}
