//! `[training]`: every constant of the optimisation recipe, each with the source it was taken from.
//!
//! Two rules shape this page. All schedules are functions of *progress* (0…1), not of the step, so that
//! `--seconds S` squeezes the same recipe into whatever time there is. And every length is relative to the
//! scene's [extent](scene_extent), so that one recipe serves a stuffed fox and a quarry.

mod average;
mod cells;
mod crops;
mod density;
mod rates;
mod schedule;
mod skips;
mod validation;

pub use average::AverageSettings;
pub use cells::CellSettings;
pub use crops::CropSettings;
pub use density::{DensitySettings, Strategy};
pub use rates::{AdamSettings, RateSettings};
pub use schedule::{ResolutionSettings, ShSettings, StopSettings, ViewSettings};
pub use skips::SkipSettings;
pub use validation::ValidationSettings;

use crate::settings::{Limits, table};

/// More than anybody takes: the steps of a schedule that time alone ends.
pub const MOST_STEPS: u32 = 1_000_000_000;

table! {
    /// The training recipe. Its defaults are what the measured tables of `tests/BENCHMARKS.md` were measured with.
    pub struct TrainSettings {
        /// Seeds view order, noise, relocation and DropGaussian; same seed, same bytes.
        pub seed: u64 = 1;
        /// Length of the schedule.
        pub steps: u32 = 10_000, in Limits::within(1.0, MOST_STEPS as f64), unit "steps", from "the paper, 4.1: 10,000 steps per device";
        /// Length of the schedule by wall clock; when given, progress is the larger of the two fractions, so that training
        /// ends at whichever comes first.
        pub seconds: Option<f64> = None, in Limits::within(1e-3, 1e9);
        /// Length of the schedule by the energy that the computer takes during it, watt-hours; with steps or seconds, whichever comes
        /// first.
        pub energy_wh: Option<f64> = None, in Limits::within(1e-6, 1e6);
        /// What the computer takes while it trains, watts, where it does not say it (power monitors of hwmon, `vcgencmd`).
        pub watts: Option<f32> = None, in Limits::within(1e-3, 1e5);
        /// What is minimised.
        pub loss: LossSettings = LossSettings::default();
        /// Step size of every parameter group.
        pub rates: RateSettings = RateSettings::default();
        /// Adam's own constants.
        pub adam: AdamSettings = AdamSettings::default();
        /// Relocation, growth and pruning.
        pub density: DensitySettings = DensitySettings::default();
        /// Spherical harmonics.
        pub sh: ShSettings = ShSettings::default();
        /// Coarse to fine.
        pub resolution: ResolutionSettings = ResolutionSettings::default();
        /// Which view comes next.
        pub views: ViewSettings = ViewSettings::default();
        /// Pictures larger than training pictures.
        pub crops: CropSettings = CropSettings::default();
        /// Scenes of more Gaussians than the device holds.
        pub cells: CellSettings = CellSettings::default();
        /// When to end before the schedule does.
        pub stop: StopSettings = StopSettings::default();
        /// Regularisers that act on the parameters or on the rendering.
        pub regularise: RegulariseSettings = RegulariseSettings::default();
        /// Views that are kept back for a while.
        pub validation: ValidationSettings = ValidationSettings::default();
        /// The mean of the last epochs.
        pub average: AverageSettings = AverageSettings::default();
        /// Work that is left out because it changes nothing.
        pub skips: SkipSettings = SkipSettings::default();
        /// Share of the Gaussians that leave a model which is delivered rounded at most: those that its loss hangs on least. The others learn
        /// to do without them.
        pub thinned_share: f32 = 0.4, in Limits::within(0.0, 0.9);
        /// They are fewer where their absence could raise the loss by more than this share of it, reckoned by its derivatives: where few
        /// Gaussians are superfluous.
        pub thinned_loss: f32 = 0.45, in Limits::at_least(0.0);
        /// Progress at which they do.
        pub thinned_at: f32 = 0.5, in Limits::within(0.0, 1.0);
        /// Last share of the schedule in which places, sizes, rotations and opacities are rounded as the delivery encoding rounds
        /// them, and colours alone are trained: where the model is delivered rounded (`[upload] encoding`, `dgtr train
        /// --for-delivery`).
        pub rounded_share: f32 = 0.15, in Limits::within(0.0, 0.9);
        /// Optimise a 6-vector per view (rotation and translation of world → camera) together with the cloud.
        pub refine_poses: bool = false;
        /// Optimise six scalars per view: log gain and offset of each channel.
        pub refine_exposure: bool = false;
    }
}

/// The share, 0…1, that `spent` steps and seconds are of those that there are; whichever is further.
pub fn share_spent(of: (u32, Option<f64>), spent: (u32, f64)) -> f32 {
    let by_steps = f64::from(spent.0) / f64::from(of.0.max(1));
    let by_time = of.1.map_or(0.0, |s| spent.1 / s.max(1e-3));
    by_steps.max(by_time).clamp(0.0, 1.0) as f32
}

impl TrainSettings {
    /// How much of the schedule is over after `steps` steps and `elapsed_s` seconds, 0…1.
    pub fn progress(&self, steps: u32, elapsed_s: f64) -> f32 {
        share_spent((self.steps, self.seconds), (steps, elapsed_s))
    }

    /// Length of the schedule for so many pictures, where neither steps nor seconds are given: [`Self::steps`], unless each view
    /// is visited [`often enough`](ViewSettings::visits) before.
    pub fn steps_for(&self, views: usize) -> u32 {
        let visits = u64::from(self.views.visits).saturating_mul(views.max(1) as u64);
        u64::from(self.steps).min(visits) as u32
    }
}

table! {
    /// `l1·L1 + ssim·(1 − SSIM) + depth·(1 − ρ(D, D_est))` (paper, total loss; the paper prints ρ itself).
    #[derive(Copy)]
    pub struct LossSettings {
        /// λ₁.
        pub l1: f32 = 0.8, in Limits::at_least(0.0), from "3DGS: 1 − λ_dssim";
        /// λ₂.
        pub ssim: f32 = 0.2, in Limits::at_least(0.0), from "3DGS: λ_dssim = 0.2";
        /// λ₃; only views that came with a depth prior pay it.
        pub depth: f32 = 0.05, in Limits::at_least(0.0), from "FSGS' weight of its Pearson loss, which the paper adopts";
        /// Depth prior pixels with less confidence than this do not take part.
        pub depth_confidence: f32 = 0.1, in Limits::within(0.0, 1.0), from "coverage matters more than purity";
        /// Shape freezing: depth gradients reach means and opacities but not scales and rotations.
        pub freeze_shape: bool = true, from "the paper, table 4: 21.53 → 21.72 dB";
        /// Weight of the mean binary entropy of the opacities in view: what hesitates becomes opaque or nothing.
        pub entropy: f32 = 0.0, in Limits::at_least(0.0), from "Fed3DGS' distillation alone has it (0.01)";
        /// Weight of what the SH coefficients above degree 0 amount to of the Gaussians that a picture shows: colours vary with the view only
        /// as far as pictures insist on it.
        pub view_dependence: f32 = 2e-7, in Limits::at_least(0.0),
            from "sheffield_cross +0.2 dB in long schedules, fox the same, a seventh less to deliver (a89875d)";
        /// Schedules that look at each view less often than this have no such weight, unless their model is delivered rounded.
        pub view_dependence_visits: u32 = 50, unit "looks at each view",
            from "as validation.visits: what is learnt by heart is learnt late";
    }
}

table! {
    /// Regularisers that act on the parameters or on the rendering. Zero switches each of them off.
    #[derive(Copy)]
    pub struct RegulariseSettings {
        /// DropGaussian's γ: by the end of training this share of the Gaussians is left out of each step and the
        /// others' opacities are raised by 1/(1 − γ). For few pictures of vegetation, which are learnt by heart; a room loses by it.
        pub drop: f32 = 0.0, in Limits::within(0.0, 0.9), from "DropGaussian (CVPR 2025) uses 0.2 on three views";
        /// Noise on the means of nearly transparent Gaussians, in units of the means' learning rate; weighted
        /// by (1 − opacity)^150 and clamped to the extent.
        pub noise: f32 = 2.0, in Limits::at_least(0.0), from "Brush: 50 at a 25 × smaller rate of the means";
        /// Opacity subtracted at every densification, fading to nothing at the end.
        pub opacity_decay: f32 = 0.004, in Limits::at_least(0.0), from "Brush opac_decay";
        /// Half-width of the random background colour around `0.5·background`, 0 = black. Keeps the cloud from using black
        /// holes as dark paint (Brush).
        pub background: f32 = 0.0, in Limits::within(0.0, 1.0);
    }
}

/// The scene's length scale, metres: the median over Gaussians of the distance to the nearest camera.
///
/// 3DGS takes 1.1 × the radius of the camera circle, which is 0 for one view and says nothing about a straight
/// flight line. The distance to the camera is proportional to what one pixel covers, which is what a step in
/// position must be measured by. At most 4,096 Gaussians, evenly spaced, are sampled; non-finite ones are
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
    fn few_pictures_get_a_hundred_visits_each_and_many_the_papers_steps() {
        let s = TrainSettings::default();
        let got = [0, 1, 15, 86, 100, 1000, usize::MAX].map(|views| s.steps_for(views));
        assert_eq!(got, [100, 100, 1500, 8600, 10_000, 10_000, 10_000]);
    }

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
