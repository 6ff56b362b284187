//! The one device allocation: a buffer as large as the plan says, divided into the plan's sections.
//!
//! Where processor and GPU share one memory, as on companion computers, the host reads and writes sections in place; of a plan that
//! lies in a card's own memory it has a mirror. Where the processor is the device, the allocation is the host's.

mod host;
mod memory;
mod mirror;

use crate::gpu::{Gpu, GpuError, Vulkan};
use crate::layout::Section;
use ash::vk;
use config::plan::Plan;
use host::HostMemory;
use memory::{Placement, allocate, map, placement};
use mirror::Mirror;

/// How the host gets at the sections.
enum Host {
    /// All of them, in place.
    Mapped(*mut u8),
    /// Those that it works on.
    Mirrored(Box<Mirror>),
}

/// Who allocated it.
enum Owner {
    /// A driver, for this device.
    Driver { gpu: Vulkan, memory: vk::DeviceMemory },
    /// This program.
    Host { _memory: HostMemory },
}

pub(crate) struct Arena {
    host: Host,
    owner: Owner,
    /// Null where there is no driver.
    pub buffer: vk::Buffer,
    sections: Vec<(&'static str, Section)>,
    pub total_bytes: u64,
}

// SAFETY: the pointers are to memory owned by this struct; every access goes through `&self`/`&mut self` methods.
unsafe impl Send for Arena {}

impl Drop for Arena {
    fn drop(&mut self) {
        if let Owner::Driver { gpu, memory } = &self.owner {
            // SAFETY: the trainer waits for the device before it drops the arena; both handles are ours. Memory is unmapped when it is
            // freed.
            unsafe {
                gpu.device().destroy_buffer(self.buffer, None);
                gpu.device().free_memory(*memory, None);
            }
        }
    }
}

impl Arena {
    /// # Errors
    /// The device has no such memory.
    pub fn new(gpu: &Gpu, plan: &Plan) -> Result<Self, GpuError> {
        match gpu.vulkan() {
            Some(gpu) => Self::by_driver(gpu, plan),
            None => Self::by_host(plan),
        }
    }

    fn by_host(plan: &Plan) -> Result<Self, GpuError> {
        let memory = HostMemory::new(plan.total_bytes)?;
        Ok(Self {
            host: Host::Mapped(memory.first()),
            owner: Owner::Host { _memory: memory },
            buffer: vk::Buffer::null(),
            sections: laid_out(plan),
            total_bytes: plan.total_bytes,
        })
    }

    /// # Errors
    /// As [`Self::new`].
    pub fn by_driver(gpu: &Vulkan, plan: &Plan) -> Result<Self, GpuError> {
        let bytes = plan.total_bytes;
        let mut made = Self {
            host: Host::Mapped(std::ptr::null_mut()),
            owner: Owner::Driver { gpu: gpu.clone(), memory: vk::DeviceMemory::null() },
            buffer: buffer(gpu, plan)?,
            sections: laid_out(plan),
            total_bytes: bytes,
        };
        let placed = placement(gpu, made.buffer, plan)?;
        let (Placement::Mapped(kind) | Placement::Mirrored { device: kind, .. }) = placed;
        // SAFETY: `made` owns buffer and memory as soon as they exist; the memory is mapped once, where it is host-visible, and written
        // within its bytes.
        unsafe {
            let allocated = allocate(gpu, made.buffer, bytes, kind)?;
            made.owner = Owner::Driver { gpu: gpu.clone(), memory: allocated };
            // Unwritten moments and margins must read as zero.
            made.host = match placed {
                Placement::Mapped(_) => {
                    let mapped = map(gpu, allocated, bytes)?;
                    std::ptr::write_bytes(mapped, 0, bytes as usize);
                    Host::Mapped(mapped)
                }
                Placement::Mirrored { host, .. } => {
                    Host::Mirrored(Box::new(Mirror::new(gpu, plan, made.buffer, &made.sections, host)?))
                }
            };
        }
        Ok(made)
    }

    /// Whether the device has room for the plan, as far as that is known without an allocation.
    ///
    /// # Errors
    /// As [`Arena::new`].
    pub fn check(gpu: &Gpu, plan: &Plan) -> Result<(), GpuError> {
        let Some(gpu) = gpu.vulkan() else { return Ok(()) };
        let buffer = buffer(gpu, plan)?;
        let placed = placement(gpu, buffer, plan);
        // SAFETY: the buffer is ours and nothing refers to it.
        unsafe { gpu.device().destroy_buffer(buffer, None) };
        placed.map(|_| ())
    }

    /// The section `name`; an unknown name has no bytes (the tests bind every kernel, so a slip shows at once).
    pub fn section(&self, name: &str) -> Section {
        section_of(&self.sections, name)
    }

    /// Slot `slot` of the views.
    pub fn view_slot(&self, plan: &Plan, slot: usize) -> Section {
        slot_of(self.section("views"), plan, slot)
    }

    /// The section's content as `T`s. The device must be idle, and the host work on the section ([`Plan::mirrored`]).
    pub fn slice<T: bytemuck::AnyBitPattern>(&self, section: Section) -> &[T] {
        let at = match &self.host {
            // SAFETY: sections lie inside the mapping.
            Host::Mapped(mapped) => unsafe { mapped.add(section.offset as usize) },
            Host::Mirrored(mirror) => mirror.read(section),
        };
        if at.is_null() {
            return &[];
        }
        // SAFETY: sections lie inside the mapping, are 256-byte aligned and T is plain data; the caller waits for the device first,
        // and `&self` keeps the host from writing meanwhile (a mirror is brought up to date where no slice of it can be: kernels
        // have run since the last one).
        unsafe { std::slice::from_raw_parts(at.cast::<T>(), section.bytes as usize / size_of::<T>()) }
    }

    /// As [`Self::slice`], to write.
    pub fn slice_mut<T: bytemuck::AnyBitPattern + bytemuck::NoUninit>(&mut self, section: Section) -> &mut [T] {
        let at = match &self.host {
            // SAFETY: sections lie inside the mapping.
            Host::Mapped(mapped) => unsafe { mapped.add(section.offset as usize) },
            Host::Mirrored(mirror) => mirror.write(section),
        };
        if at.is_null() {
            return &mut [];
        }
        // SAFETY: as in `slice`; `&mut self` makes the access exclusive on the host.
        unsafe { std::slice::from_raw_parts_mut(at.cast::<T>(), section.bytes as usize / size_of::<T>()) }
    }

    /// All of it in the host's memory; nothing where the host has a mirror.
    pub fn in_place(&self) -> Option<InPlace<'_>> {
        match &self.host {
            Host::Mapped(base) => Some(InPlace { base: *base, sections: &self.sections }),
            Host::Mirrored(_) => None,
        }
    }

    /// A copy of any section's content, the kernels' own among them. The device must be idle.
    pub fn copied<T: bytemuck::AnyBitPattern + bytemuck::NoUninit>(&self, section: Section) -> Vec<T> {
        match &self.host {
            Host::Mapped(_) => self.slice(section).to_vec(),
            Host::Mirrored(mirror) => bytemuck::pod_collect_to_vec(&mirror.copied(section)),
        }
    }

    /// Records what the host wrote since the last kernels ran; true when that was anything.
    ///
    /// Bytes of the host's memory that the mirror takes, if there is one.
    pub fn mirror_bytes(&self) -> u64 {
        match &self.host {
            Host::Mapped(_) => 0,
            Host::Mirrored(mirror) => mirror.bytes,
        }
    }

    /// # Errors
    /// What kept the host from seeing what the kernels before had written.
    ///
    /// # Safety
    /// `commands` is being recorded, and is submitted before the host looks at anything.
    pub unsafe fn before_kernels(&self, commands: vk::CommandBuffer) -> Result<bool, GpuError> {
        let Host::Mirrored(mirror) = &self.host else { return Ok(false) };
        self.failure()?;
        // SAFETY: by this function's contract.
        unsafe { mirror.before_kernels(commands) };
        Ok(true)
    }

    /// Records what lets the host see what kernels wrote into the sections of these names; it sees the others when it looks.
    ///
    /// # Safety
    /// `commands` is being recorded, behind a barrier after its last kernel.
    pub unsafe fn after_kernels(&self, commands: vk::CommandBuffer, names: &[&str]) {
        if let Host::Mirrored(mirror) = &self.host {
            // SAFETY: by this function's contract.
            unsafe { mirror.after_kernels(commands, names) };
        }
    }

    /// # Errors
    /// What kept the host from seeing what kernels wrote, since this was last asked: what it read then is old.
    pub fn failure(&self) -> Result<(), GpuError> {
        match &self.host {
            Host::Mapped(_) => Ok(()),
            Host::Mirrored(mirror) => mirror.take_failure().map_or(Ok(()), Err),
        }
    }
}

/// Slot `slot` of the section `views`.
pub(crate) fn slot_of(views: Section, plan: &Plan, slot: usize) -> Section {
    let bytes = config::plan::view_bytes(plan.pixels as u64);
    Section { offset: views.offset + slot as u64 * bytes, bytes }
}

fn section_of(sections: &[(&'static str, Section)], name: &str) -> Section {
    sections.iter().find(|s| s.0 == name).map_or(Section { offset: 0, bytes: 0 }, |s| s.1)
}

/// An arena whose sections all lie in the host's memory.
#[derive(Clone, Copy)]
pub(crate) struct InPlace<'a> {
    base: *mut u8,
    sections: &'a [(&'static str, Section)],
}

// SAFETY: it tells where sections lie; who reads and writes there answers for it.
unsafe impl Sync for InPlace<'_> {}

impl InPlace<'_> {
    /// As [`Arena::section`].
    pub fn section(&self, name: &str) -> Section {
        section_of(self.sections, name)
    }

    /// Where a section begins.
    pub fn at(&self, section: Section) -> *mut u8 {
        // SAFETY: sections lie inside the mapping.
        unsafe { self.base.add(section.offset as usize) }
    }
}

/// Where each section lies.
fn laid_out(plan: &Plan) -> Vec<(&'static str, Section)> {
    let mut offset = 0;
    let sections = plan.sections.iter().map(|(name, bytes)| {
        offset += bytes;
        (*name, Section { offset: offset - bytes, bytes: *bytes })
    });
    sections.collect()
}

fn named(call: &'static str, e: vk::Result, bytes: u64) -> GpuError {
    match GpuError::from_vk(call, e) {
        GpuError::OutOfMemory { .. } => GpuError::OutOfMemory { bytes },
        other => other,
    }
}

fn buffer(gpu: &Vulkan, plan: &Plan) -> Result<vk::Buffer, GpuError> {
    let usage = vk::BufferUsageFlags::STORAGE_BUFFER
        | vk::BufferUsageFlags::UNIFORM_BUFFER
        | vk::BufferUsageFlags::UNIFORM_TEXEL_BUFFER
        | vk::BufferUsageFlags::TRANSFER_DST
        | vk::BufferUsageFlags::TRANSFER_SRC;
    let create = vk::BufferCreateInfo::default().size(plan.buffer_bytes()).usage(usage);
    // SAFETY: the create info is complete and outlives the call.
    unsafe { gpu.device().create_buffer(&create, None) }.map_err(|e| named("vkCreateBuffer", e, plan.buffer_bytes()))
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
            let Ok(gpu) = Gpu::open_by_driver(None) else {
                return needs::missing(needs::Need::Vulkan, "no Vulkan device");
            };
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
