//! A merge in one process: planned, made cell by cell, joined.

use std::path::{Path, PathBuf};
use std::time::Instant;

use config::ground::GroundSettings;
use geometry::geodesy::Geodetic;
use models::formats::model::ModelHeader;

use super::join::{self, Joined};
use super::tally::{self, Distilled};
use super::{make, planning};
use crate::AggregateError;
use crate::light::Light;
use crate::member::Member;
use crate::merge::Kept;
use crate::plan::{Hash, Plan};
use crate::region::Region;
use crate::register::Registered;
use crate::store::Store;

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
    pub kept: Vec<Kept>,
    /// How the models were moved onto their neighbours.
    pub registered: Registered,
    /// Why none could be; the models were then merged where their GPS put them.
    pub not_registered: Option<String>,
    /// How far the models' light was apart.
    pub light: Light,
    /// Regions in use, declared or derived.
    pub regions: Vec<Option<Region>>,
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
    cancelled: &dyn Fn() -> bool,
) -> Result<Outcome, AggregateError> {
    let store = Store::folder(&out.join(GROUND));
    let path = out.join("global.dgtr");
    let planned = planning::plan(&mut members, settings, origin, &store, out.join(REGISTRATION), cancelled)?;
    planning::publish(&planned.plan, &store)?;
    let header = join::header(&planned.plan, &|index| Ok(members[index].header.clone()))?;
    let (store, plan, device) = (&store, &planned.plan, settings.device.as_deref());
    let work = Work { store, plan, members: &members, device, header, path: &path, cancelled };
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
    cancelled: &'a dyn Fn() -> bool,
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
                make::make(&merged, store, None, &|| false)?;
            }
        }
        wanted.retain(|i| names[*i] != plan.cells[*i].input);
        let join = |names: &[Hash], finished| {
            join::join(store, plan, names, ModelHeader { finished, ..self.header.clone() }, self.path)
        };
        let joined = join(&names, wanted.is_empty())?;
        let (effort, seconds) = (Distilled::default(), vec![("merge", start.elapsed().as_secs_f64())]);
        let (not_distilled, interrupted) = (None, (self.cancelled)());
        let mut done = Done { joined, names, effort, made, not_distilled, interrupted, seconds };
        if wanted.is_empty() {
            return Ok(done);
        }
        let start = Instant::now();
        for i in wanted {
            let inputs = plan.inputs(&plan.cells[i]);
            match make::make(&inputs, store, self.device, self.cancelled) {
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
        done.interrupted = (self.cancelled)();
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
mod tests;
