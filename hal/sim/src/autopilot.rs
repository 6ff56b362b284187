//! The autopilot of a flight that is already computed: says at every moment what an ArduPilot would say, at its rates
//! and with its clocks, and answers what it is asked.
//!
//! Every message is composed for the instant it is due, not for the instant the program got round to it, so that two
//! runs of a seed say the same.

use std::collections::VecDeque;
use std::time::Duration;

use config::faults::FaultSettings;
use geometry::geodesy::{EnuFrame, Geodetic};
use glam::{DQuat, DVec3};

use super::aircraft::Flight;
use super::faulty_link::FaultyLink;
use super::messages;
use super::random::{About, bits, strikes};
use super::track::Sample;
use hal::error::HalError;
use hal::link::Reconnecting;
use hal::mavlink::channel::{Channel, ChannelCounters};
use hal::mavlink::dialect::{
    ATTITUDE_QUATERNION_DATA, EXTENDED_SYS_STATE_DATA, GIMBAL_DEVICE_ATTITUDE_STATUS_DATA, GLOBAL_POSITION_INT_DATA,
    GPS_RAW_INT_DATA, HEARTBEAT_DATA, MavLandedState, SIM_STATE_DATA, SYSTEM_TIME_DATA, TIMESYNC_DATA,
};
use hal::mavlink::signing::timestamp_of_unix_us;
use hal::mavlink::{MessageData, Signer, SigningMode};
use hal::traits::Link;

mod announce;
mod requests;

pub use announce::Announcing;

/// Lines for the ground control station kept; the oldest are dropped.
pub(super) const TEXTS: usize = 32;
/// No message's id: somebody else's heartbeat, when that fault acts.
const FORGED_HEARTBEAT: u32 = u32::MAX;
const STREAM_COUNT: usize = 10;
/// Message ids and rates of an ArduPilot with its streams set for a companion, Hz.
const STREAMS: [(u32, f64); STREAM_COUNT] = [
    (HEARTBEAT_DATA::ID, 1.0),
    (EXTENDED_SYS_STATE_DATA::ID, 1.0),
    (FORGED_HEARTBEAT, 2.0),
    (SYSTEM_TIME_DATA::ID, 2.0),
    (TIMESYNC_DATA::ID, 0.1),
    (GPS_RAW_INT_DATA::ID, 5.0),
    (GLOBAL_POSITION_INT_DATA::ID, 10.0),
    (ATTITUDE_QUATERNION_DATA::ID, 25.0),
    (GIMBAL_DEVICE_ATTITUDE_STATUS_DATA::ID, 20.0),
    (SIM_STATE_DATA::ID, 0.0),
];
/// How fast a position without GPS runs away, m/s² (grows with time squared, as an inertial solution does).
const DRIFT_MS2: f64 = 0.04;

/// Ids, clocks and key of an autopilot.
#[derive(Clone, Debug, PartialEq)]
pub struct AutopilotSettings {
    /// MAVLink system id.
    pub system_id: u8,
    /// Seconds since its boot when the simulation starts.
    pub boot_s: f64,
    /// Unix time at that moment, µs; `None` = the machine's.
    pub unix_us: Option<u64>,
    /// Its clock against the companion's, parts per million.
    pub clock_drift_ppm: f64,
    /// Accuracy the GPS reports, one standard deviation, metres.
    pub gps_sigma_m: f64,
    /// Rate of SIM_STATE, the truth, Hz; 0 = only when asked for.
    pub truth_hz: f64,
    /// By which messages exposures are announced.
    pub announcing: Announcing,
    /// Signs with this key and requires signatures.
    pub signing_key: Option<[u8; 32]>,
    /// It is switched off after the flight without having disarmed.
    pub stays_armed: bool,
    /// Seed of the faults.
    pub seed: u64,
    /// The faults at the start.
    pub faults: FaultSettings,
}

impl Default for AutopilotSettings {
    fn default() -> Self {
        Self {
            system_id: 1,
            boot_s: 30.0,
            unix_us: None,
            clock_drift_ppm: 0.0,
            gps_sigma_m: 0.7,
            truth_hz: 0.0,
            announcing: Announcing::default(),
            signing_key: None,
            stays_armed: false,
            seed: 0,
            faults: FaultSettings::default(),
        }
    }
}

/// Exposures so far.
#[derive(Default)]
struct Triggers {
    /// The next one of the flight.
    next: usize,
    /// The autopilot's counter.
    counted: u16,
    /// Those whose announcement a fault swallowed.
    lost: u64,
}

struct Stream {
    id: u32,
    period_s: Option<f64>,
    next_s: f64,
    count: u64,
}

/// A flying autopilot.
pub struct Autopilot<L: Link<Error = HalError> = Reconnecting> {
    channel: Channel<FaultyLink<L>>,
    settings: AutopilotSettings,
    flight: Flight,
    frame: EnuFrame,
    faults: FaultSettings,
    streams: [Stream; STREAM_COUNT],
    unix_start_us: u64,
    /// Simulation time of take-off.
    takeoff_s: Option<f64>,
    landed: bool,
    triggers: Triggers,
    gps_lost_since_s: Option<f64>,
    wrong_key: bool,
    heard: u64,
    texts: VecDeque<String>,
    list_from: Option<usize>,
}

impl<L: Link<Error = HalError>> Autopilot<L> {
    /// An autopilot on the ground at the start of `flight`.
    pub fn new(link: FaultyLink<L>, flight: Flight, settings: AutopilotSettings) -> Self {
        let now =
            std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).map_or(0, |d| d.as_micros() as u64);
        let unix_start_us = settings.unix_us.unwrap_or(now);
        let signer = match settings.signing_key {
            Some(key) => Signer::new(SigningMode::Require, key, 1, timestamp_of_unix_us(now)),
            None => Signer::off(),
        };
        let streams = STREAMS.map(|(id, hz)| {
            let hz = if id == SIM_STATE_DATA::ID { settings.truth_hz } else { hz };
            Stream { id, period_s: (hz > 0.0).then(|| 1.0 / hz), next_s: 0.0, count: 0 }
        });
        Self {
            channel: Channel::new(link, settings.system_id, 1, signer),
            frame: EnuFrame::new(flight.origin),
            faults: settings.faults,
            settings,
            flight,
            streams,
            unix_start_us,
            takeoff_s: None,
            landed: false,
            triggers: Triggers::default(),
            gps_lost_since_s: None,
            wrong_key: false,
            heard: 0,
            texts: VecDeque::with_capacity(TEXTS),
            list_from: None,
        }
    }

    /// The flight being flown.
    pub fn flight(&self) -> &Flight {
        &self.flight
    }

    /// Frames of others understood so far; more than 0 means that somebody listens.
    pub fn heard(&self) -> u64 {
        self.heard
    }

    /// The newest lines meant for the ground control station, in order.
    pub fn texts(&self) -> Vec<String> {
        self.texts.iter().cloned().collect()
    }

    /// What happened on the line.
    pub fn counters(&self) -> ChannelCounters {
        self.channel.counters()
    }

    /// The line, for what was done to it.
    pub fn line(&mut self) -> &FaultyLink<L> {
        self.channel.link()
    }

    /// Exposures announced, and those swallowed by the fault.
    pub fn triggers(&self) -> (u64, u64) {
        (u64::from(self.triggers.counted) - self.triggers.lost, self.triggers.lost)
    }

    /// Faults acting at a simulation time.
    pub fn acting(&self, now_s: f64) -> FaultSettings {
        self.faults.acting(self.flight_s(now_s))
    }

    /// Seconds of flight at a simulation time; 0 before take-off.
    pub fn flight_s(&self, now_s: f64) -> f64 {
        self.takeoff_s.map_or(0.0, |t| now_s - t)
    }

    /// Starts the flight; the message streams begin anew with it.
    pub fn take_off(&mut self, now_s: f64) {
        self.takeoff_s = Some(now_s);
        self.channel.link_mut().restart();
        for stream in &mut self.streams {
            stream.next_s = now_s;
            stream.count = 0;
        }
    }

    /// Ends the flight: the motors are disarmed, which is said at once.
    ///
    /// # Errors
    /// The link's.
    pub fn land(&mut self, now_s: f64) -> Result<(), HalError> {
        if self.settings.stays_armed {
            self.streams.iter_mut().for_each(|stream| stream.period_s = None);
            return Ok(());
        }
        self.landed = true;
        self.prepare_line(now_s);
        self.say(HEARTBEAT_DATA::ID, 0, now_s)
    }

    fn boot_us(&self, now_s: f64) -> u64 {
        let jump = f64::from(self.acting(now_s).clock_jump_s);
        ((self.settings.boot_s + now_s * (1.0 + self.settings.clock_drift_ppm * 1e-6) + jump).max(0.0) * 1e6) as u64
    }

    fn unix_us(&self, now_s: f64) -> u64 {
        self.unix_start_us + (now_s.max(0.0) * 1e6) as u64
    }

    /// Sends everything that is due up to `now_s` (seconds of simulation), in order.
    ///
    /// # Errors
    /// The link's.
    pub fn advance(&mut self, now_s: f64) -> Result<(), HalError> {
        loop {
            let due = |s: &&mut Stream| s.period_s.is_some();
            let first = self.streams.iter_mut().filter(due).min_by(|a, b| a.next_s.total_cmp(&b.next_s));
            let stream_s = first.as_ref().map_or(f64::INFINITY, |s| s.next_s);
            let trigger = self.flight.exposures.get(self.triggers.next);
            let trigger_s = match (self.takeoff_s, trigger) {
                (Some(t), Some(e)) => t + e.trigger_s,
                _ => f64::INFINITY,
            };
            if stream_s.min(trigger_s) > now_s {
                break;
            }
            if trigger_s <= stream_s {
                self.prepare_line(trigger_s);
                self.announce(trigger_s)?;
            } else if let Some(stream) = first {
                let (id, count) = (stream.id, stream.count);
                stream.next_s += stream.period_s.unwrap_or(f64::INFINITY);
                stream.count += 1;
                self.prepare_line(stream_s);
                self.say(id, count, stream_s)?;
            }
        }
        self.prepare_line(now_s);
        self.list_parameters()
    }

    /// Reads what the others say, waiting `timeout` at most, and answers.
    ///
    /// # Errors
    /// The link's.
    pub fn listen(&mut self, now_s: &dyn Fn() -> f64, timeout: Duration) -> Result<(), HalError> {
        if self.channel.fill(timeout)? {
            self.answer(now_s)?;
        }
        Ok(())
    }

    /// Line faults and the signing key that act at this moment.
    fn prepare_line(&mut self, now_s: f64) {
        let acting = self.acting(now_s);
        self.channel.link_mut().set(acting);
        if acting.gps_enable < 0.5 {
            self.gps_lost_since_s.get_or_insert(now_s);
        } else {
            self.gps_lost_since_s = None;
        }
        let Some(key) = self.settings.signing_key else { return };
        let wrong = acting.signing_key_wrong >= 0.5;
        if wrong != self.wrong_key {
            let timestamp = self.channel.signer_mut().timestamp();
            let key = if wrong { key.map(|b| !b) } else { key };
            *self.channel.signer_mut() = Signer::new(SigningMode::Require, key, 1, timestamp);
            self.wrong_key = wrong;
        }
    }

    /// What the autopilot believes at a time, faults included, and where that is on earth.
    fn reported(&self, now_s: f64) -> (Sample, Geodetic) {
        let acting = self.acting(now_s);
        let mut s = self.flight.reported.at(self.flight_s(now_s));
        if let Some(since) = self.gps_lost_since_s {
            s.position += DVec3::new(0.8, 0.6, 0.1) * (0.5 * DRIFT_MS2 * (now_s - since).powi(2)).min(300.0);
        }
        let mut at = self.frame.to_geodetic(s.position);
        at.lat_deg += f64::from(acting.gps_glitch_lat_deg);
        at.lon_deg += f64::from(acting.gps_glitch_lon_deg);
        at.alt_m += f64::from(acting.gps_glitch_alt_m);
        (s, at)
    }

    /// An attitude as it is sent: perhaps false, perhaps with a NaN (returned as the index of that component).
    fn spoil(&self, q: DQuat, id: u32, count: u64, now_s: f64) -> (DQuat, Option<usize>) {
        let (acting, seed) = (self.acting(now_s), self.settings.seed);
        let mut q = q;
        if strikes(acting.attitude_spike_pct, seed, About::Spike, id, count) {
            let b = bits(seed, About::Spike, id, count);
            let axis =
                DVec3::new((b & 255) as f64 - 127.5, ((b >> 8) & 255) as f64 - 127.5, ((b >> 16) & 255) as f64 - 127.5);
            q = DQuat::from_axis_angle(axis.normalize(), f64::from(acting.attitude_spike_deg).to_radians()) * q;
        }
        let nan = strikes(acting.nan_pct, seed, About::Nan, id, count);
        (q, nan.then(|| (bits(seed, About::Nan, id, count) & 3) as usize))
    }

    fn say(&mut self, id: u32, count: u64, now_s: f64) -> Result<(), HalError> {
        let boot_ms = (self.boot_us(now_s) / 1000) as u32;
        match id {
            HEARTBEAT_DATA::ID => {
                let wall = timestamp_of_unix_us(self.unix_us(now_s));
                self.channel.signer_mut().advance_to(wall);
                self.channel.send(&announce::heartbeat(self.settings.announcing, !self.landed))
            }
            EXTENDED_SYS_STATE_DATA::ID => {
                let landed_state = if self.landed || self.takeoff_s.is_none() {
                    MavLandedState::MAV_LANDED_STATE_ON_GROUND
                } else {
                    MavLandedState::MAV_LANDED_STATE_IN_AIR
                };
                self.channel.send(&EXTENDED_SYS_STATE_DATA { landed_state, ..Default::default() })
            }
            FORGED_HEARTBEAT if self.acting(now_s).forged_disarm >= 0.5 => {
                self.channel.send(&announce::heartbeat(self.settings.announcing, false))
            }
            SYSTEM_TIME_DATA::ID => {
                let lost = self.acting(now_s).unix_time_lost >= 0.5;
                let time_unix_usec = if lost { 0 } else { self.unix_us(now_s) };
                self.channel.send(&SYSTEM_TIME_DATA { time_unix_usec, time_boot_ms: boot_ms })
            }
            TIMESYNC_DATA::ID => {
                let ts1 = self.boot_us(now_s) as i64 * 1000;
                self.channel.send(&TIMESYNC_DATA { tc1: 0, ts1, ..Default::default() })
            }
            GPS_RAW_INT_DATA::ID => {
                let (s, at) = self.reported(now_s);
                let fix = self.gps_lost_since_s.is_none();
                self.channel.send(&messages::gps(self.unix_us(now_s), &s, at, fix, self.settings.gps_sigma_m))
            }
            GLOBAL_POSITION_INT_DATA::ID => {
                let (s, at) = self.reported(now_s);
                self.channel.send(&messages::position(boot_ms, &s, at, &self.frame))
            }
            ATTITUDE_QUATERNION_DATA::ID => {
                let flight_s = self.flight_s(now_s);
                let (q, nan) = self.spoil(self.flight.reported.at(flight_s).attitude, id, count, now_s);
                let mut message = messages::attitude(boot_ms, q, self.flight.reported.rates(flight_s));
                let fields = [&mut message.q1, &mut message.q2, &mut message.q3, &mut message.q4];
                if let Some(k) = nan {
                    *fields[k] = f32::NAN;
                }
                self.channel.send(&message)
            }
            GIMBAL_DEVICE_ATTITUDE_STATUS_DATA::ID => {
                let (q, nan) = self.spoil(self.flight.reported.at(self.flight_s(now_s)).gimbal, id, count, now_s);
                let mut message = messages::gimbal(boot_ms, q);
                if let Some(k) = nan {
                    message.q[k] = f32::NAN;
                }
                self.channel.send(&message)
            }
            SIM_STATE_DATA::ID => {
                let flight_s = self.flight_s(now_s);
                let s = self.flight.truth.at(flight_s);
                let at = self.frame.to_geodetic(s.position);
                self.channel.send(&messages::sim_state(&s, at, self.flight.truth.rates(flight_s)))
            }
            _ => Ok(()),
        }
    }
}
