//! `dgtr plan`: the fixed memory plan as a table, before anything is allocated.

use std::path::PathBuf;

use config::plan::{Plan, PlanRequest, SORT_LANES_SOFTWARE};
use models::dataset::{Dataset, scaled};
use vulkan::gpu::Gpu;

use super::CliError;

/// Arguments of `dgtr plan`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Take picture size and number of views from this data set instead of --width, --height and --views.
    #[arg(long)]
    pub dataset: Option<PathBuf>,
    /// Split whose pictures are counted, with --dataset.
    #[arg(long, default_value = "train", requires = "dataset")]
    pub split: String,
    /// Region whose pictures are counted, with --dataset.
    #[arg(long, requires = "dataset")]
    pub region: Option<String>,
    /// Image scale, above 0 and at most 1.
    #[arg(long, default_value_t = 1.0)]
    pub scale: f64,
    /// Device memory, MiB.
    #[arg(long, default_value_t = 512)]
    pub budget_mib: u32,
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
    /// Most Gaussians wanted.
    #[arg(long)]
    pub max_gaussians: Option<usize>,
    /// Adam's moments of SH in 16 bits each (`training.sh.half_moments`).
    #[arg(long)]
    pub half_moments: bool,
    /// Vulkan device whose name contains this; without it the plan is the first device's, or a processor's.
    #[arg(long)]
    pub device: Option<String>,
    /// JSON instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// Runs `dgtr plan`.
pub fn run(args: Args) -> Result<(), CliError> {
    let (width, height, views) = match &args.dataset {
        None => (args.width, args.height, args.views),
        Some(root) => {
            let set = Dataset::open(root)?;
            let chosen = set.select(&args.split, args.region.as_deref())?;
            let (w, h) = largest(&set, &chosen, args.scale)?;
            (w, h, chosen.len() as u32)
        }
    };
    // As a job here would be planned. A device that was named has to be there; where none is, a processor's plan.
    let sort_lanes = match (Gpu::open(args.device.as_deref()), &args.device) {
        (Ok(gpu), _) => gpu.info().sort_lanes(),
        (Err(_), None) => SORT_LANES_SOFTWARE,
        (Err(e), Some(_)) => return Err(e.into()),
    };
    let request = PlanRequest {
        device_mib: args.budget_mib,
        width,
        height,
        views,
        sh_degree: args.sh_degree,
        max_gaussians: args.max_gaussians,
        half_moments: args.half_moments,
        sort_lanes,
    };
    let plan = Plan::new(&request)?;
    if args.json {
        println!("{}", serde_json::to_string(&plan).map_err(CliError::failed)?);
        return Ok(());
    }
    let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    println!(
        "{} views of {width} x {height}, SH degree {}, {} MiB allowed",
        plan.views, plan.sh_degree, args.budget_mib
    );
    println!(
        "  Gaussians {:>10}\n  instances {:>10}\n  tiles     {:>10}\n  sort lanes{:>10}\n",
        plan.gaussians, plan.instances, plan.tiles, plan.sort_lanes
    );
    for (name, bytes) in &plan.sections {
        println!("  {name:<18} {:>9.2} MiB", mib(*bytes));
    }
    println!("  {:<18} {:>9.2} MiB in one allocation", "total", mib(plan.total_bytes));
    Ok(())
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
