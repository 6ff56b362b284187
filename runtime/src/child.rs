//! One measurement, one process: its peak memory and its seconds are then its own, and a limit can be put on it.

use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Instant;

use config::error::ErrorKind;
use job::run_json::RunReport;

use crate::error::JobError;

/// How a child ended.
#[derive(Clone, Debug)]
pub struct Ended {
    /// Its report; none when it failed.
    pub report: Option<RunReport>,
    /// The last line it said but for notes, without the program's name.
    pub last_line: String,
    /// Seconds from its start to its end.
    pub seconds: f64,
}

impl Ended {
    /// The report of the child called `name`.
    ///
    /// # Errors
    /// It failed.
    pub fn report(self, name: &str) -> Result<RunReport, JobError> {
        let failed = || JobError::Child { kind: ErrorKind::Failed, line: format!("{name}: {}", self.last_line) };
        self.report.ok_or_else(failed)
    }
}

/// Runs `dgtr ARGUMENTS --out OUT` to its end, its standard error in `OUT/log.txt`. The child is this program, called with
/// `before` in front of what `dgtr` understands. A child that fails is a result, too;
/// its exit code 3 (no device) and a request to stop are not.
///
/// # Errors
/// The child cannot be started, found no device, or was interrupted.
pub fn run(before: &[&str], arguments: &[String], out: &Path, limit_mib: Option<u64>) -> Result<Ended, JobError> {
    let failed = |source| JobError::Io { path: out.into(), source };
    std::fs::create_dir_all(out).map_err(failed)?;
    let log = out.join("log.txt");
    let mut command = Command::new(std::env::current_exe().map_err(failed)?);
    command.args(before);
    if let Some(mib) = limit_mib {
        command.args(["--limit-mib", &mib.to_string()]);
    }
    command.args(arguments).arg("--out").arg(out);
    // An allocation beyond the bound ends the child with one line, and a note on how to get a trace.
    command.env("RUST_BACKTRACE", "0");
    command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(disk::regular::create(&log).map_err(failed)?);
    let start = Instant::now();
    let status = command.status().map_err(failed)?;
    let seconds = start.elapsed().as_secs_f64();
    let said = std::fs::read_to_string(&log).unwrap_or_default();
    let last_line =
        said.lines().rfind(|l| !l.starts_with("note: ")).unwrap_or_default().trim_start_matches("dgtr: ").to_owned();
    match status.code() {
        Some(0 | 5) => Ok(Ended { report: Some(RunReport::read(out)?), last_line, seconds }),
        Some(3) => Err(JobError::Child { kind: ErrorKind::Device, line: last_line }),
        Some(4) | Some(130) => {
            let line = "stopped on request; what was measured so far is kept".into();
            Err(JobError::Child { kind: ErrorKind::Interrupted, line })
        }
        _ => Ok(Ended { report: None, last_line, seconds }),
    }
}
