//! `dgtr ground join --store STORE --out DIR`.

use std::path::PathBuf;

use config::keys::to_hex;
use ground::jobs::join::{header_in, join};
use ground::plan::{Hash, Plan};
use ground::store::Store;

use super::CliError;
use crate::cli::output::outln;

/// Arguments of `dgtr ground join`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The folder or bucket that has plan and cells.
    #[arg(long)]
    store: String,
    /// Folder for global.dgtr.
    #[arg(long)]
    out: PathBuf,
}

pub(super) fn run(args: Args) -> Result<(), CliError> {
    let store = Store::open(&args.store)?;
    let plan = Plan::of(&store)?;
    let inputs: Vec<Hash> = plan.cells.iter().map(|c| c.input).collect();
    let mut header = header_in(&store, &plan)?;
    header.finished = true;
    let path = args.out.join("global.dgtr");
    let joined = join(&store, &plan, &inputs, header, &path)?;
    outln!("{}: {} Gaussians out of {} models", path.display(), joined.gaussians, plan.models.len());
    outln!("{}", to_hex(&joined.content));
    Ok(())
}
