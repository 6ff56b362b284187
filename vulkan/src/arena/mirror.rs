//! The host's mirror of what it reads and writes of an arena that lies in a card's own memory.
//!
//! Each part is the newer one on the host, on the device, or the same on both. What the host wrote goes to the device at the start of
//! the next recording; what kernels may have written comes back when the host looks at it, or, where a recording knows what will be
//! looked at, at its end.

use super::memory::{allocate, map};
use super::named;
use crate::gpu::{GpuError, Vulkan};
use crate::layout::Section;
use ash::vk;
use config::plan::{Plan, view_bytes};
use std::cell::{Cell, RefCell};

/// Copying a plan takes a second at most.
const TIMEOUT_NS: u64 = 60_000_000_000;

/// Which of the two is right.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Newer {
    Neither,
    Host,
    Device,
}

struct Part {
    name: &'static str,
    /// Where it lies on the device; of the views the slot at hand.
    section: Cell<Section>,
    /// Where it lies in the mirror.
    at: u64,
    newer: Cell<Newer>,
}

impl Part {
    /// Kernels only read these.
    fn is_hosts_alone(&self) -> bool {
        ["frame", "views"].contains(&self.name)
    }

    fn holds(&self, section: Section) -> bool {
        let own = self.section.get();
        own.offset <= section.offset && section.offset + section.bytes <= own.offset + own.bytes
    }
}

pub(super) struct Mirror {
    gpu: Vulkan,
    /// The arena's.
    device_buffer: vk::Buffer,
    buffer: vk::Buffer,
    memory: vk::DeviceMemory,
    mapped: *mut u8,
    parts: Vec<Part>,
    views: Section,
    slot_bytes: u64,
    /// Of memory, as the driver rounds them.
    pub bytes: u64,
    pool: vk::CommandPool,
    commands: vk::CommandBuffer,
    fence: vk::Fence,
    /// Why a copy did not happen, until somebody asks.
    failed: RefCell<Option<GpuError>>,
}

impl Drop for Mirror {
    fn drop(&mut self) {
        let device = self.gpu.device();
        // SAFETY: every copy was waited for; the handles are ours, and null ones may be destroyed.
        unsafe {
            device.destroy_fence(self.fence, None);
            device.destroy_command_pool(self.pool, None);
            device.destroy_buffer(self.buffer, None);
            device.free_memory(self.memory, None);
        }
    }
}

impl Mirror {
    /// All zero, as the arena in `device_buffer`, whose `sections` are as the plan has them.
    ///
    /// # Errors
    /// The host has no such memory, or the device no queue for copies.
    pub fn new(
        gpu: &Vulkan,
        plan: &Plan,
        device_buffer: vk::Buffer,
        sections: &[(&'static str, Section)],
        kind: u32,
    ) -> Result<Self, GpuError> {
        let section = |name: &str| sections.iter().find(|s| s.0 == name).map(|s| s.1);
        let mut at = 0;
        let parts = plan.mirrored().filter_map(|(name, bytes)| {
            let section = Cell::new(Section { bytes, ..section(name)? });
            at += bytes;
            Some(Part { name, section, at: at - bytes, newer: Cell::new(Newer::Neither) })
        });
        let parts: Vec<_> = parts.collect();
        let device = gpu.device();
        let bytes = plan.mirror_bytes().max(16);
        let usage = vk::BufferUsageFlags::TRANSFER_SRC | vk::BufferUsageFlags::TRANSFER_DST;
        let mut made = Self {
            gpu: gpu.clone(),
            device_buffer,
            buffer: vk::Buffer::null(),
            memory: vk::DeviceMemory::null(),
            mapped: std::ptr::null_mut(),
            parts,
            views: section("views").unwrap_or(Section { offset: 0, bytes: 0 }),
            slot_bytes: view_bytes(plan.pixels as u64),
            bytes: 0,
            pool: vk::CommandPool::null(),
            commands: vk::CommandBuffer::null(),
            fence: vk::Fence::null(),
            failed: RefCell::new(None),
        };
        // SAFETY: `made` owns each handle as soon as it exists, so that an early return destroys what was made; the memory is as large
        // as the buffer needs, mapped once, and written within its bytes.
        unsafe {
            let create = vk::BufferCreateInfo::default().size(bytes).usage(usage);
            made.buffer = device.create_buffer(&create, None).map_err(|e| named("vkCreateBuffer", e, bytes))?;
            made.bytes = device.get_buffer_memory_requirements(made.buffer).size;
            made.memory = allocate(gpu, made.buffer, made.bytes, kind)?;
            made.mapped = map(gpu, made.memory, made.bytes)?;
            std::ptr::write_bytes(made.mapped, 0, bytes as usize);
            let flags = vk::CommandPoolCreateFlags::RESET_COMMAND_BUFFER;
            let pool = vk::CommandPoolCreateInfo::default().queue_family_index(gpu.family()).flags(flags);
            made.pool = device.create_command_pool(&pool, None).map_err(|e| named("vkCreateCommandPool", e, 0))?;
            let one = vk::CommandBufferAllocateInfo::default().command_pool(made.pool).command_buffer_count(1);
            made.commands =
                device.allocate_command_buffers(&one).map_err(|e| named("vkAllocateCommandBuffers", e, 0))?[0];
            let fence = device.create_fence(&vk::FenceCreateInfo::default(), None);
            made.fence = fence.map_err(|e| named("vkCreateFence", e, 0))?;
        }
        made.submit(|m| {
            let (device, all) = (m.gpu.device(), vk::WHOLE_SIZE);
            // SAFETY: the commands are being recorded and the buffer may be filled.
            unsafe { device.cmd_fill_buffer(m.commands, m.device_buffer, 0, all, 0) };
        })?;
        Ok(made)
    }

    /// Why a copy did not happen since this was last asked; what was looked at then was old.
    pub fn take_failure(&self) -> Option<GpuError> {
        self.failed.borrow_mut().take()
    }

    /// Where the host finds `section`, the newer of the two, for as many bytes as it has; null where there is no mirror of it.
    pub fn read(&self, section: Section) -> *mut u8 {
        let Some(part) = self.part_of(section) else {
            debug_assert!(false, "no mirror of {section:?}");
            return std::ptr::null_mut();
        };
        if part.newer.get() == Newer::Device {
            self.copy_now(part, false);
        }
        // SAFETY: a part lies inside the mapping, and the section inside the part.
        unsafe { self.mapped.add((part.at + section.offset - part.section.get().offset) as usize) }
    }

    /// As [`Self::read`], to write: the device gets it before its next kernel.
    pub fn write(&self, section: Section) -> *mut u8 {
        let place = self.read(section);
        if let Some(part) = self.part_of(section) {
            part.newer.set(Newer::Host);
        }
        place
    }

    /// Bytes of a section that has no mirror, by way of the picture's.
    pub fn copied(&self, section: Section) -> Vec<u8> {
        let Some(way) = self.parts.iter().find(|part| part.name == "image") else { return Vec::new() };
        let mut bytes = Vec::with_capacity(section.bytes as usize);
        let own = way.section.get();
        while (bytes.len() as u64) < section.bytes {
            let done = bytes.len() as u64;
            let size = own.bytes.min(section.bytes - done);
            way.section.set(Section { offset: section.offset + done, bytes: size });
            self.copy_now(way, false);
            // SAFETY: the part is at least `size` bytes inside the mapping, and no copy is under way.
            bytes.extend(unsafe { std::slice::from_raw_parts(self.mapped.add(way.at as usize), size as usize) });
        }
        way.section.set(own);
        way.newer.set(Newer::Device);
        bytes
    }

    /// Records what brings the device up to date; whatever kernels may write is the device's from here on.
    ///
    /// # Safety
    /// `commands` is being recorded, and what it runs is submitted before the host looks at anything.
    pub unsafe fn before_kernels(&self, commands: vk::CommandBuffer) {
        for part in &self.parts {
            if part.newer.get() == Newer::Host {
                // SAFETY: by this function's contract.
                unsafe { self.record(commands, part, true) };
                part.newer.set(Newer::Neither);
            }
            if !part.is_hosts_alone() {
                part.newer.set(Newer::Device);
            }
        }
    }

    /// Records what brings the host up to date on the sections of these names.
    ///
    /// # Safety
    /// `commands` is being recorded, behind a barrier after its last kernel.
    pub unsafe fn after_kernels(&self, commands: vk::CommandBuffer, names: &[&str]) {
        for part in self.parts.iter().filter(|part| names.contains(&part.name)) {
            // SAFETY: by this function's contract.
            unsafe { self.record(commands, part, false) };
            part.newer.set(Newer::Neither);
        }
    }

    /// The part that `section` lies in; another slot of the views takes the place of the one at hand.
    fn part_of(&self, section: Section) -> Option<&Part> {
        let views = self.views.offset..self.views.offset + self.views.bytes;
        if views.contains(&section.offset) {
            let part = self.parts.iter().find(|part| part.name == "views")?;
            if !part.holds(section) {
                if part.newer.get() == Newer::Host {
                    self.copy_now(part, true);
                }
                let offset = section.offset - (section.offset - self.views.offset) % self.slot_bytes;
                part.section.set(Section { offset, bytes: self.slot_bytes });
                part.newer.set(Newer::Device);
            }
        }
        self.parts.iter().find(|part| part.holds(section))
    }

    fn copy_now(&self, part: &Part, to_device: bool) {
        // SAFETY: `submit` has the commands recorded.
        let done = self.submit(|m| unsafe { m.record(m.commands, part, to_device) });
        part.newer.set(Newer::Neither);
        if let Err(e) = done {
            self.failed.borrow_mut().get_or_insert(e);
        }
    }

    /// # Safety
    /// `commands` is being recorded.
    unsafe fn record(&self, commands: vk::CommandBuffer, part: &Part, to_device: bool) {
        let Section { offset, bytes } = part.section.get();
        let (device, region) = (self.gpu.device(), vk::BufferCopy::default().size(bytes));
        // SAFETY: a part lies inside both buffers, which may be copied from and to; they are two.
        unsafe {
            if to_device {
                let region = region.src_offset(part.at).dst_offset(offset);
                device.cmd_copy_buffer(commands, self.buffer, self.device_buffer, &[region]);
            } else {
                let region = region.src_offset(offset).dst_offset(part.at);
                device.cmd_copy_buffer(commands, self.device_buffer, self.buffer, &[region]);
            }
        }
    }

    /// Runs what `record` records and waits for it.
    fn submit(&self, record: impl FnOnce(&Self)) -> Result<(), GpuError> {
        let device = self.gpu.device();
        let failed = |call: &'static str| move |e| GpuError::from_vk(call, e);
        let begin = vk::CommandBufferBeginInfo::default().flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
        let copies = vk::AccessFlags::TRANSFER_READ | vk::AccessFlags::TRANSFER_WRITE;
        let others = vk::AccessFlags::MEMORY_READ | vk::AccessFlags::MEMORY_WRITE;
        let before = [vk::MemoryBarrier::default().src_access_mask(others).dst_access_mask(copies)];
        let after = [vk::MemoryBarrier::default().src_access_mask(copies).dst_access_mask(others)];
        // Kernels of earlier and later submissions, and the host.
        let (transfer, all) = (vk::PipelineStageFlags::TRANSFER, vk::PipelineStageFlags::ALL_COMMANDS);
        let all_and_host = all | vk::PipelineStageFlags::HOST;
        let buffers = [self.commands];
        let submit = [vk::SubmitInfo::default().command_buffers(&buffers)];
        // SAFETY: the commands are not pending, are recorded and submitted once and waited for.
        unsafe {
            device.begin_command_buffer(self.commands, &begin).map_err(failed("vkBeginCommandBuffer"))?;
            let none = vk::DependencyFlags::empty();
            device.cmd_pipeline_barrier(self.commands, all, transfer, none, &before, &[], &[]);
            record(self);
            device.cmd_pipeline_barrier(self.commands, transfer, all_and_host, none, &after, &[], &[]);
            device.end_command_buffer(self.commands).map_err(failed("vkEndCommandBuffer"))?;
            device.queue_submit(self.gpu.queue(), &submit, self.fence).map_err(failed("vkQueueSubmit"))?;
            match device.wait_for_fences(&[self.fence], true, TIMEOUT_NS) {
                Ok(()) => device.reset_fences(&[self.fence]).map_err(failed("vkResetFences")),
                Err(vk::Result::TIMEOUT) => Err(GpuError::DeviceLost { during: "vkWaitForFences" }),
                Err(e) => Err(GpuError::from_vk("vkWaitForFences", e)),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::fixture::Fixture;
    use crate::gpu::{Forced, Gpu};
    use crate::synthetic::{cloud, photo, plain, posed, view};
    use crate::trainer::{Rendering, RunBudget};
    use config::plan::{Plan, PlanRequest};
    use config::training::Strategy;
    use models::cloud::GaussianCloud;
    use std::ops::ControlFlow;

    /// Growth, degrees that rise, views that wait in a file: all that the host has a hand in.
    fn trained(apart: bool) -> Option<(GaussianCloud, Rendering, Vec<image::RgbImage>, u64)> {
        let gpu = Gpu::open_by_driver(None).ok()?.forced(Forced { apart, ..Forced::default() });
        let v = view(64, 48);
        let mut settings = plain();
        settings.density.strategy = Strategy::Relocate;
        settings.sh.raise_share = 0.5;
        settings.regularise.noise = 2.0;
        let request = PlanRequest { width: 64, height: 48, views: 3, view_slots: Some(2), ..Default::default() };
        let mut trainer = Fixture::new(&gpu, &Plan::with_capacities(&request, 500, 4000), &settings).unwrap();
        trainer.pictures.keep_in(tempfile::tempfile().unwrap());
        trainer.load(&cloud(8, 300, 3)).unwrap();
        for seed in 1..4 {
            trainer.add_view(&posed(&v, &photo(seed, &v)), None).unwrap();
        }
        let budget = RunBudget { steps: Some(150), ..Default::default() };
        trainer.run(&budget, &mut |_| ControlFlow::Continue(())).unwrap();
        let (mut cloud, mut drawn) = (GaussianCloud::default(), Rendering::default());
        trainer.snapshot(&mut cloud).unwrap();
        trainer.render(&v, &mut drawn).unwrap();
        let pictures = (0..3).map(|i| trainer.view_image(i).unwrap()).collect();
        Some((cloud, drawn, pictures, trainer.device().mirror_bytes()))
    }

    #[test]
    fn a_card_s_model_is_the_same_to_the_bit_and_its_mirror_as_large_as_planned() {
        let Some(mapped) = trained(false) else { return needs::missing(needs::Need::Vulkan, "no Vulkan device") };
        let Some(mirrored) = trained(true) else { return };
        assert!(mapped.0.len() > 300, "nothing grew");
        assert!((&mapped.0, &mapped.1, &mapped.2) == (&mirrored.0, &mirrored.1, &mirrored.2));
        let request = PlanRequest { width: 64, height: 48, views: 3, view_slots: Some(2), ..Default::default() };
        let planned = Plan::with_capacities(&request, 500, 4000).mirror_bytes();
        assert!((planned..planned + 4096).contains(&mirrored.3), "{} of {planned}", mirrored.3);
    }
}
