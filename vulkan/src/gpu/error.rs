//! What can go wrong between us and the driver, told apart where a caller can do something about it.

use ash::vk;
use config::error::{Error, ErrorKind};

/// A device, driver or memory problem.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum GpuError {
    /// There is no Vulkan loader on the system.
    #[error("no Vulkan loader ({0}); install libvulkan1 and a driver such as mesa-vulkan-drivers")]
    NoLoader(String),
    /// No device, or none of that name.
    #[error("no Vulkan device{}{}", .wanted.as_ref().map(|w| format!(" named like '{w}'")).unwrap_or_default(),
        if .present.is_empty() { "; install mesa-vulkan-drivers".to_owned() } else { format!("; present: {}", .present) })]
    NoDevice {
        /// The name asked for.
        wanted: Option<String>,
        /// The names there are.
        present: String,
    },
    /// The one allocation did not fit.
    #[error("device memory: {bytes} bytes could not be allocated; lower memory.device_mib")]
    OutOfMemory {
        /// What was asked for.
        bytes: u64,
    },
    /// The device went away (reset, hang, unplugged); the last checkpoint is still good.
    #[error("the device was lost during {during}; restart from the last checkpoint")]
    DeviceLost {
        /// The call that noticed.
        during: &'static str,
    },
    /// No memory type can be seen by both the host and the device.
    #[error("the device has no host-visible memory type for {bytes} bytes")]
    NoMemoryType {
        /// What was asked for.
        bytes: u64,
    },
    /// The driver adds more to the buffer than the plan leaves room for.
    #[error(
        "the driver wants {wanted} bytes for a plan of {planned}, room for the driver included; report this device"
    )]
    PlanMismatch {
        /// The driver's figure.
        wanted: u64,
        /// The plan's.
        planned: u64,
    },
    /// A workgroup larger than the device runs.
    #[error("the device runs at most {limit} lanes in a workgroup, {needed} are needed")]
    WorkgroupTooLarge {
        /// Lanes asked for.
        needed: u32,
        /// Lanes the device allows.
        limit: u32,
    },
    /// A section that the device cannot show to a kernel as a whole.
    #[error(
        "the device shows a kernel at most {limit} elements of '{section}', the plan has {needed}; \
         lower memory.max_gaussians or memory.image_scale"
    )]
    ViewTooLarge {
        /// The section.
        section: &'static str,
        /// Its elements.
        needed: u64,
        /// The device's `maxTexelBufferElements`.
        limit: u32,
    },
    /// The environment names kernels that there are not.
    #[error(transparent)]
    Kernels(#[from] config::kernels::ProcessorKernelsError),
    /// Kernels run and leave no trace.
    #[error(
        "this device computes nothing: kernels end without an effect; update its driver, or choose another with --device"
    )]
    ComputesNothing,
    /// A kernel computes something else than its reference.
    #[error(
        "this device computes something else than it should: kernel '{kernel}' is wrong about {differ} of {of} Gaussians; \
         update its driver, or choose another with --device"
    )]
    ComputesWrong {
        /// The kernel.
        kernel: &'static str,
        /// Gaussians it is wrong about.
        differ: usize,
        /// Gaussians it was tried on.
        of: usize,
    },
    /// Anything else.
    #[error("{call} failed: {result}")]
    Vulkan {
        /// The call.
        call: &'static str,
        /// The driver's answer.
        result: String,
    },
}

impl GpuError {
    pub(crate) fn from_vk(call: &'static str, result: vk::Result) -> Self {
        match result {
            vk::Result::ERROR_DEVICE_LOST => Self::DeviceLost { during: call },
            vk::Result::ERROR_OUT_OF_DEVICE_MEMORY | vk::Result::ERROR_OUT_OF_HOST_MEMORY => {
                Self::OutOfMemory { bytes: 0 }
            }
            other => Self::Vulkan { call, result: format!("{other:?}") },
        }
    }
}

impl Error for GpuError {
    fn kind(&self) -> ErrorKind {
        ErrorKind::Device
    }
}
