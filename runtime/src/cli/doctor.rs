//! `dgtr doctor`: what this machine has and lacks, one line each, with how to mend it.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use config::error::ErrorKind;
use config::kernels::{KernelChoice, VARIABLE};
use config::mission::Mission;
use config::plan::{Plan, PlanRequest};
use job::resources;
use models::onnx::network::{LazySession, Network};
use models::onnx::{OnnxError, features::FeatureNetwork, session};
use tuning::cost;
use tuning::devices;
use tuning::kernels::{self, Source};
use tuning::loads::{Footprint, Visibility};
use vulkan::gpu::{Gpu, GpuInfo};
use vulkan::trainer::{PlanFit, TrainError, check_device, check_plan};

use super::CliError;
use crate::cli::output::outln;

mod aircraft;
#[cfg(feature = "lab")]
mod report;
mod trust;

/// Arguments of `dgtr doctor`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Also check this network against its manifest, and run it once (may be given more than once).
    #[arg(long, value_name = "FILE")]
    pub model: Vec<PathBuf>,
    /// Also say what protects the deliveries of this mission, and listen on its links for ten seconds: who is heard, and what a flight lacks.
    #[arg(long, value_name = "FILE")]
    pub mission: Option<PathBuf>,
    /// Measure anew which kernel configuration is the fastest on each Vulkan device, and remember it. Hardware is measured
    /// at its first training anyway, software renderers only here.
    #[arg(long)]
    pub autotune: bool,
    #[cfg(feature = "lab")]
    #[command(flatten)]
    pub report: report::Args,
}

/// How a check came out. What is not well says how to mend it.
enum Finding {
    Ok(String),
    /// Some jobs run without it.
    Note(String),
    /// Jobs fail without it.
    Missing(String),
}

impl Finding {
    fn note(what: impl Display, mend: &str) -> Self {
        Self::Note(with_mend(what, mend))
    }

    fn missing(what: impl Display, mend: &str) -> Self {
        Self::Missing(with_mend(what, mend))
    }
}

/// `what` and how to mend it: its own words behind a semicolon, as errors have them, else `mend`.
fn with_mend(what: impl Display, mend: &str) -> String {
    let what = what.to_string();
    if what.contains("; ") { what } else { format!("{what}; {mend}") }
}

/// For what a driver does.
const DRIVER: &str = "update its driver, or name another device with --device";
/// For a network that ends with an error.
const NETWORK: &str = "export it anew as models/networks/EXPORT.md says";
const LIBRARY: &str = "install ONNX Runtime 1.22 or newer there, or point ORT_DYLIB_PATH at one";

/// Runs `dgtr doctor`; fails with exit code 3 when something is missing.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    #[cfg(feature = "lab")]
    if let Some(path) = &args.report.path {
        return report::run(path, &args.report);
    }
    let mut missing = 0;
    let mut tell = |what: &str, finding: Finding| {
        let (state, text) = match finding {
            Finding::Ok(t) => ("ok", t),
            Finding::Note(t) => ("note", t),
            Finding::Missing(t) => {
                missing += 1;
                ("missing", t)
            }
        };
        outln!("{state:<8} {what:<16} {}", text.split_whitespace().collect::<Vec<_>>().join(" "));
    };
    match Gpu::list() {
        Err(e) => tell("vulkan", Finding::missing(e, DRIVER)),
        Ok(found) => {
            if found.len() > 1 {
                tell("training", trains(&found, args.autotune));
            }
            for d in found {
                let (mib, subgroup) = (d.heap_bytes >> 20, d.subgroup_size);
                if d.has_driver() {
                    let kind = if d.is_cpu { "software" } else { "hardware" };
                    let (major, minor) = d.version;
                    let text =
                        format!("{} ({kind}, Vulkan {major}.{minor}, {mib} MiB, subgroups of {subgroup})", d.name);
                    tell("vulkan", Finding::Ok(text));
                    tell("kernels", kernel_config(&d, args.autotune));
                } else {
                    tell("processor", Finding::Ok(format!("{}, {mib} MiB", d.name)));
                }
                tell("a step", step_cost(&d, args.autotune));
                tell("device", computes(&d));
                tell("memory plan", takes_a_plan(&d));
            }
        }
    }
    match session::check_library() {
        Ok(library) => {
            tell("onnx runtime", Finding::Ok(library.display().to_string()));
            match FeatureNetwork::open(None, 1).and_then(|mut network| network.check()) {
                Ok(()) => tell("features", Finding::Ok("embedded XFeat runs".to_owned())),
                Err(e) => tell("features", Finding::missing(e, LIBRARY)),
            }
        }
        Err(e) => tell("onnx runtime", Finding::missing(e, LIBRARY)),
    }
    for path in &args.model {
        match checked(path) {
            Ok(text) => tell("network", Finding::Ok(text)),
            Err(e) => tell("network", Finding::missing(e, NETWORK)),
        }
    }
    if let Some(path) = &args.mission {
        let mission = Mission::read(path).map_err(CliError::input)?;
        for (what, finding) in trust::findings(&mission).into_iter().chain(aircraft::findings(&mission)) {
            tell(what, finding);
        }
    }
    for finding in serial_ports() {
        tell("serial port", finding);
    }
    tell(
        "pseudo terminal",
        match std::fs::OpenOptions::new().read(true).write(true).open("/dev/ptmx") {
            Ok(_) => Finding::Ok("/dev/ptmx opens (demo, sim and replay)".to_owned()),
            Err(e) => Finding::missing(format!("/dev/ptmx: {e}"), "mount devpts, or use udp: and tcp: links"),
        },
    );
    tell(
        "memory",
        match resources::available_bytes() {
            Some(bytes) if bytes < 512 << 20 => {
                Finding::note(format!("{} MiB available", bytes >> 20), "lower memory.device_mib")
            }
            Some(bytes) => Finding::Ok(format!("{} MiB available", bytes >> 20)),
            None => Finding::note("not known on this system", "mount /proc"),
        },
    );
    tell(
        "disk",
        match resources::free_disk_bytes(Path::new(".")) {
            Some(bytes) if bytes < 256 << 20 => {
                Finding::note(format!("{} MiB free here", bytes >> 20), "make room or lower keyframes.max (dgtr plan)")
            }
            Some(bytes) => Finding::Ok(format!("{} MiB free here", bytes >> 20)),
            None => Finding::note("free space is not known on this system", "bound it with memory.disk_mib"),
        },
    );
    match missing {
        0 => Ok(()),
        n => Err(CliError::new(
            ErrorKind::Device,
            format!("{n} of the checks above failed; each line says how to mend it"),
        )),
    }
}

/// A user's network, compared with its manifest and run once on blank pictures.
fn checked(manifest: &Path) -> Result<String, OnnxError> {
    let network = std::sync::Arc::new(Network::read(manifest)?);
    let mut session = LazySession::new(std::sync::Arc::clone(&network), 1);
    session.check((640, 480))?;
    let (name, contract) = (&network.manifest().name, network.manifest().contract.name());
    Ok(format!("{name} follows contract `{contract}` and runs ({} bytes)", network.file_bytes()))
}

/// Whether a kernel computes on the device what its reference says.
fn computes(info: &GpuInfo) -> Finding {
    match Gpu::open(Some(&info.name)).map_err(TrainError::from).and_then(|gpu| check_device(&gpu)) {
        Ok(agreed) => Finding::Ok(format!("{}: a kernel and its reference agree on {agreed} Gaussians", info.name)),
        Err(e) => Finding::missing(format!("{}: {e}", info.name), DRIVER),
    }
}

/// Whether the device takes the plan that `dgtr plan` makes by default.
fn takes_a_plan(info: &GpuInfo) -> Finding {
    let request = PlanRequest { lanes: info.lanes(), ..PlanRequest::default() };
    let plan = match Plan::new(&request) {
        Ok(plan) => plan,
        Err(e) => return Finding::missing(e, "lower memory.device_mib"),
    };
    let what = format!("{}: {} MiB, {} Gaussians", info.name, request.device_mib, plan.gaussians);
    match Gpu::open(Some(&info.name)).and_then(|gpu| check_plan(&gpu, &plan)) {
        Ok(PlanFit::Whole) => Finding::Ok(format!("{what} fit")),
        Ok(PlanFit::StorageReads) => Finding::note(
            format!("{what} fit, read from storage buffers (slower): few texels"),
            "lower memory.max_gaussians",
        ),
        Err(e) => Finding::missing(format!("{what}: {e}"), "lower memory.device_mib"),
    }
}

/// Which of several devices trains, and why.
fn trains(found: &[GpuInfo], autotune: bool) -> Finding {
    let steps: Vec<Option<f64>> = found.iter().map(if autotune { devices::measured } else { devices::known }).collect();
    let chosen = &found[devices::fastest(found, &steps)].name;
    if steps.contains(&None) {
        let what = format!("on {chosen} until the first job measures a step of each");
        return Finding::note(what, "dgtr doctor --autotune measures it now");
    }
    let each = found.iter().zip(&steps).map(|(d, ms)| format!("{} {:.1} ms", d.name, ms.unwrap_or(f64::INFINITY)));
    Finding::Ok(format!("on {chosen} (a step: {}; --device names another)", each.collect::<Vec<_>>().join(", ")))
}

/// Which kernel configuration is in use on a device, and why.
fn kernel_config(info: &GpuInfo, autotune: bool) -> Finding {
    let measured = match autotune {
        true => Gpu::open(Some(&info.name)).ok().and_then(|gpu| kernels::measure(&gpu)),
        false => None,
    };
    if autotune && measured.is_none() {
        return Finding::note(
            "not measured, the default configuration is used",
            "try again with nothing else on the device",
        );
    }
    let (config, source) = measured.unwrap_or_else(|| kernels::known(info));
    let why = match source {
        Source::Fixed => format!("{VARIABLE} says so"),
        Source::Kept(path) => format!("measured, kept in {}", path.display()),
        Source::Measured => "measured, not kept".to_owned(),
        Source::Standard if KernelChoice::from_environment() == Ok(KernelChoice::Autotuned) => match info.is_cpu {
            true => "default; dgtr doctor --autotune measures it, in minutes".to_owned(),
            false => "default until the first training or dgtr doctor --autotune measures it".to_owned(),
        },
        Source::Standard => format!("default, by {VARIABLE}"),
    };
    let lanes = |n: u32| if n == 1 { "one lane" } else { "several" };
    let (share, tile) = (lanes(config.share_lanes), lanes(config.tile_lanes));
    let staged = if config.fetched > 1 { ", which fetch for each other" } else { "" };
    Finding::Ok(format!("configuration {config}: {share} per share of the Gaussians, {tile} per tile{staged} ({why})"))
}

/// What `auto` forecasts with.
fn step_cost(info: &GpuInfo, autotune: bool) -> Finding {
    let config = kernels::known(info).0;
    let cost = match autotune {
        true => Gpu::open(Some(&info.name)).ok().and_then(|gpu| cost::anew(&gpu, config)),
        false => cost::known(info, config),
    };
    let Some(cost) = cost else {
        let how = "the first job with preset auto, or dgtr doctor --autotune, measures it in seconds";
        return Finding::note("what it costs is not measured yet", how);
    };
    // The point of the presets of whole pictures.
    let visibility = Visibility { gaussians: 100_000, share: 0.29, pixels: 640 * 480 };
    let threads = match info.threads() {
        0 => String::new(),
        n => format!(" with {n} threads"),
    };
    let ms = cost.step_ms(&visibility.load(Footprint::TRAINED));
    Finding::Ok(format!("{ms:.1} ms forecast{threads} for 100,000 Gaussians and pictures of 640x480"))
}

/// Ports an autopilot may hang on, and whether this user may open them.
fn serial_ports() -> Vec<Finding> {
    const PREFIXES: [&str; 5] = ["ttyACM", "ttyUSB", "ttyAMA", "ttyTHS", "serial"];
    let mut ports: Vec<PathBuf> = std::fs::read_dir("/dev")
        .map(|entries| entries.flatten().map(|e| e.path()).filter(|p| is_port(p, &PREFIXES)).collect())
        .unwrap_or_default();
    ports.sort();
    if ports.is_empty() {
        return vec![Finding::note("none found", "connect the autopilot (needed by `dgtr fly` on serial: links only)")];
    }
    ports
        .into_iter()
        .map(|p| match rustix::fs::access(&p, rustix::fs::Access::READ_OK | rustix::fs::Access::WRITE_OK) {
            Ok(()) => Finding::Ok(p.display().to_string()),
            Err(e) => {
                Finding::missing(format!("{}: {e}", p.display()), "sudo usermod -aG dialout $USER and log in again")
            }
        })
        .collect()
}

fn is_port(path: &Path, prefixes: &[&str]) -> bool {
    let name = path.file_name().and_then(|n| n.to_str()).unwrap_or_default();
    !path.is_dir()
        && prefixes.iter().any(|p| name.strip_prefix(p).is_some_and(|n| n.starts_with(|c: char| c.is_ascii_digit())))
}
