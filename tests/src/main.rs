//! `dgtr`, as the tests of the whole run it.

fn main() -> std::process::ExitCode {
    runtime::cli::main(std::env::args_os())
}
