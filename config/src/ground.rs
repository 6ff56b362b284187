//! `[ground]` of the mission file: how the ground station merges the aircraft's models and distils the result.

use crate::keys::PublicKey;
use crate::settings::{Limits, table};

table! {
    /// How the ground station merges the aircraft's models and distils the result.
    pub struct GroundSettings {
        /// Whose receipts the aircraft believe, as `dgtr keys` prints it; the ground and every aircraft have a key, or nobody.
        pub public_key: Option<PublicKey> = None;
        /// Part of the name of the device to use: processor, or a Vulkan device; absent = the fastest.
        pub device: Option<String> = None;
        /// Device memory for merging and distilling.
        pub device_mib: u32 = 1024, in Limits::within(16.0, 1_048_576.0);
        /// Upper bound of the global model; absent = as many as the memory holds.
        pub max_gaussians: Option<usize> = None;
        /// Passes over the distillation views; 0 = merge only.
        pub epochs: u32 = 5, in Limits::within(0.0, 1000.0),
            from "the paper and Fed3DGS; dgtr demo --seconds 75: 27.38 and 29.20 dB with 5, at half the rate 27.47 and 29.24 with 15";
        /// Time for distillation at most; absent = all epochs.
        pub seconds: Option<f64> = None, in Limits::above(0.0);
        /// Size of the distillation pictures relative to the training pictures.
        pub scale: f32 = 1.0, in Limits::above(0.0).up_to(1.0),
            from "Fed3DGS uses 0.25; sheffield_cross at 0.5 SSIM 0.800, at 1 SSIM 0.811";
        /// Ground so near to another aircraft's region is of whoever saw it best (pixels of all pictures per m² of it); 0 = every
        /// region is its own aircraft's.
        pub border_m: f32 = 10.0, in Limits::at_least(0.0).up_to(1e4);
        /// Side of the cells of ground that are distilled: those in which Gaussians of two aircraft meet, and six around them.
        pub seam_m: f32 = 8.0, in Limits::above(0.0);
        /// Side of the squares of ground that are merged and distilled as jobs of their own, at least; they are made of whole `seam_m`,
        /// and the origin lies in the middle of one.
        pub cell_m: f32 = 256.0, in Limits::within(1.0, 1e5), from "1,000 aircraft over 10 km²: some 150 jobs of a million Gaussians";
        /// Share of the Gaussians a view sees that must lie in a seam for the view to take part in distillation.
        pub seam_share: f32 = 0.02, in Limits::within(0.0, 1.0);
        /// Distil on views half-way between neighbouring training views, too: on its training views alone the union would
        /// learn its teachers' mistakes by heart.
        pub between_views: bool = true;
        /// Learning rates of distillation, as a fraction of the trainer's.
        pub rate: f32 = 1.0, in Limits::above(0.0).up_to(10.0),
            from "dgtr demo --seconds 75, 5 epochs: 0.03 gains 0.06 and 0.03 dB, 0.1 0.17 and 0.08, 0.3 0.38 and 0.13, 1 0.64 and 0.19";
        /// Gaussians at or below this opacity are removed after distillation.
        pub prune_opacity: f32 = 0.005, in Limits::at_least(0.0).below(0.5), from "Fed3DGS";
        /// An aircraft that was heard of and then not for so long is named, and so is one of which nothing is heard for so long after
        /// another one was.
        pub silence_s: f64 = 60.0, in Limits::within(5.0, 86_400.0);
        /// Bring the models together by what they show in common before merging (each lies where its own GPS put it).
        pub register: bool = true;
        /// Seed of the order of views.
        pub seed: u64 = 0;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_valid_and_nan_is_not() {
        assert_eq!(GroundSettings::default().check(), Ok(()));
        assert_eq!(toml::from_str::<GroundSettings>("").ok(), Some(GroundSettings::default()));
        for bad in ["scale = nan", "scale = 0.0", "seam_m = inf", "seconds = -1.0", "prune_opacity = 0.5"] {
            assert!(toml::from_str::<GroundSettings>(bad).is_ok_and(|s| s.check().is_err()), "{bad}");
        }
    }
}
