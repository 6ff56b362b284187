//! The Vulkan device: found by name, opened with nothing beyond Vulkan 1.1 compute, so that lavapipe, V3DV, PanVK,
//! Turnip and desktop drivers are all the same to the rest of the crate.

mod error;
mod limits;
mod objects;
mod processor;

pub use error::GpuError;
pub use limits::DeviceLimits;

use ash::{Device, Entry, Instance, vk};
use config::kernels::ProcessorKernels;
use config::plan::Lanes;
use std::ffi::CStr;
use std::sync::{Arc, Mutex, PoisonError};

/// What a device says about itself.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GpuInfo {
    /// The driver's name of the device.
    pub name: String,
    /// Vulkan version, major and minor.
    pub version: (u32, u32),
    /// Whether this is a software renderer.
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
}

/// What the kernels with several lanes per tile ask of a subgroup.
const SHUFFLES: vk::SubgroupFeatureFlags = vk::SubgroupFeatureFlags::from_raw(
    vk::SubgroupFeatureFlags::SHUFFLE.as_raw()
        | vk::SubgroupFeatureFlags::VOTE.as_raw()
        | vk::SubgroupFeatureFlags::BALLOT.as_raw(),
);

/// An opened device with its one compute queue. Cheap to clone; closed when the last clone is dropped.
#[derive(Clone)]
pub struct Gpu {
    inner: Arc<Inner>,
}

struct Inner {
    info: GpuInfo,
    device: Device,
    instance: &'static Instance,
    physical: vk::PhysicalDevice,
    queue: vk::Queue,
    family: u32,
    timestamp_ns: f64,
    /// Whose kernels run where the device is the processor.
    kernels: ProcessorKernels,
    #[cfg(test)]
    forced: Forced,
}

/// Oddities of drivers that the tests' own does not have.
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
    pub level: Option<fearless_simd::Level>,
}

impl std::fmt::Debug for Gpu {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Gpu").field(&self.inner.info).finish()
    }
}

impl Drop for Inner {
    fn drop(&mut self) {
        // SAFETY: everything made from the device holds a clone of `Gpu`, so nothing of it is alive any more.
        unsafe {
            let _ = self.device.device_wait_idle();
            self.device.destroy_device(None);
        }
    }
}

impl Gpu {
    /// Every device with a compute queue.
    ///
    /// # Errors
    /// [`GpuError::NoLoader`] without a Vulkan loader, [`GpuError::NoDevice`] when there is no device.
    pub fn list() -> Result<Vec<GpuInfo>, GpuError> {
        let found: Vec<_> = devices(instance()?)?.into_iter().map(|d| d.1).collect();
        if found.is_empty() { Err(GpuError::NoDevice { wanted: None, present: String::new() }) } else { Ok(found) }
    }

    /// Opens the device whose name contains `name` (case is ignored), or the first that is no software renderer, or
    /// else the first.
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

    fn open_as(name: Option<&str>, taken_for: impl Fn(GpuInfo) -> GpuInfo) -> Result<Self, GpuError> {
        let instance = instance()?;
        let (physical, info, device, family, timestamp_ns) = {
            // One after the other: of four threads that opened NVIDIA's at once (580.159) none came back, once.
            static OPENING: Mutex<()> = Mutex::new(());
            let _alone = OPENING.lock().unwrap_or_else(PoisonError::into_inner);
            open_in(instance, name)?
        };
        // SAFETY: queue 0 of `family` was requested when the device was made.
        let queue = unsafe { device.get_device_queue(family, 0) };
        let inner = Inner {
            info: taken_for(info),
            device,
            instance,
            physical,
            queue,
            family,
            timestamp_ns,
            kernels: ProcessorKernels::from_environment()?,
            #[cfg(test)]
            forced: Forced::default(),
        };
        Ok(Self { inner: Arc::new(inner) })
    }

    /// What the device says about itself.
    pub fn info(&self) -> &GpuInfo {
        &self.inner.info
    }

    /// The same device, whose driver runs all kernels.
    #[must_use]
    pub fn by_driver(mut self) -> Self {
        if let Some(inner) = Arc::get_mut(&mut self.inner) {
            inner.kernels = ProcessorKernels::Driver;
        }
        self
    }

    /// Whether the device is the processor, and runs the functions that stand for kernels there.
    pub fn runs_on_processor(&self) -> bool {
        self.inner.info.is_cpu && self.inner.kernels == ProcessorKernels::Native
    }

    /// The same device, were its limits these.
    #[cfg(test)]
    pub(crate) fn limited(mut self, limits: DeviceLimits) -> Self {
        if let Some(inner) = Arc::get_mut(&mut self.inner) {
            inner.info.limits = limits;
        }
        assert_eq!(self.info().limits, limits, "somebody else holds this device");
        self
    }

    /// The same device, with a driver that is odd in these ways.
    #[cfg(test)]
    pub(crate) fn forced(mut self, forced: Forced) -> Self {
        let inner = Arc::get_mut(&mut self.inner);
        inner.expect("nobody else holds this device").forced = forced;
        self
    }

    /// Whether kernels are left out of what is submitted.
    pub(crate) fn computes_nothing(&self) -> bool {
        #[cfg(test)]
        return self.inner.forced.computes_nothing;
        #[cfg(not(test))]
        false
    }

    /// Whether the device's memory counts as a card's although it is the host's.
    pub(crate) fn is_forced_apart(&self) -> bool {
        #[cfg(test)]
        return self.inner.forced.apart;
        #[cfg(not(test))]
        false
    }

    /// Threads and vectors by which the processor computes.
    pub(crate) fn powers(&self) -> (usize, fearless_simd::Level) {
        let usual = (processor::threads() as usize, fearless_simd::Level::new());
        #[cfg(test)]
        let usual = (self.inner.forced.threads.unwrap_or(usual.0), self.inner.forced.level.unwrap_or(usual.1));
        usual
    }

    /// What memory the driver wants for a buffer of this device.
    pub(crate) fn buffer_needs(&self, buffer: vk::Buffer) -> vk::MemoryRequirements {
        // SAFETY: the buffer was made by this device and is alive.
        let needs = unsafe { self.inner.device.get_buffer_memory_requirements(buffer) };
        #[cfg(test)]
        let needs = vk::MemoryRequirements { size: needs.size + self.inner.forced.padding, ..needs };
        needs
    }

    pub(crate) fn device(&self) -> &Device {
        &self.inner.device
    }

    pub(crate) fn queue(&self) -> vk::Queue {
        self.inner.queue
    }

    pub(crate) fn family(&self) -> u32 {
        self.inner.family
    }

    /// Nanoseconds per timestamp tick; 0 when the queue has no timestamps.
    pub fn timestamp_ns(&self) -> f64 {
        self.inner.timestamp_ns
    }

    pub(crate) fn memory_properties(&self) -> vk::PhysicalDeviceMemoryProperties {
        // SAFETY: the physical device belongs to this live instance.
        unsafe { self.inner.instance.get_physical_device_memory_properties(self.inner.physical) }
    }
}

/// The process's one instance, made when it is first asked for and never destroyed: with the last instance the loader unloads the
/// drivers, and NVIDIA's (580.159) must not be unloaded while a thread that used it is yet to end.
fn instance() -> Result<&'static Instance, GpuError> {
    static MADE: Mutex<Option<&'static (Entry, Instance)>> = Mutex::new(None);
    let mut made = MADE.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some((_, instance)) = *made {
        return Ok(instance);
    }
    let (_, instance) = *made.insert(Box::leak(Box::new(new_instance()?)));
    Ok(instance)
}

fn new_instance() -> Result<(Entry, Instance), GpuError> {
    // SAFETY: loading the system's Vulkan loader runs its initialisers; it is the documented way to reach Vulkan.
    let entry = unsafe { Entry::load() }.map_err(|e| GpuError::NoLoader(e.to_string()))?;
    let application = vk::ApplicationInfo::default().application_name(c"dgtr").api_version(vk::API_VERSION_1_1);
    let create = vk::InstanceCreateInfo::default().application_info(&application);
    // SAFETY: `create` and what it points to outlive the call.
    match unsafe { entry.create_instance(&create, None) } {
        Ok(instance) => Ok((entry, instance)),
        Err(vk::Result::ERROR_INCOMPATIBLE_DRIVER) => Err(GpuError::NoDevice { wanted: None, present: String::new() }),
        Err(e) => Err(GpuError::from_vk("vkCreateInstance", e)),
    }
}

type Found = (vk::PhysicalDevice, GpuInfo, u32, f64);

fn devices(instance: &Instance) -> Result<Vec<Found>, GpuError> {
    // SAFETY: the instance is alive; the handles below come from it.
    let all = unsafe { instance.enumerate_physical_devices() }
        .map_err(|e| GpuError::from_vk("vkEnumeratePhysicalDevices", e))?;
    let mut found = Vec::new();
    for physical in all {
        let mut subgroup = vk::PhysicalDeviceSubgroupProperties::default();
        let mut properties = vk::PhysicalDeviceProperties2::default().push_next(&mut subgroup);
        // SAFETY: the structure chain is initialised and outlives the calls.
        let (families, memory) = unsafe {
            instance.get_physical_device_properties2(physical, &mut properties);
            (
                instance.get_physical_device_queue_family_properties(physical),
                instance.get_physical_device_memory_properties(physical),
            )
        };
        let p = properties.properties;
        let compute = |f: &vk::QueueFamilyProperties| f.queue_flags.contains(vk::QueueFlags::COMPUTE);
        let Some(family) = families.iter().position(compute) else { continue };
        if p.api_version < vk::API_VERSION_1_1 {
            continue;
        }
        let ticks = families[family].timestamp_valid_bits > 0;
        let name = p.device_name_as_c_str().unwrap_or(c"unnamed");
        let heaps =
            memory.memory_heaps_as_slice().iter().filter(|h| h.flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL));
        let info = GpuInfo {
            name: CStr::to_string_lossy(name).into_owned(),
            version: (vk::api_version_major(p.api_version), vk::api_version_minor(p.api_version)),
            is_cpu: p.device_type == vk::PhysicalDeviceType::CPU,
            is_integrated: p.device_type == vk::PhysicalDeviceType::INTEGRATED_GPU,
            subgroup_size: subgroup.subgroup_size,
            shuffles: subgroup.subgroup_size >= crate::constants::RUNS
                && subgroup.supported_stages.contains(vk::ShaderStageFlags::COMPUTE)
                && subgroup.supported_operations.contains(SHUFFLES),
            heap_bytes: heaps.map(|h| h.size).max().unwrap_or(0),
            ids: (p.vendor_id, p.device_id),
            driver_version: p.driver_version,
            limits: DeviceLimits::of(&p.limits),
        };
        let timestamp_ns = if ticks { f64::from(p.limits.timestamp_period) } else { 0.0 };
        found.push((physical, info, family as u32, timestamp_ns));
    }
    Ok(found)
}

fn open_in(
    instance: &Instance,
    name: Option<&str>,
) -> Result<(vk::PhysicalDevice, GpuInfo, Device, u32, f64), GpuError> {
    let all = devices(instance)?;
    let present = all.iter().map(|d| d.1.name.as_str()).collect::<Vec<_>>().join(", ");
    let chosen = match name {
        Some(part) => {
            let part = part.to_lowercase();
            all.into_iter().find(|d| d.1.name.to_lowercase().contains(&part))
        }
        None => all.iter().position(|d| !d.1.is_cpu).or(Some(0)).and_then(|i| all.into_iter().nth(i)),
    };
    let Some((physical, info, family, timestamp_ns)) = chosen else {
        return Err(GpuError::NoDevice { wanted: name.map(str::to_owned), present });
    };
    let queues = [vk::DeviceQueueCreateInfo::default().queue_family_index(family).queue_priorities(&[1.0])];
    let create = vk::DeviceCreateInfo::default().queue_create_infos(&queues);
    // SAFETY: `create` asks for one queue of an existing family, no extension and no feature.
    let device = unsafe { instance.create_device(physical, &create, None) }
        .map_err(|e| GpuError::from_vk("vkCreateDevice", e))?;
    Ok((physical, info, device, family, timestamp_ns))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_device_name_is_refused_with_the_names_present() {
        match Gpu::open(Some("no such device")) {
            Err(GpuError::NoDevice { wanted, .. }) => {
                assert!(wanted.is_none() || wanted.as_deref() == Some("no such device"))
            }
            Err(GpuError::NoLoader(_)) => {}
            other => panic!("{other:?}"),
        }
    }
}
