//! `dgtr ground plan|cell|join`: a merge as jobs that many machines share, through a folder or a bucket that all of them reach.

mod cell;
mod join;
mod plan;

use super::CliError;

/// Arguments of `dgtr ground`.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, clap::Subcommand)]
enum Command {
    /// Brings the models together and says what is to be done: prints the key of each cell that is not there yet.
    Plan(plan::Args),
    /// Merges and distils cells of the plan; those that are there are left alone.
    Cell(cell::Args),
    /// Puts the cells together into the global model.
    Join(join::Args),
}

/// Runs `dgtr ground …`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    match args.command {
        Command::Plan(args) => plan::run(args),
        Command::Cell(args) => cell::run(args),
        Command::Join(args) => join::run(args),
    }
}
