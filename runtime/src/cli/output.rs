//! Results on standard output. Whoever reads them may have enough (`dgtr plan | head`): the rest is then for nobody, and no error. What
//! cannot be written for another reason is one, once the command has done its work.

use std::fmt::{Arguments, Write as _};
use std::io::{Error, ErrorKind, Write as _};
use std::sync::OnceLock;

use super::CliError;

/// Why nothing is written any more.
static FAILED: OnceLock<Error> = OnceLock::new();

/// As `print!`, and a closed pipe is no panic.
#[macro_export]
macro_rules! out {
    ($($text:tt)*) => { $crate::cli::output::write(format_args!($($text)*)) };
}

/// As `println!`, and a closed pipe is no panic.
#[macro_export]
macro_rules! outln {
    ($($text:tt)*) => { $crate::cli::output::write(format_args!("{}\n", format_args!($($text)*))) };
}

pub use {out, outln};

/// Writes `text` to standard output, unless that failed before. What names within it would make a terminal do is written out. Line ends
/// are left: who prints a name that may hold one calls [`disk::escaped`].
pub fn write(text: Arguments<'_>) {
    let mut safe = String::new();
    // Writing into a String cannot fail.
    let _ = disk::Escaping::new(&mut safe, |c| c.is_control() && !matches!(c, '\n' | '\t')).write_fmt(text);
    if FAILED.get().is_none()
        && let Err(e) = std::io::stdout().lock().write_all(safe.as_bytes())
    {
        _ = FAILED.set(e);
    }
}

/// Whether all of it was written, or nobody wanted it.
///
/// # Errors
/// Standard output is a file on a full disk, say.
pub(super) fn arrived() -> Result<(), CliError> {
    let flushed = std::io::stdout().lock().flush();
    match FAILED.get().or(flushed.as_ref().err()) {
        Some(e) if e.kind() != ErrorKind::BrokenPipe => {
            Err(CliError::failed(format!("standard output: {}", disk::told(e))))
        }
        _ => Ok(()),
    }
}
