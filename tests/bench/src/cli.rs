//! `bench …`: one subcommand per question; results as Markdown on standard output, JSON and CSV on request.

mod detail;
mod examples;
mod forecast;
mod ground;
mod levels;
mod map;
mod memory;
mod methods;
mod poses;
mod recipe;
mod scene;
mod skips;
mod sparse;
mod stages;
mod stress;
mod time_error;

use std::ffi::OsString;
use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand, ValueEnum};
use runtime::cli::examples::with_examples;
use runtime::cli::{CliError, Options};

use crate::child::PROGRAM;
use examples::EXAMPLES;

/// Measures run time, memory, error, skips and numerical promises of dgtr.
#[derive(Debug, Parser)]
#[command(name = "bench", version, about = "Measures run time, memory, error, skips and numerical promises of dgtr")]
#[command(subcommand_required = true, arg_required_else_help = true)]
#[command(after_help = runtime::cli::notes())]
struct Cli {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    options: Options,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Milliseconds, bytes and operations per stage, against what the device can do.
    Stages(stages::Args),
    /// Orthophoto and heights of a simulated survey against the exact ones.
    Map(map::Args),
    /// What crops of pictures larger than the plan holds are worth at their full size.
    Detail(detail::Args),
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
    /// Cards settled as `dgtr train` settles them: tied pictures, seconds, errors against a reference and stated positions.
    Poses(poses::Args),
    /// A scene larger than device and host: trained out of a file and into one, drawn, and compared with an unpaged rendering.
    Scene(scene::Args),
    /// Every skip off and on: work avoided, seconds saved, error added.
    Skips(skips::Args),
    /// What few pictures cost: every 2nd, 3rd, 5th training picture, scored on the same held-out ones.
    Sparse(sparse::Args),
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

fn program() -> clap::Command {
    with_examples(Cli::command(), EXAMPLES)
}

fn parse(arguments: impl IntoIterator<Item = OsString>) -> Result<Cli, clap::Error> {
    let mut matches = program().try_get_matches_from(arguments)?;
    Cli::from_arg_matches_mut(&mut matches).map_err(|e| e.format(&mut program()))
}

/// Parses `arguments` (the first is the program's name), measures and says how it went. Behind the word `dgtr` it is `dgtr` that is
/// called: what is measured in a process of its own is the same program.
pub fn main(arguments: impl IntoIterator<Item = OsString>) -> ExitCode {
    let arguments: Vec<OsString> = arguments.into_iter().collect();
    if arguments.get(1).is_some_and(|word| word == PROGRAM) {
        return runtime::cli::main(arguments.into_iter().skip(1));
    }
    match parse(arguments) {
        Ok(cli) => runtime::cli::run(&cli.options, || measure(cli.command)),
        Err(e) => runtime::cli::not_understood(&e),
    }
}

fn measure(command: Command) -> Result<(), CliError> {
    match command {
        Command::Stages(args) => stages::run(args),
        Command::Map(args) => map::run(args),
        Command::Detail(args) => detail::run(args),
        Command::Forecast(args) => forecast::run(args),
        Command::Ground(args) => ground::run(args),
        Command::Levels(args) => levels::run(args),
        Command::Memory(args) => memory::run(args),
        Command::Methods(args) => methods::run(args),
        Command::Poses(args) => poses::run(args),
        Command::Scene(args) => scene::run(args),
        Command::Skips(args) => skips::run(args),
        Command::Sparse(args) => sparse::run(args),
        Command::Stress(args) => stress::run(args),
        Command::TimeError(args) => time_error::run(args),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_measurements_help_ends_with_examples_that_are_understood() {
        let program = program();
        let all: Vec<_> = program.get_subcommands().filter(|c| c.get_name() != "help").collect();
        assert_eq!(all.len(), EXAMPLES.len(), "no example belongs to a measurement that is not there");
        for command in all {
            let (name, help) = (command.get_name(), command.clone().render_long_help().to_string());
            let (_, examples) = help.rsplit_once("Example").unwrap_or_else(|| panic!("{name} has no example: {help}"));
            for call in examples.lines().skip(1).map(str::trim).filter(|line| !line.is_empty()) {
                let words = call.strip_prefix("cargo run --release -p bench -- ").unwrap_or_else(|| panic!("{call}"));
                assert!(words.starts_with(name), "{name}: {call}");
                let called = ["bench"].into_iter().chain(words.split_whitespace()).map(OsString::from);
                parse(called).unwrap_or_else(|e| panic!("{call}: {e}"));
            }
        }
    }
}
