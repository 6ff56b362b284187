//! Children of the demo: the same program, each with its own log and memory limit, and ended together.

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use job::interrupt::Interrupt;
use rustix::process::{Pid, Signal, kill_process};

use super::{DemoError, io};

/// After one part failed or Ctrl-C, the others may still save for this long.
const GRACE: Duration = Duration::from_secs(15);

/// One child.
pub struct Process {
    pub name: String,
    log: PathBuf,
    child: Child,
    reader: Option<JoinHandle<String>>,
    started: Instant,
    /// Seconds it ran, once it ended.
    pub seconds: Option<f64>,
}

impl Process {
    /// Starts `dgtr ARGUMENTS`, its standard error into `out/NAME.log` and, line by line, to ours.
    ///
    /// # Errors
    /// The program cannot be started or its log not be written.
    pub fn spawn(name: &str, arguments: &[&str], out: &Path, limit_mib: u64) -> Result<Self, DemoError> {
        let log = out.join(format!("{name}.log"));
        let failed = |e: std::io::Error| DemoError::Process {
            name: name.into(),
            what: format!("could not be started: {e}"),
            log: log.clone(),
        };
        let program = std::env::current_exe().map_err(failed)?;
        let mut child = Command::new(program)
            .arg("--limit-mib")
            .arg(limit_mib.to_string())
            .args(arguments)
            .current_dir(out)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .map_err(failed)?;
        let mut file = disk::regular::create(&log).map_err(io(&log))?;
        let lines = child.stderr.take().map(BufReader::new);
        let tag = name.to_owned();
        let reader = std::thread::spawn(move || {
            let mut last = String::new();
            for line in lines.into_iter().flat_map(BufRead::lines).map_while(Result::ok) {
                // A full disk must not stop the child: it would block on its pipe.
                let _ = writeln!(file, "{line}");
                tracing::info!("{tag:>13} | {}", line.trim_start());
                last = line;
            }
            last
        });
        let (name, started) = (name.into(), Instant::now());
        Ok(Self { name, log, child, reader: Some(reader), started, seconds: None })
    }

    /// Whether it ended well; None while it runs.
    fn poll(&mut self) -> Result<Option<bool>, DemoError> {
        let status = match self.child.try_wait() {
            Ok(None) => return Ok(None),
            Ok(Some(status)) => status,
            Err(e) => return Err(self.failed(&format!("cannot be waited for: {e}"))),
        };
        let last = self.reader.take().and_then(|r| r.join().ok());
        if self.seconds.is_none() {
            self.seconds = Some(self.started.elapsed().as_secs_f64());
        }
        if status.success() {
            return Ok(Some(true));
        }
        let last = last.unwrap_or_default();
        if status.code() == Some(3) {
            return Err(DemoError::Device(last.trim_start_matches("dgtr: ").into()));
        }
        Err(self.failed(&format!("failed ({status}): {}", last.trim_start_matches("dgtr: "))))
    }

    fn failed(&self, what: &str) -> DemoError {
        DemoError::Process { name: self.name.clone(), what: what.into(), log: self.log.clone() }
    }

    fn ask_to_end(&self) {
        if let Some(pid) = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw) {
            // It may have ended on its own in between.
            let _ = kill_process(pid, Signal::INT);
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        if self.seconds.is_none() {
            let _ = self.child.kill();
            let _ = self.child.wait();
        }
    }
}

/// Waits until all have ended well.
///
/// # Errors
/// The first failure, after the others were asked to end; Ctrl-C likewise.
pub fn wait_all(processes: &mut [Process], interrupt: &Interrupt, out: &Path) -> Result<(), DemoError> {
    let mut first_error = None;
    let mut deadline: Option<Instant> = None;
    loop {
        let mut running = 0;
        for p in processes.iter_mut().filter(|p| p.seconds.is_none()) {
            match p.poll() {
                Ok(None) => running += 1,
                Ok(Some(_)) => {}
                Err(e) => {
                    first_error.get_or_insert(e);
                }
            }
        }
        if running == 0 {
            return match first_error {
                Some(e) => Err(e),
                None => Ok(()),
            };
        }
        if interrupt.requested() {
            first_error = Some(DemoError::Interrupted(out.into()));
        }
        if first_error.is_some() && deadline.is_none() {
            processes.iter().filter(|p| p.seconds.is_none()).for_each(Process::ask_to_end);
            deadline = Some(Instant::now() + GRACE);
        }
        if deadline.is_some_and(|d| Instant::now() > d) {
            // Dropping them ends them.
            return Err(first_error.unwrap_or_else(|| DemoError::Interrupted(out.into())));
        }
        std::thread::sleep(Duration::from_millis(50));
    }
}
