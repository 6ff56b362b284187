//! Faults of a simulated aircraft, all off by default: fields of the mission file's `[faults]` table and, under the
//! names of ArduPilot's SIM_ parameters where those exist, live parameters of the simulator's MAVLink link.

use crate::settings::{SettingError, table};

table! {
    /// What goes wrong, how often, and when. Percentages are of single events (bytes, frames, messages, pictures), each
    /// decided on its own by the mission's seed.
    #[derive(Copy)]
    pub struct FaultSettings {
        /// Faults act from this second of the flight on.
        pub start_s: f32 = 0.0;
        /// And for this long; 0 = to the end.
        pub length_s: f32 = 0.0;
        /// Bytes lost on the line.
        pub byte_loss_pct: f32 = 0.0;
        /// Bytes with one bit flipped.
        pub bit_flip_pct: f32 = 0.0;
        /// Whole frames lost.
        pub frame_loss_pct: f32 = 0.0;
        /// 1: the line is silent in both directions.
        pub link_pause: f32 = 0.0;
        /// 0: the GPS has no fix and the position drifts away.
        pub gps_enable: f32 = 1.0;
        /// Shift of the reported latitude.
        pub gps_glitch_lat_deg: f32 = 0.0;
        /// Shift of the reported longitude.
        pub gps_glitch_lon_deg: f32 = 0.0;
        /// Shift of the reported altitude.
        pub gps_glitch_alt_m: f32 = 0.0;
        /// Attitude messages with a false attitude.
        pub attitude_spike_pct: f32 = 0.0;
        /// By how much.
        pub attitude_spike_deg: f32 = 30.0;
        /// Attitude and gimbal messages with NaN in a field.
        pub nan_pct: f32 = 0.0;
        /// Shift of the autopilot's boot clock, seconds (a reboot or a clock that was set).
        pub clock_jump_s: f32 = 0.0;
        /// 1: SYSTEM_TIME carries Unix time 0, as before the first GPS fix.
        pub unix_time_lost: f32 = 0.0;
        /// 1: CAMERA_FEEDBACK carries 32-bit boot µs instead of Unix µs, as with a feedback pin.
        pub feedback_boot_time: f32 = 0.0;
        /// Triggers that are not announced.
        pub trigger_loss_pct: f32 = 0.0;
        /// Pictures that never arrive.
        pub picture_loss_pct: f32 = 0.0;
        /// Pictures that arrive twice (the second one under another name).
        pub picture_twice_pct: f32 = 0.0;
        /// Pictures that arrive late.
        pub picture_late_pct: f32 = 0.0;
        /// How late.
        pub picture_late_s: f32 = 5.0;
        /// Black pictures.
        pub picture_black_pct: f32 = 0.0;
        /// Overexposed pictures.
        pub picture_over_pct: f32 = 0.0;
        /// Picture files that end in the middle.
        pub picture_cut_pct: f32 = 0.0;
        /// 1: frames are signed with another key.
        pub signing_key_wrong: f32 = 0.0;
        /// 1: somebody with the autopilot's ids says twice a second that it is disarmed.
        pub forged_disarm: f32 = 0.0;
    } where Self::in_range
}

/// One fault as a MAVLink parameter.
#[derive(Clone, Copy)]
pub struct FaultParameter {
    /// At most 16 characters.
    pub name: &'static str,
    /// True for names and units that ArduPilot's simulator has too.
    pub ardupilot: bool,
    /// Smallest and largest value accepted.
    pub range: (f32, f32),
    setting: &'static str,
    field: fn(&mut FaultSettings) -> &mut f32,
}

macro_rules! parameter {
    ($name:literal, $ardupilot:literal, $low:literal..=$high:literal, $field:ident) => {
        FaultParameter {
            name: $name,
            ardupilot: $ardupilot,
            range: ($low, $high),
            setting: stringify!($field),
            field: |s| &mut s.$field,
        }
    };
}

impl FaultSettings {
    /// Every parameter, in the order of PARAM_VALUE's index.
    pub const PARAMETERS: [FaultParameter; 26] = [
        parameter!("SIM_FLT_START", false, 0.0..=1e6, start_s),
        parameter!("SIM_FLT_LENGTH", false, 0.0..=1e6, length_s),
        parameter!("SIM_UART_LOSS", true, 0.0..=100.0, byte_loss_pct),
        parameter!("SIM_UART_FLIP", false, 0.0..=100.0, bit_flip_pct),
        parameter!("SIM_FRAME_LOSS", false, 0.0..=100.0, frame_loss_pct),
        parameter!("SIM_LINK_PAUSE", false, 0.0..=1.0, link_pause),
        parameter!("SIM_GPS1_ENABLE", true, 0.0..=1.0, gps_enable),
        parameter!("SIM_GPS1_GLTCH_X", true, -1.0..=1.0, gps_glitch_lat_deg),
        parameter!("SIM_GPS1_GLTCH_Y", true, -1.0..=1.0, gps_glitch_lon_deg),
        parameter!("SIM_GPS1_GLTCH_Z", true, -1e4..=1e4, gps_glitch_alt_m),
        parameter!("SIM_ATT_SPK_PCT", false, 0.0..=100.0, attitude_spike_pct),
        parameter!("SIM_ATT_SPK_DEG", false, -180.0..=180.0, attitude_spike_deg),
        parameter!("SIM_NAN_PCT", false, 0.0..=100.0, nan_pct),
        parameter!("SIM_CLK_JUMP", false, -1e6..=1e6, clock_jump_s),
        parameter!("SIM_UNIX_LOST", false, 0.0..=1.0, unix_time_lost),
        parameter!("SIM_CAM_BOOTTIME", false, 0.0..=1.0, feedback_boot_time),
        parameter!("SIM_CAM_TRG_LOSS", false, 0.0..=100.0, trigger_loss_pct),
        parameter!("SIM_PIC_LOSS", false, 0.0..=100.0, picture_loss_pct),
        parameter!("SIM_PIC_TWICE", false, 0.0..=100.0, picture_twice_pct),
        parameter!("SIM_PIC_LATE", false, 0.0..=100.0, picture_late_pct),
        parameter!("SIM_PIC_LATE_S", false, 0.0..=1e4, picture_late_s),
        parameter!("SIM_PIC_BLACK", false, 0.0..=100.0, picture_black_pct),
        parameter!("SIM_PIC_OVER", false, 0.0..=100.0, picture_over_pct),
        parameter!("SIM_PIC_CUT", false, 0.0..=100.0, picture_cut_pct),
        parameter!("SIM_SIGN_BAD", false, 0.0..=1.0, signing_key_wrong),
        parameter!("SIM_FORGE_DISARM", false, 0.0..=1.0, forged_disarm),
    ];

    /// Value of the parameter at an index of [`FaultSettings::PARAMETERS`].
    pub fn value(&self, index: usize) -> Option<f32> {
        let mut copy = *self;
        Self::PARAMETERS.get(index).map(|p| *(p.field)(&mut copy))
    }

    /// Sets a parameter by name, clamped into its range; its index, or `None` for an unknown name or NaN.
    pub fn set(&mut self, name: &str, value: f32) -> Option<usize> {
        let index = Self::PARAMETERS.iter().position(|p| p.name == name)?;
        let p = &Self::PARAMETERS[index];
        if value.is_nan() {
            return None;
        }
        *(p.field)(self) = value.clamp(p.range.0, p.range.1);
        Some(index)
    }

    /// These settings while they act, and no fault outside of their time. `flight_s` is seconds of flight.
    pub fn acting(&self, flight_s: f64) -> Self {
        let since = flight_s - f64::from(self.start_s);
        if since >= 0.0 && (self.length_s <= 0.0 || since < f64::from(self.length_s)) { *self } else { Self::default() }
    }

    fn in_range(&self) -> Result<(), SettingError> {
        for (index, p) in Self::PARAMETERS.iter().enumerate() {
            let v = self.value(index).unwrap_or(f32::NAN);
            if !(p.range.0..=p.range.1).contains(&v) {
                let wanted = format!("{} to {} ({})", p.range.0, p.range.1, p.name);
                return Err(SettingError::new(p.setting, &v, wanted));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_field_is_a_parameter_with_a_mavlink_name() {
        let fields = toml::to_string(&FaultSettings::default()).expect("toml").lines().count();
        assert_eq!(fields, FaultSettings::PARAMETERS.len());
        for (k, p) in FaultSettings::PARAMETERS.iter().enumerate() {
            assert!(p.name.len() <= 16, "{}", p.name);
            let mut s = FaultSettings::default();
            let other = if s.value(k) == Some(p.range.1) { p.range.0 } else { p.range.1 };
            assert_eq!(s.set(p.name, other), Some(k));
            assert_eq!(s.value(k), Some(other), "{}", p.name);
            let changed = (0..fields).filter(|i| s.value(*i) != FaultSettings::default().value(*i)).count();
            assert_eq!(changed, 1, "{} changes one field", p.name);
        }
    }

    #[test]
    fn faults_act_only_in_their_time_and_within_range() {
        let s: FaultSettings = toml::from_str("start_s = 10.0\nlength_s = 5.0\nframe_loss_pct = 50.0").expect("toml");
        assert_eq!(s.acting(9.9), FaultSettings::default());
        assert_eq!(s.acting(10.0).frame_loss_pct, 50.0);
        assert_eq!(s.acting(15.0), FaultSettings::default());
        assert!(s.check().is_ok());
        let bad: FaultSettings = toml::from_str("nan_pct = 120.0").expect("toml");
        assert!(bad.check().is_err_and(|e| e.field == "nan_pct" && e.wanted.contains("SIM_NAN_PCT")));
        assert!(toml::from_str::<FaultSettings>("byte_los = 1.0").is_err());
        let mut s = FaultSettings::default();
        assert_eq!((s.set("SIM_UART_LOSS", f32::NAN), s.set("NO_SUCH", 1.0)), (None, None));
    }
}
