//! The ground's work: local models in, one global model out (the paper's §Model Aggregation).
//!
//! Bring every model into one frame → keep of each what its aircraft answers for → unite → let every aircraft's own
//! model teach the union how its own training views look, where regions meet. Pictures are never needed. What is global is planned
//! first ([`planning`]); the rest is done square by square of ground, each a pure job ([`job`]) that any machine may do, and what they
//! come to is put together ([`join`]).

use std::path::{Path, PathBuf};
use std::time::Instant;

use config::error::{Error, ErrorKind};
use config::geodesy::Geodetic;
use config::ground::GroundSettings;
use models::cloud::GaussianCloud;
use models::formats::model::{self, ModelHeader};
use vulkan::trainer::TrainError;

use join::Joined;
use member::Member;
use plan::{Hash, Plan};
use register::Registered;
use store::{Store, StoreError};
use tally::Distilled;

pub mod block;
pub mod cell;
pub mod compare;
pub mod distil;
pub mod frame;
mod hold;
pub mod job;
pub mod join;
pub mod light;
pub mod member;
pub mod merge;
pub mod plan;
pub mod planning;
pub mod region;
pub mod register;
pub mod seam;
pub mod sight;
pub mod squares;
pub mod store;
pub mod summary;
pub mod tally;

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
    /// The plan, the models' pieces or the cells.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// More than a plan can have.
    #[error("more than {most} {what} to merge; merge fewer models, or in larger squares (ground.cell_m)")]
    TooMany {
        /// Of what.
        what: &'static str,
        /// The bound.
        most: usize,
    },
    /// Not all cells have been made yet.
    #[error("{count} of {of} cells are missing: {named}; run `dgtr ground cell` for them, then join again")]
    MissingCells {
        /// The first of them.
        named: String,
        /// How many.
        count: usize,
        /// Of how many.
        of: usize,
    },
    /// No cell of the plan has this key.
    #[error("{0}: is no cell of this plan; `dgtr ground plan` prints those there are")]
    NoCell(String),
    /// The plan was made by a dgtr that makes cells in another way.
    #[error("{0}: the plan names it otherwise than this dgtr would; use one dgtr for plan and cells")]
    OtherCell(String),
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
            Self::Store(e) => e.kind(),
            Self::Changed(_) | Self::MissingCells { .. } => ErrorKind::Failed,
            Self::NoModels
            | Self::NoOrigin(_)
            | Self::TooFar { .. }
            | Self::TooMany { .. }
            | Self::NoCell(_)
            | Self::OtherCell(_)
            | Self::Plan(_) => ErrorKind::Input,
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
    pub distilled: Option<Distilled>,
    /// Why it did not run; the merged model was written all the same.
    pub not_distilled: Option<AggregateError>,
    /// Cells made now, and all.
    pub cells: [usize; 2],
    /// Seconds by stage.
    pub seconds: Vec<(&'static str, f64)>,
    /// Asked to stop before the end.
    pub interrupted: bool,
}

/// Merges and distils models in cells of ground, each a job of its own, and writes `out/global.dgtr`: first as merged, then as distilled,
/// so that an interruption or a missing device still leaves a global model. Cells that `out/ground` has already are not made again.
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
    let store = Store::folder(&out.join(GROUND));
    let path = out.join("global.dgtr");
    let planned = planning::plan(&mut members, settings, origin, &store, out.join(REGISTRATION), go_on)?;
    planning::publish(&planned.plan, &store)?;
    let header = join::header(&planned.plan, &|index| Ok(members[index].header.clone()))?;
    let (store, plan, device) = (&store, &planned.plan, settings.device.as_deref());
    let work = Work { store, plan, members: &members, device, header, path: &path, go_on };
    // A cell that lay there and turns out to be damaged when all are put together is removed and made once more.
    let done = match work.round() {
        Err(AggregateError::MissingCells { .. }) => work.round(),
        other => other,
    }?;
    planning::tidy(store, &done.names);
    let (kept, distilled) = tally::tally(plan, &done.joined.heads, done.effort);
    Ok(Outcome {
        kept,
        distilled: done.not_distilled.is_none().then_some(distilled),
        not_distilled: done.not_distilled,
        interrupted: done.interrupted,
        header: done.joined.header,
        gaussians: done.joined.gaussians,
        cells: [done.made, plan.cells.len()],
        registered: planned.registered,
        not_registered: planned.not_registered,
        light: planned.light,
        seconds: [planned.seconds, done.seconds].concat(),
        regions: plan.models.iter().map(|m| m.region.clone()).collect(),
        models: members.iter().map(|m| (m.name().to_owned(), m.header.clone())).collect(),
        path,
    })
}

/// All jobs of a plan in this process.
struct Work<'a> {
    store: &'a Store,
    plan: &'a Plan,
    members: &'a [Member],
    device: Option<&'a str>,
    header: ModelHeader,
    path: &'a Path,
    go_on: &'a dyn Fn() -> bool,
}

/// What they came to.
struct Done {
    joined: Joined,
    /// What was joined.
    names: Vec<Hash>,
    effort: Distilled,
    /// Cells made now.
    made: usize,
    not_distilled: Option<AggregateError>,
    interrupted: bool,
    seconds: Vec<(&'static str, f64)>,
}

impl Work<'_> {
    /// Makes the cells that are missing, merged first, then distilled, and joins them after each.
    fn round(&self) -> Result<Done, AggregateError> {
        let (store, plan) = (self.store, self.plan);
        let start = Instant::now();
        let mut names: Vec<Hash> = plan.cells.iter().map(|c| c.input).collect();
        let mut wanted = join::missing(store, plan, &names)?;
        let made = wanted.len();
        planning::lay_out_for(self.members, plan, store, &wanted)?;
        for &i in &wanted {
            let merged = plan.inputs(&plan.cells[i]).merged_only();
            names[i] = merged.hash()?;
            if join::sound(store, plan, &names[i])?.is_none() {
                job::make(&merged, store, None, &|| true)?;
            }
        }
        wanted.retain(|i| names[*i] != plan.cells[*i].input);
        let join = |names: &[Hash], finished| {
            join::join(store, plan, names, ModelHeader { finished, ..self.header.clone() }, self.path)
        };
        let joined = join(&names, wanted.is_empty())?;
        let (effort, seconds) = (Distilled::default(), vec![("merge", start.elapsed().as_secs_f64())]);
        let (not_distilled, interrupted) = (None, !(self.go_on)());
        let mut done = Done { joined, names, effort, made, not_distilled, interrupted, seconds };
        if wanted.is_empty() {
            return Ok(done);
        }
        let start = Instant::now();
        for i in wanted {
            let inputs = plan.inputs(&plan.cells[i]);
            match job::make(&inputs, store, self.device, self.go_on) {
                Ok(Some(made)) => {
                    done.names[i] = plan.cells[i].input;
                    done.effort.took(made.effort, &|model| inputs.models[model].index);
                }
                Ok(None) => break,
                Err(e) => {
                    done.not_distilled = Some(e);
                    break;
                }
            }
        }
        done.seconds.push(("distil", start.elapsed().as_secs_f64()));
        let start = Instant::now();
        done.interrupted = !(self.go_on)();
        let is_whole = done.names.iter().zip(&plan.cells).all(|(name, cell)| *name == cell.input);
        done.joined = join(&done.names, is_whole && !done.interrupted)?;
        done.seconds.push(("write", start.elapsed().as_secs_f64()));
        Ok(done)
    }
}

/// Folder below `out` for what is known of pairs of models.
pub const REGISTRATION: &str = "registration";
/// Folder below `out` for the plan and the cells.
pub const GROUND: &str = "ground";

#[cfg(test)]
pub(crate) mod testing;
#[cfg(test)]
mod tests;
