//! How long an aircraft takes for what it flies.

use glam::DVec2;

use crate::FleetError;

/// Acceleration along a path, m/s²: ArduCopter's WPNAV_ACCEL.
const ACCELERATION: f64 = 2.5;
/// Climbing, descending and the last metres of a landing, m/s: ArduCopter's WPNAV_SPEED_UP, WPNAV_SPEED_DN and LAND_SPEED.
const CLIMB: f64 = 2.5;
const DESCENT: f64 = 1.5;
const LANDING: f64 = 0.5;
/// The landing is slow below this height, metres: ArduCopter's LAND_ALT_LOW.
const SLOW_BELOW_M: f64 = 10.0;
/// Motors start, and stop, seconds.
const ON_GROUND_S: f64 = 10.0;
/// Against the wind at least this is left of the airspeed, m/s.
const LEAST_HEADWAY: f64 = 1.0;

/// How an area is photographed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Manner {
    /// Lines lie no further apart, metres.
    pub spacing_m: f64,
    /// Lines are longer than the ground by this, at both ends, metres.
    pub beyond_m: f64,
    /// Height above the ground, metres.
    pub height_m: f64,
    /// Speed and wind.
    pub pace: Pace,
}

/// Speed of an aircraft over ground in a wind that may come from anywhere.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pace {
    /// Over ground along a straight line, m/s: as asked, or what is left of the airspeed against the wind.
    pub speed_m_s: f64,
    /// Wind, m/s.
    pub wind_m_s: f64,
}

impl Pace {
    /// `speed_m_s` over ground where an airspeed of `fastest_m_s` allows it.
    ///
    /// # Errors
    /// A speed that cannot be flown with, or a wind that leaves none.
    pub fn new(speed_m_s: f64, wind_m_s: f64, fastest_m_s: f64) -> Result<Self, FleetError> {
        let wrong =
            |what, value: f64, wanted: String| Err(FleetError::Setting { what, value: value.to_string(), wanted });
        if !(0.5..=50.0).contains(&speed_m_s) {
            return wrong("--speed", speed_m_s, "0.5 to 50 m/s".into());
        }
        if !(speed_m_s..=100.0).contains(&fastest_m_s) {
            return wrong("--fastest", fastest_m_s, format!("{speed_m_s} (--speed) to 100 m/s"));
        }
        if !(wind_m_s >= 0.0 && wind_m_s <= fastest_m_s - LEAST_HEADWAY) {
            let wanted = format!(
                "0 to {} m/s, as the aircraft flies {fastest_m_s} m/s (--fastest)",
                fastest_m_s - LEAST_HEADWAY
            );
            return wrong("--wind", wind_m_s, wanted);
        }
        Ok(Self { speed_m_s: speed_m_s.min(fastest_m_s - wind_m_s), wind_m_s })
    }

    /// Seconds from rest to rest over a straight leg. A stop takes longer by what the aircraft needs to settle against the wind.
    pub fn leg_s(&self, metres: f64) -> f64 {
        if metres < 1e-6 {
            return 0.0;
        }
        let v = self.speed_m_s;
        let flown = match metres > v * v / ACCELERATION {
            true => metres / v + v / ACCELERATION,
            false => 2.0 * (metres / ACCELERATION).sqrt(),
        };
        flown + self.wind_m_s / ACCELERATION
    }

    /// Seconds from corner to corner.
    pub fn path_s(&self, path: &[DVec2]) -> f64 {
        path.windows(2).map(|w| self.leg_s(w[0].distance(w[1]))).sum()
    }

    /// Metres to stop from full speed.
    pub fn stop_m(&self) -> f64 {
        self.speed_m_s * self.speed_m_s / (2.0 * ACCELERATION)
    }

    /// Seconds of going from one height to another and back, metres.
    pub fn change_s(&self, from: f64, to: f64) -> f64 {
        let apart = (to - from).abs();
        apart / CLIMB + apart / DESCENT
    }

    /// Seconds of all that is vertical in a sortie that crosses at one height and photographs at another, metres above the take-off place.
    pub fn vertical_s(&self, crossing_m: f64, survey_m: f64) -> f64 {
        let down = |m: f64| m.max(0.0) / DESCENT;
        let up = |m: f64| m.max(0.0) / CLIMB;
        let slow = crossing_m.clamp(0.0, SLOW_BELOW_M);
        ON_GROUND_S + up(crossing_m) + self.change_s(crossing_m, survey_m) + down(crossing_m - slow) + slow / LANDING
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn legs_take_what_speed_and_acceleration_allow_and_the_wind_costs_at_stops() {
        let calm = Pace::new(10.0, 0.0, 15.0).expect("a pace");
        assert!((calm.leg_s(100.0) - 14.0).abs() < 1e-9 && calm.leg_s(0.0) == 0.0);
        // 10 m: half of it accelerating, half braking.
        assert!((calm.leg_s(10.0) - 4.0).abs() < 1e-9);
        let windy = Pace::new(10.0, 5.0, 15.0).expect("a pace");
        assert!((windy.leg_s(100.0) - 16.0).abs() < 1e-9);
        assert_eq!(Pace::new(10.0, 8.0, 15.0).expect("a pace").speed_m_s, 7.0);
        let refused = |a, b, c| Pace::new(a, b, c).expect_err("refused").to_string();
        assert!(refused(10.0, 14.5, 15.0).starts_with("--wind 14.5: must be 0 to 14 m/s"));
        assert!(refused(f64::NAN, 0.0, 15.0).starts_with("--speed"));
        assert!(refused(10.0, 0.0, 5.0).starts_with("--fastest 5"));
        assert!(refused(10.0, f64::NAN, 15.0).starts_with("--wind"));
    }

    #[test]
    fn climbing_and_landing_take_their_time() {
        let pace = Pace::new(10.0, 0.0, 15.0).expect("a pace");
        // 50 m up, 10 down, 10 up, 40 down, the last 10 slowly.
        let wanted = 10.0 + 50.0 / 2.5 + 10.0 / 1.5 + 10.0 / 2.5 + 40.0 / 1.5 + 10.0 / 0.5;
        assert!((pace.vertical_s(50.0, 40.0) - wanted).abs() < 1e-9);
    }
}
