//! `dgtr demo`: the whole system with nothing attached.

use std::path::PathBuf;

use job::interrupt::Interrupt;

use super::CliError;
use crate::cli::output::out;
use crate::demo::{DemoOptions, run as run_demo};

/// Two simulated aircraft and a ground station, each a process of its own, from MAVLink and pictures to one merged model.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Output folder.
    #[arg(long, value_name = "DIR", default_value = "dgtr-demo")]
    out: PathBuf,
    /// Seconds of training per aircraft after landing.
    #[arg(long, value_name = "S", default_value_t = 60.0)]
    seconds: f64,
    /// Seed of world, flights and training.
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// Bound on the memory each process may write to, MiB.
    #[arg(long, value_name = "MIB", default_value_t = 768)]
    process_mib: u64,
    /// Seconds of flight per second of wall clock.
    #[arg(long, value_name = "X", default_value_t = 4.0)]
    speed: f64,
    /// Serve the ground's live page there, as 127.0.0.1:8080, and those of the aircraft on the two ports behind it.
    #[arg(long, value_name = "ADDR")]
    http: Option<std::net::SocketAddr>,
}

/// Runs the command.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    let Args { out, seconds, seed, process_mib: limit_mib, speed, http } = args;
    let interrupt = Interrupt::install()?;
    let summary = run_demo(&DemoOptions { out, seconds, seed, limit_mib, speed, http }, &interrupt)?;
    out!("{summary}");
    Ok(())
}
