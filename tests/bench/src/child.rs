//! `dgtr` as a process of its own: this program once more, which understands what `dgtr` does behind the word [`PROGRAM`].

use std::path::Path;

use runtime::child::Ended;
use runtime::error::JobError;

/// What `dgtr`'s arguments stand behind.
pub const PROGRAM: &str = "dgtr";

/// Runs `dgtr ARGUMENTS --out OUT` to its end.
///
/// # Errors
/// The child cannot be started, found no device, or was interrupted.
pub fn run(arguments: &[String], out: &Path, limit_mib: Option<u64>) -> Result<Ended, JobError> {
    runtime::child::run(&[PROGRAM], arguments, out, limit_mib)
}
