//! What an initialisation did, for `run.json` and the tables.

use serde::Serialize;

use crate::cloud::GaussianCloud;
use crate::light::Light;

use super::pairs::SkippedPairs;

/// The result.
#[derive(Clone, Debug)]
pub struct Initialisation {
    /// The Gaussians, SH degree 0.
    pub cloud: GaussianCloud,
    /// The pictures' light, where it is uneven: the Gaussians have the colours that it leaves when it is taken out.
    pub light: Option<Light>,
    /// What happened.
    pub report: InitReport,
}

/// What a growth in flight looked at; nothing in it grows with the pictures before.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct Growth {
    /// Depth maps made: of new pictures, and anew of those beside them.
    pub depths: usize,
    /// Earlier pictures beside the new ones.
    pub compared: usize,
    /// Ground that the pictures with new depths show, m².
    pub ground_m2: f64,
}

/// Global alignment of the pairs of an unposed network; zeros of other networks.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct AlignmentReport {
    /// Pairs in the connectivity graph.
    pub edges: usize,
    /// Pairs whose scale σ is not determined (no baseline, no confidence); left out.
    pub edges_without_scale: usize,
    /// Connected components of the graph, each anchored by its own baselines.
    pub components: usize,
    /// Steps of the global alignment.
    pub align_steps: usize,
    /// Mean distance between χ and the pairs' points, metres.
    pub align_residual_m: f64,
}

/// Samples of the depth maps, and the voxels they are merged in.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct MergeReport {
    /// Samples another view agrees with.
    pub supported: usize,
    /// Samples no other view confirms or denies.
    pub alone: usize,
    /// Samples removed because other views see through them.
    pub removed: usize,
    /// Samples continued from their surroundings where no picture has a depth.
    pub filled: usize,
    /// Samples merged.
    pub samples: usize,
    /// Samples dropped as not finite or absurdly far.
    pub dropped_samples: usize,
    /// Finest voxels used.
    pub voxels: usize,
    /// Their edge, metres.
    pub voxel_m: f32,
    /// Gaussians removed for abnormal extent.
    pub abnormal: usize,
}

/// Wall time, milliseconds.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct InitTimes {
    /// Taking pictures in at the network's size.
    pub add_ms: f64,
    /// Features and triangulation for the depth range.
    pub features_ms: f64,
    /// Opening the network.
    pub open_ms: f64,
    /// Matching or network runs alone, summed over threads.
    pub run_ms: f64,
    /// Choosing partners and making depths in `build`, network runs included.
    pub depth_ms: f64,
    /// Unposed networks: global alignment and scales of Σ (ICP, neighbours), within `depth_ms`.
    pub align_ms: f64,
    /// Comparing the pictures' light.
    pub light_ms: f64,
    /// Comparing depths between pictures, summed over threads.
    pub consistency_ms: f64,
    /// Samples and their covariances, summed over threads.
    pub samples_ms: f64,
    /// Sorting samples into voxels.
    pub voxels_ms: f64,
    /// Cutting the tree and writing the cloud.
    pub cloud_ms: f64,
    /// Everything after the depths: the four above, side by side where they can be.
    pub merge_ms: f64,
}

/// Counts and times.
#[derive(Clone, Debug, Default, Serialize)]
pub struct InitReport {
    /// Name of the network, or of the matching without one.
    pub network: String,
    /// Pictures taken in.
    pub pictures: usize,
    /// Depth maps made.
    pub runs: usize,
    /// Pairs of the sliding window that were not sent to the network.
    pub skipped: SkippedPairs,
    /// Nearest and farthest depth that any picture was looked at for, metres.
    pub depth_m: [f32; 2],
    /// Depths claimed by the network that were not positive finite numbers.
    pub non_finite_depths: usize,
    /// Median difference between pictures' colours of a place, natural logarithm, as stored and with their light taken out.
    pub light: [f32; 2],
    /// Gaussians in the cloud.
    pub gaussians: usize,
    /// Host bytes planned.
    pub planned_bytes: u64,
    /// The global alignment.
    #[serde(flatten)]
    pub alignment: AlignmentReport,
    /// The merge.
    #[serde(flatten)]
    pub merge: MergeReport,
    /// The times.
    #[serde(flatten)]
    pub times: InitTimes,
}

impl InitReport {
    /// Widens [`Self::depth_m`] to hold a picture's range.
    pub(super) fn searched(&mut self, [near, far]: [f32; 2]) {
        let all = &mut self.depth_m;
        *all = if all[1] > 0.0 { [all[0].min(near), all[1].max(far)] } else { [near, far] };
    }
}
