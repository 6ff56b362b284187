//! What crops are worth: the same pictures, seconds and Gaussians, trained as whole pictures of a small size alone and with crops of
//! their full size, both compared with held-out pictures of the full size.

use std::path::Path;

use engine::device::renderer;
use engine::evaluate::{IntoModel, Scores, evaluate};
use models::formats::{model, write_atomic};
use serde::Serialize;
use survey::dataset::Dataset;

use super::child;
use runtime::error::JobError;

/// One way to train.
#[derive(Clone, Debug, Serialize)]
pub struct DetailScores {
    /// Most crops that it may take.
    pub crops: u32,
    /// Crops that it took.
    pub taken: u64,
    /// Steps of training.
    pub steps: u64,
    /// Seconds of training.
    pub seconds: f64,
    /// Gaussians.
    pub gaussians: usize,
    /// Bytes of the device.
    pub device_bytes: u64,
    /// Held-out pictures at the size of whole training pictures.
    pub small: Scores,
    /// Held-out pictures at full size.
    pub full: Scores,
}

/// Trains `data` at `scale` with each number of `crops` and with `training` (flags of `dgtr train`), into folders of `out`.
///
/// # Errors
/// The training fails, or the folder cannot be written to.
pub fn measure(
    data: &Path,
    out: &Path,
    scale: f64,
    crops: &[u32],
    training: &[String],
) -> Result<Vec<DetailScores>, JobError> {
    let set = Dataset::open(data)?;
    let frames = set.select("test", None)?;
    let mut all = Vec::new();
    for &most in crops {
        let folder = out.join(format!("crops-{most}"));
        let settings = out.join(format!("crops-{most}.toml"));
        write_atomic(&settings, |file| writeln!(file, "[training.crops]\nmost = {most}"))?;
        let mut arguments = vec!["train".to_owned(), data.display().to_string(), "--fresh".into(), "--no-eval".into()];
        arguments.extend([
            "--settings".to_owned(),
            settings.display().to_string(),
            "--scale".into(),
            scale.to_string(),
        ]);
        arguments.extend_from_slice(training);
        let report = child::run(&arguments, &folder, None)?.report("training")?;
        let (header, cloud) = model::read(&folder.join("model.dgtr"))?;
        let largest = frames.iter().map(|&i| set.frames[i].view.intrinsics).max_by_key(|k| k.pixels());
        let (width, height) = largest.map_or((1, 1), |k| (k.width, k.height));
        let mut trainer = renderer(None, &cloud, width, height)?;
        let into = IntoModel::of(&set, &header);
        let mut at = |scale: f64| evaluate(&mut trainer, &set, &frames, scale, &into, None, None);
        all.push(DetailScores {
            crops: most,
            taken: report.more.get("crops").and_then(|n| n.as_u64()).unwrap_or(0),
            steps: report.steps,
            seconds: report.more.get("train_seconds").and_then(|s| s.as_f64()).unwrap_or(0.0),
            gaussians: cloud.len(),
            device_bytes: report.memory.device_bytes_peak,
            small: at(scale)?,
            full: at(1.0)?,
        });
    }
    Ok(all)
}
