//! Presets: budgets for a class of hardware, each a point of the measured front of run time against error.
//!
//! A preset only fills what nobody said: a number in the mission file or on the command line always wins.

use serde::{Deserialize, Serialize};

/// A class of hardware.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Preset {
    /// Raspberry Pi 5, 8 GB.
    Rpi5,
    /// RK3588 boards.
    Rk3588,
    /// Jetson Orin.
    Orin,
    /// The ground station's own machine.
    Ground,
    /// Continuous integration: the least that still trains.
    Ci,
}

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
    /// Every preset with the name it has in files and on the command line.
    pub const ALL: [(&'static str, Self); 5] = [
        ("rpi5", Self::Rpi5),
        ("rk3588", Self::Rk3588),
        ("orin", Self::Orin),
        ("ground", Self::Ground),
        ("ci", Self::Ci),
    ];

    /// The preset of this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.iter().find(|p| p.0 == name).map(|p| p.1)
    }

    /// Its budgets. Each row names the point of `dgtr bench time-error sheffield_cross --init feed-forward` that it is (43 key
    /// frames, an idle lavapipe on two cores, PSNR at the row's scale; all lie on the front). No board has been measured: a
    /// preset carries over the size of the problem, not the seconds it then takes.
    pub fn values(self) -> PresetValues {
        let row = |device_mib, max_gaussians, image_scale, seconds| PresetValues {
            device_mib,
            max_gaussians,
            image_scale,
            seconds,
        };
        match self {
            // --budgets-mib 512 --max-gaussians 100000 --seconds 80: 24.56 dB, 85.0 s in all.
            Self::Rpi5 => row(512, 100_000, 1.0, 80.0),
            // The same with --seconds 40: 24.09 dB, 44.7 s.
            Self::Rk3588 => row(512, 100_000, 1.0, 40.0),
            // The same with --seconds 160: 24.81 dB, 166 s.
            Self::Orin => row(512, 100_000, 1.0, 160.0),
            // The same with --seconds 300: 25.00 dB, 306 s; the ground has mains power.
            Self::Ground => row(512, 100_000, 1.0, 300.0),
            // --scale 0.5 --budgets-mib 96 --max-gaussians 12000 --seconds 10: 23.88 dB, 12.3 s.
            Self::Ci => row(96, 12_000, 0.5, 10.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::{Plan, PlanRequest, SORT_LANES_GPU};

    #[test]
    fn every_preset_has_a_plan_for_forty_eight_photographs() {
        for (name, preset) in Preset::ALL {
            assert_eq!(Preset::named(name), Some(preset));
            let v = preset.values();
            let side = |full: u32| (full as f32 * v.image_scale) as u32;
            let plan = Plan::new(&PlanRequest {
                device_mib: v.device_mib,
                width: side(640),
                height: side(480),
                views: 48,
                sh_degree: 3,
                max_gaussians: Some(v.max_gaussians as usize),
                // The more of the two.
                sort_lanes: SORT_LANES_GPU,
                ..Default::default()
            });
            let plan = plan.unwrap_or_else(|e| panic!("{name}: {e}"));
            assert_eq!(plan.gaussians, v.max_gaussians as usize, "{name}: the budget does not hold its Gaussians");
        }
        assert_eq!(Preset::named("pi5"), None);
    }
}
