//! Host memory of the initialisation, planned from the number of pictures and Gaussians before the first picture.

use super::assemble::AHEAD;
use super::{Initialiser, Pairs, VOXELS_PER_GAUSSIAN};
use crate::init::merge::VoxelMerge;
use crate::init::unposed;

/// ONNX Runtime itself: its code, its registries (resident, measured on x86-64).
const RUNTIME_BYTES: u64 = 64 << 20;
/// The features network at its size, with its session (measured: 26 MiB).
const FEATURES_BYTES: u64 = 32 << 20;
/// Per sample of a picture that is being checked: its points, its fill, the resolved grid, its samples twice.
const WORK_BYTES: u64 = 256;
/// Per Gaussian of the cloud beside the merge's own: axes and the cloud's columns.
const CLOUD_BYTES: u64 = 100;
/// A sparse point, and room to sort depths.
const RANGE_BYTES: u64 = 32;

impl Initialiser {
    /// Host bytes planned for a number of pictures and Gaussians: pictures at the network's size, depths and priors on
    /// the grid, the network's tensors, for unposed networks the pairs' pointmaps and heads, and the merge. What the
    /// caller still holds of the pictures themselves is not in it.
    pub fn planned_bytes(&self, pictures: usize, max_gaussians: usize) -> u64 {
        let pixels = self.frames.first().map_or(640 * 480, |f| f.view.intrinsics.pixels()) as u64;
        self.planned(pixels, pictures, max_gaussians)
    }

    /// The same before the first picture, for pictures of `size`.
    pub fn planned_bytes_at(&self, size: (u32, u32), pictures: usize, max_gaussians: usize) -> u64 {
        let (width, height) = self.network_size(size);
        self.planned(u64::from(width) * u64::from(height), pictures, max_gaussians)
    }

    fn planned(&self, pixels: u64, pictures: usize, max_gaussians: usize) -> u64 {
        let samples = pixels / u64::from(self.settings.stride).pow(2);
        let network = match &self.pairs {
            Pairs::Posed(n) => n.planned_bytes(pixels),
            Pairs::Unposed(n) => {
                let edges = pictures * (self.settings.window + self.settings.covisible);
                n.planned_bytes(pixels) + unposed::planned_bytes(pictures as u64, edges as u64, samples)
            }
        };
        let features = if self.features.is_some() { FEATURES_BYTES } else { 0 };
        pictures as u64 * (3 * pixels + 16 * samples)
            + RUNTIME_BYTES
            + network
            + features
            + super::super::range::MAX_POINTS as u64 * RANGE_BYTES
            + 2 * AHEAD as u64 * samples * WORK_BYTES
            + VoxelMerge::planned_bytes(max_gaussians * VOXELS_PER_GAUSSIAN, max_gaussians)
            + max_gaussians as u64 * CLOUD_BYTES
    }
}
