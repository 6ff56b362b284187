//! The limits of a device that a plan or a kernel configuration can run into.

use super::GpuError;
use ash::vk;

/// What the device refuses beyond.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DeviceLimits {
    /// Lanes of one workgroup along x (`maxComputeWorkGroupInvocations` and `maxComputeWorkGroupSize[0]`; at least 128).
    pub workgroup_lanes: u32,
    /// Elements of one texel view (`maxTexelBufferElements`; at least 65,536, 2^27 on most).
    pub texel_elements: u32,
    /// Storage buffers of one kernel (`maxPerStageDescriptorStorageBuffers`; at least 4, V3D has 8).
    pub storage_buffers: u32,
}

impl DeviceLimits {
    pub(super) fn of(limits: &vk::PhysicalDeviceLimits) -> Self {
        Self {
            workgroup_lanes: limits.max_compute_work_group_invocations.min(limits.max_compute_work_group_size[0]),
            texel_elements: limits.max_texel_buffer_elements,
            storage_buffers: limits.max_per_stage_descriptor_storage_buffers,
        }
    }

    pub(crate) fn check_workgroup(&self, lanes: u32) -> Result<(), GpuError> {
        let limit = self.workgroup_lanes;
        if lanes <= limit { Ok(()) } else { Err(GpuError::WorkgroupTooLarge { needed: lanes, limit }) }
    }

    pub(crate) fn check_view(&self, section: &'static str, elements: u64) -> Result<(), GpuError> {
        let limit = self.texel_elements;
        match elements <= u64::from(limit) {
            true => Ok(()),
            false => Err(GpuError::ViewTooLarge { section, needed: elements, limit }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fixture::Fixture;
    use crate::gpu::Gpu;
    use crate::synthetic::{cloud, photo, plain, posed, view};
    use crate::trainer::TrainError;
    use config::plan::{Plan, PlanRequest};
    use models::camera::DepthPrior;
    use models::cloud::GaussianCloud;

    const COMMON: DeviceLimits = DeviceLimits { workgroup_lanes: 256, texel_elements: 1 << 27, storage_buffers: 8 };

    /// A trainer of 10,000 Gaussians on this machine's device, were its limits these.
    fn under(limits: DeviceLimits) -> Option<Result<Fixture, TrainError>> {
        let Ok(gpu) = Gpu::open_by_driver(None) else {
            needs::missing(needs::Need::Vulkan, "no Vulkan device");
            return None;
        };
        let request = PlanRequest {
            device_mib: 64,
            width: 64,
            height: 48,
            views: 1,
            sh_degree: 3,
            max_gaussians: Some(10_000),
            scene_gaussians: None,
            ..Default::default()
        };
        let plan = Plan::new(&request).unwrap();
        Some(Fixture::new(&gpu.limited(limits), &plan, &plain()))
    }

    #[test]
    fn a_plan_beyond_the_device_s_texel_limit_is_refused_by_name_where_storage_buffers_are_few() {
        let Some(made) = under(DeviceLimits { texel_elements: 1 << 16, ..COMMON }) else { return };
        // Nine vec4 of geometry per Gaussian are the first to exceed it.
        match made.err() {
            Some(TrainError::Gpu(GpuError::ViewTooLarge { section, needed, limit })) => {
                assert_eq!((section, limit), ("geometry", 1 << 16));
                assert!((90_000..=90_016).contains(&needed), "{needed}");
            }
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn beyond_the_texel_limit_kernels_read_storage_buffers_and_leave_the_same_bits() {
        let trained = |limits| {
            let mut trainer = under(limits)?.unwrap();
            trainer.load(&cloud(8, 9_000, 3)).unwrap();
            let v = view(64, 48);
            let prior = DepthPrior { width: 2, height: 1, depth: vec![2.0, 3.0], confidence: vec![1.0; 2] };
            trainer.add_view(&posed(&v, &photo(1, &v)), Some(&prior)).unwrap();
            (0..3).for_each(|_| assert!(trainer.step().unwrap().loss.is_finite()));
            let mut model = GaussianCloud::default();
            trainer.snapshot(&mut model).unwrap();
            Some(model)
        };
        let small = DeviceLimits { texel_elements: 1 << 16, storage_buffers: 16, ..COMMON };
        assert!(trained(COMMON) == trained(small), "another model");
    }

    #[test]
    fn a_device_with_too_small_workgroups_is_refused() {
        let Some(made) = under(DeviceLimits { workgroup_lanes: 128, ..COMMON }) else { return };
        let expected = TrainError::Gpu(GpuError::WorkgroupTooLarge { needed: 256, limit: 128 });
        assert_eq!(made.err(), Some(expected));
    }
}
