//! `dgtr bench …`: one subcommand per question; results as Markdown on standard output, JSON and CSV on request.

mod detail;
mod device;
mod forecast;
mod ground;
mod levels;
mod map;
mod memory;
mod methods;
mod scene;
mod skips;
mod stages;
mod stress;
mod time_error;

use clap::{Subcommand, ValueEnum};

use super::CliError;

/// Arguments of `dgtr bench`.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Milliseconds, bytes and operations per stage, against what the device can do.
    Stages(stages::Args),
    /// Orthophoto and heights of a simulated survey against the exact ones.
    Map(map::Args),
    /// What crops of pictures larger than the plan holds are worth at their full size.
    Detail(detail::Args),
    /// All that a board or a card can tell in ten minutes, as a report to send in.
    Device(device::Args),
    /// What preset auto forecasts of a step against what it takes, at three sizes.
    Forecast(forecast::Args),
    /// A ground station of many simulated aircraft: seconds for each, memory, how well they meet.
    Ground(ground::Args),
    /// Levels of detail: how many Gaussians each has, and what it shows from its own distance against the whole scene.
    Levels(levels::Args),
    /// Planned against measured bytes, and quality, across memory budgets.
    Memory(memory::Args),
    /// The field's methods beside ours, on the same pictures, poses, steps, Gaussians, memory and seed.
    Methods(methods::Args),
    /// A scene larger than device and host: trained out of a file and into one, drawn, and compared with an unpaged rendering.
    Scene(scene::Args),
    /// Every skip off and on: work avoided, seconds saved, error added.
    Skips(skips::Args),
    /// Numbers that broke other renderers: the promise, the outcome, what was counted.
    Stress(stress::Args),
    /// Seconds from the first picture against held-out error, and the Pareto front.
    TimeError(time_error::Args),
}

/// Where the first Gaussians come from, as `dgtr train --init` takes it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Init {
    FeedForward,
    Sfm,
    Random,
}

impl Init {
    fn flag(self) -> String {
        self.to_possible_value().map_or_else(String::new, |v| v.get_name().to_owned())
    }
}

/// Runs `dgtr bench`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    match args.command {
        Command::Stages(args) => stages::run(args),
        Command::Map(args) => map::run(args),
        Command::Detail(args) => detail::run(args),
        Command::Device(args) => device::run(args),
        Command::Forecast(args) => forecast::run(args),
        Command::Ground(args) => ground::run(args),
        Command::Levels(args) => levels::run(args),
        Command::Memory(args) => memory::run(args),
        Command::Methods(args) => methods::run(args),
        Command::Scene(args) => scene::run(args),
        Command::Skips(args) => skips::run(args),
        Command::Stress(args) => stress::run(args),
        Command::TimeError(args) => time_error::run(args),
    }
}
