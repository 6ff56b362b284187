//! Vulkan objects that more than one part of the crate makes: compute pipelines, and texel views within the device's limit.

use super::{GpuError, Vulkan};
use crate::kernels::texel_bytes;
use crate::layout::Section;
use ash::vk;
use std::io::Cursor;

impl Vulkan {
    /// A compute pipeline from checked-in SPIR-V, entry point `main`. `name` is the kernel's, for messages.
    ///
    /// # Safety
    /// `layout` is a valid pipeline layout of this device with every binding and push constant that the SPIR-V declares.
    pub(crate) unsafe fn compute_pipeline(
        &self,
        name: &'static str,
        spirv: &[u8],
        layout: vk::PipelineLayout,
        constants: &vk::SpecializationInfo<'_>,
    ) -> Result<vk::Pipeline, GpuError> {
        let failed = |e: vk::Result| GpuError::from_vk("vkCreateComputePipelines", e);
        let code = ash::util::read_spv(&mut Cursor::new(spirv))
            .map_err(|e| GpuError::Vulkan { call: name, result: e.to_string() })?;
        let device = self.device();
        // SAFETY: the SPIR-V is checked in and compared with its source by a test; the infos outlive the calls.
        unsafe {
            let module = device
                .create_shader_module(&vk::ShaderModuleCreateInfo::default().code(&code), None)
                .map_err(|e| GpuError::from_vk("vkCreateShaderModule", e))?;
            let stage = vk::PipelineShaderStageCreateInfo::default()
                .stage(vk::ShaderStageFlags::COMPUTE)
                .module(module)
                .name(c"main")
                .specialization_info(constants);
            let info = [vk::ComputePipelineCreateInfo::default().stage(stage).layout(layout)];
            let made = device.create_compute_pipelines(vk::PipelineCache::null(), &info, None);
            device.destroy_shader_module(module, None);
            made.map(|p| p[0]).map_err(|(_, e)| failed(e))
        }
    }

    /// A texel view of `section`, called `name`; the caller destroys it.
    ///
    /// # Errors
    /// [`GpuError::ViewTooLarge`] when the device cannot show so many elements; [`GpuError::Vulkan`].
    ///
    /// # Safety
    /// `section` lies inside `buffer`, which belongs to this device and allows texel views of `format`.
    pub(crate) unsafe fn texel_view(
        &self,
        name: &'static str,
        buffer: vk::Buffer,
        section: Section,
        format: vk::Format,
    ) -> Result<vk::BufferView, GpuError> {
        self.info().limits.check_view(name, section.bytes / texel_bytes(format))?;
        let info = vk::BufferViewCreateInfo::default()
            .buffer(buffer)
            .format(format)
            .offset(section.offset)
            .range(section.bytes);
        // SAFETY: by this function's contract; the view is within the limit.
        unsafe { self.device().create_buffer_view(&info, None) }.map_err(|e| GpuError::from_vk("vkCreateBufferView", e))
    }
}
