//! `dgtr demo`: the whole system on one machine with nothing attached. Two simulated aircraft, each an autopilot on its
//! own pseudo-terminal and a camera over a ray-cast world; two onboard jobs; one ground station. Every part is a process
//! of its own, under a memory limit, exactly as it would run in the field.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use config::error::{Error, ErrorKind};
use disk::Disk;
use vulkan::gpu::Gpu;

mod evaluate;
mod mission;
mod processes;
mod summary;

pub use evaluate::Figures;
pub use summary::Summary;

use job::interrupt::Interrupt;
use processes::Process;
use tuning::kernels;
use uplink::keys::{self, GROUND};

/// What the command line may change.
#[derive(Clone, Debug)]
pub struct DemoOptions {
    /// Output folder.
    pub out: PathBuf,
    /// Seconds of training per aircraft after landing.
    pub seconds: f64,
    /// Seed of world, flights and training.
    pub seed: u64,
    /// Bound on each process's writable memory, MiB.
    pub limit_mib: u64,
    /// Seconds of flight per second of wall clock.
    pub speed: f64,
    /// Where the ground serves its live page; the aircraft serve theirs on the ports behind it (any free ones for port 0).
    pub http: Option<SocketAddr>,
}

/// Why the demo failed.
#[derive(Debug, thiserror::Error)]
pub enum DemoError {
    /// A file or folder.
    #[error("{}: {}", path.display(), disk::told(source))]
    Io {
        /// Where.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// A child process could not be started or failed.
    #[error("{name} {what}; its log is {}", log.display())]
    Process {
        /// Which one.
        name: String,
        /// What happened.
        what: String,
        /// Its log.
        log: PathBuf,
    },
    /// A process ended with code 3: device or driver missing.
    #[error("{0}")]
    Device(String),
    /// The report could not be written, or figures could not be read.
    #[error("{0}")]
    Report(String),
    /// Ctrl-C.
    #[error("interrupted; what was saved is in {}", .0.display())]
    Interrupted(PathBuf),
}

impl Error for DemoError {
    fn kind(&self) -> ErrorKind {
        match self {
            Self::Io { source, .. } => Error::kind(source),
            Self::Process { .. } | Self::Report(_) => ErrorKind::Failed,
            Self::Device(_) => ErrorKind::Device,
            Self::Interrupted(_) => ErrorKind::Interrupted,
        }
    }
}

/// The two aircraft.
pub(crate) const AIRCRAFT: [&str; 2] = ["west", "east"];

/// How long a simulator may take to open its port.
const PORT_PATIENCE: Duration = Duration::from_secs(30);

fn io(path: &Path) -> impl FnOnce(std::io::Error) -> DemoError {
    let path = path.to_path_buf();
    move |source| DemoError::Io { path, source }
}

/// Runs the demo to its end.
///
/// # Errors
/// The first process that fails, with the last line of its log.
pub fn run(options: &DemoOptions, interrupt: &Interrupt) -> Result<Summary, DemoError> {
    let started = Instant::now();
    // Links of ports must be absolute; a folder of an earlier demo is begun afresh.
    std::fs::create_dir_all(&options.out).map_err(io(&options.out))?;
    let out = options.out.canonicalize().map_err(io(&options.out))?;
    for name in AIRCRAFT.into_iter().chain([GROUND, "keys"]) {
        let folder = out.join(name);
        if folder.is_dir() {
            std::fs::remove_dir_all(&folder).map_err(io(&folder))?;
        }
        std::fs::create_dir_all(&folder).map_err(io(&folder))?;
    }
    let mission = out.join("mission.toml");
    let key = |id: &str| keys::make(&out.join("keys"), id).map(|k| k.0).map_err(|e| DemoError::Report(e.to_string()));
    let [west, east] = AIRCRAFT;
    let text = mission::text(options, [key(GROUND)?, key(west)?, key(east)?]);
    let written = Disk::default().replace(&mission, |file| file.write_all(text.as_bytes()));
    written.map_err(|e| io(&mission)(e.into()))?;

    // Once, and before anything else is at work; the jobs find the result. Without a device they say so themselves.
    if let Ok(gpu) = Gpu::open(None) {
        kernels::config_of(&gpu);
    }
    let spawn = |name: &str, arguments: &[&str]| Process::spawn(name, arguments, &out, options.limit_mib);
    let mission = mission.to_string_lossy().into_owned();
    let path = |a: &str, b: &str| out.join(a).join(b).to_string_lossy().into_owned();

    let spawn_shown = |name: &str, arguments: &[&str], i: u16| {
        let page = options.http.map(|at| SocketAddr::new(at.ip(), port_behind(at.port(), i)).to_string());
        let page = page.as_deref().map_or(vec![], |at| vec!["--http", at]);
        spawn(name, &[arguments, &page].concat())
    };
    let ground = spawn_shown("ground", &["serve", "--mission", &mission, "--out", &path("ground", "out")], 0)?;
    let mut simulators = Vec::new();
    let mut jobs = Vec::new();
    let speed = options.speed.to_string();
    for (i, a) in (1..).zip(AIRCRAFT) {
        let port = out.join(a).join("port");
        let link = format!("pty:{}", port.display());
        let (camera, truth) = (path(a, "camera"), path(a, "truth"));
        simulators.push(spawn(
            &format!("{a}-aircraft"),
            &[
                "sim",
                "--mission",
                &mission,
                "--aircraft",
                a,
                "--link",
                &link,
                "--camera-dir",
                &camera,
                "--reference",
                &truth,
                "--speed",
                &speed,
                "--forward-overlap",
                "0.7",
                "--side-overlap",
                "0.5",
                "--linger",
                "3",
            ],
        )?);
        wait_for(&port, interrupt, &out)?;
        let out = path(a, "out");
        jobs.push(spawn_shown(
            a,
            &["fly", "--mission", &mission, "--aircraft", a, "--out", &out, "--silence", "10"],
            i,
        )?);
    }
    let mut processes: Vec<Process> = jobs.into_iter().chain(simulators).chain([ground]).collect();
    processes::wait_all(&mut processes, interrupt, &out)?;
    let flown_s = started.elapsed().as_secs_f64();

    let figures = evaluate::all(&out, options, interrupt)?;
    let summary = summary::write(&out, options, &figures, &processes, flown_s, started)?;
    Ok(summary)
}

/// The port `i` behind `port`; any free one for 0.
fn port_behind(port: u16, i: u16) -> u16 {
    if port == 0 { 0 } else { port.saturating_add(i) }
}

fn wait_for(port: &Path, interrupt: &Interrupt, out: &Path) -> Result<(), DemoError> {
    let until = Instant::now() + PORT_PATIENCE;
    while !port.exists() {
        if interrupt.requested() {
            return Err(DemoError::Interrupted(out.into()));
        }
        if Instant::now() > until {
            return Err(DemoError::Report(format!("{} did not appear within {PORT_PATIENCE:?}", port.display())));
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    Ok(())
}
