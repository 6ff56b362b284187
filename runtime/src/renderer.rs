//! A trained model ready to be rendered: the trainer with as little memory as rendering takes.

use config::plan::{Plan, PlanRequest};
use config::training::TrainSettings;
use models::cloud::GaussianCloud;
use vulkan::gpu::Gpu;
use vulkan::trainer::Trainer;

use crate::cli::CliError;
use crate::kernels;

/// Gaussian–tile instances held at once, per pixel; pictures with more are rendered in bands.
const INSTANCES_PER_PIXEL: usize = 8;

/// Loads `cloud` on the device for pictures of up to `width` × `height` (larger ones are rendered in windows).
///
/// # Errors
/// No device, or not enough of its memory; an empty cloud.
pub fn open(device: Option<&str>, cloud: &GaussianCloud, width: u32, height: u32) -> Result<Trainer, CliError> {
    if cloud.is_empty() {
        return Err(CliError::input("the model holds no Gaussians; train it first (dgtr train continues it)"));
    }
    let gpu = Gpu::open(device)?;
    let request = PlanRequest {
        device_mib: u32::MAX,
        width,
        height,
        views: 0,
        sh_degree: cloud.sh_degree,
        max_gaussians: Some(cloud.len()),
        sort_lanes: gpu.info().sort_lanes(),
        ..Default::default()
    };
    let pixels = width as usize * height as usize;
    let plan = Plan::with_capacities(&request, cloud.len(), cloud.len() + INSTANCES_PER_PIXEL * pixels);
    let mut settings = TrainSettings::default();
    settings.sh.degree = cloud.sh_degree;
    let mut trainer = Trainer::with_shape(&gpu, &plan, &settings, kernels::known(gpu.info()).0)?;
    trainer.load(cloud)?;
    Ok(trainer)
}
