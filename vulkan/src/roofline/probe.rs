//! Two buffers, two kernels and a command buffer: just enough Vulkan to measure a device, apart from the trainer's own
//! so that the trainer makes no pipeline it does not train with.

use crate::arena::Arena;
use crate::gpu::{GpuError, Vulkan};
use ash::vk;
use config::plan::Plan;

/// Long enough for 128 copies on a very small board.
const TIMEOUT_NS: u64 = 600_000_000_000;
const LOCAL_SIZE: u32 = 64;
/// Workgroups of the copying kernel.
const COPY_GROUPS: u32 = 1 << 10;

/// What is run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// `roofline_copy.comp` over the whole buffer.
    CopyKernel,
    /// `vkCmdCopyBuffer` over the whole buffer.
    CopyCommand,
    /// `vkCmdFillBuffer` over the whole buffer with something else than zeros, which some devices do not move.
    Fill,
    /// `roofline_fma.comp`.
    Fma { lanes: u32, turns: u32 },
}

pub(super) struct Probe {
    // Every handle is null until it exists; null handles may be destroyed.
    pool: vk::CommandPool,
    fence: vk::Fence,
    set_layout: vk::DescriptorSetLayout,
    layout: vk::PipelineLayout,
    sets: vk::DescriptorPool,
    texels: vk::BufferView,
    pipelines: [vk::Pipeline; 2],
    set: vk::DescriptorSet,
    buffer: vk::CommandBuffer,
    arena: Arena,
    gpu: Vulkan,
}

impl Drop for Probe {
    fn drop(&mut self) {
        let device = self.gpu.device();
        // SAFETY: every submission was waited for; the handles are ours and destroyed once, the arena after them.
        unsafe {
            for p in self.pipelines {
                device.destroy_pipeline(p, None);
            }
            device.destroy_buffer_view(self.texels, None);
            device.destroy_descriptor_pool(self.sets, None);
            device.destroy_pipeline_layout(self.layout, None);
            device.destroy_descriptor_set_layout(self.set_layout, None);
            device.destroy_fence(self.fence, None);
            device.destroy_command_pool(self.pool, None);
        }
    }
}

fn vulkan(call: &'static str) -> impl Fn(vk::Result) -> GpuError {
    move |e| GpuError::from_vk(call, e)
}

/// An allocation of two equal sections and nothing else.
fn two_buffers(bytes: u64) -> Plan {
    Plan {
        scene: 0,
        gaussians: 0,
        instances: 0,
        pixels: 0,
        tiles: 0,
        views: 0,
        crops: 0,
        view_slots: 0,
        sh_degree: 0,
        half_moments: false,
        lanes: config::plan::Lanes::SOFTWARE,
        sections: vec![("source", bytes), ("into", bytes)],
        total_bytes: 2 * bytes,
    }
}

impl Probe {
    /// `bytes` is a multiple of 64 KiB.
    ///
    /// # Errors
    /// The device refuses buffers or pipeline.
    pub fn new(gpu: &Vulkan, bytes: u64) -> Result<Self, GpuError> {
        let mut made = Self {
            pool: vk::CommandPool::null(),
            fence: vk::Fence::null(),
            set_layout: vk::DescriptorSetLayout::null(),
            layout: vk::PipelineLayout::null(),
            sets: vk::DescriptorPool::null(),
            texels: vk::BufferView::null(),
            pipelines: [vk::Pipeline::null(); 2],
            set: vk::DescriptorSet::null(),
            buffer: vk::CommandBuffer::null(),
            arena: Arena::by_driver(gpu, &two_buffers(bytes))?,
            gpu: gpu.clone(),
        };
        let source = made.arena.section("source");
        let device = gpu.device();
        let binding = |i: u32, kind: vk::DescriptorType| {
            vk::DescriptorSetLayoutBinding::default()
                .binding(i)
                .descriptor_type(kind)
                .descriptor_count(1)
                .stage_flags(vk::ShaderStageFlags::COMPUTE)
        };
        let (texel, storage) = (vk::DescriptorType::UNIFORM_TEXEL_BUFFER, vk::DescriptorType::STORAGE_BUFFER);
        let bindings = [binding(0, texel), binding(1, storage)];
        let sizes = [
            vk::DescriptorPoolSize { ty: texel, descriptor_count: 1 },
            vk::DescriptorPoolSize { ty: storage, descriptor_count: 1 },
        ];
        let set_info = vk::DescriptorSetLayoutCreateInfo::default().bindings(&bindings);
        let sets_info = vk::DescriptorPoolCreateInfo::default().max_sets(1).pool_sizes(&sizes);
        let flags = vk::CommandPoolCreateFlags::RESET_COMMAND_BUFFER;
        let pool_info = vk::CommandPoolCreateInfo::default().queue_family_index(gpu.family()).flags(flags);
        // SAFETY: all create infos outlive their calls; `made` owns each handle as soon as it exists, so an early return
        // destroys exactly what was made.
        unsafe {
            made.pool = device.create_command_pool(&pool_info, None).map_err(vulkan("vkCreateCommandPool"))?;
            let allocate = vk::CommandBufferAllocateInfo::default().command_pool(made.pool).command_buffer_count(1);
            made.buffer = device.allocate_command_buffers(&allocate).map_err(vulkan("vkAllocateCommandBuffers"))?[0];
            made.fence = device.create_fence(&vk::FenceCreateInfo::default(), None).map_err(vulkan("vkCreateFence"))?;
            made.set_layout =
                device.create_descriptor_set_layout(&set_info, None).map_err(vulkan("vkCreateDescriptorSetLayout"))?;
            let layouts = [made.set_layout];
            let push = [vk::PushConstantRange::default().stage_flags(vk::ShaderStageFlags::COMPUTE).size(8)];
            let layout_info = vk::PipelineLayoutCreateInfo::default().set_layouts(&layouts).push_constant_ranges(&push);
            made.layout =
                device.create_pipeline_layout(&layout_info, None).map_err(vulkan("vkCreatePipelineLayout"))?;
            made.sets = device.create_descriptor_pool(&sets_info, None).map_err(vulkan("vkCreateDescriptorPool"))?;
            let set_allocate =
                vk::DescriptorSetAllocateInfo::default().descriptor_pool(made.sets).set_layouts(&layouts);
            made.set = device.allocate_descriptor_sets(&set_allocate).map_err(vulkan("vkAllocateDescriptorSets"))?[0];
            made.texels = gpu.texel_view("source", made.arena.buffer, source, vk::Format::R32G32B32A32_SFLOAT)?;
            made.pipelines[0] =
                made.pipeline("roofline_copy", include_bytes!("../../shaders/spirv/roofline_copy.spv"))?;
            made.pipelines[1] =
                made.pipeline("roofline_fma", include_bytes!("../../shaders/spirv/roofline_fma.spv"))?;
        }
        made.bind();
        made.run(Kind::Fill, 1)?;
        Ok(made)
    }

    fn bind(&self) {
        let into = self.arena.section("into");
        let (views, buffers) = (
            [self.texels],
            [vk::DescriptorBufferInfo { buffer: self.arena.buffer, offset: into.offset, range: into.bytes }],
        );
        let write = |i: u32, kind| {
            vk::WriteDescriptorSet::default().dst_set(self.set).dst_binding(i).descriptor_type(kind).descriptor_count(1)
        };
        let writes = [
            write(0, vk::DescriptorType::UNIFORM_TEXEL_BUFFER).texel_buffer_view(&views),
            write(1, vk::DescriptorType::STORAGE_BUFFER).buffer_info(&buffers),
        ];
        // SAFETY: set, view and buffer are alive and the set is in no pending command buffer.
        unsafe { self.gpu.device().update_descriptor_sets(&writes, &[]) };
    }

    /// # Safety
    /// `self.layout` is a valid pipeline layout.
    unsafe fn pipeline(&self, name: &'static str, spirv: &[u8]) -> Result<vk::Pipeline, GpuError> {
        let size = LOCAL_SIZE.to_ne_bytes();
        let entries = [vk::SpecializationMapEntry { constant_id: 0, offset: 0, size: 4 }];
        let special = vk::SpecializationInfo::default().map_entries(&entries).data(&size);
        // SAFETY: by this function's contract.
        unsafe { self.gpu.compute_pipeline(name, spirv, self.layout, &special) }
    }

    /// Runs `kind` `repeats` times, one after the other, and waits.
    ///
    /// # Errors
    /// The device fails.
    pub fn run(&self, kind: Kind, repeats: u32) -> Result<(), GpuError> {
        let device = self.gpu.device();
        let begin = vk::CommandBufferBeginInfo::default().flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
        let stages = vk::PipelineStageFlags::COMPUTE_SHADER | vk::PipelineStageFlags::TRANSFER;
        let all = vk::AccessFlags::SHADER_READ
            | vk::AccessFlags::SHADER_WRITE
            | vk::AccessFlags::TRANSFER_READ
            | vk::AccessFlags::TRANSFER_WRITE;
        let memory = [vk::MemoryBarrier::default().src_access_mask(all).dst_access_mask(all)];
        let buffers = [self.buffer];
        let submit = [vk::SubmitInfo::default().command_buffers(&buffers)];
        // SAFETY: the buffer is recorded and submitted once and waited for; everything it uses is ours and alive.
        unsafe {
            device.begin_command_buffer(self.buffer, &begin).map_err(vulkan("vkBeginCommandBuffer"))?;
            for _ in 0..repeats {
                self.record(kind);
                let none = vk::DependencyFlags::empty();
                device.cmd_pipeline_barrier(self.buffer, stages, stages, none, &memory, &[], &[]);
            }
            device.end_command_buffer(self.buffer).map_err(vulkan("vkEndCommandBuffer"))?;
            device.queue_submit(self.gpu.queue(), &submit, self.fence).map_err(vulkan("vkQueueSubmit"))?;
            match device.wait_for_fences(&[self.fence], true, TIMEOUT_NS) {
                Ok(()) => {}
                Err(vk::Result::TIMEOUT) => return Err(GpuError::DeviceLost { during: "vkWaitForFences" }),
                Err(e) => return Err(GpuError::from_vk("vkWaitForFences", e)),
            }
            device.reset_fences(&[self.fence]).map_err(vulkan("vkResetFences"))
        }
    }

    /// # Safety
    /// `self.buffer` is recording.
    unsafe fn record(&self, kind: Kind) {
        let device = self.gpu.device();
        let (source, into) = (self.arena.section("source"), self.arena.section("into"));
        let (pipeline, groups, turns) = match kind {
            Kind::CopyCommand => {
                let region =
                    [vk::BufferCopy { src_offset: source.offset, dst_offset: into.offset, size: source.bytes }];
                // SAFETY: both ranges lie inside the buffer, which may be copied from and to, and do not overlap.
                unsafe { device.cmd_copy_buffer(self.buffer, self.arena.buffer, self.arena.buffer, &region) };
                return;
            }
            Kind::Fill => {
                let half = 0.5f32.to_bits();
                // SAFETY: the range lies inside the buffer, which may be filled.
                unsafe { device.cmd_fill_buffer(self.buffer, self.arena.buffer, source.offset, source.bytes, half) };
                return;
            }
            Kind::CopyKernel => (self.pipelines[0], COPY_GROUPS, 0),
            Kind::Fma { lanes, turns } => (self.pipelines[1], lanes.div_ceil(LOCAL_SIZE), turns),
        };
        let push = [(source.bytes / 16) as u32, turns];
        let compute = vk::PipelineBindPoint::COMPUTE;
        // SAFETY: pipeline, layout and set belong together and outlive the submission.
        unsafe {
            device.cmd_bind_pipeline(self.buffer, compute, pipeline);
            device.cmd_bind_descriptor_sets(self.buffer, compute, self.layout, 0, &[self.set], &[]);
            let stage = vk::ShaderStageFlags::COMPUTE;
            device.cmd_push_constants(self.buffer, self.layout, stage, 0, bytemuck::cast_slice(&push));
            device.cmd_dispatch(self.buffer, groups, 1, 1);
        }
    }
}
