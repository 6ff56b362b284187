//! `[ground]` of the mission file: how the ground station merges the aircraft's models and distils the result.

use serde::{Deserialize, Serialize};

/// `[ground]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GroundSettings {
    /// Part of the name of the Vulkan device to use; None = the best there is.
    pub device: Option<String>,
    /// Device memory for merging and distilling, MiB.
    pub device_mib: u32,
    /// Upper bound of the global model; None = as many as the memory holds.
    pub max_gaussians: Option<usize>,
    /// Passes over the distillation views. 0 = merge only. Fed3DGS uses 5; sheffield_cross merged: 25.45 dB with 5, 25.63 with
    /// 15, and its best aircraft's own views lose 0.31 and 0.07 dB.
    pub epochs: u32,
    /// Seconds for distillation at most; None = all epochs.
    pub seconds: Option<f64>,
    /// Size of the distillation pictures relative to the training pictures (Fed3DGS uses ¼; smaller ones than the models
    /// were trained on cost detail: sheffield_cross at ½ SSIM 0.800, at 1 SSIM 0.811).
    pub scale: f32,
    /// Width of the band along a border between two regions that counts as seam, metres.
    pub seam_m: f32,
    /// Share of the Gaussians a view sees that must lie in a seam for the view to take part in distillation, 0..1.
    pub seam_share: f32,
    /// Distil on every view, not only on those that see a seam.
    pub all_views: bool,
    /// Teach views half-way between neighbouring training views, too: on its training views alone the union would
    /// learn its teachers' mistakes by heart.
    pub between_views: bool,
    /// Learning rates of distillation, as a fraction of the trainer's.
    pub rate: f32,
    /// Gaussians at or below this opacity are removed after distillation (Fed3DGS: 0.005).
    pub prune_opacity: f32,
    /// Bring the models together by what they show in common before merging (each lies where its own GPS put it).
    pub register: bool,
    /// Seed of the order of views.
    pub seed: u64,
}

impl Default for GroundSettings {
    fn default() -> Self {
        Self {
            device: None,
            device_mib: 1024,
            max_gaussians: None,
            epochs: 15,
            seconds: None,
            scale: 1.0,
            seam_m: 8.0,
            seam_share: 0.02,
            all_views: false,
            between_views: true,
            rate: 1.0,
            prune_opacity: 0.005,
            register: true,
            seed: 0,
        }
    }
}

/// What is wrong with `[ground]`.
#[derive(Debug, thiserror::Error, PartialEq)]
#[error("{name} {value} is outside {range}")]
pub struct GroundSettingsError {
    /// Key in the file.
    pub name: &'static str,
    /// What it is.
    pub value: f64,
    /// What it may be.
    pub range: &'static str,
}

impl GroundSettings {
    /// Checks what serde cannot.
    pub fn validate(&self) -> Result<(), GroundSettingsError> {
        let checks: [(&'static str, f64, bool, &'static str); 8] = [
            ("device_mib", f64::from(self.device_mib), (16..=1 << 20).contains(&self.device_mib), "16..=1048576"),
            ("epochs", f64::from(self.epochs), self.epochs <= 1000, "0..=1000"),
            ("seconds", self.seconds.unwrap_or(1.0), self.seconds.is_none_or(|s| s > 0.0 && s.is_finite()), "> 0"),
            ("scale", f64::from(self.scale), self.scale > 0.0 && self.scale <= 1.0, "0 < scale <= 1"),
            ("seam_m", f64::from(self.seam_m), self.seam_m > 0.0 && self.seam_m.is_finite(), "> 0"),
            ("seam_share", f64::from(self.seam_share), (0.0..=1.0).contains(&self.seam_share), "0..=1"),
            ("rate", f64::from(self.rate), self.rate > 0.0 && self.rate <= 10.0, "0 < rate <= 10"),
            ("prune_opacity", f64::from(self.prune_opacity), (0.0..0.5).contains(&self.prune_opacity), "0 <= p < 0.5"),
        ];
        match checks.into_iter().find(|c| !c.2) {
            Some((name, value, _, range)) => Err(GroundSettingsError { name, value, range }),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn defaults_are_valid_and_nan_is_not() {
        assert_eq!(GroundSettings::default().validate(), Ok(()));
        assert_eq!(toml::from_str::<GroundSettings>("").ok(), Some(GroundSettings::default()));
        for bad in ["scale = nan", "scale = 0.0", "seam_m = inf", "seconds = -1.0", "prune_opacity = 0.5"] {
            assert!(toml::from_str::<GroundSettings>(bad).is_ok_and(|s| s.validate().is_err()), "{bad}");
        }
    }
}
