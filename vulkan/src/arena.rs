//! The one device allocation: a buffer as large as the plan says, mapped for as long as it lives, divided into the
//! plan's sections.
//!
//! Companion computers share one memory between processor and GPU, so the host reads and writes sections in place; a
//! discrete card without host-visible local memory is served from system memory (correct, slower).

use crate::gpu::{Gpu, GpuError};
use ash::vk;
use config::plan::Plan;

/// A section's place in the arena, bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Section {
    pub offset: u64,
    pub bytes: u64,
}

pub(crate) struct Arena {
    gpu: Gpu,
    pub buffer: vk::Buffer,
    memory: vk::DeviceMemory,
    mapped: *mut u8,
    sections: Vec<(&'static str, Section)>,
    pub total_bytes: u64,
}

// SAFETY: the pointer is to memory owned by this struct; every access goes through `&self`/`&mut self` methods.
unsafe impl Send for Arena {}

impl Drop for Arena {
    fn drop(&mut self) {
        // SAFETY: the trainer waits for the device before it drops the arena; both handles are ours.
        unsafe {
            self.gpu.device().unmap_memory(self.memory);
            self.gpu.device().destroy_buffer(self.buffer, None);
            self.gpu.device().free_memory(self.memory, None);
        }
    }
}

impl Arena {
    /// # Errors
    /// The device has no such memory.
    pub fn new(gpu: &Gpu, plan: &Plan) -> Result<Self, GpuError> {
        let device = gpu.device();
        let bytes = plan.total_bytes;
        let buffer = buffer(gpu, plan)?;
        // SAFETY: buffer and memory are ours; on failure the buffer is destroyed.
        unsafe {
            let made = memory_kind(gpu, buffer, plan).and_then(|kind| allocate(gpu, buffer, bytes, kind));
            let (memory, mapped) = made.inspect_err(|_| device.destroy_buffer(buffer, None))?;
            let mut offset = 0;
            let mut sections = Vec::with_capacity(plan.sections.len());
            for (name, bytes) in &plan.sections {
                sections.push((*name, Section { offset, bytes: *bytes }));
                offset += bytes;
            }
            // Unwritten moments and margins must read as zero.
            std::ptr::write_bytes(mapped, 0, bytes as usize);
            Ok(Self { gpu: gpu.clone(), buffer, memory, mapped, sections, total_bytes: bytes })
        }
    }

    /// Whether the device has room for the plan, as far as that is known without an allocation.
    ///
    /// # Errors
    /// As [`Arena::new`].
    pub fn check(gpu: &Gpu, plan: &Plan) -> Result<(), GpuError> {
        let buffer = buffer(gpu, plan)?;
        let kind = memory_kind(gpu, buffer, plan);
        // SAFETY: the buffer is ours and nothing refers to it.
        unsafe { gpu.device().destroy_buffer(buffer, None) };
        kind.map(|_| ())
    }

    /// The section `name`; an unknown name has no bytes (the tests bind every kernel, so a slip shows at once).
    pub fn section(&self, name: &str) -> Section {
        self.sections.iter().find(|s| s.0 == name).map_or(Section { offset: 0, bytes: 0 }, |s| s.1)
    }

    /// Slot `slot` of the views.
    pub fn view_slot(&self, plan: &Plan, slot: usize) -> Section {
        let bytes = config::plan::view_bytes(plan.pixels as u64);
        Section { offset: self.section("views").offset + slot as u64 * bytes, bytes }
    }

    /// The section's content as `T`s. The device must be idle.
    pub fn slice<T: bytemuck::AnyBitPattern>(&self, section: Section) -> &[T] {
        // SAFETY: sections lie inside the mapping, are 256-byte aligned and T is plain data; the caller waits for the
        // device first, and `&self` keeps the host from writing meanwhile.
        unsafe {
            std::slice::from_raw_parts(
                self.mapped.add(section.offset as usize).cast::<T>(),
                section.bytes as usize / size_of::<T>(),
            )
        }
    }

    /// As [`Self::slice`], to write.
    pub fn slice_mut<T: bytemuck::AnyBitPattern + bytemuck::NoUninit>(&mut self, section: Section) -> &mut [T] {
        // SAFETY: as in `slice`; `&mut self` makes the access exclusive on the host.
        unsafe {
            std::slice::from_raw_parts_mut(
                self.mapped.add(section.offset as usize).cast::<T>(),
                section.bytes as usize / size_of::<T>(),
            )
        }
    }
}

fn named(call: &'static str, e: vk::Result, bytes: u64) -> GpuError {
    match GpuError::from_vk(call, e) {
        GpuError::OutOfMemory { .. } => GpuError::OutOfMemory { bytes },
        other => other,
    }
}

fn buffer(gpu: &Gpu, plan: &Plan) -> Result<vk::Buffer, GpuError> {
    let usage = vk::BufferUsageFlags::STORAGE_BUFFER
        | vk::BufferUsageFlags::UNIFORM_BUFFER
        | vk::BufferUsageFlags::UNIFORM_TEXEL_BUFFER
        | vk::BufferUsageFlags::TRANSFER_DST
        | vk::BufferUsageFlags::TRANSFER_SRC;
    let create = vk::BufferCreateInfo::default().size(plan.buffer_bytes()).usage(usage);
    // SAFETY: the create info is complete and outlives the call.
    unsafe { gpu.device().create_buffer(&create, None) }.map_err(|e| named("vkCreateBuffer", e, plan.buffer_bytes()))
}

/// The memory type that serves the plan best: local, mapped, and what the driver wants for the buffer fits the plan.
fn memory_kind(gpu: &Gpu, buffer: vk::Buffer, plan: &Plan) -> Result<u32, GpuError> {
    let (needs, bytes) = (gpu.buffer_needs(buffer), plan.total_bytes);
    if needs.size > bytes {
        return Err(GpuError::PlanMismatch { wanted: needs.size, planned: bytes });
    }
    let properties = gpu.memory_properties();
    let usable = vk::MemoryPropertyFlags::HOST_VISIBLE | vk::MemoryPropertyFlags::HOST_COHERENT;
    let local = vk::MemoryPropertyFlags::DEVICE_LOCAL;
    let cached = vk::MemoryPropertyFlags::HOST_CACHED;
    let heap = |t: &vk::MemoryType| properties.memory_heaps[t.heap_index as usize].size;
    let find = |flags: vk::MemoryPropertyFlags| {
        properties.memory_types_as_slice().iter().enumerate().position(|(i, t)| {
            needs.memory_type_bits & (1 << i) != 0 && t.property_flags.contains(flags) && heap(t) >= bytes
        })
    };
    let kind = [usable | local | cached, usable | local, usable | cached, usable].into_iter().find_map(find);
    kind.map(|kind| kind as u32).ok_or(GpuError::NoMemoryType { bytes })
}

/// The only `vkAllocateMemory` of the crate.
///
/// # Safety
/// `buffer` was made by `gpu`, needs at most `bytes` of memory of type `kind`, and has none yet.
unsafe fn allocate(
    gpu: &Gpu,
    buffer: vk::Buffer,
    bytes: u64,
    kind: u32,
) -> Result<(vk::DeviceMemory, *mut u8), GpuError> {
    let device = gpu.device();
    // SAFETY: by this function's contract; the memory is bound once and mapped whole.
    unsafe {
        let info = vk::MemoryAllocateInfo::default().allocation_size(bytes).memory_type_index(kind);
        let memory = device.allocate_memory(&info, None).map_err(|e| named("vkAllocateMemory", e, bytes))?;
        let mapped = device
            .bind_buffer_memory(buffer, memory, 0)
            .and_then(|()| device.map_memory(memory, 0, vk::WHOLE_SIZE, vk::MemoryMapFlags::empty()));
        match mapped {
            Ok(pointer) => Ok((memory, pointer.cast::<u8>())),
            Err(e) => {
                device.free_memory(memory, None);
                Err(named("vkMapMemory", e, bytes))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::Forced;
    use config::plan::{DRIVER_ROOM, PlanRequest};

    #[test]
    fn what_a_driver_adds_to_the_buffer_fits_the_plan_and_more_than_its_room_is_refused() {
        let plan =
            Plan::with_capacities(&PlanRequest { width: 64, height: 48, views: 1, ..Default::default() }, 300, 1000);
        // 256: what V3DV adds.
        for (padding, fits) in [(0, true), (256, true), (DRIVER_ROOM, true), (DRIVER_ROOM + (1 << 20), false)] {
            let Ok(gpu) = Gpu::open(None) else { return println!("skipped: no Vulkan device") };
            let gpu = gpu.forced(Forced { padding, ..Forced::default() });
            let made = Arena::new(&gpu, &plan);
            assert_eq!(Arena::check(&gpu, &plan).err(), made.as_ref().err().cloned());
            match (made, fits) {
                (Ok(arena), true) => assert_eq!(arena.total_bytes, plan.total_bytes),
                (Err(GpuError::PlanMismatch { wanted, planned }), false) => {
                    assert!(wanted > planned && planned == plan.total_bytes);
                }
                (other, _) => panic!("{padding}: {:?}", other.err()),
            }
        }
    }
}
