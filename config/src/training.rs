//! `[training]`: every constant of the optimisation recipe, each with the source it was taken from.
//!
//! Two rules shape this page. All schedules are functions of *progress* (0…1), not of the step, so that
//! `--seconds S` squeezes the same recipe into whatever time there is. And every length is relative to the
//! scene's [extent](scene_extent), so that one recipe serves a stuffed fox and a quarry.

mod density;
mod rates;
mod schedule;
mod skips;

pub use density::{DensitySettings, Strategy};
pub use rates::{AdamSettings, RateSettings};
pub use schedule::{ResolutionSettings, ShSettings, StopSettings, ViewSettings};
pub use skips::SkipSettings;

use serde::{Deserialize, Serialize};

/// The training recipe. `TrainSettings::default()` is what the figures in the README were measured with.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainSettings {
    /// Seeds view order, noise, relocation and DropGaussian; same seed, same bytes.
    pub seed: u64,
    /// Length of the schedule in steps. The paper trains each device for 10,000 steps.
    pub steps: u32,
    /// Length of the schedule in seconds of wall clock; when given, progress is the larger of the two
    /// fractions, so that training ends at whichever comes first.
    pub seconds: Option<f64>,
    /// What is minimised.
    pub loss: LossSettings,
    /// Step size of every parameter group.
    pub rates: RateSettings,
    /// Adam's own constants.
    pub adam: AdamSettings,
    /// Relocation, growth and pruning.
    pub density: DensitySettings,
    /// Spherical harmonics.
    pub sh: ShSettings,
    /// Coarse to fine.
    pub resolution: ResolutionSettings,
    /// Which view comes next.
    pub views: ViewSettings,
    /// When to end before the schedule does.
    pub stop: StopSettings,
    /// Regularisers that act on the parameters or on the rendering.
    pub regularise: RegulariseSettings,
    /// Work that is left out because it changes nothing.
    pub skips: SkipSettings,
    /// Optimise a 6-vector per view (rotation and translation of world → camera) together with the cloud.
    pub refine_poses: bool,
    /// Optimise six scalars per view: log gain and offset of each channel.
    pub refine_exposure: bool,
}

impl Default for TrainSettings {
    fn default() -> Self {
        Self {
            seed: 1,
            steps: 10_000, // paper §4.1: 10,000 steps per device
            seconds: None,
            loss: LossSettings::default(),
            rates: RateSettings::default(),
            adam: AdamSettings::default(),
            density: DensitySettings::default(),
            sh: ShSettings::default(),
            resolution: ResolutionSettings::default(),
            views: ViewSettings::default(),
            stop: StopSettings::default(),
            regularise: RegulariseSettings::default(),
            skips: SkipSettings::default(),
            refine_poses: false,
            refine_exposure: false,
        }
    }
}

impl TrainSettings {
    /// How much of the schedule is over after `steps` steps and `elapsed_s` seconds, 0…1.
    pub fn progress(&self, steps: u32, elapsed_s: f64) -> f32 {
        let by_steps = f64::from(steps) / f64::from(self.steps.max(1));
        let by_time = self.seconds.map_or(0.0, |s| elapsed_s / s.max(1e-3));
        by_steps.max(by_time).clamp(0.0, 1.0) as f32
    }

    /// Says which field is outside its range, if any.
    ///
    /// # Errors
    /// One line naming the field, its value and the range.
    pub fn check(&self) -> Result<(), TrainSettingsError> {
        let r = &self.rates;
        let a = &self.adam;
        let l = &self.loss;
        let non_negative = [
            ("loss.l1", l.l1),
            ("loss.ssim", l.ssim),
            ("loss.depth", l.depth),
            ("rates.mean_start", r.mean_start),
            ("rates.mean_end", r.mean_end),
            ("rates.log_scale", r.log_scale),
            ("rates.rotation", r.rotation),
            ("rates.opacity", r.opacity),
            ("rates.sh_dc", r.sh_dc),
            ("rates.sh_rest", r.sh_rest),
            ("rates.pose_rotation", r.pose_rotation),
            ("rates.pose_translation", r.pose_translation),
            ("rates.exposure", r.exposure),
            ("regularise.noise", self.regularise.noise),
            ("regularise.opacity_decay", self.regularise.opacity_decay),
            ("density.growth", self.density.growth),
            ("density.spread", self.density.spread),
        ];
        for (name, value) in non_negative {
            within(name, value, 0.0, f32::MAX)?;
        }
        within("rates.final_share", r.final_share, 1e-6, 1.0)?;
        within("adam.beta1", a.beta1, 0.0, 0.999_999)?;
        within("adam.beta2", a.beta2, 0.0, 0.999_999)?;
        within("adam.epsilon", a.epsilon, f32::MIN_POSITIVE, 1.0)?;
        within("loss.depth_confidence", l.depth_confidence, 0.0, 1.0)?;
        within("regularise.drop", self.regularise.drop, 0.0, 0.9)?;
        within("regularise.background", self.regularise.background, 0.0, 1.0)?;
        within("density.dead_opacity", self.density.dead_opacity, 0.0, 0.5)?;
        within("views.residual_share", self.views.residual_share, 0.0, 1.0)?;
        within("sh.degree", f32::from(self.sh.degree), 0.0, 3.0)?;
        within("sh.raise_share", self.sh.raise_share, 0.0, 1.0)?;
        within("steps", self.steps as f32, 1.0, 1e9)?;
        within("seconds", self.seconds.unwrap_or(1.0) as f32, 1e-3, 1e9)
    }
}

fn within(field: &'static str, value: f32, low: f32, high: f32) -> Result<(), TrainSettingsError> {
    // Written so that NaN fails.
    if value >= low && value <= high { Ok(()) } else { Err(TrainSettingsError { field, value, low, high }) }
}

/// A field of `[training]` is outside its range.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("[training] {field} = {value} is outside {low}…{high}; mend it in the mission file")]
pub struct TrainSettingsError {
    /// Dotted name of the field below `[training]`.
    pub field: &'static str,
    /// What it was.
    pub value: f32,
    /// Least allowed value.
    pub low: f32,
    /// Greatest allowed value.
    pub high: f32,
}

/// `l1·L1 + ssim·(1 − SSIM) + depth·(1 − ρ(D, D_est))` (paper, total loss; the paper prints ρ itself).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LossSettings {
    /// λ₁.
    pub l1: f32,
    /// λ₂.
    pub ssim: f32,
    /// λ₃; only views that came with a depth prior pay it.
    pub depth: f32,
    /// Depth prior pixels with less confidence than this do not take part.
    pub depth_confidence: f32,
    /// Shape freezing: depth gradients reach means and opacities but not scales and rotations.
    pub freeze_shape: bool,
}

impl Default for LossSettings {
    fn default() -> Self {
        Self {
            l1: 0.8,               // 3DGS: 1 − λ_dssim
            ssim: 0.2,             // 3DGS: λ_dssim = 0.2
            depth: 0.05,           // FSGS' weight of its Pearson loss, which the paper adopts
            depth_confidence: 0.1, // findings.md: coverage matters more than purity
            freeze_shape: true,    // paper table 4: 21.53 → 21.72 dB
        }
    }
}

/// Regularisers. Zero switches each of them off.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RegulariseSettings {
    /// DropGaussian's γ: by the end of training this share of the Gaussians is left out of each step and the
    /// others' opacities are raised by 1/(1 − γ). For sparse views (≈ 3…12); harmful with many.
    pub drop: f32,
    /// Noise on the means of nearly transparent Gaussians, in units of the means' learning rate; weighted
    /// by (1 − opacity)^150 and clamped to the extent (Brush).
    pub noise: f32,
    /// Opacity subtracted at every densification, fading to nothing at the end (Brush).
    pub opacity_decay: f32,
    /// Half-width of the random background colour around `0.5·background`, 0 = black. Keeps the cloud from using black
    /// holes as dark paint (Brush).
    pub background: f32,
}

impl Default for RegulariseSettings {
    fn default() -> Self {
        Self {
            drop: 0.0,            // DropGaussian (CVPR 2025) uses 0.2 on three views
            noise: 2.0,           // Brush: 50 at a 25 × smaller rate of the means
            opacity_decay: 0.004, // Brush opac_decay
            background: 0.0,
        }
    }
}

/// The scene's length scale, metres: the median over Gaussians of the distance to the nearest camera.
///
/// 3DGS takes 1.1 × the radius of the camera circle, which is 0 for one view and says nothing about a straight
/// flight line. The distance to the camera is proportional to what one pixel covers, which is what a step in
/// position must be measured by. At most 4,096 Gaussians, evenly spaced, are looked at; non-finite ones are
/// ignored; 1 when nothing remains.
pub fn scene_extent(means: &[[f32; 3]], centers: &[[f64; 3]]) -> f32 {
    let stride = means.len().div_ceil(4096).max(1);
    let mut nearest: Vec<f64> = means
        .iter()
        .step_by(stride)
        .filter_map(|m| {
            let square = |c: &[f64; 3]| (0..3).map(|k| (f64::from(m[k]) - c[k]).powi(2)).sum::<f64>();
            centers.iter().map(square).min_by(f64::total_cmp)
        })
        .filter(|d2| d2.is_finite() && *d2 > 0.0)
        .collect();
    if nearest.is_empty() {
        return 1.0;
    }
    let middle = nearest.len() / 2;
    let (_, median, _) = nearest.select_nth_unstable_by(middle, f64::total_cmp);
    median.sqrt() as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_empty_table_is_the_default_and_an_unknown_key_is_refused() {
        assert_eq!(toml::from_str::<TrainSettings>("").unwrap(), TrainSettings::default());
        assert!(TrainSettings::default().check().is_ok());
        let error = toml::from_str::<TrainSettings>("[rates]\nmeans = 1.0").unwrap_err();
        assert!(error.to_string().contains("means"), "{error}");
    }

    #[test]
    fn nan_and_negative_rates_are_named() {
        let mut s = TrainSettings::default();
        s.rates.opacity = f32::NAN;
        assert_eq!(s.check().unwrap_err().field, "rates.opacity");
        s.rates.opacity = -1.0;
        assert!(s.check().unwrap_err().to_string().contains("rates.opacity = -1"));
    }

    #[test]
    fn progress_is_whichever_of_steps_and_seconds_is_further() {
        let mut s = TrainSettings { steps: 100, ..Default::default() };
        assert_eq!(s.progress(25, 1e9), 0.25);
        s.seconds = Some(10.0);
        assert_eq!(s.progress(25, 5.0), 0.5);
        assert_eq!(s.progress(1000, 5.0), 1.0);
    }

    #[test]
    fn extent_ignores_rows_that_are_not_finite_and_survives_none() {
        assert_eq!(scene_extent(&[], &[[0.0; 3]]), 1.0);
        assert_eq!(scene_extent(&[[1.0; 3]], &[]), 1.0);
        let means = [[f32::NAN; 3], [0.0, 0.0, 4.0], [f32::INFINITY, 0.0, 0.0]];
        assert_eq!(scene_extent(&means, &[[0.0; 3], [9.0; 3]]), 4.0);
    }
}
