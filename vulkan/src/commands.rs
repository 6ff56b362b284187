//! One command buffer, recorded and submitted again and again: dispatches in order, a barrier and a timestamp after
//! each stage. Nothing here allocates after start-up.

use crate::arena::Arena;
use crate::gpu::{Gpu, GpuError};
use crate::kernels::{GROUPS, Group, KERNELS, Kernel};
use crate::layout::Push;
use crate::layout::Section;
use crate::pipelines::Pipelines;
use crate::processor::Processor;
use crate::stages::{DEVICE_TIMES, STAGE_NAMES, Stage};
use ash::vk;
use std::cell::Cell;
use std::time::Instant;

/// Timestamps per submission; a submission that dispatches more leaves the rest untimed.
const STAMPS: usize = 64;

/// How long a submission may take before the device counts as lost: lavapipe on a small board may need long.
const TIMEOUT_NS: u64 = 600_000_000_000;

pub(crate) struct Commands {
    gpu: Gpu,
    pool: vk::CommandPool,
    buffer: vk::CommandBuffer,
    fence: vk::Fence,
    queries: vk::QueryPool,
    stamps: Cell<usize>,
    stages: [Cell<Stage>; STAMPS],
    stage_ms: Cell<[f64; STAGE_NAMES.len()]>,
    /// What ran up to each timestamp; none where no kernel did.
    groups: [Cell<Option<Group>>; STAMPS],
    group_ms: Cell<[f64; GROUPS]>,
    /// How many submissions the timed one stands for; 0: it is not timed.
    weight: Cell<f64>,
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
    pub fn new(gpu: &Gpu) -> Result<Self, GpuError> {
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
                stage_ms: Cell::new([0.0; STAGE_NAMES.len()]),
                groups: [const { Cell::new(None) }; STAMPS],
                group_ms: Cell::new([0.0; GROUPS]),
                weight: Cell::new(1.0),
            };
            let allocate = vk::CommandBufferAllocateInfo::default().command_pool(pool).command_buffer_count(1);
            made.buffer = device.allocate_command_buffers(&allocate).map_err(vulkan("vkAllocateCommandBuffers"))?[0];
            made.fence = device.create_fence(&vk::FenceCreateInfo::default(), None).map_err(vulkan("vkCreateFence"))?;
            made.queries = device.create_query_pool(&query_info, None).map_err(vulkan("vkCreateQueryPool"))?;
            Ok(made)
        }
    }

    /// Milliseconds per stage since they were last cleared.
    pub fn stage_ms(&self) -> [f64; STAGE_NAMES.len()] {
        self.stage_ms.get()
    }

    /// Milliseconds that each kind of kernel took since they were last cleared (by `Group as usize`).
    pub fn group_ms(&self) -> [f64; GROUPS] {
        self.group_ms.get()
    }

    pub fn clear_times(&self) {
        self.group_ms.set([0.0; GROUPS]);
        self.stage_ms.set([0.0; STAGE_NAMES.len()]);
    }

    /// From here on a submission's times count `weight` times; with 0 it gets no timestamps.
    pub fn weigh(&self, weight: f64) {
        self.weight.set(weight);
    }

    /// Starts a recording; the one before was submitted or dropped.
    ///
    /// # Errors
    /// The device fails.
    pub fn begin<'a>(
        &'a self,
        pipelines: &'a Pipelines,
        processor: Option<&'a Processor>,
        arena: &'a Arena,
    ) -> Result<Recording<'a>, GpuError> {
        if processor.is_some() {
            // Nothing is recorded: a kernel runs when it is asked for.
            return Ok(Recording { commands: self, pipelines, processor, arena, timed: self.weight.get() > 0.0 });
        }
        let info = vk::CommandBufferBeginInfo::default().flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
        let timed = self.gpu.timestamp_ns() > 0.0 && (self.weight.get() > 0.0 || is_traced());
        // SAFETY: the buffer is not pending: `submit` waits.
        unsafe {
            let device = self.gpu.device();
            device.begin_command_buffer(self.buffer, &info).map_err(vulkan("vkBeginCommandBuffer"))?;
            self.stamps.set(0);
            if timed {
                device.cmd_reset_query_pool(self.buffer, self.queries, 0, STAMPS as u32);
            }
        }
        let recording = Recording { commands: self, pipelines, processor, arena, timed };
        // SAFETY: the buffer is being recorded, and a recording is submitted before the host goes on.
        if unsafe { arena.before_kernels(self.buffer)? } {
            recording.barrier();
        }
        recording.stamp(Stage::Target, None);
        Ok(recording)
    }

    fn collect_times(&self) {
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
            if is_traced() {
                self.tell_times(&ticks[..stamps]);
            }
            let (mut all, mut groups) = (self.stage_ms.get(), self.group_ms.get());
            for i in 1..stamps {
                let ns = ticks[i].saturating_sub(ticks[i - 1]) as f64 * self.gpu.timestamp_ns() * self.weight.get();
                all[self.stages[i].get() as usize] += ns * 1e-6;
                if let Some(group) = self.groups[i].get() {
                    groups[group as usize] += ns * 1e-6;
                }
            }
            self.stage_ms.set(all);
            self.group_ms.set(groups);
        }
    }
}

impl Commands {
    /// Adds what a stage took that just ended.
    fn add_time(&self, stage: Stage, group: Option<Group>, ns: u64) {
        if is_traced() {
            tracing::trace!(target: DEVICE_TIMES, stage = stage as u64, ago_ns = ns, took_ns = ns);
        }
        let (mut all, mut groups) = (self.stage_ms.get(), self.group_ms.get());
        let ms = ns as f64 * 1e-6 * self.weight.get();
        all[stage as usize] += ms;
        if let Some(group) = group {
            groups[group as usize] += ms;
        }
        self.stage_ms.set(all);
        self.group_ms.set(groups);
    }
}

/// Whether somebody wants to know when every kernel ran.
fn is_traced() -> bool {
    tracing::enabled!(target: DEVICE_TIMES, tracing::Level::TRACE)
}

impl Commands {
    /// Tells of every stage in `ticks`. The two clocks are set by the end of the submission, which the host has just seen: its own
    /// way back, some microseconds, is taken for the device's.
    fn tell_times(&self, ticks: &[u64]) {
        let Some(last) = ticks.last() else { return };
        let ns = |ticks: u64| (ticks as f64 * self.gpu.timestamp_ns()) as u64;
        for (i, pair) in ticks.windows(2).enumerate() {
            let (stage, took_ns) = (self.stages[i + 1].get() as u64, ns(pair[1].saturating_sub(pair[0])));
            tracing::trace!(target: DEVICE_TIMES, stage, ago_ns = ns(last.saturating_sub(pair[0])), took_ns);
        }
    }
}

pub(crate) struct Recording<'a> {
    commands: &'a Commands,
    pipelines: &'a Pipelines,
    processor: Option<&'a Processor>,
    arena: &'a Arena,
    timed: bool,
}

impl Recording<'_> {
    /// Runs `kernel` on at least `lanes` lanes after everything recorded before it.
    pub fn run(&self, kernel: Kernel, lanes: usize, push: Push) {
        if let Some(processor) = self.processor {
            return self.run_here(processor, kernel, 0, push);
        }
        self.dispatch(kernel, self.pipelines.set_of(kernel), lanes, push);
        self.stamp_kernel(kernel);
    }

    /// Runs `kernel` on the processor.
    fn run_here(&self, processor: &Processor, kernel: Kernel, slot: usize, push: Push) {
        if self.commands.gpu.computes_nothing() {
            return;
        }
        let start = self.timed.then(Instant::now);
        processor.run(self.arena, kernel, slot, push);
        if let Some(start) = start {
            let info = &KERNELS[kernel as usize];
            self.commands.add_time(info.stage, Some(info.group), start.elapsed().as_nanos() as u64);
        }
    }

    /// Runs `kernel` again and again, `push.pass` counting from 0: work that goes on where the round before ended.
    pub fn run_rounds(&self, kernel: Kernel, lanes: usize, push: Push, rounds: u32) {
        if let Some(processor) = self.processor {
            // One round is enough: no driver ends a loop.
            return self.run_here(processor, kernel, 0, push);
        }
        for pass in 0..rounds {
            self.dispatch(kernel, self.pipelines.set_of(kernel), lanes, Push { pass, ..push });
        }
        self.stamp_kernel(kernel);
    }

    /// As [`Self::run`], with the descriptor set of view slot `slot`.
    pub fn run_view(&self, kernel: Kernel, slot: usize, lanes: usize, push: Push) {
        if let Some(processor) = self.processor {
            return self.run_here(processor, kernel, slot, push);
        }
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
    pub fn clear(&self, section: Section, bytes: u64, stage: Stage) {
        if let Some(processor) = self.processor {
            return processor.clear(self.arena, section, bytes);
        }
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
    ///
    /// # Errors
    /// The device fails or is lost.
    pub fn submit(self) -> Result<(), GpuError> {
        self.submit_and_read(&[])
    }

    /// As [`Self::submit`]; the host looks at the sections of these names next, which a mirror then has at once.
    ///
    /// # Errors
    /// Those of [`Self::submit`].
    pub fn submit_and_read(self, sections: &[&str]) -> Result<(), GpuError> {
        let c = self.commands;
        if self.processor.is_some() {
            return Ok(());
        }
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
        c.collect_times();
        Ok(())
    }
}
