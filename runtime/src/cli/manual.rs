//! `dgtr manual --out DIR`: manual pages and shell completions of what the command line defines, for the packages.

use std::io;
use std::path::{Path, PathBuf};

use clap::Command;
use clap_complete::Shell;

use super::CliError;

/// Arguments of `dgtr manual`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Folder for `dgtr.1`, a page per subcommand, and the completions of bash, zsh and fish.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Only what is in the onboard program.
    #[arg(long)]
    onboard: bool,
}

/// Writes the manual of `program`; `is_lab` says which subcommands do not fly.
///
/// # Errors
/// The folder cannot be written to.
pub fn run(args: Args, program: Command, is_lab: impl Fn(&str) -> bool) -> Result<(), CliError> {
    let program = with_subcommands(&program, |c| !(c.is_hide_set() || args.onboard && is_lab(c.get_name())));
    write(&args.out, program).map_err(|e| CliError::input(format!("{}: {}", args.out.display(), disk::told(&e))))
}

/// `program` with some of its subcommands: clap hides them from the help only, not from completions.
fn with_subcommands(program: &Command, keep: impl Fn(&Command) -> bool) -> Command {
    let some = Command::new("dgtr")
        .version(env!("CARGO_PKG_VERSION"))
        .args(program.get_arguments().cloned())
        .subcommands(program.get_subcommands().filter(|c| keep(c)).cloned())
        .subcommand_required(true);
    some.about(program.get_about().cloned().unwrap_or_default())
        .after_help(program.get_after_help().cloned().unwrap_or_default())
}

fn write(out: &Path, mut program: Command) -> io::Result<()> {
    std::fs::create_dir_all(out)?;
    // Before the completions, which add a `help` to every command that the pages would describe.
    clap_mangen::generate_to(program.clone(), out)?;
    for shell in [Shell::Bash, Shell::Zsh, Shell::Fish] {
        clap_complete::generate_to(shell, &mut program, "dgtr", out)?;
    }
    Ok(())
}
