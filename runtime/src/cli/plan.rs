//! `dgtr plan`: the fixed memory plan as a table, before anything is allocated.

use std::path::PathBuf;

use config::budget::Memory;
use config::init::InitSettings;
use config::map::MapSettings;
use config::mission::{MemorySettings, Mission, NetworkSettings};
use config::plan::{Lanes, Plan};
use config::refine::RefineSettings;
use config::training::{CropSettings, ShSettings};
use disk::plan::{DiskPlan, DiskRequest};
use engine::device::DeviceRequest;
use engine::preset;
use engine::scratch_bytes;
use flight::fly::delivered_bytes;
use job::service::limits::{DeviceMemory, ServiceLimits};
use survey::dataset::{Dataset, scaled};
use tuning::devices;
use vulkan::gpu::GpuInfo;

use super::CliError;
use crate::cli::output::{out, outln};

/// Arguments of `dgtr plan`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The plan of an aircraft of this mission, instead of the numbers below.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["dataset", "scale", "budget_mib", "width", "height", "views",
        "view_slots", "sh_degree", "max_gaussians", "scene_gaussians", "half_moments"])]
    pub mission: Option<PathBuf>,
    /// Take picture size and number of views from this data set instead of --width, --height and --views.
    #[arg(long)]
    pub dataset: Option<PathBuf>,
    /// Split whose pictures are counted, with --dataset.
    #[arg(long, default_value = "train", requires = "dataset")]
    pub split: String,
    /// Region whose pictures are counted, with --dataset.
    #[arg(long, requires = "dataset")]
    pub region: Option<String>,
    /// Image scale, above 0 and at most 1 [default: whole, or 640 pixels of the longer side where that is less].
    #[arg(long)]
    pub scale: Option<f64>,
    #[command(flatten)]
    pub memory: Memory,
    /// Picture width, pixels.
    #[arg(long, default_value_t = 640)]
    pub width: u32,
    /// Picture height, pixels.
    #[arg(long, default_value_t = 480)]
    pub height: u32,
    /// Training views.
    #[arg(long, default_value_t = 64)]
    pub views: u32,
    /// Highest SH degree, 0 to 3.
    #[arg(long, default_value_t = 3)]
    pub sh_degree: u8,
    /// Adam's moments of SH in 16 bits each (`training.sh.half_moments`).
    #[arg(long)]
    pub half_moments: bool,
    /// Device whose name contains this: processor, or a Vulkan device; without it the plan is the first device's, or a processor's.
    #[arg(long)]
    pub device: Option<String>,
    /// JSON instead of a table.
    #[arg(long)]
    pub json: bool,
    /// Instead of a table, a drop-in for dgtr-fly.service with the bounds of this plan on this computer.
    #[arg(long, requires = "mission", conflicts_with = "json")]
    pub systemd: bool,
}

/// Runs `dgtr plan`.
///
/// # Errors
/// Whatever ends the command; its kind is the exit code.
pub fn run(args: Args) -> Result<(), CliError> {
    // As a job here would be planned. A device that was named has to be there; where none is, a processor's plan.
    let gpu = devices::open_known(args.device.as_deref());
    let job = match &args.mission {
        Some(path) => {
            let mut mission = Mission::read(path)?;
            // What a service may take must hold for whatever a flight chooses.
            let measured = gpu.as_ref().ok().filter(|_| !args.systemd);
            if let Some(choice) = measured.and_then(|gpu| preset::foresee(&mut mission, gpu)) {
                tracing::info!("{choice}");
            }
            Job::of_flight(mission)
        }
        None => Job::of_arguments(&args)?,
    };
    let (lanes, lies) = match (gpu, &args.device) {
        (Ok(gpu), _) => (gpu.info().lanes(), device_memory(gpu.info())),
        // A bound that is too large ends no flight.
        (Err(_), None) => (Lanes::SOFTWARE, DeviceMemory::Shared),
        (Err(e), Some(_)) => return Err(e.into()),
    };
    let request = job.device.plan_request(&job.sh, lanes);
    let plan = Plan::new(&request)?;
    if args.systemd {
        let processors = std::thread::available_parallelism().map_or(1, usize::from);
        out!("{}", ServiceLimits::of_flight(&job.memory, lies, processors));
        return Ok(());
    }
    if args.json {
        outln!("{}", serde_json::to_string(&plan).map_err(CliError::failed)?);
        return Ok(());
    }
    let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    outln!(
        "{} views and {} crops of {} x {}, {} of them on the device at once, SH degree {}, {} MiB allowed",
        plan.views,
        plan.crops,
        request.width,
        request.height,
        plan.view_slots,
        plan.sh_degree,
        request.device_mib
    );
    outln!(
        "  Gaussians {:>10}\n  instances {:>10}\n  tiles     {:>10}\n  sort lanes{:>10}\n",
        plan.gaussians,
        plan.instances,
        plan.tiles,
        plan.lanes.sort
    );
    if plan.is_paged() {
        outln!(
            "  of a scene of {} in up to {} cells; the others wait in a file of {:.2} MiB\n",
            plan.scene,
            plan.cells(),
            mib(plan.scene_file_bytes())
        );
    }
    for (name, bytes) in &plan.sections {
        outln!("  {name:<18} {:>9.2} MiB", mib(*bytes));
    }
    outln!("  {:<18} {:>9.2} MiB in one allocation", "total", mib(plan.total_bytes));
    if lies == DeviceMemory::Separate {
        outln!(
            "  {:<18} {:>9.2} MiB of the host's memory: what it reads and writes of them",
            "mirror",
            mib(plan.mirror_bytes())
        );
    }
    let disk = DiskPlan::new(&DiskRequest {
        width: job.picture.0,
        height: job.picture.1,
        key_frames: request.views,
        scratch: scratch_bytes(&request, &job.init, &job.network, job.refine.as_ref()),
        gaussians: plan.scene,
        sh_degree: plan.sh_degree,
        delivered: job.delivered,
        map: job.map.disk_bytes(),
        recording: 0,
    });
    outln!("\n  on disk, for a flight:");
    for (name, bytes) in &disk.sections {
        outln!("  {name:<18} {:>9.2} MiB", mib(*bytes));
    }
    outln!("  {:<18} {:>9.2} MiB at most, {:.2} MiB to begin", "total", mib(disk.total_bytes), mib(disk.min_bytes));
    Ok(())
}

fn device_memory(device: &GpuInfo) -> DeviceMemory {
    match (device.is_cpu, device.is_integrated) {
        (true, _) => DeviceMemory::Planned,
        (_, true) => DeviceMemory::Shared,
        _ => DeviceMemory::Separate,
    }
}

/// What is planned for.
struct Job {
    device: DeviceRequest,
    memory: MemorySettings,
    /// Width and height of whole pictures.
    picture: (u32, u32),
    sh: ShSettings,
    init: InitSettings,
    network: NetworkSettings,
    /// Where poses are refined.
    refine: Option<RefineSettings>,
    /// Most bytes of a Gaussian as it is delivered.
    delivered: usize,
    /// What an aircraft draws.
    map: MapSettings,
}

impl Job {
    fn of_flight(mission: Mission) -> Self {
        Self {
            device: DeviceRequest::of_flight(&mission, None),
            memory: mission.memory,
            picture: (mission.camera.width, mission.camera.height),
            delivered: delivered_bytes(&mission),
            map: mission.map,
            sh: mission.training.sh,
            init: mission.init,
            network: mission.network,
            refine: Some(mission.refine),
        }
    }

    fn of_arguments(args: &Args) -> Result<Self, CliError> {
        let (picture, views) = match &args.dataset {
            None => ((args.width, args.height), args.views as usize),
            Some(root) => {
                let set = Dataset::open(root)?;
                let chosen = set.select(&args.split, args.region.as_deref())?;
                (largest(&set, &chosen, 1.0)?, chosen.len())
            }
        };
        let memory = MemorySettings { image_scale: args.scale.map(|s| s as f32), ..MemorySettings::default() };
        memory.check().map_err(|e| CliError::input(format!("--scale: {e}")))?;
        let (size, settings) = (memory.training_size(picture), CropSettings::default());
        let crops = u64::from(settings.planned(picture, size)) * views as u64;
        let device = DeviceRequest {
            device: None,
            memory: args.memory,
            size,
            views,
            crops: crops.min(settings.most.into()) as usize,
            folder: None,
        };
        let sh = ShSettings { degree: args.sh_degree, half_moments: args.half_moments, ..ShSettings::default() };
        let (init, network) = (InitSettings::default(), NetworkSettings::default());
        Ok(Self { device, memory, picture, sh, init, network, refine: None, delivered: 0, map: MapSettings::default() })
    }
}

/// The widest and the highest picture of `frames` at `scale`.
pub(super) fn largest(set: &Dataset, frames: &[usize], scale: f64) -> Result<(u32, u32), CliError> {
    let mut size = (1, 1);
    for &i in frames {
        let k = scaled(&set.frames[i].view.intrinsics, scale)?;
        size = (size.0.max(k.width), size.1.max(k.height));
    }
    Ok(size)
}
