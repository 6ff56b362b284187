//! Presets: budgets of a size of job, each a point of the measured front of run time against error. No board has been
//! measured: a preset says how large the problem is, not how long a board then takes.
//!
//! A preset only fills what nobody said: a number in the mission file or on the command line always wins. `auto` is the one that knows
//! the device: the point is chosen by what a step costs there, from the figures below.

use crate::settings::choice;

choice! {
    /// A size of job.
    pub enum Preset {
        /// The least that still trains: pictures of half the size, few Gaussians, seconds of training.
        Tiny = "tiny",
        /// Whole pictures, training of less than a minute.
        Short = "short",
        /// Whole pictures, twice as long.
        Medium = "medium",
        /// Whole pictures, four times as long.
        Long = "long",
        /// Whole pictures, minutes of training: for a machine on mains power.
        Longest = "longest",
        /// The largest point of the front that this device reaches in the time there is, by what a step costs on it.
        Auto = "auto",
    }
}

/// Visits to each picture, half of the schedule at half its size, that a point needs before a larger one is preferred. On sheffield_cross,
/// scored at full size, pictures of half the size have 0.08 dB more than whole ones of the same time after 0.9 visits to whole ones, and
/// 0.27 and 0.23 less after 2.2 and 5.0 (measured at dc27ca5).
pub const VISITS: u32 = 3;
/// Gaussians in view per pixel of a picture, at the most and at the least worth having: those of the presets of whole pictures (100,000
/// Gaussians, of which a picture of 640×480 sees 29 %), and half as many, which at half the size cost 0.15 dB.
pub const DENSITIES: [f64; 2] = [0.05, 0.1];
/// Seconds for which a size is chosen where nobody says how long: those of [`Preset::Longest`]. Half as many had 0.06 dB less
/// (25.02 and 25.08 after 160 and 300 s, tests/BENCHMARKS.md).
pub const SECONDS: f64 = 300.0;
/// Pictures of a survey that show each place; one of so many shows that share of the scene, where nothing else says how much it does. Of
/// sheffield_cross's 43 pictures each shows 20 to 30 %.
pub const SHOWN_BY: f64 = 10.0;

/// What a preset stands for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PresetValues {
    /// The one device allocation, MiB.
    pub device_mib: u32,
    /// Most Gaussians.
    pub max_gaussians: u32,
    /// Pictures are trained at this fraction of their size, 0 < scale ≤ 1.
    pub image_scale: f32,
    /// Seconds of training.
    pub seconds: f64,
}

impl Preset {
    /// The preset of this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.iter().find(|p| p.0 == name).map(|p| p.1)
    }

    /// Its budgets. Each row names the point of `bench time-error sheffield_cross --init feed-forward` that it is (43 key
    /// frames, an idle lavapipe on two cores, PSNR at the row's scale; all lie on the front, `long` by its SSIM). `None`: they are the
    /// device's to say.
    pub fn values(self) -> Option<PresetValues> {
        let row = |device_mib, max_gaussians, image_scale, seconds| PresetValues {
            device_mib,
            max_gaussians,
            image_scale,
            seconds,
        };
        Some(match self {
            // --scale 0.5 --budgets-mib 96 --max-gaussians 12000 --seconds 10: 23.88 dB, 12.3 s (an earlier recipe).
            Self::Tiny => row(96, 12_000, 0.5, 10.0),
            // --budgets-mib 512 --max-gaussians 100000 --seconds 40: 24.67 dB, 44.9 s.
            Self::Short => row(512, 100_000, 1.0, 40.0),
            // The same with --seconds 80: 25.04 dB, 85.3 s in all.
            Self::Medium => row(512, 100_000, 1.0, 80.0),
            // The same with --seconds 160: 25.02 dB, 0.006 more SSIM, 166 s.
            Self::Long => row(512, 100_000, 1.0, 160.0),
            // The same with --seconds 300: 25.08 dB, 307 s.
            Self::Longest => row(512, 100_000, 1.0, SECONDS),
            Self::Auto => return None,
        })
    }
}

impl std::fmt::Display for PresetValues {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { device_mib, max_gaussians, image_scale, seconds } = self;
        write!(f, "{device_mib} MiB, {max_gaussians} Gaussians, pictures at {image_scale} of their size, {seconds} s")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::{Lanes, Plan, PlanRequest};

    #[test]
    fn every_preset_has_a_plan_for_forty_eight_photographs() {
        for &(name, preset) in Preset::ALL {
            assert_eq!(Preset::named(name), Some(preset));
            let Some(v) = preset.values() else { continue };
            let side = |full: u32| (full as f32 * v.image_scale) as u32;
            let plan = Plan::new(&PlanRequest {
                device_mib: v.device_mib,
                width: side(640),
                height: side(480),
                views: 48,
                sh_degree: 3,
                max_gaussians: Some(v.max_gaussians as usize),
                scene_gaussians: None,
                // The more of the two.
                lanes: Lanes::BOARD,
                ..Default::default()
            });
            let plan = plan.unwrap_or_else(|e| panic!("{name}: {e}"));
            assert_eq!(plan.gaussians, v.max_gaussians as usize, "{name}: the budget does not hold its Gaussians");
        }
        assert_eq!(Preset::named("rpi5"), None);
    }
}
