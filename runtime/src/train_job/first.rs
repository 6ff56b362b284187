//! A model that training begins with.

use std::path::Path;

use engine::model_path;
use models::formats::model::Chunks;
use survey::dataset::Dataset;

use crate::error::JobError;

/// Opens the model `from`. It is read once more, piece by piece, when it is trained, and must still be there then.
///
/// # Errors
/// It cannot be read, holds no Gaussians, or is the one that a `fresh` job in `out` replaces.
pub(super) fn open(from: &Path, out: &Path, fresh: bool) -> Result<Chunks, JobError> {
    let model = Chunks::open(from)?;
    let said = |what: &str| Err(JobError::Request(format!("{}: {what}", from.display())));
    if model.count == 0 {
        return said("holds no Gaussians to begin with; train it first (dgtr train continues it)");
    }
    let resolved = |path: &Path| path.canonicalize().ok();
    if fresh && resolved(from).is_some_and(|from| resolved(&model_path(out)) == Some(from)) {
        return said("is the model that --fresh replaces; give another --out");
    }
    Ok(model)
}

/// Whether the model lies where the data set does.
///
/// # Errors
/// Their frames have different origins.
pub(super) fn check(model: &Chunks, set: &Dataset) -> Result<(), JobError> {
    match (model.header.origin, set.origin) {
        (Some(from), Some(set)) if from != set => {
            let [from, set] = [from, set].map(|o| format!("{}, {}, {} m", o.lat_deg, o.lon_deg, o.alt_m));
            Err(JobError::Request(format!(
                "--from: the model's frame begins at {from}, that of the pictures at {set}; give a model of the same frame"
            )))
        }
        // A model that was moved by itself lies where nobody else's does.
        _ if model.header.local != set.local => Err(JobError::Request(
            "--from: the model's coordinates were brought near another origin than those of the pictures; give a model of the same frame"
                .to_owned(),
        )),
        _ => Ok(()),
    }
}
