//! One training of a comparison: a `dgtr train` of its own, in a folder named by all that decides its result. Methods that differ on
//! the ground only share it, and what is finished is not trained again.

use std::path::{Path, PathBuf};

use disk::Disk;
use job::run_json::RunReport;
use models::formats::delivery::Rounding;
use models::formats::model;

use super::super::child;
use super::Request;
use super::data::{OWN, SEEN, Written};
use super::presets::{Method, Pictures};
use runtime::error::JobError;
use runtime::figures::write_text;

/// Digits of the hash in a folder's name.
const DIGITS: usize = 12;

/// What is asked of `dgtr train`.
#[derive(Clone, Debug)]
pub struct Training {
    /// Region; `None`: all of the data set.
    pub region: Option<String>,
    /// What it is called in messages.
    pub name: String,
    arguments: Vec<String>,
    settings: String,
    /// Folder of the model.
    pub folder: PathBuf,
}

/// A trained model.
#[derive(Clone, Debug)]
pub struct Trained {
    /// Its file.
    pub model: PathBuf,
    /// Its report.
    pub report: RunReport,
    /// Bytes of the file.
    pub bytes: u64,
    /// Bytes of the same model in the delivery encoding.
    pub delivery_bytes: u64,
}

impl Training {
    /// Of `method` in `region`, with the steps, Gaussians and memory of `shares` aircraft.
    pub fn of(method: &Method, region: Option<&str>, shares: u32, request: &Request, data: &Written) -> Self {
        let list = if method.pictures == Pictures::Seen { SEEN } else { OWN };
        let mut arguments = Vec::new();
        let mut argue = |flag: &str, value: String| arguments.extend([flag.to_owned(), value]);
        argue("--split", list.to_owned());
        if let Some(region) = region {
            argue("--region", region.to_owned());
        }
        argue("--init", method.start.to_owned());
        if let Some(steps) = request.steps {
            argue("--steps", (steps.saturating_mul(shares)).to_string());
        }
        if let Some(seconds) = request.seconds {
            argue("--seconds", (seconds * f64::from(shares)).to_string());
        }
        argue("--max-gaussians", (request.onboard.max_gaussians * shares as usize).to_string());
        argue("--budget-mib", (request.onboard.budget_mib.saturating_mul(shares)).to_string());
        argue("--seed", request.seed.to_string());
        argue("--scale", request.scale.to_string());
        if let Some(pair) = &request.networks.pair {
            argue("--model", pair.display().to_string());
        }
        if let Some(device) = &request.onboard.device {
            argue("--device", device.clone());
        }
        let mut settings = method.settings.to_owned();
        if let Some(depth) = &request.networks.depth {
            let depth = std::path::absolute(depth).unwrap_or_else(|_| depth.clone());
            settings += &format!("[network]\ndepth = {}\n", toml::Value::from(depth.to_string_lossy().into_owned()));
        }
        let what = serde_json::json!([arguments, settings, data.content]);
        let key = blake3::hash(what.to_string().as_bytes()).to_hex();
        let place = region.unwrap_or("all");
        // A region's name may be anything.
        let safe: String = place.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).take(32).collect();
        let folder = request.out.join("models").join(format!("{safe}-{}", &key[..DIGITS]));
        let name = format!("{}, {place}", method.name);
        Self { region: region.map(str::to_owned), name, arguments, settings, folder }
    }

    /// All that decides its result, to be compared.
    pub fn key(&self) -> String {
        self.folder.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default()
    }

    /// The finished training, now or from before.
    ///
    /// # Errors
    /// It fails or is stopped; its files cannot be read or written.
    pub fn run(&self, data: &Written, again: bool) -> Result<Trained, JobError> {
        let model = self.folder.join("model.dgtr");
        let done = RunReport::read(&self.folder).ok().filter(|r| r.outcome == "done" && model.is_file() && !again);
        let report = match done {
            Some(report) => report,
            None => {
                let settings = self.folder.join("settings.toml");
                write_text(&settings, &self.settings)?;
                let mut arguments = vec!["train".to_owned(), data.root.display().to_string()];
                arguments.extend_from_slice(&self.arguments);
                let settings = settings.display().to_string();
                arguments.extend(["--settings".to_owned(), settings, "--no-eval".into(), "--fresh".into()]);
                write_text(&self.folder.join("command.txt"), &format!("dgtr {}\n", arguments.join(" ")))?;
                child::run(&arguments, &self.folder, None)?.report(&self.name)?
            }
        };
        let bytes = size(&model)?;
        let delivery_bytes = delivered(&model)?;
        Ok(Trained { model, report, bytes, delivery_bytes })
    }
}

fn size(path: &Path) -> Result<u64, JobError> {
    Ok(std::fs::metadata(path).map_err(JobError::io(path))?.len())
}

/// Bytes of a model in the delivery encoding, which is left beside it.
fn delivered(model: &Path) -> Result<u64, JobError> {
    let path = model.with_file_name("delivery.dgtr");
    let (header, cloud) = model::read(model)?;
    model::write_rounded(&Disk::default(), &path, &header, &cloud, &Rounding::default())?;
    size(&path)
}
