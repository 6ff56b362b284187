//! Settings of the link to the autopilot and of what the HAL does with pictures: table `[link]` of the mission.

use std::path::PathBuf;

use crate::settings::{Limits, choice, table};

choice! {
    /// MAVLink 2 message signing.
    pub enum Signing {
        /// Nothing is signed or checked.
        Off = "off",
        /// We sign; unsigned frames are accepted, wrongly signed ones are not.
        Accept = "accept",
        /// We sign; only rightly signed frames are accepted.
        Require = "require",
    }
}

table! {
    /// The link to the autopilot, and the pictures.
    pub struct LinkSettings {
        /// Our MAVLink component id: 100 to 105 for the camera that we act as.
        pub own_component: u8 = 100, in Limits::within(2.0, 255.0), from "MAV_COMP_ID_CAMERA";
        /// Act as a MAVLink camera (heartbeat, information, capture commands), so that ArduPilot's CAM1_TYPE 6 and ground
        /// control stations see one.
        pub act_as_camera: bool = true;
        /// The link counts as lost after this long without a heartbeat.
        pub heartbeat_timeout_s: f32 = 5.0, in Limits::within(0.1, 3600.0),
            from "QGroundControl and ArduPilot: 3 to 5 heartbeats at 1 Hz";
        /// A flight whose end nobody has seen goes on for this long without a sign of life from autopilot and camera.
        pub silence_limit_s: f32 = 1800.0, in Limits::above(0.0).up_to(86_400.0),
            from "what a multirotor stays in the air";
        /// A flight that an earlier start began is over when the aircraft has stood disarmed for this long: a program started
        /// after the landing never sees it fly.
        pub standing_limit_s: f32 = 600.0, in Limits::above(0.0).up_to(86_400.0),
            from "longer than a change of batteries";
        /// An aircraft that has landed before its region is covered may take off again within this time, with another battery: the
        /// flight goes on. 0: it is over with the landing.
        pub battery_swap_s: f32 = 60.0, in Limits::within(0.0, 86_400.0);
        /// Message signing.
        pub signing: Signing = Signing::Off;
        /// File with the 32-byte key, raw or as 64 hexadecimal digits. The last time stamp is kept in the state
        /// folder (`STATE_DIRECTORY`), without one beside it.
        pub signing_key: Option<PathBuf> = None;
        /// Expected time from exposure to complete picture; learnt from there on.
        pub picture_latency_ms: f32 = 200.0, in Limits::within(0.0, 600_000.0);
        /// Pictures and exposures that do not find each other are put aside after this; after the landing they are compared once
        /// more, all with all.
        pub patience_s: f32 = 15.0, in Limits::above(0.0).up_to(86_400.0);
        /// After the landing pictures of announced exposures are waited for until none has come for this long.
        pub late_pictures_s: f32 = 60.0, in Limits::within(0.0, 3600.0);
        /// Pictures that belong to no announced exposure (video, intervalometer) are used, posed at their arrival less the
        /// latency.
        pub free_running: bool = false;
        /// Least time between two free-running pictures; those between are dropped.
        pub picture_interval_ms: f32 = 500.0, in Limits::within(0.0, 3_600_000.0);
        /// A picture without a pose from the autopilot takes the one in its EXIF and XMP data, if it has one.
        pub exif_pose: bool = true;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_timeout_that_is_not_a_number_is_refused_and_named() {
        assert_eq!(LinkSettings::default().check(), Ok(()));
        for bad in [
            "heartbeat_timeout_s = nan",
            "heartbeat_timeout_s = 0.0",
            "picture_latency_ms = -1.0",
            "patience_s = inf",
            "picture_interval_ms = nan",
            "own_component = 0",
        ] {
            let field = bad.split(' ').next();
            let refused = toml::from_str::<LinkSettings>(bad).expect("TOML").check().expect_err(bad);
            assert_eq!(Some(refused.field.as_str()), field);
        }
    }
}
