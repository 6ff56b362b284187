//! `[init]`: how pictures become the first Gaussians.

use serde::{Deserialize, Serialize};

/// Settings of the initialisation; the defaults are what the figures in the README were measured with.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields, default)]
pub struct InitSettings {
    /// Threads of ONNX Runtime, 1…64.
    pub threads: usize,
    /// Most key frames the job will see; host memory is planned for them.
    pub max_pictures: usize,
    /// Sliding window: picture i is paired with i+1 … i+window.
    pub window: usize,
    /// Further co-visible pictures (other flight lines) that may be sources of one picture.
    pub covisible: usize,
    /// Least share of a picture's ground that its source must see.
    pub min_overlap: f32,
    /// Baseline divided by depth: pairs outside give no depth (pure rotation) or no matches.
    pub baseline: [f32; 2],
    /// Largest angle between two optical axes, degrees.
    pub max_angle_deg: f32,
    /// Nearest and farthest depth, metres; absent = measured from matched features.
    pub depth_m: Option<[f32; 2]>,
    /// Depths of lower confidence make no Gaussian.
    pub min_confidence: f32,
    /// Longest side of the pictures given to a network of any size, pixels.
    pub max_side: u32,
    /// Every how many pixels (of the network's picture) a Gaussian is proposed.
    pub stride: u32,
    /// Resolve conflicting depths by multi-view consistency.
    pub consistency: bool,
    /// Continue the ground where no second picture looks (the rim of the region); needs `consistency`.
    pub fill: bool,
    /// Depths of two views agree when they differ by less than this share.
    pub depth_tolerance: f32,
    /// sᵍ: bring the Gaussians' extent to the scale of the poses (off only for the paper's ablation).
    pub global_scale: bool,
    /// sˡ: set the Gaussians' extent from the distance to their neighbours (off only for the paper's ablation).
    pub local_scale: bool,
    /// Gaussians longer than this many median extents are abnormal and removed.
    pub max_scale_ratio: f32,
    /// Opacity of a Gaussian of full confidence.
    pub opacity: f32,
    /// Most steps of the global alignment (the paper: 500).
    pub align_steps: usize,
    /// Seed of everything random here.
    pub seed: u64,
}

impl Default for InitSettings {
    fn default() -> Self {
        Self {
            threads: 2,
            max_pictures: 300,
            window: 2,
            covisible: 2,
            min_overlap: 0.35,
            baseline: [0.03, 0.9],
            max_angle_deg: 45.0,
            depth_m: None,
            min_confidence: 0.005,
            max_side: 640,
            stride: 2,
            consistency: true,
            fill: true,
            depth_tolerance: 0.005,
            global_scale: true,
            local_scale: true,
            max_scale_ratio: 8.0,
            opacity: 0.9,
            align_steps: 500,
            seed: 0,
        }
    }
}

impl InitSettings {
    /// Checks every number; the error names the field.
    ///
    /// # Errors
    /// A field and what it must be.
    pub fn check(&self) -> Result<(), (&'static str, &'static str)> {
        let share = |v: f32| (0.0..=1.0).contains(&v);
        let rules: [(bool, &'static str, &'static str); 14] = [
            ((1..=64).contains(&self.threads), "threads", "must be within 1…64"),
            ((2..=100_000).contains(&self.max_pictures), "max_pictures", "must be within 2…100000"),
            ((1..=16).contains(&self.window), "window", "must be within 1…16"),
            (self.covisible <= 16, "covisible", "must be at most 16"),
            (share(self.min_overlap), "min_overlap", "must be within 0…1"),
            (
                self.baseline[0] >= 0.0 && self.baseline[0] < self.baseline[1] && self.baseline[1] <= 10.0,
                "baseline",
                "must be two growing numbers within 0…10",
            ),
            (self.max_angle_deg > 0.0 && self.max_angle_deg <= 120.0, "max_angle_deg", "must be within 0…120"),
            (
                self.depth_m.is_none_or(|[n, f]| n > 0.0 && f > n && f.is_finite()),
                "depth_m",
                "must be two growing positive numbers",
            ),
            (share(self.min_confidence) && share(self.opacity), "min_confidence, opacity", "must be within 0…1"),
            ((64..=8192).contains(&self.max_side), "max_side", "must be within 64…8192"),
            ((1..=16).contains(&self.stride), "stride", "must be within 1…16"),
            (self.depth_tolerance > 0.0 && self.depth_tolerance < 0.5, "depth_tolerance", "must be within 0…0.5"),
            (self.max_scale_ratio > 1.0, "max_scale_ratio", "must be above 1"),
            ((1..=10_000).contains(&self.align_steps), "align_steps", "must be within 1…10000"),
        ];
        rules.into_iter().find(|r| !r.0).map_or(Ok(()), |r| Err((r.1, r.2)))
    }
}
