//! `[memory]`: the two numbers everything is planned from, or a preset that stands for them.

use serde::Deserialize;

use crate::plan::WORKING_SIDE;
use crate::preset::Preset;
use crate::settings::{Limits, table};

table! {
    /// The two numbers everything is planned from, or a preset that stands for them.
    #[derive(Copy)]
    #[serde(from = "Given")]
    pub struct MemorySettings {
        /// Fills what is not given: here, and `seconds` of `[training]`; absent = `auto` for a flight whose mission gives none of
        /// `device_mib`, `max_gaussians` and `image_scale`.
        pub preset: Option<Preset> = None;
        /// The one device allocation; absent = 512, or what the preset says.
        pub device_mib: Option<u32> = None, in Limits::within(16.0, 131_072.0);
        /// Bound on the host's resident memory (refused at start when the plan exceeds it).
        pub host_mib: u32 = 2048, in Limits::within(64.0, 1_048_576.0);
        /// Training views on the device at once, the others waiting in a file in the output folder; absent = all while they leave
        /// half of `device_mib`, else what an eighth of it holds.
        pub view_slots: Option<u32> = None, in Limits::within(2.0, 4096.0);
        /// Cap on the number of Gaussians below what the budget would hold; absent = what it holds.
        pub max_gaussians: Option<u32> = None;
        /// Gaussians of the whole scene: more than the device holds wait in a file in the output folder, by cells of ground; absent =
        /// all are on the device.
        pub scene_gaussians: Option<u32> = None;
        /// Bound on what an aircraft's output folder takes of the disk, MiB; absent = what is free.
        pub disk_mib: Option<u32> = None;
        /// Pictures are trained at this fraction of their size; absent = whole, or at 640 pixels of the longer side where that is
        /// less.
        pub image_scale: Option<f32> = None, in Limits::above(0.0).up_to(1.0);
    }
}

/// The one device allocation where nobody says another, MiB.
pub const DEVICE_MIB: u32 = 512;

impl MemorySettings {
    /// The one device allocation, MiB.
    pub fn device_mib(&self) -> u32 {
        self.device_mib.unwrap_or(DEVICE_MIB)
    }

    /// Whether a flight's sizes are chosen by what its device can do: the mission says so, or gives none of them.
    pub fn is_auto(&self) -> bool {
        let given = self.device_mib.is_some() || self.max_gaussians.is_some() || self.image_scale.is_some();
        self.preset == Some(Preset::Auto) || (self.preset.is_none() && !given)
    }

    /// The size at which pictures of a camera are trained.
    pub fn training_size(&self, (width, height): (u32, u32)) -> (u32, u32) {
        let scale =
            self.image_scale.unwrap_or_else(|| WORKING_SIDE as f32 / width.max(height).max(WORKING_SIDE) as f32);
        let scaled = |side: u32| ((side as f32 * scale).round() as u32).max(1);
        (scaled(width), scaled(height))
    }
}

/// The table as written: only so can a preset tell what was said from what was not.
#[derive(Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct Given {
    preset: Option<Preset>,
    device_mib: Option<u32>,
    host_mib: Option<u32>,
    view_slots: Option<u32>,
    max_gaussians: Option<u32>,
    scene_gaussians: Option<u32>,
    disk_mib: Option<u32>,
    image_scale: Option<f32>,
}

impl From<Given> for MemorySettings {
    fn from(given: Given) -> Self {
        let mut all = Self { preset: given.preset, ..Self::default() };
        if let Some(values) = given.preset.and_then(Preset::values) {
            all.device_mib = Some(values.device_mib);
            all.max_gaussians = Some(values.max_gaussians);
            all.image_scale = Some(values.image_scale);
        }
        all.device_mib = given.device_mib.or(all.device_mib);
        all.host_mib = given.host_mib.unwrap_or(all.host_mib);
        all.view_slots = given.view_slots;
        all.max_gaussians = given.max_gaussians.or(all.max_gaussians);
        all.scene_gaussians = given.scene_gaussians;
        all.disk_mib = given.disk_mib;
        all.image_scale = given.image_scale.or(all.image_scale);
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_preset_fills_only_what_is_not_given() {
        let of = |text: &str| toml::from_str::<MemorySettings>(text).unwrap();
        assert_eq!(of(""), MemorySettings::default());
        let values = Preset::Medium.values().unwrap();
        let all = of("preset = \"medium\"");
        assert_eq!((all.device_mib(), all.image_scale), (values.device_mib, Some(values.image_scale)));
        assert_eq!(all.max_gaussians, Some(values.max_gaussians));
        let some = of("preset = \"medium\"\ndevice_mib = 100");
        assert_eq!((some.device_mib(), some.max_gaussians), (100, Some(values.max_gaussians)));
        assert!(toml::from_str::<MemorySettings>("preset = \"toaster\"").is_err());
        assert!(toml::from_str::<MemorySettings>("devce_mib = 3").is_err());
    }

    #[test]
    fn sizes_are_the_devices_to_choose_where_the_mission_says_so_or_nothing() {
        let auto = |text: &str| toml::from_str::<MemorySettings>(text).unwrap().is_auto();
        assert!(auto("") && auto("host_mib = 1024") && auto("preset = \"auto\""));
        let said = toml::from_str::<MemorySettings>("preset = \"auto\"\ndevice_mib = 512").unwrap();
        assert!(said.is_auto() && said.device_mib == Some(512), "what was said is known from what was not");
        for given in ["device_mib = 512", "max_gaussians = 1000", "image_scale = 0.5", "preset = \"short\""] {
            assert!(!auto(given), "{given}");
        }
        assert_eq!(MemorySettings::default().device_mib(), 512);
    }

    #[test]
    fn pictures_are_trained_at_a_working_size_unless_the_mission_says_another() {
        let size = |text: &str, full| toml::from_str::<MemorySettings>(text).unwrap().training_size(full);
        assert_eq!(size("", (640, 480)), (640, 480));
        assert_eq!(size("", (4000, 3000)), (640, 480));
        assert_eq!(size("", (300, 48_000_000)), (1, 640));
        assert_eq!(size("image_scale = 0.5", (4000, 3000)), (2000, 1500));
    }
}
