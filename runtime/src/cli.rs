//! The command line: one file per command, one error type, and the exit codes that scripts may rely on.

use std::ffi::OsString;
use std::process::ExitCode;

use clap::{CommandFactory, FromArgMatches, Parser, Subcommand};
use config::error::ErrorKind;

use job::console;
use job::trace::Trace;

mod aggregate;
mod change;
#[cfg(feature = "lab")]
mod demo;
mod doctor;
mod ending;
mod error;
mod eval;
pub mod examples;
mod export;
mod fly;
mod ground;
mod http;
mod import;
mod init;
mod keys;
#[cfg(feature = "lab")]
mod manual;
mod ortho;
pub mod output;
mod plan;
mod render;
#[cfg(feature = "lab")]
mod replay;
mod serve;
#[cfg(feature = "lab")]
mod sim;
mod survey;
mod train;
mod volume;

pub use error::CliError;
use error::{EXIT_CODES, exit_code};

/// Heading of what every command takes.
const GLOBAL: &str = "Global options";

/// Posed aerial pictures to 3D Gaussian Splatting on board, merged on the ground.
#[derive(Debug, Parser)]
#[command(
    name = "dgtr",
    version,
    about = "Posed aerial pictures to 3D Gaussian Splatting on board, merged on the ground"
)]
#[command(subcommand_required = true, arg_required_else_help = true)]
#[command(after_help = notes())]
struct Cli {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    options: Options,
}

/// What every command takes.
#[derive(Debug, clap::Args)]
pub struct Options {
    /// Write more log lines: -v what each stage does, -vv everything; RUST_LOG overrides.
    #[arg(short, long, global = true, help_heading = GLOBAL, action = clap::ArgAction::Count)]
    verbose: u8,
    /// Most memory that this process may write to, MiB (RLIMIT_DATA).
    #[arg(long, global = true, value_name = "MIB", help_heading = GLOBAL)]
    limit_mib: Option<u64>,
    // Not global: `train --log` is a flight's log.
    /// How log lines and errors are written: text for people, json one object a line. Given before the command.
    #[arg(long = "log", value_name = "FORMAT", value_enum, default_value_t = console::Format::Text)]
    log_format: console::Format,
    /// Write a trace of all stages, with the device's own times, for ui.perfetto.dev; it times every step.
    #[arg(long, global = true, value_name = "FILE", help_heading = GLOBAL)]
    trace: Option<std::path::PathBuf>,
    /// Write warnings and errors only, and no progress.
    #[arg(short, long, global = true, conflicts_with = "verbose", help_heading = GLOBAL)]
    quiet: bool,
}

/// What `--help` ends with.
pub fn notes() -> String {
    let codes: Vec<String> = EXIT_CODES.iter().map(|(_, code, meaning)| format!("{code} {meaning}")).collect();
    format!(
        "Exit codes: 0 done, {}.\n\nDGTR_KERNELS=auto|default|processor|board|card: kernel configuration. auto measures it once per \
         hardware device and driver (dgtr doctor shows it); default and the three profiles measure nothing. Models do not \
         depend on it.\nDGTR_PROCESSOR=native|driver: whose kernels run where the device is the processor, the program's own or \
         those of Mesa's software driver. Models differ by rounding.\n\
         LP_NUM_THREADS=N: threads by which a processor computes; one for each core where it is not set.",
        codes.join(", ")
    )
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Trains a model from a folder of posed pictures.
    Train(Box<train::Args>),
    /// Scores a model on held-out pictures.
    Eval(eval::Args),
    /// Renders colour and depth of given cameras.
    Render(render::Args),
    /// Draws a model as a map: orthophoto and heights as Cloud-Optimised GeoTIFF.
    Ortho(ortho::Args),
    /// Measures how much lies above and below the ground of polygons: cut, fill and net, each with its standard deviation.
    Volume(volume::Args),
    /// Finds what changed between two maps of one place: where, how high, how much.
    Change(change::Args),
    /// Merges local models into a global one.
    Aggregate(aggregate::Args),
    /// Merging as jobs that many machines share: plan, cells, join.
    Ground(ground::Args),
    /// Receives the models of all aircraft of a mission and merges them.
    Serve(serve::Args),
    /// The onboard job: from MAVLink and pictures to a model, while flying.
    Fly(fly::Args),
    /// Writes a model in a format that other programs read.
    Export(export::Args),
    /// Makes a model of another program's file.
    Import(import::Args),
    /// Makes the keys of aircraft and ground, and prints the public ones for the mission file.
    Keys(keys::Args),
    /// Writes a mission file to start from, asking for what is not given, or prints the reference of all settings.
    Init(init::Args),
    /// Deals an area to a fleet: regions of equal flight time, a mission, plans of all flights.
    Survey(survey::Args),
    /// Prints what a memory budget holds, section by section.
    Plan(plan::Args),
    /// Checks device, driver, ONNX Runtime, ports: what is there, what is missing, how to mend it.
    Doctor(doctor::Args),
    #[cfg(feature = "lab")]
    #[command(flatten)]
    Lab(Lab),
}

/// What does not fly.
#[cfg(feature = "lab")]
#[derive(Debug, Subcommand)]
enum Lab {
    /// The whole system with nothing attached.
    Demo(demo::Args),
    /// Recorded pictures or a recorded log as a living aircraft.
    Replay(replay::Args),
    /// A simulated aircraft over a ray-cast world.
    Sim(sim::Args),
    /// Writes manual pages and shell completions.
    #[command(hide = true)]
    Manual(manual::Args),
}

/// All that the command line knows.
fn program() -> clap::Command {
    examples::with_examples(Cli::command(), examples::EXAMPLES)
}

/// What is asked, and an `--out` that no folder of this machine has.
fn parse(arguments: impl IntoIterator<Item = OsString>) -> Result<(Cli, Option<String>), clap::Error> {
    let mut matches = program().try_get_matches_from(arguments)?;
    let address = address_to_write(&matches);
    let cli = Cli::from_arg_matches_mut(&mut matches).map_err(|e| e.format(&mut program()))?;
    Ok((cli, address))
}

/// An `--out` such as s3://bucket/field, which would become a folder named `s3:`.
fn address_to_write(matches: &clap::ArgMatches) -> Option<String> {
    let (_, of) = matches.subcommand()?;
    let mut given = of.try_get_raw("out").ok().flatten().into_iter().flatten().map(|out| out.to_string_lossy());
    let is_address = |out: &std::borrow::Cow<'_, str>| {
        out.split_once("://").is_some_and(|(scheme, _)| {
            !scheme.is_empty() && scheme.chars().all(|c| c.is_ascii_alphanumeric() || "+.-".contains(c))
        })
    };
    given.find(is_address).map(|out| out.into_owned()).or_else(|| address_to_write(of))
}

/// Parses `arguments` (the first is the program's name), runs the command and says how it went: results on standard
/// output, everything else on standard error.
pub fn main(arguments: impl IntoIterator<Item = OsString>) -> ExitCode {
    match parse(arguments) {
        Ok((cli, Some(address))) => run(&cli.options, || {
            let why = "is an address, and results are written to this machine; give a path";
            Err(CliError::input(format!("--out {address}: {why}")))
        }),
        Ok((cli, None)) => run(&cli.options, || command(cli.command)),
        Err(e) => not_understood(&e),
    }
}

/// Prints why a command line was not understood, or the help that was asked for.
pub fn not_understood(e: &clap::Error) -> ExitCode {
    // A closed pipe is no reason to fail.
    let _ = e.print();
    if e.use_stderr() { exit_code(ErrorKind::Input) } else { ExitCode::SUCCESS }
}

/// Does `job` as `options` say; its error is one line on standard error and the exit code.
pub fn run(options: &Options, job: impl FnOnce() -> Result<(), CliError>) -> ExitCode {
    let trace = match options.trace.as_deref().map(Trace::create).transpose() {
        Ok(trace) => trace,
        Err(e) => {
            console::install(options.verbose, options.quiet, options.log_format, None);
            return failed(&e.into());
        }
    };
    console::install(options.verbose, options.quiet, options.log_format, trace.clone());
    if let Some(mib) = options.limit_mib
        && let Err(e) = job::resources::limit_data(mib)
    {
        console::error(&format!("--limit-mib {mib}: {e}"));
        return exit_code(ErrorKind::Input);
    }
    if let Err(e) = job::resources::survive_file_size_limit() {
        tracing::debug!("SIGXFSZ: {e}");
    }
    let result = job();
    if let Some(trace) = trace {
        trace.finish();
    }
    match result.and_then(|()| output::arrived()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => failed(&e),
    }
}

fn command(command: Command) -> Result<(), CliError> {
    match command {
        Command::Train(args) => train::run(*args),
        Command::Eval(args) => eval::run(args),
        Command::Render(args) => render::run(args),
        Command::Ortho(args) => ortho::run(args),
        Command::Volume(args) => volume::run(args),
        Command::Change(args) => change::run(args),
        Command::Aggregate(args) => aggregate::run(args),
        Command::Ground(args) => ground::run(args),
        Command::Serve(args) => serve::run(args),
        Command::Fly(args) => fly::run(args),
        Command::Export(args) => export::run(args),
        Command::Import(args) => import::run(args),
        Command::Keys(args) => keys::run(args),
        Command::Init(args) => init::run(args),
        Command::Survey(args) => survey::run(args),
        Command::Plan(args) => plan::run(args),
        Command::Doctor(args) => doctor::run(args),
        #[cfg(feature = "lab")]
        Command::Lab(Lab::Sim(args)) => sim::run(args),
        #[cfg(feature = "lab")]
        Command::Lab(Lab::Replay(args)) => replay::run(args),
        #[cfg(feature = "lab")]
        Command::Lab(Lab::Demo(args)) => demo::run(args),
        #[cfg(feature = "lab")]
        Command::Lab(Lab::Manual(args)) => manual::run(args, program(), Lab::has_subcommand),
    }
}

fn failed(e: &CliError) -> ExitCode {
    console::error(&e.to_string());
    e.exit_code()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every command that is shown, by its path, with its help.
    fn shown(command: &clap::Command, path: &str) -> Vec<(String, String)> {
        let commands = command.get_subcommands().filter(|c| !c.is_hide_set());
        let of = |c: &clap::Command| {
            let path = format!("{path} {}", c.get_name()).trim_start().to_owned();
            let mut all = shown(c, &path);
            if all.is_empty() {
                all.push((path, c.clone().render_long_help().to_string()));
            }
            all
        };
        commands.flat_map(of).collect()
    }

    #[test]
    fn every_commands_help_ends_with_examples_that_are_understood() {
        let all = shown(&program(), "");
        assert!(all.len() > 12, "{all:?}");
        for (path, help) in &all {
            let (_, examples) = help.rsplit_once("Example").unwrap_or_else(|| panic!("{path} has no example: {help}"));
            let calls: Vec<&str> = examples.lines().skip(1).map(str::trim).filter(|line| !line.is_empty()).collect();
            assert!((1..=2).contains(&calls.len()), "{path}: {calls:?}");
            for call in calls {
                assert!(call.starts_with(&format!("dgtr {path}")), "{path}: {call}");
                if let Err(e) = parse(call.split_whitespace().map(OsString::from)) {
                    panic!("{call}: {e}");
                }
            }
        }
        // And no example belongs to a command that is not there (any more).
        #[cfg(feature = "lab")]
        assert_eq!(all.len(), examples::EXAMPLES.len());
    }
}
