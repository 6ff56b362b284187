//! Settings of the pose refinement: what it may hold in memory, how long it may take and how far telemetry is
//! believed to be wrong. Every bound here is a hard cap; what it leaves out is counted in the refiner's report.

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// `[refine]` of the mission file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RefineSettings {
    /// Key frames held at once; further ones are refused and keep their telemetry pose.
    pub max_keyframes: usize,
    /// Key points kept per picture, best score first.
    pub max_features: usize,
    /// Verified pairs per new key frame; candidates are tried best overlap first, at most twice as many.
    pub max_pairs: usize,
    /// Tracks the bundle adjustment works on (longest first, spread over the pictures); the others are
    /// triangulated once with the adjusted poses.
    pub max_tracks: usize,
    /// Observations over all tracks, adjusted or not.
    pub max_observations: usize,
    /// Longer side of the picture that the feature network sees, pixels; larger pictures are shrunk.
    pub feature_side: u32,
    /// Threads of the feature network.
    pub threads: usize,
    /// Predicted overlap of two footprints (0..1) below which a pair is not tried.
    pub min_overlap: f64,
    /// Smallest cosine of two descriptors that may match.
    pub min_cosine: f32,
    /// A match must beat the best candidate elsewhere in the picture by this much.
    pub cosine_margin: f32,
    /// Largest distance from the epipolar line at the original picture size, pixels.
    pub epipolar_px: f64,
    /// Matches that must agree with one relative pose before a pair counts.
    pub min_inliers: usize,
    /// Noise of a key point, pixels: weighs pictures against telemetry.
    pub pixel_sigma: f64,
    /// Observations further than this from their adjusted point are dropped, pixels.
    pub outlier_px: f64,
    /// Smallest angle between two rays of a point, degrees.
    pub min_angle_deg: f64,
    /// Prior of the shared camera-mount misalignment about each camera axis, degrees; 0 = mount is exact.
    pub mount_sigma_deg: f64,
    /// Prior of the shared delay of positions against exposures, seconds (metres along track where key frames
    /// carry no times); 0 = no delay.
    pub delay_sigma_s: f64,
    /// Prior of the shared relative error of the focal length; 0 = calibrated.
    pub focal_sigma: f64,
    /// A shared parameter is estimated when the pictures cut its standard deviation below this fraction of its
    /// prior, and left alone otherwise.
    pub observable_ratio: f64,
    /// Wall time one `solve` may take, seconds; it returns the best poses so far.
    pub solve_seconds: f64,
}

impl Default for RefineSettings {
    fn default() -> Self {
        Self {
            max_keyframes: 512,
            max_features: 1000,
            max_pairs: 6,
            max_tracks: 4000,
            max_observations: 400_000,
            feature_side: 640,
            threads: 2,
            min_overlap: 0.2,
            // XFeat's own matcher asks for 0.82; here guided search and the comparison of the pictures themselves weed
            // out what is wrong, and brighton_beach (forest) is refined to 0.25° with 0.65 but to 0.9° with 0.75.
            min_cosine: 0.6,
            cosine_margin: 0.02,
            epipolar_px: 2.0,
            min_inliers: 16,
            // Polished key points: median residual 0.2 px on sheffield_cross.
            pixel_sigma: 0.4,
            outlier_px: 3.0,
            min_angle_deg: 1.5,
            mount_sigma_deg: 3.0,
            delay_sigma_s: 1.0,
            focal_sigma: 0.0,
            observable_ratio: 0.5,
            solve_seconds: 10.0,
        }
    }
}

/// A setting that cannot work.
#[derive(Clone, Debug, Error, PartialEq)]
#[error("[refine] {field} = {value}: must be {wanted}")]
pub struct RefineSettingsError {
    /// Name of the field.
    pub field: &'static str,
    /// What was given.
    pub value: f64,
    /// What would be accepted.
    pub wanted: &'static str,
}

impl RefineSettings {
    /// Checks every field's range; the caps also bound the memory of one refiner to about 100 bytes per feature
    /// and 250 bytes per observation.
    pub fn check(&self) -> Result<(), RefineSettingsError> {
        let whole = |field, value: usize, low: usize, high: usize, wanted| match (low..=high).contains(&value) {
            true => Ok(()),
            false => Err(RefineSettingsError { field, value: value as f64, wanted }),
        };
        let real = |field, value: f64, low: f64, high: f64, wanted| match value >= low && value <= high {
            true => Ok(()),
            false => Err(RefineSettingsError { field, value, wanted }),
        };
        whole("max_keyframes", self.max_keyframes, 2, 4096, "2 to 4096")?;
        whole("max_features", self.max_features, 16, 8192, "16 to 8192")?;
        whole("max_pairs", self.max_pairs, 1, 64, "1 to 64")?;
        whole("max_tracks", self.max_tracks, 16, 1_000_000, "16 to 1000000")?;
        whole("max_observations", self.max_observations, 64, 10_000_000, "64 to 10000000")?;
        whole("feature_side", self.feature_side as usize, 64, 8192, "64 to 8192 pixels")?;
        whole("threads", self.threads, 1, 64, "1 to 64")?;
        whole("min_inliers", self.min_inliers, 6, 10_000, "6 to 10000")?;
        real("min_overlap", self.min_overlap, 0.0, 1.0, "0 to 1")?;
        real("min_cosine", self.min_cosine.into(), -1.0, 1.0, "-1 to 1")?;
        real("cosine_margin", self.cosine_margin.into(), 0.0, 1.0, "0 to 1")?;
        real("epipolar_px", self.epipolar_px, 0.1, 100.0, "0.1 to 100 pixels")?;
        real("pixel_sigma", self.pixel_sigma, 0.01, 100.0, "0.01 to 100 pixels")?;
        real("outlier_px", self.outlier_px, 0.1, 1000.0, "0.1 to 1000 pixels")?;
        real("min_angle_deg", self.min_angle_deg, 0.01, 45.0, "0.01 to 45 degrees")?;
        real("mount_sigma_deg", self.mount_sigma_deg, 0.0, 45.0, "0 to 45 degrees")?;
        real("delay_sigma_s", self.delay_sigma_s, 0.0, 60.0, "0 to 60 seconds")?;
        real("focal_sigma", self.focal_sigma, 0.0, 0.5, "0 to 0.5")?;
        real("observable_ratio", self.observable_ratio, 0.0, 1.0, "0 to 1")?;
        real("solve_seconds", self.solve_seconds, 0.001, 3600.0, "0.001 to 3600 seconds")
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
