//! The ground's work: local models in, one global model out (the paper's §Model Aggregation).
//!
//! Bring every model into one frame → keep of each what its aircraft answers for → unite → let every aircraft's own
//! model teach the union how its own training views look, where regions meet. Pictures are never needed, and the Gaussians of
//! one model at a time are in memory besides the union.

use std::path::{Path, PathBuf};
use std::time::Instant;

use config::disk::Disk;
use config::error::{Error, ErrorKind};
use config::geodesy::Geodetic;
use config::ground::GroundSettings;
use models::cloud::GaussianCloud;
use models::formats::model::{self, ModelHeader};
use models::light::PictureLight;
use vulkan::trainer::TrainError;

use member::Member;
use register::edge::Edges;
use register::fit::RenderedFitter;
use register::{Registered, Registrar};

pub mod compare;
pub mod distil;
pub mod frame;
pub mod light;
pub mod member;
pub mod merge;
pub mod region;
pub mod register;
pub mod seam;
pub mod sight;
pub mod summary;

/// One aircraft's model as it arrived.
#[derive(Clone, Debug)]
pub struct LocalModel {
    /// Where it was read from.
    pub path: PathBuf,
    /// What it says about itself.
    pub header: ModelHeader,
    /// Its Gaussians.
    pub cloud: GaussianCloud,
    /// BLAKE3 of the file.
    pub content: [u8; 32],
}

impl LocalModel {
    /// Reads and verifies a model file.
    ///
    /// # Errors
    /// Unreadable, damaged, or not a model.
    pub fn read(path: &Path) -> Result<Self, AggregateError> {
        let (header, cloud, content) = model::read_with_hash(path)?;
        Ok(Self { path: path.into(), header, cloud, content })
    }
}

/// Why no global model could be made.
#[derive(Debug, thiserror::Error)]
pub enum AggregateError {
    /// A model file cannot be read or written.
    #[error(transparent)]
    Format(#[from] models::formats::FormatError),
    /// Nothing to merge.
    #[error("no models to merge; give at least one .dgtr file")]
    NoModels,
    /// Some models are georeferenced and this one is not.
    #[error("{0}: has no (valid) WGS-84 origin while other models have one; all or none must")]
    NoOrigin(String),
    /// Models of different places.
    #[error("{name}: its origin lies {km:.1} km from the others'; are these models of one mission?")]
    TooFar {
        /// Whose.
        name: String,
        /// How far.
        km: f64,
    },
    /// Another model lies under the name of one that was counted already.
    #[error("{0}: was replaced while it was being merged; run the command again")]
    Changed(String),
    /// Distillation does not fit into `ground.device_mib`.
    #[error("ground: {0}")]
    Plan(#[from] config::plan::PlanError),
    /// The device or the trainer.
    #[error(transparent)]
    Train(#[from] TrainError),
}

impl Error for AggregateError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Format(e) => e.kind(),
            Self::Train(e) => e.kind(),
            Self::Changed(_) => ErrorKind::Failed,
            Self::NoModels | Self::NoOrigin(_) | Self::TooFar { .. } | Self::Plan(_) => ErrorKind::Input,
        }
    }
}

/// What the aggregation came to; everything the report shows.
#[derive(Debug, Default)]
pub struct Outcome {
    /// The global model's file.
    pub path: PathBuf,
    /// Its header.
    pub header: ModelHeader,
    /// Its Gaussians.
    pub gaussians: usize,
    /// Per model, in the order given: name and header (in the common frame).
    pub models: Vec<(String, ModelHeader)>,
    /// Per model: what became of its Gaussians.
    pub kept: Vec<merge::Kept>,
    /// How the models were moved onto their neighbours.
    pub registered: Registered,
    /// Why none could be; the models were then merged where their GPS put them.
    pub not_registered: Option<String>,
    /// How far the models' light was apart.
    pub light: light::Light,
    /// Regions in use, declared or derived.
    pub regions: Vec<Option<region::Region>>,
    /// Distillation, when it ran or found nothing to do.
    pub distilled: Option<distil::Distilled>,
    /// Why it did not run; the merged model was written all the same.
    pub not_distilled: Option<AggregateError>,
    /// Seconds by stage: read, merge, distil, write.
    pub seconds: Vec<(&'static str, f64)>,
    /// Asked to stop before the end.
    pub interrupted: bool,
}

/// Merges and distils models, and writes `out/global.dgtr`: first as merged, then as distilled, so that an
/// interruption or a missing device still leaves a global model.
///
/// `origin` is the common origin wanted; None takes the first model's.
///
/// # Errors
/// Models that do not belong together or cannot be written. A failing distillation is in [`Outcome::not_distilled`].
pub fn run(
    mut members: Vec<Member>,
    settings: &GroundSettings,
    origin: Option<Geodetic>,
    out: &Path,
    go_on: &dyn Fn() -> bool,
) -> Result<Outcome, AggregateError> {
    if members.is_empty() {
        return Err(AggregateError::NoModels);
    }
    let mut outcome = Outcome { path: out.join("global.dgtr"), ..Default::default() };
    let start = Instant::now();
    let origin = member::unify(&mut members, origin)?;
    outcome.seconds.push(("unify", start.elapsed().as_secs_f64()));
    let start = Instant::now();
    if settings.register {
        match registrar(settings, out).register(&mut members, go_on) {
            Ok(done) => outcome.registered = done,
            Err(e) => outcome.not_registered = Some(e),
        }
    }
    outcome.seconds.push(("register", start.elapsed().as_secs_f64()));
    let start = Instant::now();
    outcome.light = light::unite(&mut members)?;
    outcome.seconds.push(("light", start.elapsed().as_secs_f64()));
    let start = Instant::now();
    let partition = region::Partition::new(&members, settings.border_m);
    let mut merged = merge::merge(&members, &partition, settings.max_gaussians.unwrap_or(usize::MAX))?;
    outcome.seconds.push(("merge", start.elapsed().as_secs_f64()));
    outcome.header = ModelHeader {
        mission: members[0].header.mission.clone(),
        aircraft: "global".into(),
        origin,
        views: members.iter().flat_map(|m| m.header.views.clone()).collect(),
        seed: settings.seed,
        lights: lights(&members),
        ..Default::default()
    };
    outcome.models = members.iter().map(|m| (m.name().to_owned(), m.header.clone())).collect();
    outcome.regions = partition.regions;
    model::write(&outcome.path, &outcome.header, &merged.cloud)?;

    let start = Instant::now();
    match distil::distil(&members, &mut merged, settings, go_on) {
        Ok(distilled) => {
            outcome.header.steps = u64::from(distilled.steps);
            outcome.distilled = Some(distilled);
        }
        Err(e) => outcome.not_distilled = Some(e),
    }
    outcome.seconds.push(("distil", start.elapsed().as_secs_f64()));
    outcome.interrupted = !go_on();
    outcome.header.finished = outcome.not_distilled.is_none() && !outcome.interrupted;
    outcome.gaussians = merged.cloud.len();
    outcome.kept = merged.kept;
    let start = Instant::now();
    model::write(&outcome.path, &outcome.header, &merged.cloud)?;
    outcome.seconds.push(("write", start.elapsed().as_secs_f64()));
    Ok(outcome)
}

/// The lights of all views, in the order of the members; none where all of them are even.
fn lights(members: &[Member]) -> Vec<PictureLight> {
    if members.iter().all(|m| m.header.lights.is_empty()) {
        return Vec::new();
    }
    let of = |m: &Member| -> Vec<PictureLight> {
        let mut lights = m.header.lights.clone();
        lights.resize(m.header.views.len(), PictureLight::default());
        lights
    };
    members.iter().flat_map(of).collect()
}

/// Folder below `out` for what is known of pairs of models.
const REGISTRATION: &str = "registration";

/// Fits by rendering on the ground's device, and remembers it in `out`.
pub fn registrar(settings: &GroundSettings, out: &Path) -> Registrar<RenderedFitter> {
    let edges = Edges::open(&Disk::default(), &out.join(REGISTRATION));
    Registrar::new(edges, RenderedFitter::new(settings.device.as_deref()))
}

#[cfg(test)]
pub(crate) mod testing;
#[cfg(test)]
mod tests;
