//! Whether the aircraft is down: a state that several independent signs agree on for seconds. Never one message, which anybody
//! may have sent, and never silence, which says nothing about the aircraft.

use crate::mavlink::dialect::MavLandedState;

/// Disarmed heartbeats in a row, and for how long, before the motors are believed to be off.
const HEARTBEATS: u8 = 3;
const HOLD_NS: u64 = 3_000_000_000;
/// Without a second sign (on a slope above the take-off, no landed state reported), or once the heartbeats have ended as well,
/// everything must have held for this long.
const LONG_HOLD_NS: u64 = 30_000_000_000;
/// What was reported longer ago than this is no sign any more.
const FRESH_NS: u64 = 5_000_000_000;
/// Faster than this nothing stands: GPS velocity of a standing receiver stays below 0.5 m/s.
const AT_REST_M_S: f64 = 1.5;
/// So near to the height it was armed at, it may stand: a barometer drifts by metres in an hour.
const NEAR_GROUND_M: f64 = 5.0;
/// A height or speed that only a flight has.
const ALOFT_M: f64 = 3.0;
const FLYING_M_S: f64 = 3.0;

/// The signs, as they came; times are the companion's, ns.
#[derive(Clone, Copy, Debug, Default)]
pub struct Landing {
    armed: bool,
    flown: bool,
    disarmed_since_ns: Option<u64>,
    disarmed_heartbeats: u8,
    heartbeat_ns: u64,
    /// Height above home when it was armed, m.
    armed_height_m: Option<f64>,
    height: Option<(u64, f64)>,
    landed_state: Option<(u64, bool)>,
    /// When something last spoke against standing on the ground.
    moving_ns: Option<u64>,
    /// An earlier start saw it fly: without a flight of this start it is down after standing for so long.
    standing_ns: Option<u64>,
}

impl Landing {
    /// Of a flight that an earlier start began; it is over when the aircraft has stood disarmed for `standing_ns`.
    pub(super) fn continued(standing_ns: u64) -> Self {
        Self { standing_ns: Some(standing_ns), ..Self::default() }
    }

    /// A heartbeat of the autopilot.
    pub(super) fn on_heartbeat(&mut self, armed: bool, now_ns: u64) {
        self.heartbeat_ns = now_ns;
        if armed {
            if !self.armed {
                self.armed_height_m = self.height.map(|h| h.1);
            }
            (self.disarmed_since_ns, self.disarmed_heartbeats) = (None, 0);
            // Without positions nobody can tell a flight from a test of the motors.
            self.flown |= self.height.is_none();
        } else {
            self.disarmed_since_ns.get_or_insert(now_ns);
            self.disarmed_heartbeats = self.disarmed_heartbeats.saturating_add(1);
        }
        self.armed = armed;
    }

    /// Height above home, m, and speed, m/s.
    pub(super) fn on_motion(&mut self, height_m: f64, speed_m_s: f64, now_ns: u64) {
        self.height = Some((now_ns, height_m));
        if self.armed && self.armed_height_m.is_none() {
            self.armed_height_m = Some(height_m);
        }
        if speed_m_s > AT_REST_M_S {
            self.moving_ns = Some(now_ns);
        }
        let risen = self.armed_height_m.is_some_and(|armed| height_m - armed > ALOFT_M);
        self.flown |= self.armed && (risen || speed_m_s > FLYING_M_S);
    }

    /// EXTENDED_SYS_STATE.
    pub(super) fn on_landed_state(&mut self, state: MavLandedState, now_ns: u64) {
        use MavLandedState::{MAV_LANDED_STATE_ON_GROUND as ON_GROUND, MAV_LANDED_STATE_UNDEFINED as UNDEFINED};
        if state == UNDEFINED {
            return;
        }
        self.landed_state = Some((now_ns, state == ON_GROUND));
        if state != ON_GROUND {
            self.flown |= self.armed;
            self.moving_ns = Some(now_ns);
        }
    }

    /// An exposure was announced: nobody photographs on the ground.
    pub(super) fn on_exposure(&mut self) {
        self.flown |= self.armed;
    }

    /// The motors may turn, by the last heartbeat.
    pub fn is_armed(&self) -> bool {
        self.armed
    }

    /// It flew, in this start or an earlier one, and everything that is known at `now_ns` says that it is down again.
    pub fn is_down(&self, now_ns: u64) -> bool {
        let Some(since_ns) = self.disarmed_since_ns else { return false };
        // What spoke against it last counts, whichever came later.
        let quiet_ns = now_ns.saturating_sub(since_ns.max(self.moving_ns.unwrap_or(0)));
        let fresh = |at: u64| now_ns.saturating_sub(at) < FRESH_NS;
        let on_ground = self.landed_state.filter(|s| fresh(s.0)).map(|s| s.1);
        if on_ground == Some(false) || self.disarmed_heartbeats < HEARTBEATS {
            return false;
        }
        let near_ground = match (self.height, self.armed_height_m) {
            (Some((at, height)), Some(armed)) => fresh(at) && (height - armed).abs() < NEAR_GROUND_M,
            // Heartbeats are all this autopilot sends.
            (None, _) => true,
            (Some(_), None) => false,
        };
        let agreed = fresh(self.heartbeat_ns) && (on_ground == Some(true) || near_ground);
        match (self.flown, self.standing_ns) {
            (true, _) => quiet_ns >= if agreed { HOLD_NS } else { LONG_HOLD_NS },
            // Nobody flies with the motors off; but a second flight of the same mission may still begin.
            (false, Some(standing_ns)) => quiet_ns >= standing_ns,
            (false, None) => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use MavLandedState::{MAV_LANDED_STATE_IN_AIR as IN_AIR, MAV_LANDED_STATE_ON_GROUND as ON_GROUND};

    const S: u64 = 1_000_000_000;

    /// Seconds of a flight with heartbeats at 1 Hz and positions at 10 Hz; the first second it is down.
    fn first_down(
        seconds: u64,
        armed: impl Fn(u64) -> bool,
        motion: impl Fn(u64) -> Option<(f64, f64)>,
        state: impl Fn(u64) -> Option<MavLandedState>,
    ) -> Option<u64> {
        let mut landing = Landing::default();
        for tenth in 0..seconds * 10 {
            let (now, s) = (S + tenth * S / 10, tenth / 10);
            if tenth % 10 == 0 {
                landing.on_heartbeat(armed(s), now);
                state(s).into_iter().for_each(|state| landing.on_landed_state(state, now));
            }
            motion(s).into_iter().for_each(|(height, speed)| landing.on_motion(height, speed, now));
            if landing.is_down(now) {
                return Some(s);
            }
        }
        None
    }

    /// Up within 10 s, down again from 50 s on.
    fn survey(s: u64) -> Option<(f64, f64)> {
        Some(if (10..50).contains(&s) { (40.0, 5.0) } else { (0.2, 0.1) })
    }

    #[test]
    fn a_landing_is_a_state_held_for_seconds() {
        let down = first_down(100, |s| (5..52).contains(&s), survey, |_| None);
        assert_eq!(down, Some(55));
    }

    #[test]
    fn disarmed_heartbeats_of_somebody_else_end_no_flight() {
        // One message, a burst of four seconds while flying, and half of all heartbeats while hovering.
        assert_eq!(first_down(50, |s| s > 4 && s != 20, survey, |_| None), None);
        assert_eq!(first_down(50, |s| s > 4 && !(20..49).contains(&s), survey, |_| None), None);
        let hovering = |s| Some((if s > 8 { 40.0 } else { 0.0 }, 0.1));
        assert_eq!(first_down(600, |s| s > 4 && s % 2 == 0, hovering, |_| None), None);
        assert_eq!(first_down(30, |s| s > 4 && s < 15, hovering, |_| None), None, "at 40 m, for 15 s");
    }

    #[test]
    fn what_the_autopilot_says_about_the_ground_counts_on_both_sides() {
        // A landing on a hill: no height to go by.
        let hill = |s| Some(if (10..50).contains(&s) { (40.0, 5.0) } else { (if s < 10 { 0.0 } else { 25.0 }, 0.1) });
        let armed = |s| (5..52).contains(&s);
        assert_eq!(first_down(200, armed, hill, |s| Some(if s < 52 { IN_AIR } else { ON_GROUND })), Some(55));
        assert_eq!(first_down(200, armed, hill, |_| None), Some(82), "held for longer without");
        assert_eq!(first_down(200, armed, survey, |_| Some(IN_AIR)), None, "contradicted");
    }

    #[test]
    fn motors_that_were_tested_on_the_ground_are_no_flight_and_silence_is_no_landing() {
        assert_eq!(first_down(60, |s| (5..10).contains(&s), |_| Some((0.0, 0.1)), |_| None), None);
        let mut landing = Landing::default();
        for s in 0..60 {
            landing.on_heartbeat(s > 1, s * S);
            landing.on_motion(if s > 5 { 40.0 } else { 0.0 }, 6.0, s * S);
        }
        assert!((60..100_000).all(|s| !landing.is_down(s * S)));
        // An autopilot that is switched off after it has said three times that it stands.
        for s in 60..64 {
            landing.on_heartbeat(false, s * S);
            landing.on_motion(0.0, 0.1, s * S);
        }
        assert!(landing.is_down(100 * S));
    }

    #[test]
    fn an_autopilot_that_only_sends_heartbeats_lands_by_them() {
        assert_eq!(first_down(100, |s| (5..52).contains(&s), |_| None, |_| None), Some(55));
    }

    #[test]
    fn a_program_started_after_the_landing_sees_it_only_when_an_earlier_one_saw_the_flight() {
        let first_down = |mut landing: Landing, armed: fn(u64) -> bool, moved: fn(u64) -> f64| {
            (0..2000).find(|&s| {
                landing.on_heartbeat(armed(s), S + s * S);
                landing.on_motion(moved(s), 0.2, S + s * S);
                landing.is_down(S + s * S)
            })
        };
        let continued = || Landing::continued(600 * S);
        assert_eq!(first_down(continued(), |_| false, |_| 0.0), Some(600));
        assert_eq!(first_down(Landing::default(), |_| false, |_| 0.0), None);
        // A second flight begins after a change of batteries, and ends as any.
        let armed = |s| (300..900).contains(&s);
        let height = |s| if (310..890).contains(&s) { 40.0 } else { 0.0 };
        assert_eq!(first_down(continued(), armed, height), Some(903));
    }
}
