//! The `bench` program. Everything it does lives in the library, so that its tests can call it.

use std::process::ExitCode;

fn main() -> ExitCode {
    bench::cli::main(std::env::args_os())
}
