//! Surveyed points through the renderings: the pixel at which a point is marked in a picture, at the depth that the model shows there,
//! is a place on the ground, and so is the survey's. Their difference is what a measurement in the model is off by.

use std::collections::BTreeMap;

use geometry::geodesy::{EnuFrame, Geodetic};
use glam::DVec3;
use models::camera::{Pinhole, View};
use models::refine::ControlPoint;
use serde::Serialize;
use survey::card::control::{SurveyedPoint, UNKNOWN_HEIGHT_SIGMA_M};
use survey::dataset::{Dataset, scaled};
use survey::names::PictureNames;
use vulkan::trainer::{Rendering, Trainer};

use crate::error::EngineError;

/// Light that may be left behind the ground at a mark: with more, nothing is shown there.
const SOLID: f32 = 0.5;

/// How far a point lies from where it was surveyed.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PointOff {
    /// Its number among the points.
    #[serde(skip)]
    pub point: usize,
    /// Its name.
    pub name: String,
    /// Marks where the model shows something.
    pub marks: usize,
    /// The mean of where the model shows it less where it was surveyed, east and north, metres; none where it shows nothing.
    pub off_m: Option<[f64; 2]>,
    /// And up; none where its height was not surveyed, either.
    pub up_m: Option<f64>,
}

/// A mark in the rendering of its picture.
pub struct Mark<'a> {
    /// Number of its point.
    pub point: usize,
    /// The picture.
    pub picture: &'a str,
    /// Where it is marked, pixels of the rendering.
    pub pixel: [f32; 2],
    /// Where the survey has it, if its height is known and the picture shows that.
    pub surveyed: Option<[f32; 2]>,
    /// The rendering.
    pub shown: &'a Rendering,
}

/// How far marks in the renderings lie from where their points were surveyed.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct SurveyedScores {
    /// Points with a mark that the model shows.
    pub points: usize,
    /// Such marks.
    pub marks: usize,
    /// Marks where the model shows nothing.
    pub unseen: usize,
    /// Root mean square over the points of the mean horizontal distance of their marks, metres.
    pub horizontal_rmse_m: Option<f64>,
    /// Root mean square over the points of known heights of the mean height error of their marks, metres.
    pub vertical_rmse_m: Option<f64>,
    /// Mean of these points' height errors, positive where the model is too high, metres.
    pub vertical_bias_m: Option<f64>,
    /// The point that is farthest off, and its distance, metres.
    pub worst: Option<(String, f64)>,
    /// Every point, in their order.
    pub each: Vec<PointOff>,
}

/// The points in the frame about `origin`, with their marks in pictures loaded at `scale`.
pub fn marked(set: &Dataset, surveyed: &[SurveyedPoint], origin: Geodetic, scale: f64) -> Vec<ControlPoint> {
    let frame = EnuFrame::new(origin);
    let names: Vec<String> = set.frames.iter().map(|f| f.name.to_lowercase()).collect();
    let names = PictureNames::of(names.iter().map(String::as_str));
    let mark = |picture: &str, pixel: [f64; 2]| {
        let frame = &set.frames[names.find(picture)?];
        let lens = scaled(&frame.view.intrinsics, scale).ok()?;
        Some((frame.name.clone(), frame.loaded_pixel(pixel, (lens.width, lens.height))?))
    };
    let point = |p: &SurveyedPoint| ControlPoint {
        name: p.name.clone(),
        place: frame.to_enu(p.position),
        sigma_m: DVec3::new(p.sigma_m[0], p.sigma_m[0], p.sigma_m[1]),
        marks: p.marks.iter().filter_map(|(picture, pixel)| mark(picture, *pixel)).collect(),
    };
    surveyed.iter().map(point).collect()
}

/// Renders each picture that shows a point, as `view_of` it is loaded, and compares; `look` is shown every mark in it. `None` when
/// `cancelled` said so, which is asked before each picture.
///
/// # Errors
/// The device fails.
pub fn compare(
    trainer: &mut Trainer,
    points: &[ControlPoint],
    view_of: &dyn Fn(&str) -> Option<View>,
    cancelled: &dyn Fn() -> bool,
    look: &mut dyn FnMut(&Mark),
) -> Result<Option<SurveyedScores>, EngineError> {
    let mut pictures: BTreeMap<&str, Vec<(usize, [f32; 2])>> = BTreeMap::new();
    for (i, (picture, pixel)) in points.iter().enumerate().flat_map(|(i, p)| p.marks.iter().map(move |m| (i, m))) {
        pictures.entry(picture).or_default().push((i, *pixel));
    }
    let mut off: Vec<Vec<DVec3>> = vec![Vec::new(); points.len()];
    let (mut shown, mut unseen) = (Rendering::default(), 0);
    for (picture, marks) in pictures {
        let Some(view) = view_of(picture) else { continue };
        if cancelled() {
            return Ok(None);
        }
        trainer.render(&view, &mut shown)?;
        let camera = Pinhole::from(&view);
        for (i, pixel) in marks {
            let point = &points[i];
            let place = Some(point.place).filter(|_| has_height(point));
            let surveyed = place.and_then(|p| camera.project(p)).map(|at| at.as_vec2().to_array());
            look(&Mark { point: i, picture, pixel, surveyed, shown: &shown });
            match depth_at(&shown, pixel) {
                Some(depth) => off[i].push(camera.unproject(pixel, depth) - point.place),
                None => unseen += 1,
            }
        }
    }
    Ok(Some(SurveyedScores::of(points, &off, unseen)))
}

fn has_height(point: &ControlPoint) -> bool {
    point.sigma_m.z < UNKNOWN_HEIGHT_SIGMA_M
}

/// Depth of the surface that a rendering shows at a pixel.
fn depth_at(shown: &Rendering, [x, y]: [f32; 2]) -> Option<f64> {
    let inside = x >= 0.0 && y >= 0.0 && x < shown.width as f32 && y < shown.height as f32;
    let at = inside.then(|| y as usize * shown.width as usize + x as usize)?;
    let left = *shown.transmittance.get(at)?;
    let depth = f64::from(*shown.depth.get(at)?) / f64::from(1.0 - left);
    (left < SOLID && depth.is_finite() && depth > 0.0).then_some(depth)
}

impl SurveyedScores {
    fn of(points: &[ControlPoint], off: &[Vec<DVec3>], unseen: usize) -> Self {
        let of_all = |off: &[DVec3]| off.iter().sum::<DVec3>() / off.len() as f64;
        let each = points.iter().zip(off).enumerate().map(|(point, (p, off))| {
            let mean = (!off.is_empty()).then(|| of_all(off));
            let up_m = mean.filter(|_| has_height(p)).map(|m| m.z);
            let off_m = mean.map(|m| m.truncate().to_array());
            PointOff { point, name: p.name.clone(), marks: off.len(), off_m, up_m }
        });
        let each: Vec<PointOff> = each.collect();
        // A distance is the mean of the marks', so that errors of opposite marks do not cancel.
        let distance = |point: &PointOff, of: &dyn Fn(&DVec3) -> f64| {
            off[point.point].iter().map(of).sum::<f64>() / point.marks.max(1) as f64
        };
        let shown = || each.iter().filter(|e| e.marks > 0);
        let mean = |sum: f64, n: usize| (n > 0).then(|| sum / n as f64);
        let flat: f64 = shown().map(|e| distance(e, &|o| o.truncate().length()).powi(2)).sum();
        let heights: Vec<f64> = each.iter().filter_map(|e| e.up_m).collect();
        let worst = shown().map(|e| {
            let has_height = e.up_m.is_some();
            (e.name.clone(), distance(e, &|o| if has_height { o.length() } else { o.truncate().length() }))
        });
        Self {
            points: shown().count(),
            marks: shown().map(|e| e.marks).sum(),
            unseen,
            horizontal_rmse_m: mean(flat, shown().count()).map(f64::sqrt),
            vertical_rmse_m: mean(heights.iter().map(|h| h * h).sum(), heights.len()).map(f64::sqrt),
            vertical_bias_m: mean(heights.iter().sum(), heights.len()),
            worst: worst.max_by(|a, b| a.1.total_cmp(&b.1)),
            each,
        }
    }

    /// One line for a log; `what` the points are.
    pub fn announce(&self, what: &str) {
        let Some(horizontal) = self.horizontal_rmse_m else {
            return tracing::warn!("{what}: the model shows none of them");
        };
        let vertical = self.vertical_rmse_m.map_or_else(
            || ", their heights not known".to_owned(),
            |vertical| format!(" and {vertical:.3} m vertically"),
        );
        tracing::info!(
            "{what} through the renderings: {} points in {} marks, {horizontal:.3} m off horizontally{vertical} (rms){}",
            self.points,
            self.marks,
            self.worst.as_ref().map_or_else(String::new, |(name, m)| format!(", {name} {m:.3} m at most"))
        );
    }
}

#[cfg(test)]
mod tests {
    use vulkan::gpu::Gpu;

    use super::*;
    use crate::carpet::{carpet, nadir};
    use crate::device::renderer;

    fn point(name: &str, place: DVec3, marks: &[(&str, View)]) -> ControlPoint {
        let mark = |(picture, view): &(&str, View)| {
            let pixel = Pinhole::from(view).project(place).expect("in front");
            ((*picture).to_owned(), [pixel.x as f32, pixel.y as f32])
        };
        let marks = marks.iter().map(mark).collect();
        ControlPoint { name: name.into(), place, sigma_m: DVec3::splat(0.03), marks }
    }

    #[test]
    fn points_on_the_ground_of_a_model_are_found_where_they_were_surveyed_and_others_are_told() {
        if Gpu::list().is_err() {
            return needs::missing(needs::Need::Vulkan, "no Vulkan device (install mesa-vulkan-drivers)");
        }
        // Ground at a height of nothing, seen from 30 m above.
        let cloud = carpet([0.0, 0.0], [40.0, 40.0], 0.25);
        let views = [("a", nadir(18.0, 20.0, 30.0)), ("b", nadir(22.0, 20.0, 30.0))];
        let of = |name: &str| views.iter().find(|v| v.0 == name).map(|v| v.1);
        let size = (views[0].1.intrinsics.width, views[0].1.intrinsics.height);
        let mut trainer = renderer(None, &cloud, size.0, size.1).expect("a device");
        let good = [
            point("p1", DVec3::new(19.0, 21.0, 0.0), &views),
            point("p2", DVec3::new(21.0, 19.0, 0.0), &[views[0], ("missing", views[0].1)]),
        ];
        let mut marks = Vec::new();
        let mut look = |mark: &Mark| marks.push((mark.point, mark.picture.to_owned(), mark.surveyed, mark.pixel));
        let scores = compare(&mut trainer, &good, &of, &|| false, &mut look).expect("rendered").expect("all");
        assert_eq!(marks.iter().map(|m| (m.0, m.1.as_str())).collect::<Vec<_>>(), [(0, "a"), (1, "a"), (0, "b")]);
        assert!(marks.iter().all(|m| m.2 == Some(m.3)), "marked where they were surveyed: {marks:?}");
        let each: Vec<_> = scores.each.iter().map(|e| (e.point, e.name.as_str(), e.marks)).collect();
        assert_eq!(each, [(0, "p1", 2), (1, "p2", 1)]);
        let is_near =
            |e: &PointOff| e.off_m.is_some_and(|o| o[0].hypot(o[1]) < 0.1) && e.up_m.is_some_and(|u| u.abs() < 0.1);
        assert!(scores.each.iter().all(is_near), "{scores:?}");
        assert_eq!((scores.points, scores.marks, scores.unseen), (2, 3, 0), "{scores:?}");
        assert!(scores.horizontal_rmse_m.is_some_and(|m| m < 0.05), "{scores:?}");
        assert!(scores.vertical_rmse_m.is_some_and(|m| m < 0.1), "{scores:?}");
        // A stone of a metre that the model does not have: each picture sees the ground behind it, away from its own foot.
        let mut stone = point("stone", DVec3::new(20.0, 20.0, 1.0), &views);
        let scores = compare(&mut trainer, std::slice::from_ref(&stone), &of, &|| false, &mut |_| {})
            .expect("rendered")
            .expect("all");
        assert!(scores.vertical_bias_m.is_some_and(|m| (m + 1.0).abs() < 0.1) && scores.worst.is_some(), "{scores:?}");
        stone.marks = vec![("a".into(), [-3.0, 5.0]), ("b".into(), [f32::NAN, 5.0])];
        let scores = compare(&mut trainer, &[stone], &of, &|| false, &mut |_| {}).expect("rendered").expect("all");
        let each = vec![PointOff { point: 0, name: "stone".into(), marks: 0, off_m: None, up_m: None }];
        assert_eq!(scores, SurveyedScores { unseen: 2, each, ..Default::default() });
        // A height that nobody surveyed is none to compare with.
        let mut flat = good[0].clone();
        flat.sigma_m.z = UNKNOWN_HEIGHT_SIGMA_M;
        flat.place.z = 20.0;
        let scores = compare(&mut trainer, &[flat], &of, &|| false, &mut |m| assert_eq!(m.surveyed, None))
            .expect("rendered")
            .expect("all");
        assert_eq!((scores.vertical_rmse_m, scores.vertical_bias_m, scores.each[0].up_m), (None, None, None));
        assert!(compare(&mut trainer, &good, &of, &|| true, &mut |_| {}).expect("rendered").is_none(), "cancelled");
    }
}
