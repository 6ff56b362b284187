//! Host memory of the initialisation, planned from the number of pictures and Gaussians before the first picture.

use config::init::InitSettings;

use super::assemble::{AHEAD, WITNESSES};
use super::strips::at_once;
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

/// The most that waits of a picture of `size`, for plans made before the network is known: sides in steps of at most 64
/// pixels, or, with a network of the user's, a square.
pub fn most_frame_bytes(settings: &InitSettings, size: (u32, u32), own_network: bool) -> u64 {
    let longer = u64::from(size.0.max(size.1)).max(1);
    let side = |side: u32| (u64::from(side) * u64::from(settings.max_side).min(longer)).div_ceil(longer);
    let square = u64::from(settings.max_side).pow(2);
    let pixels = side(size.0).next_multiple_of(64) * side(size.1).next_multiple_of(64);
    frame_bytes(settings, if own_network { pixels.max(square) } else { pixels })
}

fn frame_bytes(settings: &InitSettings, pixels: u64) -> u64 {
    3 * pixels + 8 * pixels / u64::from(settings.stride).pow(2)
}

impl Initialiser {
    /// Host bytes planned for a number of pictures and Gaussians: pictures at the network's size and depths on the grid (those
    /// at work, where a file keeps them), what matching or the network holds, for unposed networks the pairs' pointmaps and heads, and the merge. What the
    /// caller still holds of the pictures themselves is not in it.
    pub fn planned_bytes(&self, pictures: usize, max_gaussians: usize) -> u64 {
        let pixels = self.frames.first().map_or(640 * 480, |f| f.view.intrinsics.pixels()) as u64;
        self.planned(pixels, pictures, max_gaussians)
    }

    /// The planned bytes before the first picture, for pictures of `size`.
    pub fn planned_bytes_at(&self, size: (u32, u32), pictures: usize, max_gaussians: usize) -> u64 {
        let (width, height) = self.network_size(size);
        self.planned(u64::from(width) * u64::from(height), pictures, max_gaussians)
    }

    /// What waits of a picture of `size`, in memory or in the file: itself at the network's size, and its depth.
    pub fn frame_bytes_at(&self, size: (u32, u32)) -> u64 {
        let (width, height) = self.network_size(size);
        frame_bytes(&self.settings, u64::from(width) * u64::from(height))
    }

    fn planned(&self, pixels: u64, pictures: usize, max_gaussians: usize) -> u64 {
        let samples = pixels / u64::from(self.settings.stride).pow(2);
        let depths = match &self.pairs {
            Pairs::Posed(n) => n.planned_bytes(pixels),
            Pairs::Unposed(n) => {
                let edges = pictures * (self.settings.window + self.settings.covisible);
                n.planned_bytes(pixels) + unposed::planned_bytes(pictures as u64, edges as u64, samples)
            }
        };
        let features = if self.features.is_some() { FEATURES_BYTES } else { 0 };
        let runtime = if self.features.is_some() || self.network.is_some() { RUNTIME_BYTES } else { 0 };
        let in_memory = match self.file {
            None => pictures,
            // Each thread's picture and its sources or witnesses, and the one that comes in.
            Some(_) => self.settings.threads.max(AHEAD) * (1 + WITNESSES.max(self.pairs.sources())) + 1,
        };
        let voxels = at_once(max_gaussians.saturating_mul(VOXELS_PER_GAUSSIAN));
        in_memory as u64 * frame_bytes(&self.settings, pixels)
            // Priors on their way out, and the caller's copy of one.
            + (2 * AHEAD as u64 + 1) * 8 * samples
            + runtime
            + depths
            + features
            + super::super::range::MAX_POINTS as u64 * RANGE_BYTES
            + 2 * AHEAD as u64 * samples * WORK_BYTES
            + VoxelMerge::planned_bytes(voxels, max_gaussians)
            + max_gaussians as u64 * CLOUD_BYTES
    }
}
