//! What the refiner made of the surveyed points of a card.

use glam::DVec3;
use models::refine::ControlResidual;

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
