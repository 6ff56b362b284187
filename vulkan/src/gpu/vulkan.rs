//! Vulkan devices: listed, and opened with one compute queue.

use super::{DeviceLimits, GpuError, GpuInfo};
use ash::{Device, Entry, Instance, vk};
use std::ffi::CStr;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

/// What the kernels with several lanes per tile ask of a subgroup.
const SHUFFLES: vk::SubgroupFeatureFlags = vk::SubgroupFeatureFlags::from_raw(
    vk::SubgroupFeatureFlags::SHUFFLE.as_raw()
        | vk::SubgroupFeatureFlags::VOTE.as_raw()
        | vk::SubgroupFeatureFlags::BALLOT.as_raw(),
);

/// An opened device with its one compute queue. Cheap to clone; closed when the last clone is dropped.
#[derive(Clone)]
pub(crate) struct Vulkan {
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
    #[cfg(test)]
    forced: super::Forced,
}

impl Drop for Inner {
    fn drop(&mut self) {
        // SAFETY: everything made from the device holds a clone of `Vulkan`, so nothing of it is alive any more.
        unsafe {
            let _ = self.device.device_wait_idle();
            self.device.destroy_device(None);
        }
    }
}

/// Every device with a compute queue.
///
/// # Errors
/// [`GpuError::NoLoader`] without a Vulkan loader; what the driver says.
pub(super) fn list() -> Result<Vec<GpuInfo>, GpuError> {
    Ok(devices(instance()?)?.into_iter().map(|d| d.1).collect())
}

/// Whether the system has a device file of a GPU. Without one no driver finds hardware, and the loader would only bring in software
/// renderers, of which Mesa's takes 50 MB until the process ends. Linux alone is asked; elsewhere there may be one.
pub(super) fn has_gpu() -> bool {
    has_gpu_in(Path::new("/dev"))
}

fn has_gpu_in(devices: &Path) -> bool {
    /// Render nodes, and what drivers outside DRM name theirs: NVIDIA (Jetson: nvhost, nvgpu, nvmap), Arm Mali, Qualcomm Adreno,
    /// Imagination, Vivante, and Windows' under WSL.
    const NODES: [&str; 10] =
        ["dri/renderD", "nvidia", "nvhost", "nvgpu", "nvmap", "mali", "kgsl", "pvr", "galcore", "dxg"];
    if !cfg!(target_os = "linux") {
        return true;
    }
    NODES.iter().any(|node| {
        let (folder, begins) = node.rsplit_once('/').unwrap_or(("", node));
        let names = std::fs::read_dir(devices.join(folder)).into_iter().flatten().flatten();
        names.map(|entry| entry.file_name()).any(|name| name.to_string_lossy().starts_with(begins))
    })
}

impl Vulkan {
    /// Opens the device whose name contains `name` (case is ignored), or the first that is no software renderer, or else the first; what it
    /// says about itself is taken for something else.
    ///
    /// # Errors
    /// As [`list`]; [`GpuError::NoDevice`] names what is present when nothing matches.
    pub fn open(name: Option<&str>, taken_for: impl Fn(GpuInfo) -> GpuInfo) -> Result<Self, GpuError> {
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
            #[cfg(test)]
            forced: super::Forced::default(),
        };
        Ok(Self { inner: Arc::new(inner) })
    }

    /// What the device says about itself.
    pub fn info(&self) -> &GpuInfo {
        &self.inner.info
    }

    /// This device, were its limits these.
    #[cfg(test)]
    pub fn limited(mut self, limits: DeviceLimits) -> Self {
        Arc::get_mut(&mut self.inner).expect("nobody else holds this device").info.limits = limits;
        self
    }

    /// This device, with a driver that is odd in these ways.
    #[cfg(test)]
    pub fn forced(mut self, forced: super::Forced) -> Self {
        Arc::get_mut(&mut self.inner).expect("nobody else holds this device").forced = forced;
        self
    }

    /// Whether kernels are left out of what is submitted.
    pub fn computes_nothing(&self) -> bool {
        #[cfg(test)]
        return self.inner.forced.computes_nothing;
        #[cfg(not(test))]
        false
    }

    /// Whether the device's memory counts as a card's although it is the host's.
    pub fn is_forced_apart(&self) -> bool {
        #[cfg(test)]
        return self.inner.forced.apart;
        #[cfg(not(test))]
        false
    }

    /// What memory the driver wants for a buffer of this device.
    pub fn buffer_needs(&self, buffer: vk::Buffer) -> vk::MemoryRequirements {
        // SAFETY: the buffer was made by this device and is alive.
        let needs = unsafe { self.inner.device.get_buffer_memory_requirements(buffer) };
        #[cfg(test)]
        let needs = vk::MemoryRequirements { size: needs.size + self.inner.forced.padding, ..needs };
        needs
    }

    pub fn device(&self) -> &Device {
        &self.inner.device
    }

    pub fn queue(&self) -> vk::Queue {
        self.inner.queue
    }

    pub fn family(&self) -> u32 {
        self.inner.family
    }

    /// Nanoseconds per timestamp tick; 0 when the queue has no timestamps.
    pub fn timestamp_ns(&self) -> f64 {
        self.inner.timestamp_ns
    }

    pub fn memory_properties(&self) -> vk::PhysicalDeviceMemoryProperties {
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
    #[cfg(target_os = "linux")]
    fn a_gpu_is_looked_for_only_where_the_system_has_a_device_file_of_one() {
        let devices = tempfile::tempdir().unwrap();
        let node = |name: &str| std::fs::write(devices.path().join(name), "").unwrap();
        node("null");
        node("nvram");
        std::fs::create_dir(devices.path().join("dri")).unwrap();
        node("dri/card0");
        assert!(!has_gpu_in(devices.path()), "a display alone computes nothing");
        for name in ["dri/renderD128", "nvidia0", "nvhost-gpu", "mali0", "kgsl-3d0", "dxg"] {
            node(name);
            assert!(has_gpu_in(devices.path()), "{name}");
            std::fs::remove_file(devices.path().join(name)).unwrap();
        }
        assert!(!has_gpu_in(Path::new("/nowhere")));
    }
}
