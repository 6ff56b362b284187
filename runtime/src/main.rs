//! The `dgtr` program. Everything it does lives in the library, so that tests and other programs can call it.

use std::process::ExitCode;

fn main() -> ExitCode {
    runtime::cli::main(std::env::args_os())
}
