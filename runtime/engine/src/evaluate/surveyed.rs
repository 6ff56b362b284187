//! Surveyed points through the renderings: the pixel at which a point is marked in a picture, at the depth that the model shows there,
//! is a place on the ground, and so is the survey's. Their difference is what a measurement in the model is off by.

use geometry::geodesy::EnuFrame;
use glam::DVec3;
use models::camera::{Pinhole, View};
use models::refine::ControlPoint;
use serde::Serialize;
use survey::card::control::SurveyedPoint;
use survey::dataset::{Dataset, scaled};
use survey::names::PictureNames;
use vulkan::trainer::{Rendering, Trainer};

use crate::error::EngineError;

/// Light that may be left behind the ground at a mark: with more, nothing is shown there.
const SOLID: f32 = 0.5;

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
    pub horizontal_rmse_m: f64,
    /// Root mean square over the points of the mean height error of their marks, metres.
    pub vertical_rmse_m: f64,
    /// Mean of the heights' errors, positive where the model is too high, metres.
    pub vertical_bias_m: f64,
    /// The point that is farthest off, and its distance, metres.
    pub worst: Option<(String, f64)>,
}

/// The points in the frame of the data set, or of the first of them where it has none, with their marks in pictures loaded at
/// `scale`.
pub fn marked(set: &Dataset, surveyed: &[SurveyedPoint], scale: f64) -> Vec<ControlPoint> {
    let Some(origin) = set.origin.or(surveyed.first().map(|p| p.position)) else { return Vec::new() };
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

/// Renders each picture that shows a point, as `view_of` it is loaded, and compares.
///
/// # Errors
/// The device fails.
pub fn compare(
    trainer: &mut Trainer,
    points: &[ControlPoint],
    view_of: &dyn Fn(&str) -> Option<View>,
) -> Result<SurveyedScores, EngineError> {
    let mut pictures: Vec<&str> = points.iter().flat_map(|p| &p.marks).map(|(name, _)| name.as_str()).collect();
    pictures.sort_unstable();
    pictures.dedup();
    let mut off: Vec<Vec<DVec3>> = vec![Vec::new(); points.len()];
    let (mut shown, mut unseen) = (Rendering::default(), 0);
    for picture in pictures {
        let Some(view) = view_of(picture) else { continue };
        trainer.render(&view, &mut shown)?;
        let camera = Pinhole::from(&view);
        for (point, off) in points.iter().zip(&mut off) {
            for (_, pixel) in point.marks.iter().filter(|(name, _)| name == picture) {
                match depth_at(&shown, *pixel) {
                    Some(depth) => off.push(camera.unproject(*pixel, depth) - point.place),
                    None => unseen += 1,
                }
            }
        }
    }
    Ok(SurveyedScores::of(points, &off, unseen))
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
        let seen: Vec<(&ControlPoint, &Vec<DVec3>)> =
            points.iter().zip(off).filter(|(_, off)| !off.is_empty()).collect();
        let n = seen.len().max(1) as f64;
        let mean = |off: &[DVec3], of: &dyn Fn(&DVec3) -> f64| off.iter().map(of).sum::<f64>() / off.len() as f64;
        let over = |of: &dyn Fn(&DVec3) -> f64, power: i32| {
            seen.iter().map(|(_, off)| mean(off, of).powi(power)).sum::<f64>() / n
        };
        let worst = seen.iter().map(|(p, off)| (p.name.clone(), mean(off, &|o| o.length())));
        Self {
            points: seen.len(),
            marks: seen.iter().map(|(_, off)| off.len()).sum(),
            unseen,
            horizontal_rmse_m: over(&|o| o.truncate().length(), 2).sqrt(),
            vertical_rmse_m: over(&|o| o.z, 2).sqrt(),
            vertical_bias_m: over(&|o| o.z, 1),
            worst: worst.max_by(|a, b| a.1.total_cmp(&b.1)),
        }
    }

    /// One line for a log; `what` the points are.
    pub fn announce(&self, what: &str) {
        if self.points == 0 {
            return tracing::warn!("{what}: the model shows none of them");
        }
        tracing::info!(
            "{what} through the renderings: {} points in {} marks, {:.3} m off horizontally and {:.3} m vertically (rms){}",
            self.points,
            self.marks,
            self.horizontal_rmse_m,
            self.vertical_rmse_m,
            self.worst.as_ref().map_or_else(String::new, |(name, m)| format!(", {name} {m:.3} m at most"))
        );
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec2;
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
        let scores = compare(&mut trainer, &good, &of).expect("rendered");
        assert_eq!((scores.points, scores.marks, scores.unseen), (2, 3, 0), "{scores:?}");
        assert!(scores.horizontal_rmse_m < 0.05 && scores.vertical_rmse_m < 0.1, "{scores:?}");
        // A stone of a metre that the model does not have: each picture sees the ground behind it, away from its own foot.
        let mut stone = point("stone", DVec3::new(20.0, 20.0, 1.0), &views);
        let scores = compare(&mut trainer, std::slice::from_ref(&stone), &of).expect("rendered");
        assert!((scores.vertical_bias_m + 1.0).abs() < 0.1 && scores.worst.is_some(), "{scores:?}");
        stone.marks = vec![("a".into(), [-3.0, 5.0]), ("b".into(), [f32::NAN, 5.0])];
        let scores = compare(&mut trainer, &[stone], &of).expect("rendered");
        assert_eq!(scores, SurveyedScores { unseen: 2, ..Default::default() });
        assert!(DVec2::splat(scores.vertical_rmse_m).is_finite());
    }
}
