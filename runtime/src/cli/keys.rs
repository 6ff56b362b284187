//! `dgtr keys --mission FILE`: makes the private keys that are missing and prints the public ones for the mission file.

use std::path::PathBuf;

use config::mission::Mission;
use uplink::keys::{self, GROUND};

use super::CliError;
use crate::cli::output::outln;

/// Arguments of `dgtr keys`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The mission file. Private keys go into its [upload] keys folder, by default `keys` beside it.
    #[arg(long, value_name = "FILE")]
    mission: PathBuf,
    /// Only the key of this aircraft, or of `ground`: made on its own machine, a private key never leaves it.
    #[arg(long, value_name = "ID")]
    only: Option<String>,
}

/// Runs `dgtr keys`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let mission = Mission::read(&args.mission)?;
    if let Some(id) = args.only.as_deref().filter(|id| *id != GROUND) {
        mission.aircraft(Some(id))?;
    }
    let aircraft = mission.aircraft.iter().map(|a| (a.id.as_str(), a.public_key));
    let everybody = std::iter::once((GROUND, mission.ground.public_key)).chain(aircraft);
    for (id, known) in everybody.filter(|(id, _)| args.only.as_deref().is_none_or(|only| only == *id)) {
        let (key, new) = keys::make(&mission.upload.keys, id)?;
        let path = keys::private_path(&mission.upload.keys, id);
        let table = if id == GROUND { "[ground]".to_owned() } else { format!("the [[aircraft]] table of {id}") };
        let made = if new { "new" } else { "was there" };
        outln!("# into {table}; private key in {} ({made})\npublic_key = \"{key}\"\n", path.display());
        if known.is_some_and(|known| known != key) {
            tracing::warn!("the mission has another public_key for {id}; replace it in the files of all");
        }
    }
    tracing::info!("every aircraft needs the mission file and its own private key only; the ground needs ground.key");
    Ok(())
}
