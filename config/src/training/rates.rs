//! Step sizes of the parameter groups and Adam's constants.

use crate::settings::{Limits, table};

table! {
    /// Learning rates per step. Means and pose translations are multiplied by the scene's extent.
    ///
    /// The peers' rates are made for 30,000 steps; an aircraft has a few hundred. Held-out PSNR on fox (270 × 480, SfM points,
    /// growth to 24,000 Gaussians) after 1,000 steps: a third of these 26.9 dB, with copies displaced by half a deviation and two
    /// thirds of these 28.6 dB, with these 29.0 dB; on sheffield_cross (feed-forward, 98,000 Gaussians) after 300 steps a third of
    /// these 23.4 dB, two thirds 24.1 dB.
    #[derive(Copy)]
    pub struct RateSettings {
        /// Means at progress 0.
        pub mean_start: f32 = 1.5e-3, in Limits::at_least(0.0), unit "extents", from "3DGS: 1.6e-4";
        /// Means at progress 1; exponential in between.
        pub mean_end: f32 = 1.5e-5, in Limits::at_least(0.0), unit "extents", from "3DGS: final = initial / 100";
        /// Natural logarithm of the scales.
        pub log_scale: f32 = 6e-2, in Limits::at_least(0.0), from "3DGS: 5e-3, Brush: 7e-3";
        /// Quaternion components.
        pub rotation: f32 = 3e-2, in Limits::at_least(0.0), from "3DGS: 1e-3, Brush: 2e-3";
        /// Opacity logits.
        pub opacity: f32 = 1.5e-1, in Limits::at_least(0.0), from "3DGS: 5e-2 until 2024, now 2.5e-2; Brush: 1.2e-2";
        /// SH degree 0.
        pub sh_dc: f32 = 3e-2, in Limits::at_least(0.0), from "3DGS: 2.5e-3, Brush: 2e-3";
        /// SH degrees 1…3.
        pub sh_rest: f32 = 1.5e-3, in Limits::at_least(0.0), from "sh_dc / 20 as 3DGS";
        /// Pose rotation.
        pub pose_rotation: f32 = 1e-4, in Limits::at_least(0.0), unit "radians",
            from "a third of a milliradian every few steps: 0.04 pixels at f = 357 pixels";
        /// Pose translation.
        pub pose_translation: f32 = 1e-4, in Limits::at_least(0.0), unit "extents",
            from "the same displacement in pixels as pose_rotation";
        /// Log gain and offset of the exposure.
        pub exposure: f32 = 1e-3, in Limits::at_least(0.0), from "3DGS exposure_lr_final";
        /// Share of their rate that log scales, rotations, opacities and SH still have at progress 1; exponential in between.
        pub final_share: f32 = 0.2, in Limits::within(1e-6, 1.0),
            from "0.1 to 0.2: fox +0.31 dB, sheffield_cross +0.13, brighton_beach −0.06; 0.3 is the same (1b428c2)";
    }
}

impl RateSettings {
    /// Factor on the rates of log scales, rotations, opacities and SH: Adam at a constant rate never settles below the
    /// noise of single views.
    pub fn decay(&self, progress: f32) -> f32 {
        self.final_share.max(1e-6).powf(progress.clamp(0.0, 1.0))
    }

    /// The means' learning rate in world units: exponential decay as in 3DGS.
    pub fn mean(&self, progress: f32, extent: f32) -> f32 {
        if self.mean_start <= 0.0 || self.mean_end <= 0.0 {
            return (self.mean_start + (self.mean_end - self.mean_start) * progress) * extent;
        }
        let p = progress.clamp(0.0, 1.0);
        (self.mean_start.ln() * (1.0 - p) + self.mean_end.ln() * p).exp() * extent
    }
}

table! {
    /// Adam (Kingma & Ba 2015) as 3DGS configures it.
    #[derive(Copy)]
    pub struct AdamSettings {
        /// Decay of the first moment.
        pub beta1: f32 = 0.9, in Limits::within(0.0, 0.999_999), from "3DGS";
        /// Decay of the second moment.
        pub beta2: f32 = 0.999, in Limits::within(0.0, 0.999_999), from "3DGS";
        /// Added to the root of the second moment; tiny because gradients of a mean over pixels are.
        pub epsilon: f32 = 1e-15, in Limits::within(f32::MIN_POSITIVE as f64, 1.0), from "3DGS";
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_means_rate_decays_exponentially_and_scales_with_the_extent() {
        let r = RateSettings { mean_start: 1e-4, mean_end: 1e-6, ..Default::default() };
        assert!((r.mean(0.5, 2.0) - 2e-5).abs() < 1e-10);
        let off = RateSettings { mean_start: 0.0, mean_end: 0.0, ..Default::default() };
        assert_eq!(off.mean(0.3, 5.0), 0.0);
    }
}
