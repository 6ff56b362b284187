//! One pipeline and one descriptor set per kernel, all made at start-up over one shared layout.

#[cfg(test)]
mod listed;

use crate::arena::Arena;
use crate::constants::STRIP;
use crate::gpu::{DeviceLimits, GpuError, Vulkan};
use crate::kernel_config::KernelConfig;
use crate::kernels::{
    DEPTH_LANES, FIRST_TEXELS, Group, KERNELS, Kernel, SCAN_LANES, part_bytes_of_slots, part_of_slots,
};
use crate::kernels::{texel_bytes, texel_format};
use crate::layout::Section;
use ash::vk;
use config::plan::{Plan, sh_columns};

/// Storage buffers a kernel may bind (V3DV allows eight per stage).
const STORAGE_BINDINGS: u32 = 8;
/// Read-only sections a kernel may fetch as texels. On lavapipe a texel fetch gathers without branches and is ten times
/// as fast as a load from a storage buffer (measured: 54 vec4 per lane, 24 ms against 2 ms); GPUs serve both alike.
const TEXEL_BINDINGS: u32 = 5;

pub(crate) struct Pipelines {
    gpu: Vulkan,
    set_layout: vk::DescriptorSetLayout,
    pub layout: vk::PipelineLayout,
    pool: vk::DescriptorPool,
    pipelines: Vec<vk::Pipeline>,
    sets: Vec<vk::DescriptorSet>,
    view_sets: Vec<vk::DescriptorSet>,
    texel_views: Vec<vk::BufferView>,
    config: KernelConfig,
    /// Kernels read storage buffers where they would fetch texels.
    storage_reads: bool,
}

impl Drop for Pipelines {
    fn drop(&mut self) {
        let device = self.gpu.device();
        // SAFETY: the trainer waits for the device first; each handle is ours and destroyed once.
        unsafe {
            for p in &self.pipelines {
                device.destroy_pipeline(*p, None);
            }
            for view in &self.texel_views {
                device.destroy_buffer_view(*view, None);
            }
            device.destroy_descriptor_pool(self.pool, None);
            device.destroy_pipeline_layout(self.layout, None);
            device.destroy_descriptor_set_layout(self.set_layout, None);
        }
    }
}

#[repr(C)]
#[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
struct Specialisation {
    local_size: u32,
    sh_columns: u32,
    sh_degree: u32,
    sort_lanes: u32,
    loop_lanes: u32,
    own_degrees: u32,
    half_moments: u32,
    staged: u32,
    rolled: u32,
}

/// What a kernel sees of the arena under a section's name.
fn bound(arena: &Arena, plan: &Plan, name: &str) -> Section {
    part_of_slots(name, arena.section("slots"), plan.pixels).unwrap_or_else(|| arena.section(name))
}

/// Whether kernels of this kind run as their variant: more than one lane per tile or share, strips in parts.
fn takes_variant(group: Group, config: KernelConfig) -> bool {
    match group {
        Group::Sort | Group::Walk => config.share_lanes > 1,
        Group::Strips => config.part < STRIP,
        _ => config.tile_lanes > 1,
    }
}

/// Lanes of a workgroup of this kind.
fn local_size(group: Group, config: KernelConfig) -> u32 {
    let KernelConfig { wide, narrow, share_lanes, tiles, tile_lanes, .. } = config;
    match group {
        Group::Wide | Group::Strips => wide,
        Group::Sort if share_lanes > 1 => SCAN_LANES,
        Group::Sort | Group::Walk => narrow,
        Group::Tiles => tiles * tile_lanes,
        Group::Scan => SCAN_LANES,
    }
}

fn vulkan(call: &'static str) -> impl Fn(vk::Result) -> GpuError {
    move |e| GpuError::from_vk(call, e)
}

impl Pipelines {
    /// Compiles `kernels`; the others must not be run. `own_degrees`: whether Gaussians have SH degrees of their own, or all
    /// the plan's.
    ///
    /// # Errors
    /// The device refuses a kernel.
    pub fn new(
        gpu: &Vulkan,
        plan: &Plan,
        arena: &Arena,
        config: KernelConfig,
        own_degrees: bool,
        kernels: &[Kernel],
    ) -> Result<Self, GpuError> {
        // Compiling may take minutes: what the device refuses is found out first.
        let limits = &gpu.info().limits;
        limits.check_workgroup(config.largest_workgroup().max(SCAN_LANES))?;
        let storage_reads = Self::needs_storage_reads(limits, plan)?;
        let device = gpu.device();
        let read = match storage_reads {
            true => vk::DescriptorType::STORAGE_BUFFER,
            false => vk::DescriptorType::UNIFORM_TEXEL_BUFFER,
        };
        let binding = |i: u32| {
            let kind = match i {
                0 => vk::DescriptorType::UNIFORM_BUFFER,
                i if i < FIRST_TEXELS => vk::DescriptorType::STORAGE_BUFFER,
                _ => read,
            };
            vk::DescriptorSetLayoutBinding::default()
                .binding(i)
                .descriptor_type(kind)
                .descriptor_count(1)
                .stage_flags(vk::ShaderStageFlags::COMPUTE)
        };
        let bindings: Vec<_> = (0..FIRST_TEXELS + TEXEL_BINDINGS).map(binding).collect();
        let set_count = (KERNELS.len() + plan.view_slots) as u32;
        let sizes = [
            vk::DescriptorPoolSize { ty: vk::DescriptorType::UNIFORM_BUFFER, descriptor_count: set_count },
            vk::DescriptorPoolSize {
                ty: vk::DescriptorType::STORAGE_BUFFER,
                descriptor_count: set_count * STORAGE_BINDINGS,
            },
            vk::DescriptorPoolSize { ty: read, descriptor_count: set_count * TEXEL_BINDINGS },
        ];
        let set_info = vk::DescriptorSetLayoutCreateInfo::default().bindings(&bindings);
        let pool_info = vk::DescriptorPoolCreateInfo::default().max_sets(set_count).pool_sizes(&sizes);
        // SAFETY: all create infos outlive their calls; `made` owns each handle as soon as it exists, so an early
        // return destroys exactly what was made.
        unsafe {
            let set_layout =
                device.create_descriptor_set_layout(&set_info, None).map_err(vulkan("vkCreateDescriptorSetLayout"))?;
            let mut made = Self {
                gpu: gpu.clone(),
                set_layout,
                layout: vk::PipelineLayout::null(),
                pool: vk::DescriptorPool::null(),
                pipelines: Vec::with_capacity(KERNELS.len()),
                sets: Vec::new(),
                view_sets: Vec::new(),
                texel_views: Vec::new(),
                config,
                storage_reads,
            };
            let layouts = [set_layout];
            let push = [vk::PushConstantRange::default().stage_flags(vk::ShaderStageFlags::COMPUTE).size(16)];
            let layout_info = vk::PipelineLayoutCreateInfo::default().set_layouts(&layouts).push_constant_ranges(&push);
            made.layout =
                device.create_pipeline_layout(&layout_info, None).map_err(vulkan("vkCreatePipelineLayout"))?;
            made.pool = device.create_descriptor_pool(&pool_info, None).map_err(vulkan("vkCreateDescriptorPool"))?;
            for index in 0..KERNELS.len() {
                let wanted = kernels.iter().any(|k| *k as usize == index);
                made.pipelines.push(match wanted {
                    true => made.pipeline(index, plan, own_degrees)?,
                    false => vk::Pipeline::null(),
                });
            }
            let all = vec![set_layout; set_count as usize];
            let allocate = vk::DescriptorSetAllocateInfo::default().descriptor_pool(made.pool).set_layouts(&all);
            made.sets = device.allocate_descriptor_sets(&allocate).map_err(vulkan("vkAllocateDescriptorSets"))?;
            made.view_sets = made.sets.split_off(KERNELS.len());
            for slot in 0..plan.view_slots {
                made.bind_slot(slot, arena, arena.view_slot(plan, slot));
            }
            for (index, kernel) in KERNELS.iter().enumerate() {
                for (i, name) in kernel.bindings.iter().enumerate() {
                    if *name == "view" {
                        continue; // bound per slot
                    }
                    made.bind(made.sets[index], i as u32 + 1, arena, bound(arena, plan, name));
                }
                made.bind(made.sets[index], 0, arena, arena.section("frame"));
                for (i, name) in kernel.texels.iter().enumerate() {
                    let (set, binding, section) = (made.sets[index], FIRST_TEXELS + i as u32, bound(arena, plan, name));
                    match storage_reads {
                        true => made.bind(set, binding, arena, section),
                        false => made.bind_texels(
                            set,
                            binding,
                            arena,
                            section,
                            (name, texel_format(name, plan.half_moments)),
                        )?,
                    }
                }
            }
            Ok(made)
        }
    }

    /// Whether some section of the plan has more elements than the device shows to a kernel as texels, so that kernels have to
    /// read storage buffers instead.
    ///
    /// # Errors
    /// [`GpuError::ViewTooLarge`] when the device has too few storage buffers for that.
    pub fn needs_storage_reads(limits: &DeviceLimits, plan: &Plan) -> Result<bool, GpuError> {
        let refused = KERNELS.iter().flat_map(|k| k.texels).find_map(|name| {
            let bytes = part_bytes_of_slots(name, plan.pixels).unwrap_or_else(|| plan.bytes(name));
            limits.check_view(name, bytes / texel_bytes(texel_format(name, plan.half_moments))).err()
        });
        match refused {
            Some(refused) if limits.storage_buffers < STORAGE_BINDINGS + TEXEL_BINDINGS => Err(refused),
            refused => Ok(refused.is_some()),
        }
    }

    /// Points the set of view slot `slot` at its pixels.
    fn bind_slot(&self, slot: usize, arena: &Arena, view: Section) {
        let set = self.view_sets[slot];
        self.bind(set, 0, arena, arena.section("frame"));
        self.bind(set, 1, arena, view);
        self.bind(set, 2, arena, arena.section("target"));
    }

    fn bind_texels(
        &mut self,
        set: vk::DescriptorSet,
        binding: u32,
        arena: &Arena,
        section: Section,
        (name, format): (&'static str, vk::Format),
    ) -> Result<(), GpuError> {
        // SAFETY: the section lies inside the buffer and the buffer allows texel views; the view is kept and destroyed
        // with the pipelines, before the arena.
        unsafe {
            let view = self.gpu.texel_view(name, arena.buffer, section, format)?;
            self.texel_views.push(view);
            let views = [view];
            let write = [vk::WriteDescriptorSet::default()
                .dst_set(set)
                .dst_binding(binding)
                .descriptor_type(vk::DescriptorType::UNIFORM_TEXEL_BUFFER)
                .texel_buffer_view(&views)];
            self.gpu.device().update_descriptor_sets(&write, &[]);
        }
        Ok(())
    }

    fn bind(&self, set: vk::DescriptorSet, binding: u32, arena: &Arena, section: Section) {
        let info = [vk::DescriptorBufferInfo { buffer: arena.buffer, offset: section.offset, range: section.bytes }];
        let kind = if binding == 0 { vk::DescriptorType::UNIFORM_BUFFER } else { vk::DescriptorType::STORAGE_BUFFER };
        let write = [vk::WriteDescriptorSet::default()
            .dst_set(set)
            .dst_binding(binding)
            .descriptor_type(kind)
            .buffer_info(&info)];
        // SAFETY: set and buffer are alive and the set is in no pending command buffer.
        unsafe { self.gpu.device().update_descriptor_sets(&write, &[]) };
    }

    /// # Safety
    /// `self.layout` is a valid pipeline layout.
    unsafe fn pipeline(&self, index: usize, plan: &Plan, own_degrees: bool) -> Result<vk::Pipeline, GpuError> {
        let kernel = &KERNELS[index];
        let constants = Specialisation {
            local_size: local_size(kernel.group, self.config),
            sh_columns: sh_columns(plan.sh_degree) as u32,
            sh_degree: plan.sh_degree.into(),
            sort_lanes: plan.lanes.sort,
            loop_lanes: match kernel.file {
                "depth_sums" | "depth_finish" => DEPTH_LANES,
                _ => plan.lanes.loops,
            },
            own_degrees: own_degrees.into(),
            half_moments: plan.half_moments.into(),
            staged: (self.config.fetched > 1).into(),
            rolled: (self.config.summed < self.config.tile_lanes).into(),
        };
        let entries: [_; 9] = std::array::from_fn(|i| vk::SpecializationMapEntry {
            constant_id: i as u32,
            offset: 4 * i as u32,
            size: 4,
        });
        let special = vk::SpecializationInfo::default().map_entries(&entries).data(bytemuck::bytes_of(&constants));
        let shared = kernel.shared.filter(|_| self.config.meets(self.gpu.info()));
        let variant = shared.or(kernel.variant).filter(|_| takes_variant(kernel.group, self.config));
        // SAFETY: by this function's contract; the constants are those that `frame.glsl` and `tile.glsl` declare.
        unsafe {
            self.gpu.compute_pipeline(
                kernel.name,
                variant.unwrap_or(kernel.spirv).reading(self.storage_reads),
                self.layout,
                &special,
            )
        }
    }

    /// Workgroups that give `kernel` at least `count` lanes, tiles or shares, whichever it is dispatched over.
    pub fn groups(&self, kernel: Kernel, count: usize) -> u32 {
        let each = match KERNELS[kernel as usize].group {
            Group::Tiles => self.config.tiles,
            Group::Sort | Group::Walk if self.config.share_lanes > 1 => 1,
            group => local_size(group, self.config),
        };
        (count as u32).div_ceil(each).max(1)
    }

    pub fn pipeline_of(&self, kernel: Kernel) -> vk::Pipeline {
        self.pipelines[kernel as usize]
    }

    pub fn set_of(&self, kernel: Kernel) -> vk::DescriptorSet {
        self.sets[kernel as usize]
    }

    pub fn view_set(&self, slot: usize) -> vk::DescriptorSet {
        self.view_sets[slot]
    }
}
