//! Which of the device's memories the plan is kept in, and the allocations.

use super::named;
use crate::gpu::{GpuError, Vulkan};
use ash::vk;
use ash::vk::MemoryPropertyFlags as Flags;
use config::plan::Plan;

/// Where the plan lies, and how the host gets at it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Placement {
    /// In memory of this type, mapped: the host reads and writes in place.
    Mapped(u32),
    /// In memory of type `device`, and what the host works on once more in its own, of type `host`.
    Mirrored { device: u32, host: u32 },
}

/// The memory that serves the plan best.
///
/// Companion computers share one memory between processor and GPU, so the host works in place. A card's own memory is either out of
/// the host's reach, or can be written by it well and read at a microsecond a word (an H100's: a training step took 114 ms, 113 of
/// them for reading 0.5 MB of sums): there the host has a mirror.
///
/// # Errors
/// The driver wants more than the plan, or no memory is large enough.
pub(super) fn placement(gpu: &Vulkan, buffer: vk::Buffer, plan: &Plan) -> Result<Placement, GpuError> {
    let (needs, bytes) = (gpu.buffer_needs(buffer), plan.total_bytes);
    if needs.size > bytes {
        return Err(GpuError::PlanMismatch { wanted: needs.size, planned: bytes });
    }
    let properties = gpu.memory_properties();
    let find = |bytes: u64, with: Flags, without: Flags| {
        let types = properties.memory_types_as_slice().iter().enumerate();
        let fits = |(i, t): &(usize, &vk::MemoryType)| {
            let flags = t.property_flags;
            needs.memory_type_bits & (1 << i) != 0
                && flags.contains(with)
                && !flags.intersects(without)
                && properties.memory_heaps[t.heap_index as usize].size >= bytes
        };
        types.clone().find(fits).map(|(i, _)| i as u32)
    };
    let (usable, local, cached) = (Flags::HOST_VISIBLE | Flags::HOST_COHERENT, Flags::DEVICE_LOCAL, Flags::HOST_CACHED);
    let host = [usable | cached, usable].into_iter().find_map(|with| find(plan.mirror_bytes(), with, local));
    let in_place = find(bytes, usable | local | cached, Flags::empty());
    let apart = find(bytes, local, Flags::HOST_VISIBLE).or_else(|| find(bytes, local, Flags::empty()));
    match (in_place, apart, host) {
        (Some(kind), ..) if !gpu.is_forced_apart() => return Ok(Placement::Mapped(kind)),
        (_, Some(device), Some(host)) => return Ok(Placement::Mirrored { device, host }),
        (Some(kind), ..) => return Ok(Placement::Mirrored { device: kind, host: kind }),
        _ => {}
    }
    let kinds = [usable | local, usable | cached, usable];
    let kind = kinds.into_iter().find_map(|with| find(bytes, with, Flags::empty()));
    kind.map(Placement::Mapped).ok_or(GpuError::NoMemoryType { bytes })
}

/// Allocates memory and gives it to `buffer`. The only `vkAllocateMemory` of the crate: once for the plan, once for its mirror where
/// there is one.
///
/// # Safety
/// `buffer` was made by `gpu`, needs at most `bytes` of memory of type `kind`, and has none yet.
pub(super) unsafe fn allocate(
    gpu: &Vulkan,
    buffer: vk::Buffer,
    bytes: u64,
    kind: u32,
) -> Result<vk::DeviceMemory, GpuError> {
    let device = gpu.device();
    // SAFETY: by this function's contract; the memory is bound once, and freed when it cannot be.
    unsafe {
        let info = vk::MemoryAllocateInfo::default().allocation_size(bytes).memory_type_index(kind);
        let memory = device.allocate_memory(&info, None).map_err(|e| named("vkAllocateMemory", e, bytes))?;
        match device.bind_buffer_memory(buffer, memory, 0) {
            Ok(()) => Ok(memory),
            Err(e) => {
                device.free_memory(memory, None);
                Err(named("vkBindBufferMemory", e, bytes))
            }
        }
    }
}

/// Maps all of `memory`.
///
/// # Safety
/// `memory` belongs to `gpu`, is host-visible, is not mapped, and holds `bytes`.
pub(super) unsafe fn map(gpu: &Vulkan, memory: vk::DeviceMemory, bytes: u64) -> Result<*mut u8, GpuError> {
    // SAFETY: by this function's contract.
    let mapped = unsafe { gpu.device().map_memory(memory, 0, vk::WHOLE_SIZE, vk::MemoryMapFlags::empty()) };
    mapped.map(<*mut _>::cast).map_err(|e| named("vkMapMemory", e, bytes))
}
