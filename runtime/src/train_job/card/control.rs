//! Surveyed points of a card, from the file's words to the refiner's, and what it made of them.

use config::geodesy::EnuFrame;
use glam::DVec3;
use models::card::control::SurveyedPoint;
use models::dataset::{Dataset, scaled};
use models::refine::{ControlPoint, ControlResidual};

/// The points in the frame of the data set, or of the first of them where it has none, with their marks in pictures loaded at
/// `scale`.
pub(super) fn points(set: &Dataset, surveyed: &[SurveyedPoint], scale: f64) -> Vec<ControlPoint> {
    let Some(origin) = set.origin.or(surveyed.first().map(|p| p.position)) else { return Vec::new() };
    let frame = EnuFrame::new(origin);
    let mark = |picture: &str, pixel: [f64; 2]| {
        let frame = set.frames.iter().find(|f| f.name.to_lowercase() == picture)?;
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

/// One line on how the points agree with the pictures; each that fewer than two pictures place, and the worst.
pub(super) fn announce(residuals: &[ControlResidual]) {
    if residuals.is_empty() {
        return;
    }
    let (used, unused): (Vec<_>, Vec<_>) = residuals.iter().partition(|r| r.views >= 2);
    let rms = |of: &dyn Fn(&ControlResidual) -> f64| {
        (used.iter().map(|r| of(r)).sum::<f64>() / used.len().max(1) as f64).sqrt()
    };
    let length = |r: &ControlResidual| DVec3::from_array(r.off_m).length();
    let worst = used.iter().max_by(|a, b| length(a).total_cmp(&length(b)));
    tracing::info!(
        "ground control: {} of {} points used, {:.3} m off horizontally and {:.3} m vertically (rms){}",
        used.len(),
        residuals.len(),
        rms(&|r| r.off_m[0].powi(2) + r.off_m[1].powi(2)),
        rms(&|r| r.off_m[2].powi(2)),
        worst.map_or_else(String::new, |r| format!(", {} {:.3} m at most", r.name, length(r)))
    );
    for r in unused {
        tracing::warn!("ground control: {} is marked in fewer than two pictures that agree on it; not used", r.name);
    }
}
