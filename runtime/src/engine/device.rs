//! What every job opens before its first picture: the device, the plan of its memory, the trainer. The one place that asks
//! for a plan.

use config::plan::{Plan, PlanError, PlanRequest};
use config::training::{ShSettings, TrainSettings};
use models::cloud::GaussianCloud;
use vulkan::gpu::Gpu;
use vulkan::trainer::{TrainError, Trainer};

use crate::error::JobError;
use crate::kernels;

/// Gaussian–tile instances that a renderer holds at once, per pixel; pictures with more are rendered in bands.
const INSTANCES_PER_PIXEL: usize = 8;

/// What a job wants of which device.
#[derive(Clone, Debug)]
pub struct DeviceRequest {
    /// Part of the Vulkan device's name.
    pub device: Option<String>,
    /// Device memory, MiB.
    pub device_mib: u32,
    /// Width and height of the largest picture, pixels; the trainer fits the others in.
    pub size: (u32, u32),
    /// Views that are resident at once.
    pub views: usize,
    /// Cap below what the budget holds.
    pub max_gaussians: Option<usize>,
}

impl DeviceRequest {
    /// The request that [`Plan`] is made of; `sort_lanes` are the device's.
    pub fn plan_request(&self, sh: &ShSettings, sort_lanes: u32) -> PlanRequest {
        PlanRequest {
            device_mib: self.device_mib,
            width: self.size.0,
            height: self.size.1,
            views: self.views as u32,
            sh_degree: sh.degree,
            max_gaussians: self.max_gaussians,
            half_moments: sh.half_moments,
            sort_lanes,
        }
    }

    /// Opens the device and allocates the plan. Call it before anything that must not wait: a device seen for the first
    /// time is measured for a second or two.
    ///
    /// # Errors
    /// No device, or a plan that does not fit into it or into `device_mib`.
    pub fn open<E: From<PlanError> + From<TrainError>>(&self, training: &TrainSettings) -> Result<Trainer, E> {
        let gpu = Gpu::open(self.device.as_deref()).map_err(TrainError::from)?;
        let plan = Plan::new(&self.plan_request(&training.sh, gpu.info().sort_lanes()))?;
        Ok(Trainer::with_shape(&gpu, &plan, training, kernels::shape_of(&gpu))?)
    }
}

/// A trained model ready to be rendered, with as little memory as rendering takes: `cloud` on the device for pictures of up
/// to `width` × `height` (larger ones are rendered in windows).
///
/// # Errors
/// No device, or not enough of its memory; an empty cloud.
pub fn renderer(device: Option<&str>, cloud: &GaussianCloud, width: u32, height: u32) -> Result<Trainer, JobError> {
    if cloud.is_empty() {
        let what = "the model holds no Gaussians; train it first (dgtr train continues it)";
        return Err(JobError::Request(what.into()));
    }
    let gpu = Gpu::open(device)?;
    let mut settings = TrainSettings::default();
    settings.sh.degree = cloud.sh_degree;
    let max_gaussians = Some(cloud.len());
    let request = DeviceRequest { device: None, device_mib: u32::MAX, size: (width, height), views: 0, max_gaussians };
    let request = request.plan_request(&settings.sh, gpu.info().sort_lanes());
    let pixels = width as usize * height as usize;
    let plan = Plan::with_capacities(&request, cloud.len(), cloud.len() + INSTANCES_PER_PIXEL * pixels);
    let mut trainer = Trainer::with_shape(&gpu, &plan, &settings, kernels::known(gpu.info()).0)?;
    trainer.load(cloud)?;
    Ok(trainer)
}
