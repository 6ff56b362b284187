//! What the refiner made of the surveyed points of a card.

use glam::DVec3;
use models::refine::ControlResidual;
use survey::card::control::SurveyedPoint;

/// A point so many of its standard deviations from where the pictures see it contradicts them.
const CONTRADICTS: f64 = 5.0;

/// Points that the pictures see elsewhere than their survey allows: their names.
fn contradicting<'a>(residuals: &'a [ControlResidual], surveyed: &[SurveyedPoint]) -> Vec<&'a str> {
    let is_off = |r: &&ControlResidual| {
        let Some(point) = surveyed.iter().find(|p| p.name == r.name).filter(|_| r.views >= 2) else { return false };
        let [east, north, up] = r.off_m;
        east.hypot(north) > CONTRADICTS * point.sigma_m[0] || up.abs() > CONTRADICTS * point.sigma_m[1]
    };
    residuals.iter().filter(is_off).map(|r| r.name.as_str()).collect()
}

/// One line on how the points agree with the pictures; those that fewer than two pictures place, those that contradict them, and the worst.
pub(super) fn announce(residuals: &[ControlResidual], surveyed: &[SurveyedPoint]) {
    if residuals.is_empty() {
        return;
    }
    let contradicting = contradicting(residuals, surveyed);
    if !contradicting.is_empty() {
        tracing::warn!(
            "ground control: {} of {} points lie more than {CONTRADICTS} of their standard deviations from where the pictures see them ({}); check their marks, heights and reference system",
            contradicting.len(),
            residuals.len(),
            contradicting.join(", ")
        );
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
    if !unused.is_empty() {
        let names: Vec<&str> = unused.iter().map(|r| r.name.as_str()).collect();
        tracing::warn!(
            "ground control: {} of {} points are marked in fewer than two pictures that agree on them; not used ({})",
            unused.len(),
            residuals.len(),
            names.join(", ")
        );
    }
}

#[cfg(test)]
mod tests {
    use geometry::geodesy::Geodetic;

    use super::*;

    #[test]
    fn points_that_the_pictures_see_elsewhere_are_named() {
        let point = |name: &str, vertical: f64| SurveyedPoint {
            name: name.to_owned(),
            position: Geodetic { lat_deg: 46.0, lon_deg: 7.0, alt_m: 400.0 },
            sigma_m: [0.03, vertical],
            is_sigma_stated: [true; 2],
            marks: Vec::new(),
        };
        let residual =
            |name: &str, views, off_m| ControlResidual { name: name.to_owned(), views, off_m, error_px: 0.5 };
        let surveyed =
            [point("good", 0.05), point("moved", 0.05), point("feet", 0.05), point("flat", 100.0), point("few", 0.05)];
        let residuals = [
            residual("good", 4, [0.02, -0.05, 0.1]),
            residual("moved", 4, [1.5, 0.0, 0.0]),
            residual("feet", 3, [0.0, 0.0, 360.0]),
            residual("flat", 3, [0.0, 0.0, 360.0]),
            residual("few", 1, [50.0, 0.0, 0.0]),
        ];
        assert_eq!(contradicting(&residuals, &surveyed), ["moved", "feet"]);
    }
}
