//! `[init]`: how pictures become the first Gaussians.

use crate::settings::{Limits, SettingError, table};

table! {
    /// How pictures become the first Gaussians.
    pub struct InitSettings {
        /// Pictures that are matched at once, or threads of a network.
        pub threads: usize = 2, in Limits::within(1.0, 64.0);
        /// Most key frames the job will see; host memory is planned for them.
        pub max_pictures: usize = 300, in Limits::within(2.0, 100_000.0);
        /// Sliding window: picture i is paired with i+1 … i+window.
        pub window: usize = 2, in Limits::within(1.0, 16.0), from "the paper, step 2";
        /// Further co-visible pictures (other flight lines) that may be sources of one picture.
        pub covisible: usize = 2, in Limits::within(0.0, 16.0);
        /// Least share of a picture's ground that its source must see.
        pub min_overlap: f32 = 0.35, in Limits::within(0.0, 1.0);
        /// Baseline divided by depth, least and greatest: pairs outside give no depth (pure rotation) or no matches.
        pub baseline: [f32; 2] = [0.03, 0.9], in Limits::within(0.0, 10.0);
        /// Largest angle between two optical axes.
        pub max_angle_deg: f32 = 45.0, in Limits::above(0.0).up_to(120.0);
        /// Nearest and farthest depth; absent = measured from matched features.
        pub depth_m: Option<[f32; 2]> = None, in Limits::above(0.0);
        /// Depths of lower confidence make no Gaussian.
        pub min_confidence: f32 = 0.005, in Limits::within(0.0, 1.0);
        /// Longest side of the pictures that are matched, or given to a network of any size.
        pub max_side: u32 = 640, in Limits::within(64.0, 8192.0), unit "pixels";
        /// Every how many pixels (of the network's picture) a Gaussian is proposed.
        pub stride: u32 = 2, in Limits::within(1.0, 16.0), unit "pixels";
        /// Resolve conflicting depths by multi-view consistency.
        pub consistency: bool = true;
        /// Continue the ground where no second picture looks (the rim of the region); needs `consistency`.
        pub fill: bool = true;
        /// Compare the pictures' light where their depths agree, and train on one light where it is uneven: exposure, white
        /// balance and the lens's fall-off towards the corners.
        pub light: bool = true;
        /// Depths of two views agree when they differ by less than this share.
        pub depth_tolerance: f32 = 0.005, in Limits::above(0.0).below(0.5);
        /// sᵍ: bring the Gaussians' extent to the scale of the poses (off only for the paper's ablation).
        pub global_scale: bool = true, from "the paper";
        /// sˡ: set the Gaussians' extent from the distance to their neighbours (off only for the paper's ablation).
        pub local_scale: bool = true, from "the paper";
        /// Gaussians longer than this many median extents are abnormal and removed.
        pub max_scale_ratio: f32 = 8.0, in Limits::above(1.0);
        /// Depths of the matching or of the pair network for the depth loss when training starts from sparse points or at random, too; a feed-forward start
        /// has them anyway.
        pub depth_priors: bool = false;
        /// Opacity of a Gaussian of full confidence.
        pub opacity: f32 = 0.9, in Limits::within(0.0, 1.0);
        /// Most steps of the global alignment.
        pub align_steps: usize = 500, in Limits::within(1.0, 10_000.0), from "the paper";
    } where Self::ranges_grow
}

impl InitSettings {
    fn ranges_grow(&self) -> Result<(), SettingError> {
        let grows = |[low, high]: &[f32; 2]| low < high;
        match &self.depth_m {
            Some(depth) if !grows(depth) => Err(SettingError::new("depth_m", depth, "two growing numbers")),
            _ if !grows(&self.baseline) => Err(SettingError::new("baseline", &self.baseline, "two growing numbers")),
            _ => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_must_grow_and_numbers_be_numbers() {
        assert_eq!(InitSettings::default().check(), Ok(()));
        for bad in [
            "baseline = [0.9, 0.03]",
            "baseline = [0.1, nan]",
            "depth_m = [5.0, 5.0]",
            "depth_m = [0.0, 5.0]",
            "depth_tolerance = 0.5",
            "max_scale_ratio = inf",
            "threads = 0",
        ] {
            let field = bad.split(' ').next().expect("a name");
            let refused = toml::from_str::<InitSettings>(bad).expect("TOML").check().expect_err(bad);
            assert!(refused.field.starts_with(field), "{refused}");
        }
    }
}
