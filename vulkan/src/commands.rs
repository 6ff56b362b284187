//! Kernels in order, again and again: of a driver in one command buffer, with a barrier and a timestamp after each stage; of the processor
//! one by one. Nothing here allocates after start-up.

use crate::arena::Arena;
use crate::gpu::{GpuError, Vulkan};
use crate::kernels::{Group, KERNELS, Kernel};
use crate::layout::Push;
use crate::layout::Section;
use crate::pipelines::Pipelines;
use crate::processor::Processor;
use crate::stages::Stage;
use crate::times::{self, Times};
use ash::vk;
use std::cell::Cell;
use std::time::Instant;

/// Timestamps per submission; a submission that dispatches more leaves the rest untimed.
const STAMPS: usize = 64;

/// How long a submission may take before the device counts as lost: lavapipe on a small board may need long.
const TIMEOUT_NS: u64 = 600_000_000_000;

/// A driver's command buffer.
pub(crate) struct Commands {
    gpu: Vulkan,
    pool: vk::CommandPool,
    buffer: vk::CommandBuffer,
    fence: vk::Fence,
    queries: vk::QueryPool,
    stamps: Cell<usize>,
    stages: [Cell<Stage>; STAMPS],
    /// What ran up to each timestamp; none where no kernel did.
    groups: [Cell<Option<Group>>; STAMPS],
}

impl Drop for Commands {
    fn drop(&mut self) {
        let device = self.gpu.device();
        // SAFETY: every submission was waited for; handles are ours.
        unsafe {
            device.destroy_query_pool(self.queries, None);
            device.destroy_fence(self.fence, None);
            device.destroy_command_pool(self.pool, None);
        }
    }
}

fn vulkan(call: &'static str) -> impl Fn(vk::Result) -> GpuError {
    move |e| GpuError::from_vk(call, e)
}

impl Commands {
    /// # Errors
    /// The device refuses a command pool, fence or query pool.
    pub fn new(gpu: &Vulkan) -> Result<Self, GpuError> {
        let device = gpu.device();
        let flags = vk::CommandPoolCreateFlags::RESET_COMMAND_BUFFER;
        let pool_info = vk::CommandPoolCreateInfo::default().queue_family_index(gpu.family()).flags(flags);
        let query_info =
            vk::QueryPoolCreateInfo::default().query_type(vk::QueryType::TIMESTAMP).query_count(STAMPS as u32);
        // SAFETY: `made` owns each handle as soon as it exists; null handles may be destroyed.
        unsafe {
            let pool = device.create_command_pool(&pool_info, None).map_err(vulkan("vkCreateCommandPool"))?;
            let mut made = Self {
                gpu: gpu.clone(),
                pool,
                buffer: vk::CommandBuffer::null(),
                fence: vk::Fence::null(),
                queries: vk::QueryPool::null(),
                stamps: Cell::new(0),
                stages: [const { Cell::new(Stage::Target) }; STAMPS],
                groups: [const { Cell::new(None) }; STAMPS],
            };
            let allocate = vk::CommandBufferAllocateInfo::default().command_pool(pool).command_buffer_count(1);
            made.buffer = device.allocate_command_buffers(&allocate).map_err(vulkan("vkAllocateCommandBuffers"))?[0];
            made.fence = device.create_fence(&vk::FenceCreateInfo::default(), None).map_err(vulkan("vkCreateFence"))?;
            made.queries = device.create_query_pool(&query_info, None).map_err(vulkan("vkCreateQueryPool"))?;
            Ok(made)
        }
    }

    /// Starts a recording; the one before was submitted or dropped.
    ///
    /// # Errors
    /// The device fails.
    pub fn begin<'a>(
        &'a self,
        pipelines: &'a Pipelines,
        arena: &'a Arena,
        times: &'a Times,
    ) -> Result<Recording<'a>, GpuError> {
        let info = vk::CommandBufferBeginInfo::default().flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
        let timed = self.gpu.timestamp_ns() > 0.0 && times.are_taken();
        // SAFETY: the buffer is not pending: `submit` waits.
        unsafe {
            let device = self.gpu.device();
            device.begin_command_buffer(self.buffer, &info).map_err(vulkan("vkBeginCommandBuffer"))?;
            self.stamps.set(0);
            if timed {
                device.cmd_reset_query_pool(self.buffer, self.queries, 0, STAMPS as u32);
            }
        }
        let recording = Recorded { commands: self, pipelines, arena, times, timed };
        // SAFETY: the buffer is being recorded, and a recording is submitted before the host goes on.
        if unsafe { arena.before_kernels(self.buffer)? } {
            recording.barrier();
        }
        recording.stamp(Stage::Target, None);
        Ok(Recording::Driver(recording))
    }

    fn collect_times(&self, times: &Times) {
        let stamps = self.stamps.get();
        if stamps < 2 {
            return;
        }
        let mut ticks = [0u64; STAMPS];
        // SAFETY: the submission that wrote these queries has completed.
        let read = unsafe {
            self.gpu.device().get_query_pool_results(
                self.queries,
                0,
                &mut ticks[..stamps],
                vk::QueryResultFlags::TYPE_64,
            )
        };
        if read.is_ok() {
            if times::is_traced() {
                self.tell_times(&ticks[..stamps]);
            }
            for i in 1..stamps {
                let ns = ticks[i].saturating_sub(ticks[i - 1]) as f64 * self.gpu.timestamp_ns();
                times.add(self.stages[i].get(), self.groups[i].get(), ns * 1e-6);
            }
        }
    }

    /// Tells of every stage in `ticks`. The two clocks are set by the end of the submission, which the host has just seen: its own
    /// way back, some microseconds, is taken for the device's.
    fn tell_times(&self, ticks: &[u64]) {
        let Some(last) = ticks.last() else { return };
        let ns = |ticks: u64| (ticks as f64 * self.gpu.timestamp_ns()) as u64;
        for (i, pair) in ticks.windows(2).enumerate() {
            let took_ns = ns(pair[1].saturating_sub(pair[0]));
            times::tell(self.stages[i + 1].get(), ns(last.saturating_sub(pair[0])), took_ns);
        }
    }
}

/// What kernels are run with: a driver records them and runs them when they are submitted; the processor runs each when it is asked for.
pub(crate) enum Recording<'a> {
    Driver(Recorded<'a>),
    Processor(Running<'a>),
}

impl Recording<'_> {
    /// Runs `kernel` on at least `lanes` lanes after everything before it.
    pub fn run(&self, kernel: Kernel, lanes: usize, push: Push) {
        match self {
            Self::Driver(r) => r.run(kernel, lanes, push),
            Self::Processor(r) => r.run(kernel, 0, push),
        }
    }

    /// Runs `kernel` again and again, `push.pass` counting from 0: work that goes on where the round before ended. For the processor one
    /// round is enough: no driver ends its loops.
    pub fn run_rounds(&self, kernel: Kernel, lanes: usize, push: Push, rounds: u32) {
        match self {
            Self::Driver(r) => r.run_rounds(kernel, lanes, push, rounds),
            Self::Processor(r) => r.run(kernel, 0, push),
        }
    }

    /// As [`Self::run`], with the picture in view slot `slot`.
    pub fn run_view(&self, kernel: Kernel, slot: usize, lanes: usize, push: Push) {
        match self {
            Self::Driver(r) => r.run_view(kernel, slot, lanes, push),
            Self::Processor(r) => r.run(kernel, slot, push),
        }
    }

    /// Zeroes a section's first `bytes` bytes (a multiple of four).
    pub fn clear(&self, section: Section, bytes: u64, stage: Stage) {
        match self {
            Self::Driver(r) => r.clear(section, bytes, stage),
            Self::Processor(r) => r.processor.clear(r.arena, section, bytes),
        }
    }

    /// Returns when all of it is done and the host can see it.
    ///
    /// # Errors
    /// The device fails or is lost.
    pub fn submit(self) -> Result<(), GpuError> {
        self.submit_and_read(&[])
    }

    /// As [`Self::submit`]; the host looks at the sections of these names next, which a mirror then has at once.
    ///
    /// # Errors
    /// Errors of [`Self::submit`].
    pub fn submit_and_read(self, sections: &[&str]) -> Result<(), GpuError> {
        match self {
            Self::Driver(r) => r.submit_and_read(sections),
            Self::Processor(_) => Ok(()),
        }
    }
}

/// Kernels that the processor runs one by one.
pub(crate) struct Running<'a> {
    pub processor: &'a Processor,
    pub arena: &'a Arena,
    pub times: &'a Times,
}

impl Running<'_> {
    fn run(&self, kernel: Kernel, slot: usize, push: Push) {
        let start = self.times.are_taken().then(Instant::now);
        self.processor.run(self.arena, kernel, slot, push);
        if let Some(took) = start.map(|start| start.elapsed()) {
            let info = &KERNELS[kernel as usize];
            if times::is_traced() {
                times::tell(info.stage, took.as_nanos() as u64, took.as_nanos() as u64);
            }
            self.times.add(info.stage, Some(info.group), took.as_secs_f64() * 1e3);
        }
    }
}

/// Kernels that a driver records.
pub(crate) struct Recorded<'a> {
    commands: &'a Commands,
    pipelines: &'a Pipelines,
    arena: &'a Arena,
    times: &'a Times,
    timed: bool,
}

impl Recorded<'_> {
    /// Runs `kernel` on at least `lanes` lanes after everything recorded before it.
    fn run(&self, kernel: Kernel, lanes: usize, push: Push) {
        self.dispatch(kernel, self.pipelines.set_of(kernel), lanes, push);
        self.stamp_kernel(kernel);
    }

    /// Runs `kernel` again and again, `push.pass` counting from 0: work that goes on where the round before ended.
    fn run_rounds(&self, kernel: Kernel, lanes: usize, push: Push, rounds: u32) {
        for pass in 0..rounds {
            self.dispatch(kernel, self.pipelines.set_of(kernel), lanes, Push { pass, ..push });
        }
        self.stamp_kernel(kernel);
    }

    /// As [`Self::run`], with the descriptor set of view slot `slot`.
    fn run_view(&self, kernel: Kernel, slot: usize, lanes: usize, push: Push) {
        self.dispatch(kernel, self.pipelines.view_set(slot), lanes, push);
        self.stamp_kernel(kernel);
    }

    fn dispatch(&self, kernel: Kernel, set: vk::DescriptorSet, lanes: usize, push: Push) {
        if self.commands.gpu.computes_nothing() {
            return;
        }
        let groups = self.pipelines.groups(kernel, lanes);
        let (device, buffer) = (self.commands.gpu.device(), self.commands.buffer);
        // SAFETY: the buffer is recording; pipeline, layout and set belong together and outlive the submission.
        unsafe {
            device.cmd_bind_pipeline(buffer, vk::PipelineBindPoint::COMPUTE, self.pipelines.pipeline_of(kernel));
            let layout = self.pipelines.layout;
            device.cmd_bind_descriptor_sets(buffer, vk::PipelineBindPoint::COMPUTE, layout, 0, &[set], &[]);
            let stages = vk::ShaderStageFlags::COMPUTE;
            device.cmd_push_constants(buffer, layout, stages, 0, bytemuck::bytes_of(&push));
            device.cmd_dispatch(buffer, groups, 1, 1);
        }
        self.barrier();
    }

    /// Zeroes a section's first `bytes` bytes (a multiple of four).
    fn clear(&self, section: Section, bytes: u64, stage: Stage) {
        // SAFETY: the range lies inside the arena's buffer, which has TRANSFER_DST usage.
        unsafe {
            let bytes = bytes.min(section.bytes);
            self.commands.gpu.device().cmd_fill_buffer(
                self.commands.buffer,
                self.arena.buffer,
                section.offset,
                bytes,
                0,
            );
        }
        self.barrier();
        self.stamp(stage, None);
    }

    fn barrier(&self) {
        let stages = vk::PipelineStageFlags::COMPUTE_SHADER | vk::PipelineStageFlags::TRANSFER;
        let all = vk::AccessFlags::SHADER_READ
            | vk::AccessFlags::SHADER_WRITE
            | vk::AccessFlags::TRANSFER_READ
            | vk::AccessFlags::TRANSFER_WRITE
            | vk::AccessFlags::UNIFORM_READ;
        let memory = [vk::MemoryBarrier::default().src_access_mask(all).dst_access_mask(all)];
        // SAFETY: the buffer is recording.
        unsafe {
            self.commands.gpu.device().cmd_pipeline_barrier(
                self.commands.buffer,
                stages,
                stages,
                vk::DependencyFlags::empty(),
                &memory,
                &[],
                &[],
            );
        }
    }

    fn stamp_kernel(&self, kernel: Kernel) {
        let info = &KERNELS[kernel as usize];
        self.stamp(info.stage, Some(info.group));
    }

    fn stamp(&self, stage: Stage, group: Option<Group>) {
        let (c, at) = (self.commands, self.commands.stamps.get());
        if self.timed && at < STAMPS {
            // SAFETY: the buffer is recording and the query was reset in it.
            unsafe {
                let done = vk::PipelineStageFlags::BOTTOM_OF_PIPE;
                c.gpu.device().cmd_write_timestamp(c.buffer, done, c.queries, at as u32);
            }
            c.stages[at].set(stage);
            c.groups[at].set(group);
            c.stamps.set(at + 1);
        }
    }

    /// Submits what was recorded and waits until the device is done and the host can see it.
    fn submit_and_read(self, sections: &[&str]) -> Result<(), GpuError> {
        let c = self.commands;
        // SAFETY: the buffer is being recorded, and every kernel ends with a barrier.
        unsafe { self.arena.after_kernels(c.buffer, sections) };
        let stages = vk::PipelineStageFlags::COMPUTE_SHADER | vk::PipelineStageFlags::TRANSFER;
        let host = [vk::MemoryBarrier::default()
            .src_access_mask(vk::AccessFlags::SHADER_WRITE | vk::AccessFlags::TRANSFER_WRITE)
            .dst_access_mask(vk::AccessFlags::HOST_READ | vk::AccessFlags::HOST_WRITE)];
        let buffers = [c.buffer];
        let submit = [vk::SubmitInfo::default().command_buffers(&buffers)];
        // SAFETY: the buffer is recording and then submitted once; the fence is unsignalled before and reset after.
        unsafe {
            let device = c.gpu.device();
            let none = vk::DependencyFlags::empty();
            device.cmd_pipeline_barrier(c.buffer, stages, vk::PipelineStageFlags::HOST, none, &host, &[], &[]);
            device.end_command_buffer(c.buffer).map_err(vulkan("vkEndCommandBuffer"))?;
            device.queue_submit(c.gpu.queue(), &submit, c.fence).map_err(vulkan("vkQueueSubmit"))?;
            match device.wait_for_fences(&[c.fence], true, TIMEOUT_NS) {
                Ok(()) => {}
                Err(vk::Result::TIMEOUT) => return Err(GpuError::DeviceLost { during: "vkWaitForFences" }),
                Err(e) => return Err(GpuError::from_vk("vkWaitForFences", e)),
            }
            device.reset_fences(&[c.fence]).map_err(vulkan("vkResetFences"))?;
        }
        c.collect_times(self.times);
        Ok(())
    }
}
