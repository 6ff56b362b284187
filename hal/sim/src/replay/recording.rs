//! A telemetry log read into memory: the vehicle's own frames with their times, its truth, and its exposures on its
//! boot clock.

use std::path::Path;
use std::time::Duration;

use geometry::geodesy::{EnuFrame, Geodetic};
use glam::DQuat;

use crate::SimError;
use crate::messages;
use crate::track::{Sample, Track};
use hal::frames::{euler_to_ned, yaw_of_ned};
use hal::link::TlogLink;
use hal::mavlink::dialect::{
    CAMERA_FEEDBACK_DATA, GIMBAL_DEVICE_ATTITUDE_STATUS_DATA, GLOBAL_POSITION_INT_DATA, GimbalDeviceFlags,
    HEARTBEAT_DATA, MavAutopilot, SIM_STATE_DATA, SYSTEM_TIME_DATA,
};
use hal::mavlink::{Frame, Framer};
use hal::traits::Link;

/// Larger logs are refused before they are read: 1 GiB is a day of telemetry.
const LARGEST_LOG: u64 = 1 << 30;
/// CAMERA_FEEDBACK times above this are Unix µs, below it boot µs.
const UNIX_US: u64 = 1_000_000_000_000_000;

/// One frame as it was recorded.
pub(super) struct Record {
    /// Seconds since the first record, on the recorder's clock.
    pub time_s: f64,
    /// Start and end in [`Recording::bytes`].
    pub range: (usize, usize),
}

/// A log in memory.
pub struct Recording {
    pub(super) records: Vec<Record>,
    pub(super) bytes: Vec<u8>,
    /// Recorder's seconds and the vehicle's boot seconds, both growing.
    pub(super) clock: Vec<(f64, f64)>,
    /// Ids of the autopilot.
    pub(super) ids: (u8, u8),
    /// Home: position at the first fix, at ground level.
    pub home: Geodetic,
    /// Truth by boot seconds, ENU around `home`; `None` when the log holds no SIM_STATE.
    pub truth: Option<Track>,
    /// Exposures: boot seconds and counter.
    pub exposures: Vec<(f64, u16)>,
    /// Stretches of the log that were no record.
    pub damaged: u64,
    /// The log ended inside a record.
    pub truncated: bool,
}

/// Gimbal attitude, and whether its yaw is against north (else against the vehicle's heading).
type GimbalAttitude = (DQuat, bool);

/// What is collected while reading.
#[derive(Default)]
struct Reader {
    boot_s: f64,
    unix_minus_boot_us: Option<i128>,
    home: Option<Geodetic>,
    gimbal: Option<GimbalAttitude>,
    states: Vec<(f64, SIM_STATE_DATA, Option<GimbalAttitude>)>,
    feedbacks: Vec<(f64, CAMERA_FEEDBACK_DATA)>,
    clock: Vec<(f64, f64)>,
    ids: Option<(u8, u8)>,
}

impl Reader {
    fn take(&mut self, time_s: f64, frame: &Frame<'_>) {
        if let Some(m) = frame.message::<HEARTBEAT_DATA>() {
            if m.autopilot != MavAutopilot::MAV_AUTOPILOT_INVALID {
                self.ids.get_or_insert((frame.system(), frame.component()));
            }
        } else if let Some(m) = frame.message::<GLOBAL_POSITION_INT_DATA>() {
            self.boot_s = f64::from(m.time_boot_ms) / 1000.0;
            if self.clock.last().is_none_or(|(t, b)| *t < time_s && *b < self.boot_s) {
                self.clock.push((time_s, self.boot_s));
            }
            if m.lat != 0 || m.lon != 0 {
                let alt_m = (f64::from(m.alt) - f64::from(m.relative_alt)) / 1000.0;
                self.home.get_or_insert(Geodetic { lat_deg: degrees(m.lat), lon_deg: degrees(m.lon), alt_m });
            }
        } else if let Some(m) = frame.message::<SYSTEM_TIME_DATA>() {
            if m.time_unix_usec > UNIX_US {
                self.unix_minus_boot_us = Some(i128::from(m.time_unix_usec) - i128::from(m.time_boot_ms) * 1000);
            }
        } else if let Some(m) = frame.message::<GIMBAL_DEVICE_ATTITUDE_STATUS_DATA>() {
            let q = DQuat::from_xyzw(m.q[1].into(), m.q[2].into(), m.q[3].into(), m.q[0].into());
            let earth = m.flags.contains(GimbalDeviceFlags::GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME)
                || (m.flags.contains(GimbalDeviceFlags::GIMBAL_DEVICE_FLAGS_YAW_LOCK)
                    && !m.flags.contains(GimbalDeviceFlags::GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME));
            if q.is_finite() && q.length() > 0.5 {
                self.gimbal = Some((q.normalize(), earth));
            }
        } else if let Some(m) = frame.message::<SIM_STATE_DATA>() {
            // It has no time of its own; ArduPilot sends it right after the position of the same moment.
            if self.boot_s > 0.0 && self.states.last().is_none_or(|s| s.0 < self.boot_s) {
                self.states.push((self.boot_s, m, self.gimbal));
            }
        } else if let Some(m) = frame.message::<CAMERA_FEEDBACK_DATA>() {
            self.feedbacks.push((self.boot_s, m));
        }
    }

    /// Boot seconds of an announced exposure.
    fn exposure(&self, heard_at_s: f64, m: &CAMERA_FEEDBACK_DATA) -> f64 {
        match self.unix_minus_boot_us {
            Some(offset) if m.time_usec > UNIX_US => (i128::from(m.time_usec) - offset) as f64 / 1e6,
            // 32-bit boot µs: the wrap that comes closest to when it was heard.
            _ if m.time_usec <= u64::from(u32::MAX) => {
                let wrap = 4_294.967_296;
                let us = m.time_usec as f64 / 1e6;
                us + wrap * ((heard_at_s - us) / wrap).round()
            }
            _ => heard_at_s,
        }
    }
}

fn degrees(e7: i32) -> f64 {
    f64::from(e7) * 1e-7
}

/// The true state in one SIM_STATE.
fn sample(boot_s: f64, m: &SIM_STATE_DATA, gimbal: Option<GimbalAttitude>, frame: &EnuFrame) -> Sample {
    let (at, attitude, velocity) = messages::truth(m);
    let heading = DQuat::from_rotation_z(yaw_of_ned(attitude));
    let gimbal = match gimbal {
        Some((q, true)) => q,
        Some((q, false)) => heading * q,
        None => heading * euler_to_ned(0.0, -std::f64::consts::FRAC_PI_2, 0.0),
    };
    Sample { time_s: boot_s, position: frame.to_enu(at), velocity, attitude, gimbal }
}

impl Recording {
    /// Reads the log at `path`. Damaged stretches are passed over and counted.
    ///
    /// # Errors
    /// A file that cannot be read, is larger than 1 GiB, or holds no autopilot with a position.
    pub fn read(path: &Path) -> Result<Self, SimError> {
        let at = |source| SimError::Folder { path: path.into(), source };
        let wrong =
            |why: String| SimError::Settings { what: "telemetry log", why: format!("{}: {why}", path.display()) };
        let size = std::fs::metadata(path).map_err(at)?.len();
        if size > LARGEST_LOG {
            return Err(wrong(format!("{size} bytes, at most {LARGEST_LOG} are read; cut it")));
        }
        let mut log = TlogLink::open(path)?;
        let mut framer = Framer::new();
        let (mut records, mut bytes, mut reader) = (Vec::new(), Vec::new(), Reader::default());
        let mut first_ns = None;
        while let Ok(received) = log.read(framer.space(), Duration::ZERO) {
            framer.filled(received.bytes);
            let Some(ns) = received.time_ns else { continue };
            let time_s = (ns as f64 - *first_ns.get_or_insert(ns as f64)) / 1e9;
            while let Some(frame) = framer.next_frame() {
                reader.take(time_s, &frame);
                let start = bytes.len();
                bytes.extend_from_slice(frame.bytes());
                records.push(Record { time_s, range: (start, bytes.len()) });
            }
        }
        let (Some(ids), Some(home)) = (reader.ids, reader.home) else {
            return Err(wrong("no autopilot with a position in it; give a .tlog of a flight".into()));
        };
        let frame = EnuFrame::new(home);
        let truth = Track::new(reader.states.iter().map(|(t, m, g)| sample(*t, m, *g, &frame)).collect());
        let exposures = reader.feedbacks.iter().map(|(t, m)| (reader.exposure(*t, m), m.img_idx)).collect();
        let truncated = log.truncated();
        Ok(Self { records, bytes, clock: reader.clock, ids, home, truth, exposures, damaged: log.damaged(), truncated })
    }

    /// The vehicle's boot time when the recorder's clock showed `time_s`, seconds.
    pub fn boot_s(&self, time_s: f64) -> f64 {
        let k = self.clock.partition_point(|c| c.0 <= time_s).clamp(1, self.clock.len().max(2) - 1);
        let (Some(a), Some(b)) = (self.clock.get(k - 1), self.clock.get(k)) else {
            return self.clock.first().map_or(time_s, |c| c.1 + time_s - c.0);
        };
        a.1 + (time_s - a.0) * (b.1 - a.1) / (b.0 - a.0)
    }

    /// Length on the recorder's clock, seconds.
    pub fn length_s(&self) -> f64 {
        self.records.last().map_or(0.0, |r| r.time_s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use hal::mavlink::Encoder;

    #[test]
    fn heights_at_the_ends_of_their_numbers_are_no_overflow() {
        let mut encoder = Encoder::new(1, 1);
        let beat = encoder.encode(&HEARTBEAT_DATA::default(), None).to_vec();
        let far = GLOBAL_POSITION_INT_DATA { lat: 1, alt: i32::MAX, relative_alt: i32::MIN, ..Default::default() };
        let mut log = Vec::new();
        for (us, frame) in [beat, encoder.encode(&far, None).to_vec()].into_iter().enumerate() {
            log.extend(1_700_000_000_000_000_u64.wrapping_add(us as u64).to_be_bytes());
            log.extend(frame);
        }
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("far.tlog");
        std::fs::write(&path, log).expect("written");
        let home = Recording::read(&path).expect("two messages").home;
        assert_eq!(home.alt_m, (f64::from(i32::MAX) - f64::from(i32::MIN)) / 1000.0);
    }
}
