//! Settings of the pose refinement: what it may hold in memory, how long it may take and how far telemetry is
//! believed to be wrong. Every bound here is a hard cap; what it leaves out is counted in the refiner's report.

use crate::settings::{Limits, table};

table! {
    /// How telemetry's poses are refined. The caps also bound the memory of one refiner to about 100 bytes per feature and 250
    /// bytes per observation.
    pub struct RefineSettings {
        /// Key frames held at once; further ones are refused and keep their telemetry pose.
        pub max_keyframes: usize = 512, in Limits::within(2.0, 4096.0);
        /// Key points kept per picture, best score first.
        pub max_features: usize = 1000, in Limits::within(16.0, 8192.0);
        /// Verified pairs per new key frame; candidates are tried best overlap first, at most twice as many.
        pub max_pairs: usize = 6, in Limits::within(1.0, 64.0);
        /// Tracks the bundle adjustment works on (longest first, spread over the pictures); the others are triangulated once
        /// with the adjusted poses.
        pub max_tracks: usize = 4000, in Limits::within(16.0, 1_000_000.0);
        /// As many of them for each key frame where that is more.
        pub tracks_per_keyframe: usize = 24, in Limits::within(0.0, 1000.0),
            from "4,000 of 160 pictures hold them to centimetres";
        /// Observations over all tracks, adjusted or not.
        pub max_observations: usize = 400_000, in Limits::within(64.0, 10_000_000.0);
        /// Longer side of the picture that the feature network sees; larger pictures are shrunk.
        pub feature_side: u32 = 640, in Limits::within(64.0, 8192.0), unit "pixels";
        /// Threads of the feature network.
        pub threads: usize = 2, in Limits::within(1.0, 64.0);
        /// Predicted overlap of two footprints below which a pair is not tried.
        pub min_overlap: f64 = 0.2, in Limits::within(0.0, 1.0);
        // Guided search and the comparison of the pictures themselves weed out what is wrong.
        /// Smallest cosine of two descriptors that may match.
        pub min_cosine: f32 = 0.6, in Limits::within(-1.0, 1.0),
            from "XFeat's own matcher: 0.82; brighton_beach (forest) is refined to 0.25° with 0.65, to 0.9° with 0.75";
        /// A match must beat the best candidate elsewhere in the picture by this much.
        pub cosine_margin: f32 = 0.02, in Limits::within(0.0, 1.0);
        /// Largest distance from the epipolar line at the original picture size.
        pub epipolar_px: f64 = 2.0, in Limits::within(0.1, 100.0);
        /// Matches that must agree with one relative pose before a pair counts.
        pub min_inliers: usize = 16, in Limits::within(6.0, 10_000.0);
        /// Noise of a key point: weighs pictures against telemetry.
        pub pixel_sigma: f64 = 0.4, in Limits::within(0.01, 100.0), unit "pixels",
            from "polished key points: median residual 0.2 px on sheffield_cross";
        /// Observations further than this from their adjusted point are dropped.
        pub outlier_px: f64 = 3.0, in Limits::within(0.1, 1000.0);
        /// Smallest angle between two rays of a point.
        pub min_angle_deg: f64 = 1.5, in Limits::within(0.01, 45.0);
        /// Prior of the shared camera-mount misalignment about each camera axis; 0 = mount is exact.
        pub mount_sigma_deg: f64 = 3.0, in Limits::within(0.0, 45.0);
        /// Prior of the shared delay of positions against exposures (metres along track where key frames carry no times);
        /// 0 = no delay.
        pub delay_sigma_s: f64 = 1.0, in Limits::within(0.0, 60.0);
        /// Prior of the shared relative error of the focal length; 0 = calibrated.
        pub focal_sigma: f64 = 0.0, in Limits::within(0.0, 0.5);
        /// Prior of the shared relative error of fy / fx, which a rolling shutter causes; 0 = calibrated.
        pub aspect_sigma: f64 = 0.0, in Limits::within(0.0, 0.1);
        /// Prior of the shared error of the principal point, in focal lengths; 0 = calibrated.
        pub principal_sigma: f64 = 0.0, in Limits::within(0.0, 0.5);
        /// Prior of the radial distortion (k1 and k2) that the given lens lacks; 0 = calibrated.
        pub radial_sigma: f64 = 0.0, in Limits::within(0.0, 0.5);
        /// A shared parameter is estimated when the pictures cut its standard deviation below this fraction of its prior, and
        /// left alone otherwise.
        pub observable_ratio: f64 = 0.5, in Limits::within(0.0, 1.0);
        /// Wall time one `solve` may take; it returns the best poses so far.
        pub solve_seconds: f64 = 10.0, in Limits::within(0.001, 3600.0);
    }
}

impl RefineSettings {
    /// Bytes of a key frame that may wait in a file: 64 of each descriptor, and grey values at the network's size, 4:3.
    pub fn kept_bytes(&self) -> u64 {
        let side = u64::from(self.feature_side);
        64 * self.max_features as u64 + side * side * 3 / 4
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a test may
mod tests {
    use super::*;

    #[test]
    fn the_defaults_are_accepted_and_nonsense_is_named() {
        assert_eq!(RefineSettings::default().check(), Ok(()));
        let bad = RefineSettings { pixel_sigma: f64::NAN, ..Default::default() };
        assert_eq!(bad.check().unwrap_err().field, "pixel_sigma");
        let bad = RefineSettings { max_features: usize::MAX, ..Default::default() };
        assert!(bad.check().unwrap_err().to_string().contains("16 to 8192"));
    }
}
