//! `[failsafe]` of the mission file: from which values on something counts as trouble, and how patient the ladder is.

use crate::settings::{Limits, SettingError, table};

table! {
    /// Thresholds of the failsafe flags, and the times of the ladder.
    #[derive(Copy)]
    pub struct FailsafeSettings {
        /// Temperature of the hottest thermal zone from which training uses half the resolution.
        pub hot_c: f32 = 80.0, in Limits::within(20.0, 125.0), unit "°C",
            from "BCM2712 and RK3588 begin to throttle at 80 to 85 °C";
        /// From which it stops.
        pub very_hot_c: f32 = 90.0, in Limits::within(20.0, 125.0), unit "°C",
            from "they shut down soon after";
        /// Share of `memory.host_mib` that may be resident before memory counts as short.
        pub memory_share: f32 = 0.95, in Limits::within(0.1, 1.0);
        /// Free space of the output's file system below which the ground control station is warned.
        pub disk_low_mib: u32 = 512, from "a checkpoint, its successor and some hundred key frames";
        /// Remaining battery at or below which the best model is offered and training stops.
        pub battery_low_pct: u8 = 20, in Limits::within(0.0, 100.0), from "ArduPilot's customary low battery";
        /// A position with a larger standard deviation does not place a picture.
        pub position_sigma_m: f32 = 20.0, in Limits::within(0.01, 1e4);
        /// Exposures in a row without a picture after which the camera counts as silent.
        pub silent_exposures: u32 = 3, in Limits::at_least(1.0);
        /// Pictures in a row that show nothing or cannot be decoded after which they count as poor.
        pub poor_pictures: u32 = 3, in Limits::at_least(1.0);
        /// Training is behind when `training.seconds` gives each view fewer visits than this at the present pace.
        pub behind_visits: f32 = 2.0, in Limits::within(0.0, 1e4),
            from "measured on sheffield_cross: 1.2 visits cost 1.2 dB against 9, 4.6 visits 0.25 dB";
        /// And far behind below this.
        pub far_behind_visits: f32 = 1.0, in Limits::within(0.0, 1e4);
        /// A cause must be gone this long before a step back.
        pub recovery_s: f32 = 10.0, in Limits::within(0.0, 3600.0);
        /// Without autopilot or pictures for this long the best model is offered.
        pub silent_s: f32 = 60.0, in Limits::within(1.0, 86_400.0);
        /// After the best model was offered and nothing got better for this long, hold.
        pub hold_after_s: f32 = 30.0, in Limits::within(0.0, 86_400.0);
    } where Self::in_order
}

impl FailsafeSettings {
    fn in_order(&self) -> Result<(), SettingError> {
        if self.very_hot_c < self.hot_c {
            return Err(SettingError::new("very_hot_c", &self.very_hot_c, "hot_c or more"));
        }
        if self.far_behind_visits > self.behind_visits {
            return Err(SettingError::new("far_behind_visits", &self.far_behind_visits, "behind_visits or less"));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thresholds_out_of_range_or_out_of_order_are_refused_by_name() {
        assert_eq!(FailsafeSettings::default().check(), Ok(()));
        for (text, field) in [
            ("hot_c = nan", "hot_c"),
            ("hot_c = 85.0\nvery_hot_c = 80.0", "very_hot_c"),
            ("behind_visits = 1.0\nfar_behind_visits = 2.0", "far_behind_visits"),
            ("battery_low_pct = 101", "battery_low_pct"),
            ("silent_exposures = 0", "silent_exposures"),
        ] {
            let settings: FailsafeSettings = toml::from_str(text).expect("TOML");
            assert_eq!(settings.check().expect_err(text).field, field);
        }
        assert!(toml::from_str::<FailsafeSettings>("hot = 80.0").is_err());
    }
}
