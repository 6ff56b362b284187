//! Devices and what steps cost on them, for tests.

use vulkan::gpu::{DeviceLimits, GpuInfo};

use crate::model::CostModel;

/// A board's GPU.
pub fn device(name: &str) -> GpuInfo {
    GpuInfo {
        name: name.into(),
        version: (1, 3),
        is_cpu: false,
        is_integrated: true,
        subgroup_size: 16,
        shuffles: true,
        heap_bytes: 1 << 30,
        ids: (0x14e4, 42),
        driver_version: 7,
        limits: DeviceLimits { workgroup_lanes: 256, texel_elements: 1 << 27, storage_buffers: 8 },
    }
}

/// A processor of two cores: the slopes of `bench stages` there (4a95410).
pub const PROCESSOR: CostModel = CostModel {
    fixed_ms: 5.0,
    gaussian_ns: 54.0,
    visible_ns: 664.0,
    pixel_ns: 163.0,
    instance_ns: 64.0,
    evaluation_ns: 6.6,
};

/// A card: 1.0 ms at 10,000 Gaussians, 5 ms at half a million (the same, "On an NVIDIA H100").
pub const CARD: CostModel = CostModel {
    fixed_ms: 0.8,
    gaussian_ns: 0.5,
    visible_ns: 4.0,
    pixel_ns: 0.4,
    instance_ns: 1.0,
    evaluation_ns: 0.02,
};
