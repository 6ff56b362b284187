//! Why pictures give nothing to begin with: what is wrong with them, tested, in place of what initialisation missed.

use engine::error::EngineError;
use image::RgbImage;
use models::camera::{Pinhole, View};
use models::init::InitError;
use survey::dataset::Dataset;

use crate::error::JobError;

/// Pictures sampled.
const SAMPLED: usize = 12;
/// Side at which they are compared, pixels.
const SIDE: f64 = 64.0;
/// Brightest value of a black picture.
const BLACK: u8 = 12;
/// Mean difference of two copies of one picture.
const SAME: f64 = 1.0;
/// Views whose overlap is asked.
const MOST_VIEWS: usize = 60;
/// Distances at which two views may see the same, in distances between them.
const DEPTHS: [f64; 9] = [0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 64.0, 256.0];

/// `error`, or where its cause is found, that.
pub(super) fn of(error: EngineError, set: &Dataset, frames: &[usize]) -> JobError {
    let EngineError::Init(InitError::NoRange { .. } | InitError::NoDepth { .. } | InitError::NoPoints { .. }) = error
    else {
        return error.into();
    };
    match why(set, frames) {
        Some(why) => JobError::Request(format!("{}: {why}", set.root.display())),
        None => error.into(),
    }
}

fn why(set: &Dataset, frames: &[usize]) -> Option<String> {
    let n = frames.len();
    let views: Vec<View> = frames.iter().map(|&i| set.frames[i].view).collect();
    let first = views.first()?.pose.center;
    let spread = views.iter().map(|v| v.pose.center.distance(first)).fold(0.0, f64::max);
    if n < 2 {
        return Some("one picture shows no depth; take at least two from different places".to_owned());
    }
    if spread <= 1e-9 * (1.0 + first.length()) {
        return Some(format!(
            "all {n} pictures are taken from one place, by their poses; a scene needs pictures from several"
        ));
    }
    let pictures = sampled(set, frames);
    if pictures.len() > 1 {
        let is_black = |p: &RgbImage| p.iter().all(|v| *v < BLACK);
        let black = pictures.iter().filter(|p| is_black(p)).count();
        if black == pictures.len() {
            return Some(format!("its pictures are black ({black} of {black} sampled); expose them longer"));
        }
        let differs = |a: &RgbImage, b: &RgbImage| {
            let sum: f64 = a.iter().zip(b.iter()).map(|(a, b)| f64::from(a.abs_diff(*b))).sum();
            a.dimensions() != b.dimensions() || sum > SAME * a.as_raw().len().max(1) as f64
        };
        if pictures[1..].iter().all(|p| !differs(&pictures[0], p)) {
            return Some("its pictures are all the same; give the pictures that the poses were made of".to_owned());
        }
    }
    if !overlap(&views) {
        return Some(
            "no two pictures show the same, by their poses: are these right (axes, units), and do the pictures overlap?"
                .to_owned(),
        );
    }
    (n < 3).then(|| "two pictures share too little to tell depth by; take more, with more overlap".to_owned())
}

/// Some of the pictures, small; those that cannot be decoded are not among them.
fn sampled(set: &Dataset, frames: &[usize]) -> Vec<RgbImage> {
    let every = frames.len().div_ceil(SAMPLED).max(1);
    let small = |i: &usize| {
        let lens = &set.frames[*i].view.intrinsics;
        let scale = (SIDE / f64::from(lens.width.max(lens.height))).min(1.0);
        set.load(*i, scale).ok().map(|p| p.image)
    };
    frames.iter().step_by(every).filter_map(small).collect()
}

/// Whether any two views have something before both.
fn overlap(views: &[View]) -> bool {
    let every = views.len().div_ceil(MOST_VIEWS).max(1);
    let cameras: Vec<(Pinhole, &View)> = views.iter().step_by(every).map(|v| (Pinhole::from(v), v)).collect();
    let sees =
        |camera: &(Pinhole, &View), at| camera.0.project(at).is_some_and(|pixel| camera.1.intrinsics.contains(pixel));
    cameras.iter().enumerate().any(|(i, a)| {
        cameras[i + 1..].iter().any(|b| {
            let apart = a.1.pose.center.distance(b.1.pose.center);
            DEPTHS.iter().any(|depth| {
                let before = |v: &View| v.pose.center + v.pose.forward() * (depth * apart);
                apart > 0.0 && (sees(b, before(a.1)) || sees(a, before(b.1)))
            })
        })
    })
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use std::path::Path;

    use glam::{DQuat, DVec3};
    use image::Rgb;
    use models::camera::Pose;
    use models::formats::transforms::pose_to_opengl;

    use super::*;

    /// Pictures that look straight down from `places`, each painted by `pixel`.
    fn set(root: &Path, places: &[DVec3], pixel: impl Fn(usize, u32, u32) -> u8) -> Dataset {
        let mut frames = Vec::new();
        for (i, center) in places.iter().enumerate() {
            RgbImage::from_fn(40, 30, |x, y| Rgb([pixel(i, x, y); 3])).save(root.join(format!("{i}.png"))).unwrap();
            let m = pose_to_opengl(&Pose { rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), center: *center });
            frames.push(format!(r#"{{"file_path":"{i}.png","transform_matrix":{m:?}}}"#));
        }
        let text = format!(r#"{{"camera_angle_x":0.7,"frames":[{}]}}"#, frames.join(","));
        std::fs::write(root.join("transforms.json"), text).unwrap();
        Dataset::open(root).unwrap()
    }

    fn said(places: &[DVec3], pixel: impl Fn(usize, u32, u32) -> u8) -> String {
        let dir = tempfile::tempdir().unwrap();
        let set = set(dir.path(), places, pixel);
        let frames: Vec<usize> = (0..places.len()).collect();
        let line = of(InitError::NoRange { points: 0 }.into(), &set, &frames).to_string();
        assert!(!line.contains('\n'), "{line}");
        line
    }

    #[test]
    fn each_reason_why_there_is_nothing_to_begin_with_has_its_own_line() {
        let row: Vec<DVec3> = (0..6).map(|i| DVec3::new(f64::from(i) * 2.0, 0.0, 40.0)).collect();
        let noise = |i: usize, x: u32, y: u32| (i as u32 * 71 + x * 37 + y * 91) as u8;
        assert!(said(&row[..1], noise).contains("one picture"));
        assert!(said(&[row[0]; 5], noise).contains("from one place"));
        assert!(said(&row, |_, _, _| 3).contains("black"));
        assert!(said(&row, |_, x, y| (x * 37 + y * 91) as u8).contains("all the same"));
        assert!(said(&row[..2], noise).contains("two pictures"));
        // Nothing of this: initialisation's own words.
        assert!(said(&row, noise).contains("triangulated"));
        let far: Vec<DVec3> = (0..4).map(|i| DVec3::new(f64::from(i) * 500.0, 0.0, 1.0 + f64::from(i))).collect();
        assert!(said(&far, noise).contains("triangulated"), "from high enough they overlap");
    }

    #[test]
    fn views_back_to_back_do_not_overlap() {
        let view = |yaw: f64, x: f64| View {
            intrinsics: models::camera::Intrinsics { width: 40, height: 30, fx: 60.0, fy: 60.0, cx: 20.0, cy: 15.0 },
            pose: Pose { rotation: DQuat::from_rotation_y(yaw), center: DVec3::new(x, 0.0, 0.0) },
        };
        assert!(!overlap(&[view(-1.57, 0.0), view(1.57, 10.0)]), "each looks away from the other");
        assert!(overlap(&[view(1.57, 0.0), view(-1.57, 10.0)]));
    }
}
