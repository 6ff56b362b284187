//! The device that runs the kernels: a Vulkan device, found by name and opened with nothing beyond Vulkan 1.1 compute, so that V3DV, PanVK,
//! Turnip and desktop drivers are all the same to the rest of the crate; or the processor, which needs no driver.

mod error;
mod limits;
mod objects;
mod processor;
mod vulkan;

pub use error::GpuError;
pub use limits::DeviceLimits;
pub(crate) use vulkan::Vulkan;

use config::kernels::ProcessorKernels;
use config::plan::Lanes;
use fearless_simd::Level;
use std::sync::Arc;

/// What a device says about itself.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GpuInfo {
    /// The driver's name of the device.
    pub name: String,
    /// Vulkan version, major and minor; zeros of a processor without a driver.
    pub version: (u32, u32),
    /// Whether this is the processor, with a software renderer or without.
    pub is_cpu: bool,
    /// Whether its memory is the host's although it is none (a board's GPU).
    pub is_integrated: bool,
    /// Invocations that run in lockstep.
    pub subgroup_size: u32,
    /// Whether a kernel's lanes can read each other's registers (shuffle and vote, at least eight lanes in lockstep).
    pub shuffles: bool,
    /// Bytes of the largest device-local heap.
    pub heap_bytes: u64,
    /// Vulkan's numbers of the vendor and of the device.
    pub ids: (u32, u32),
    /// The driver's version, packed as the driver likes.
    pub driver_version: u32,
    /// What the device refuses beyond.
    pub limits: DeviceLimits,
}

impl GpuInfo {
    /// Lanes that share the work on this device: what a plan for it asks for.
    pub fn lanes(&self) -> Lanes {
        match (self.is_cpu, self.is_integrated) {
            (true, _) => Lanes::SOFTWARE,
            (false, true) => Lanes::BOARD,
            (false, false) => Lanes::CARD,
        }
    }

    /// Threads by which it computes where it is the processor; 0 for others, which the processor's cores do not make faster.
    pub fn threads(&self) -> u32 {
        if self.is_cpu { processor::threads() } else { 0 }
    }

    /// Whether a driver runs the kernels, and not this program itself.
    pub fn has_driver(&self) -> bool {
        self.version.0 > 0
    }
}

/// An opened device. Cheap to clone; closed when the last clone is dropped.
#[derive(Clone)]
pub struct Gpu {
    inner: Arc<Inner>,
}

struct Inner {
    info: GpuInfo,
    /// None: the processor.
    vulkan: Option<Vulkan>,
    #[cfg(test)]
    forced: Forced,
}

/// Oddities of devices that the tests' own does not have.
#[cfg(test)]
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Forced {
    /// Bytes that the driver wants beyond those of a buffer.
    pub padding: u64,
    /// Kernels have no effect.
    pub computes_nothing: bool,
    /// The host cannot reach the device's memory.
    pub apart: bool,
    /// Threads of the processor, where not as many as usual.
    pub threads: Option<usize>,
    /// Vectors of the processor, where not the best that it has.
    pub level: Option<Level>,
}

impl std::fmt::Debug for Gpu {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Gpu").field(&self.inner.info).finish()
    }
}

impl Gpu {
    /// Every device: those of Vulkan drivers that are no software renderers, and the processor; every device of Vulkan drivers where the
    /// environment asks for these ([`ProcessorKernels`]).
    ///
    /// # Errors
    /// [`GpuError::Kernels`]; of drivers alone: [`GpuError::NoLoader`] without a Vulkan loader, [`GpuError::NoDevice`] when there is no
    /// device.
    pub fn list() -> Result<Vec<GpuInfo>, GpuError> {
        match ProcessorKernels::from_environment()? {
            ProcessorKernels::Driver => match vulkan::list()? {
                none if none.is_empty() => Err(GpuError::NoDevice { wanted: None, present: String::new() }),
                all => Ok(all),
            },
            ProcessorKernels::Native => {
                let drivers = if vulkan::has_gpu() { vulkan::list() } else { Ok(Vec::new()) };
                let drivers = drivers.unwrap_or_else(|e| {
                    tracing::debug!("no Vulkan device: {e}");
                    Vec::new()
                });
                Ok(drivers.into_iter().filter(|d| !d.is_cpu).chain([processor::info()]).collect())
            }
        }
    }

    /// Opens the device whose name contains `name` (case is ignored), or the first that is no processor, or else the first. A software
    /// renderer is opened where it is named.
    ///
    /// # Errors
    /// As [`Gpu::list`]; [`GpuError::NoDevice`] names what is present when nothing matches.
    pub fn open(name: Option<&str>) -> Result<Self, GpuError> {
        Self::open_as(name, |info| info)
    }

    /// As [`Gpu::open`], taking the lanes of the device for such that cannot read each other, as those of a Raspberry Pi 4 cannot: what runs
    /// there can be tried on any other.
    ///
    /// # Errors
    /// As [`Gpu::open`].
    pub fn open_without_shuffles(name: Option<&str>) -> Result<Self, GpuError> {
        Self::open_as(name, |info| GpuInfo { shuffles: false, ..info })
    }

    /// As [`Gpu::open`] among the devices of Vulkan drivers alone.
    ///
    /// # Errors
    /// As [`Gpu::list`] of drivers.
    pub fn open_by_driver(name: Option<&str>) -> Result<Self, GpuError> {
        Vulkan::open(name, |info| info).map(Self::of)
    }

    fn open_as(name: Option<&str>, taken_for: impl Fn(GpuInfo) -> GpuInfo) -> Result<Self, GpuError> {
        if ProcessorKernels::from_environment()? == ProcessorKernels::Driver {
            return Vulkan::open(name, taken_for).map(Self::of);
        }
        let devices = Self::list()?;
        let named = |info: &GpuInfo| name.is_none_or(|name| info.name.to_lowercase().contains(&name.to_lowercase()));
        match devices.iter().find(|info| named(info)) {
            Some(info) if info.has_driver() => Vulkan::open(Some(&info.name), taken_for).map(Self::of),
            Some(info) => Ok(Self::on_processor(taken_for(info.clone()))),
            None => Vulkan::open(name, taken_for).map(Self::of).map_err(|e| match e {
                GpuError::NoLoader(_) | GpuError::NoDevice { .. } => GpuError::NoDevice {
                    wanted: name.map(str::to_owned),
                    present: devices.iter().map(|d| d.name.as_str()).collect::<Vec<_>>().join(", "),
                },
                e => e,
            }),
        }
    }

    fn of(vulkan: Vulkan) -> Self {
        let inner = Inner {
            info: vulkan.info().clone(),
            vulkan: Some(vulkan),
            #[cfg(test)]
            forced: Forced::default(),
        };
        Self { inner: Arc::new(inner) }
    }

    fn on_processor(info: GpuInfo) -> Self {
        let inner = Inner {
            info,
            vulkan: None,
            #[cfg(test)]
            forced: Forced::default(),
        };
        Self { inner: Arc::new(inner) }
    }

    /// What the device says about itself.
    pub fn info(&self) -> &GpuInfo {
        &self.inner.info
    }

    /// The driver's device; none where the processor is the device.
    pub(crate) fn vulkan(&self) -> Option<&Vulkan> {
        self.inner.vulkan.as_ref()
    }

    /// Nanoseconds per tick of the device's clock; 0 when it has none.
    pub fn timestamp_ns(&self) -> f64 {
        self.vulkan().map_or(1.0, Vulkan::timestamp_ns)
    }

    /// This device, were its limits these.
    #[cfg(test)]
    pub(crate) fn limited(mut self, limits: DeviceLimits) -> Self {
        let inner = Arc::get_mut(&mut self.inner).expect("nobody else holds this device");
        inner.info.limits = limits;
        inner.vulkan = inner.vulkan.take().map(|vulkan| vulkan.limited(limits));
        self
    }

    /// This device, odd in these ways.
    #[cfg(test)]
    pub(crate) fn forced(mut self, forced: Forced) -> Self {
        let inner = Arc::get_mut(&mut self.inner).expect("nobody else holds this device");
        inner.forced = forced;
        inner.vulkan = inner.vulkan.take().map(|vulkan| vulkan.forced(forced));
        self
    }

    /// Whether kernels are left out of what is run.
    pub(crate) fn computes_nothing(&self) -> bool {
        #[cfg(test)]
        return self.inner.forced.computes_nothing;
        #[cfg(not(test))]
        false
    }

    /// Threads and vectors by which the processor computes.
    pub(crate) fn powers(&self) -> (usize, Level) {
        let usual = (processor::threads() as usize, Level::new());
        #[cfg(test)]
        let usual = (self.inner.forced.threads.unwrap_or(usual.0), self.inner.forced.level.unwrap_or(usual.1));
        usual
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_device_name_is_refused_with_the_names_present() {
        match Gpu::open(Some("no such device")) {
            Err(GpuError::NoDevice { wanted, present }) => {
                assert_eq!(wanted.as_deref(), Some("no such device"));
                assert!(!present.is_empty());
            }
            Err(GpuError::NoLoader(_)) => {}
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn the_processor_is_a_device_whether_a_driver_is_there_or_not() {
        if ProcessorKernels::from_environment() != Ok(ProcessorKernels::Native) {
            return;
        }
        let gpu = Gpu::open(Some("processor")).unwrap();
        let info = gpu.info();
        assert!(gpu.vulkan().is_none() && info.is_cpu && !info.has_driver() && info.threads() > 0);
        assert!(info.heap_bytes > 1 << 28, "{}", info.heap_bytes);
        assert_eq!(Gpu::list().unwrap().last(), Some(info));
    }
}
