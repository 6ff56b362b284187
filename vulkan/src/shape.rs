//! The workgroup sizes of the kernels: the one thing about them that is chosen per device. Every kernel works with any of
//! the sizes here and leaves the same bits with each (`tests/shapes.rs`); only the time differs, and
//! [`calibration`](crate::calibration) measures which is the fastest.

use crate::gpu::GpuInfo;

/// Lanes of a workgroup, by kind of kernel. The two are independent: no kernel knows both.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct KernelShape {
    /// Plain loops over Gaussians or pixels.
    pub wide: u32,
    /// Kernels whose lanes hold much state (a tile's pixels, a sorting lane's cursor) or are few.
    pub narrow: u32,
}

/// Sizes worth trying. All divide the lanes that the looping kernels are written for (`config::plan::LOOP_LANES` and
/// `SORT_LANES_*`), so that no lane runs beyond them.
const WIDE: [u32; 4] = [32, 64, 128, 256];
const NARROW: [u32; 3] = [8, 16, 32];

impl KernelShape {
    /// What is used where nothing was measured.
    pub fn standard(info: &GpuInfo) -> Self {
        // Software renderers run a workgroup on one core: small groups of tiles balance better there.
        Self { wide: 64, narrow: if info.is_cpu { 8 } else { 32 } }
    }

    /// Sizes of wide workgroups that this device can run and that fill its subgroups, the standard one among them.
    pub fn wide_candidates(info: &GpuInfo) -> Vec<u32> {
        candidates(&WIDE, Self::standard(info).wide, info)
    }

    /// The same for narrow workgroups.
    pub fn narrow_candidates(info: &GpuInfo) -> Vec<u32> {
        candidates(&NARROW, Self::standard(info).narrow, info)
    }

    /// Whether the kernels are written for these sizes and the device can run them.
    pub fn fits(&self, info: &GpuInfo) -> bool {
        let limit = info.limits.workgroup_lanes;
        WIDE.contains(&self.wide) && NARROW.contains(&self.narrow) && self.wide.max(self.narrow) <= limit
    }
}

/// A number that changes whenever any kernel does: a shape measured with other kernels says nothing about these.
pub fn kernels_fingerprint() -> u64 {
    crate::kernels::fingerprint()
}

/// Less than a subgroup leaves lanes idle.
fn candidates(sizes: &[u32], standard: u32, info: &GpuInfo) -> Vec<u32> {
    let usable = |n: u32| n <= info.limits.workgroup_lanes && n >= info.subgroup_size;
    sizes.iter().copied().filter(|n| *n == standard || usable(*n)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gpu::DeviceLimits;
    use config::plan::{LOOP_LANES, SORT_LANES_GPU, SORT_LANES_SOFTWARE};

    fn device(is_cpu: bool, subgroup_size: u32, workgroup_lanes: u32) -> GpuInfo {
        GpuInfo {
            name: "device".into(),
            version: (1, 1),
            is_cpu,
            subgroup_size,
            heap_bytes: 1 << 30,
            ids: (1, 2),
            driver_version: 3,
            limits: DeviceLimits { workgroup_lanes, texel_elements: 1 << 27 },
        }
    }

    #[test]
    fn candidates_respect_the_limits_and_fill_subgroups() {
        let lavapipe = device(true, 8, 1024);
        assert_eq!(KernelShape::wide_candidates(&lavapipe), WIDE);
        assert_eq!(KernelShape::narrow_candidates(&lavapipe), NARROW);
        let pi5 = device(false, 16, 256);
        assert_eq!(KernelShape::narrow_candidates(&pi5), [16, 32]);
        let turnip = device(false, 128, 1024);
        assert_eq!(KernelShape::wide_candidates(&turnip), [64, 128, 256]);
        assert_eq!(KernelShape::narrow_candidates(&turnip), [32], "the standard one remains");
        assert_eq!(KernelShape::wide_candidates(&device(false, 32, 128)), [32, 64, 128]);
    }

    #[test]
    fn every_candidate_fits_and_divides_the_lanes_of_the_loops() {
        for info in [device(true, 8, 1024), device(false, 64, 256), device(false, 4, 128)] {
            let (wide, narrow) = (KernelShape::wide_candidates(&info), KernelShape::narrow_candidates(&info));
            for (wide, narrow) in wide.iter().flat_map(|w| narrow.iter().map(|n| (*w, *n))) {
                assert!(KernelShape { wide, narrow }.fits(&info));
                assert_eq!(LOOP_LANES % u64::from(wide), 0);
                assert_eq!((SORT_LANES_GPU % narrow, SORT_LANES_SOFTWARE % narrow), (0, 0));
            }
        }
        let info = device(false, 32, 128);
        for (wide, narrow) in [(256, 32), (64, 0), (48, 32), (64, 64), (0, 8)] {
            assert!(!KernelShape { wide, narrow }.fits(&info), "{wide} {narrow}");
        }
    }
}
