//! A card's surveyed points in the pictures of its model.

use engine::Reconstruction;
use engine::evaluate::surveyed;
use models::camera::View;
use survey::dataset::{Dataset, scaled};

use crate::error::JobError;

/// How far the model's renderings put a card's surveyed points off, those that held its poses and those that did not.
///
/// # Errors
/// The renderer's.
pub(super) fn measure(engine: &mut Reconstruction, set: &Dataset, scale: f64) -> Result<(), JobError> {
    let Some(notes) = &set.card else { return Ok(()) };
    let view_of = |name: &str| {
        let view = set.frames.iter().find(|f| f.name == name)?.view;
        Some(View { intrinsics: scaled(&view.intrinsics, scale).ok()?, ..view })
    };
    for (what, key, points) in
        [("ground control", "ground_control", &notes.control), ("check points", "check_points", &notes.check)]
    {
        if !points.is_empty() {
            let points = surveyed::marked(set, points, scale);
            let scores = surveyed::compare(engine.trainer(), &points, &view_of)?;
            scores.announce(what);
            engine.report.more.insert(key.to_owned(), serde_json::to_value(scores)?);
        }
    }
    Ok(())
}
