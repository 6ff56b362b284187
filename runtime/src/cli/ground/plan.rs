//! `dgtr ground plan MODEL… --store STORE`.

use std::path::PathBuf;

use config::ground::GroundSettings;
use config::mission::Mission;
use ground::LocalModel;
use ground::jobs::aggregate::REGISTRATION;
use ground::jobs::join::missing;
use ground::jobs::planning::{lay_out, plan, publish};
use ground::jobs::serve::admit::admit;
use ground::member::Member;
use ground::store::Store;
use job::interrupt::Interrupt;
use models::formats::model::read_header;

use super::CliError;
use crate::cli::aggregate::Merging;
use crate::cli::ending::within_bounds;
use crate::cli::output::outln;

/// Arguments of `dgtr ground plan`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The aircraft's .dgtr models.
    #[arg(required = true)]
    models: Vec<PathBuf>,
    /// A folder that all workers reach, or s3://BUCKET/PREFIX.
    #[arg(long)]
    store: String,
    /// The mission whose aircraft made the models: its origin, regions and `[ground]`.
    #[arg(long, value_name = "FILE")]
    mission: Option<PathBuf>,
    /// How to merge, over `[ground]` of the mission.
    #[command(flatten)]
    settings: Merging,
}

pub(super) fn run(args: Args) -> Result<(), CliError> {
    let mission = args.mission.as_deref().map(Mission::read).transpose()?;
    let mut settings = mission.as_ref().map_or_else(GroundSettings::default, |m| m.ground.clone());
    args.settings.apply(&mut settings)?;
    let stop = Interrupt::install()?;
    within_bounds(&stop).map_err(CliError::failed)?;
    let store = Store::open(&args.store)?;
    let member = |path: &PathBuf| match &mission {
        None => Ok(Member::of(LocalModel::read(path)?)),
        Some(mission) => {
            let aircraft = read_header(path)?.0.aircraft;
            let admitted = admit(mission, &aircraft, path);
            admitted.map(Member::of).map_err(|why| CliError::input(format!("{}: {why}", path.display())))
        }
    };
    let mut members = args.models.iter().map(member).collect::<Result<Vec<_>, CliError>>()?;
    let origin = mission.map(|m| m.origin);
    // What is known of pairs stays with a folder; for a bucket it is found anew.
    let scratch = tempfile::tempdir().map_err(CliError::failed)?;
    let fits = store.path().unwrap_or(scratch.path()).join(REGISTRATION);
    let planned = plan(&mut members, &settings, origin, &store, fits, &|| stop.requested())?;
    if stop.requested() {
        return Err(CliError::interrupted("stopped on request; run the same command again"));
    }
    store.sweep();
    for warning in &planned.registered.warnings {
        tracing::warn!("{warning}");
    }
    if let Some(why) = &planned.not_registered {
        tracing::warn!("the models stay where their GPS put them, they could not be registered: {why}");
    }
    let plan = planned.plan;
    lay_out(&members, &plan, &store, &|_| true)?;
    publish(&plan, &store)?;
    let inputs: Vec<_> = plan.cells.iter().map(|c| c.input).collect();
    let missing = missing(&store, &plan, &inputs)?;
    tracing::info!("{} cells of {} are to be made", missing.len(), plan.cells.len());
    for i in missing {
        outln!("{}", plan.cells[i].key);
    }
    Ok(())
}
